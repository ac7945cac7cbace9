// Depth by transmittance, after the blending and only on request, with the layout of blend.cu: a thread searches for
// its two pixels at once, and each step of the search is a pass over the pairs of the warp, selected by the words of
// the forward pass. A warp continues while one of its pixels does; the warps of a block never wait for each other.
#include "cuda/pixels.h"

namespace gs2d {

struct DepthArguments {
    View view;
    const float* records;
    const uint* entries;
    const int64* ranges;
    const int* tiles;
    const uint* seen;
    const float *alpha, *median;  // [H, W] from the blending; the median is the initial guess
    float *depth, *slope;         // [H, W]: depth at which half of alpha is reached; -dT/dz there
};

// Calls pair(half, alpha, inverse depth) for the pairs that the pixels of this thread have blended.
template <class F>
__device__ __forceinline__ void walk(const DepthArguments& a, const Place& at, const BlendLimits<float>& limits,
                                     float4 (*records)[32], F&& pair) {
    const float x = float(at.x) + 0.5f, y = float(at.y) + 0.5f;
    const int64 begin = a.ranges[2 * int64(at.tile)];
    const int count = int(a.ranges[2 * int64(at.tile) + 1] - begin);
    float T[HALVES] = {at.inside[0] ? 1.f : 0.f, at.inside[1] ? 1.f : 0.f};
    for (int chunk = 0; 32 * chunk < count; ++chunk) {
        const uint* words = a.seen + word_of(begin, at.tile, chunk);
        const uint hits[HALVES] = {uniform(words[at.sub_block[0]], at.lane), uniform(words[at.sub_block[1]], at.lane)};
        const uint wanted = hits[0] | hits[1];
        if (wanted == 0u) continue;  // uniform over the warp
        bool mine_is_plain = false;
        if (wanted >> at.lane & 1u) {
            fetch_record(a.records, a.entries[begin + 32 * chunk + at.lane] >> 8, records, at.lane);
            mine_is_plain = plain_for_warp(a.view, at, records);
        }
        const uint plain = __ballot_sync(FULL_MASK, mine_is_plain);
        __syncwarp();
        for_each_splat(wanted, plain, [&](auto is_plain, int j, uint bit) {
            const Record<float> s = record_of(records[0][j], records[1][j], records[2][j], records[3][j]);
            const float dx = x - s.cx, dy = y - s.cy;
            PlaneAt<float> planes[HALVES];
            planes_of(s, dx, dy, planes);
#pragma unroll
            for (int h = 0; h < HALVES; ++h) {
                if (!(hits[h] & bit)) continue;  // uniform over the warp
                const Hit<float> hit = hit_of<decltype(is_plain)::value>(s, planes[h], dx, dy + float(4 * h), limits);
                const float alpha = min(hit.alpha, limits.alpha_max), after = fnma(alpha, T[h], T[h]);
                const bool goes_on = after >= limits.transmittance_min;
                T[h] = keep(goes_on, after);
                pair(h, keep(goes_on, alpha), hit.inverse_depth);
            }
        });
        __syncwarp();  // the records are overwritten in the next iteration
    }
}

extern "C" __global__ void __launch_bounds__(128, 7) transmittance_depth(DepthArguments a) {
    __shared__ float4 staged[4][4][32];
    const Place at = place_of(a.view, a.tiles);
    float4(*records)[32] = staged[at.warp];
    const BlendLimits<float> limits = limits_of(a.view);
    const float inv_width = a.view.inv_depth_width;
    float least[HALVES], most[HALVES], level[HALVES], first[HALVES];
    Transmittance<float> t[HALVES];
#pragma unroll
    for (int h = 0; h < HALVES; ++h) {
        const int64 i = int64(at.y + 4 * h) * a.view.width + at.x;
        level[h] = at.inside[h] ? fnma(0.5f, a.alpha[i], 1.f) : 1.f, first[h] = at.inside[h] ? a.median[i] : 0.f;
        least[h] = 1e30f, most[h] = 0.f, t[h] = {1.f, 0.f};
    }
    walk(a, at, limits, records, [&](int h, float alpha, float inverse_depth) {
        least[h] = alpha > 0.f ? min(least[h], inverse_depth) : least[h];
        most[h] = alpha > 0.f ? max(most[h], inverse_depth) : most[h];
        pass_pair(alpha, inverse_depth, first[h], inv_width, t[h]);
    });
    DepthSearch<float> search[HALVES];
#pragma unroll
    for (int h = 0; h < HALVES; ++h) {
        search[h] = begin_search(first[h], least[h], most[h], inv_width, level[h] < 1.f);
        advance(t[h], level[h], inv_width, SEARCH_TOLERANCE<float>, search[h]);
    }
    for (int step = 1; step < MAX_SEARCH_STEPS && __any_sync(FULL_MASK, search[0].open || search[1].open); ++step) {
        t[0] = {1.f, 0.f}, t[1] = {1.f, 0.f};
        walk(a, at, limits, records, [&](int h, float alpha, float inverse_depth) {
            pass_pair(alpha, inverse_depth, search[h].z, inv_width, t[h]);
        });
#pragma unroll
        for (int h = 0; h < HALVES; ++h) advance(t[h], level[h], inv_width, SEARCH_TOLERANCE<float>, search[h]);
    }
#pragma unroll
    for (int h = 0; h < HALVES; ++h) {
        if (!at.inside[h]) continue;
        const int64 i = int64(at.y + 4 * h) * a.view.width + at.x;
        const bool hit = level[h] < 1.f;
        a.depth[i] = hit ? search[h].z : 0.f;
        a.slope[i] = hit ? slope_of(search[h].fall, a.alpha[i], search[h].z, inv_width) : 1.f;
    }
}

}  // namespace gs2d
