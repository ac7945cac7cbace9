// Splat errors with occlusion (rule 17): a pixel counts until it has stopped at or before the splat. The pass is the
// same as blending, with tile lists for the footprint rho <= error_k2. Sums are integers, so their order does not
// affect the result.
#include "cuda/pixels.h"
#include "cuda/reduce.h"

namespace gs2d {

typedef unsigned long long uint64;

struct OccludedArguments {
    View view;
    const float* records;  // from a projection with `errors` set
    const uint* entries;
    const int64* ranges;
    const int* tiles;
    const float* image;  // [H, W, 3]
    const uchar* mask;   // [H, W], 0 = ignore; or null
    uint64* errors;      // [N], in units of ERROR_UNIT; zeros on entry
};

constexpr float ERROR_UNIT = 1.f / (1 << 24);  // same value in cuda_passes.py
constexpr float MOST_ERROR = 1e9f;             // limit for a splat in the 64 pixels of a warp, prevents overflow

extern "C" __global__ void __launch_bounds__(128) splat_errors_occluded(OccludedArguments a) {
    __shared__ float4 staged[4][4][32];
    __shared__ uint splats[4][32];
    const Place at = place_of(a.view, a.tiles);
    float4(*records)[32] = staged[at.warp];
    const View& v = a.view;
    const BlendLimits<float> limits = limits_of(v);
    Vec3<float> target[HALVES];
    float T[HALVES];
    bool counts[HALVES];
#pragma unroll
    for (int h = 0; h < HALVES; ++h) {
        const int64 pixel = int64(at.y + 4 * h) * v.width + at.x;
        T[h] = at.inside[h] ? 1.f : 0.f;
        counts[h] = at.inside[h] && (!a.mask || a.mask[pixel]);
        target[h] =
            counts[h] ? Vec3<float>{a.image[3 * pixel], a.image[3 * pixel + 1], a.image[3 * pixel + 2]} : Vec3<float>{};
    }
    const float x = float(at.x) + 0.5f, y = float(at.y) + 0.5f;
    const int64 begin = a.ranges[2 * int64(at.tile)], end = a.ranges[2 * int64(at.tile) + 1];
    for (int64 i = begin; i < end; i += 32) {
        const uint entry = i + at.lane < end ? a.entries[i + at.lane] : 0u;
        uint hits[HALVES];
#pragma unroll
        for (int h = 0; h < HALVES; ++h) {
            const bool live = __any_sync(FULL_MASK, T[h] > 0.f);
            const uint touched = __ballot_sync(FULL_MASK, entry >> at.sub_block[h] & 1u);
            hits[h] = uniform(live ? touched : 0u, at.lane);
        }
        if (!__any_sync(FULL_MASK, T[0] > 0.f || T[1] > 0.f)) break;
        const uint wanted = hits[0] | hits[1];
        if (wanted >> at.lane & 1u) {
            splats[at.warp][at.lane] = entry >> 8;
            fetch_record(a.records, entry >> 8, records, at.lane);
        }
        __syncwarp();
        for (uint todo = wanted; todo; todo &= todo - 1) {
            const int j = __ffs(int(todo)) - 1;
            const uint bit = todo & (0u - todo);
            const Record<float> s = record_of(records[0][j], records[1][j], records[2][j], records[3][j]);
            const float zc = reciprocal(s.iz);
            float error = 0.f;
#pragma unroll
            for (int h = 0; h < HALVES; ++h) {
                if (!(hits[h] & bit)) continue;
                const Hit<float> hit = intersect(s, zc, x - s.cx, y + float(4 * h) - s.cy, limits);
                const float alpha = min(hit.alpha, limits.alpha_max), after = fnma(alpha, T[h], T[h]);
                const bool open = after >= limits.transmittance_min;
                T[h] = keep(open, after);  // stopped pixels stay at 0
                const bool covered = counts[h] && open && hit.rho <= v.error_k2 && hit.depth >= v.near;
                const Vec3<float> d = {abs(s.red - target[h].x), abs(s.green - target[h].y), abs(s.blue - target[h].z)};
                error = error + keep(covered, d.x + d.y + d.z);
            }
            const float sum = min(sum_over_warp(error), MOST_ERROR);
            if (at.lane == 0 && sum > 0.f) atomicAdd(a.errors + splats[at.warp][j], uint64(sum * (1.f / ERROR_UNIT)));
        }
        __syncwarp();  // the records are overwritten in the next iteration
    }
}

}  // namespace gs2d
