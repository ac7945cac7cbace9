// Gradients of colours only, for all or some splats, with everything else frozen (stage 2). A second blending pass
// recomputes the weights, without remaining sums, alpha or geometry. Splats that are not trained only affect the
// transmittance, and a warp stops after the last trained splat.
#include "cuda/colors.h"
#include "cuda/pixels.h"
#include "cuda/reduce.h"

namespace gs2d {

struct BlendColorsArguments {
    View view;
    const float* records;
    const uint* entries;
    const int64* ranges;
    const int* tiles;
    const uint* seen;
    const uchar* learns;   // [N], 0: no gradient; null: all have gradients
    const float* g_color;  // [H, W, 3]
    const int64* slots;    // as in blend_vjp.cu
    float* gradients;      // [N, 4]: colours and padding; zeros on entry; with slots [4 * candidates, 4]
    Pieces pieces;         // of the forward pass
};

struct ProjectColorsArguments {
    View view;
    int64 count, sh_rest;
    const float *means, *sh0, *shN;
    const int* tile_counts;  // [N]; 0: not drawn
    const uchar* learns;     // [N], 0: no gradient; or null
    float* gradients;        // [N, 4]
    float *g_sh0, *g_shN;    // null: not computed
    int clears;              // 1: reset the rows of gradients to zero
};

extern "C" __global__ void __launch_bounds__(128, 8) blend_vjp_learning(BlendColorsArguments a) {
    __shared__ float4 staged[4][4][32];  // warp, quarter of a record, entry
    __shared__ uint rows[4][32];
    const Part part = part_of(a.pieces, a.ranges, a.tiles);
    if (part.tile < 0) return;
    const Place at = place_of(a.view, part.tile);
    float4(*records)[32] = staged[at.warp];
    const BlendLimits<float> limits = limits_of(a.view);
    Vec3<float> g[HALVES];
    float T[HALVES];
#pragma unroll
    for (int h = 0; h < HALVES; ++h) {
        const float* from = a.g_color + 3 * (int64(at.y + 4 * h) * a.view.width + at.x);
        T[h] = at.inside[h] ? in_front(a.pieces, part, h, limits.transmittance_min) : 0.f;
        g[h] = at.inside[h] ? Vec3<float>{from[0], from[1], from[2]} : Vec3<float>{0.f, 0.f, 0.f};
    }
    const float x = float(at.x) + 0.5f, y = float(at.y) + 0.5f;
    const int64 begin = part.begin, end = begin + part.count;
    const auto learning = [&](int64 i, uint wanted) {  // returns which entries of the chunk are trained
        const bool mine = wanted >> at.lane & 1u && (!a.learns || a.learns[a.entries[i + at.lane] >> 8]);
        return __ballot_sync(FULL_MASK, mine);
    };
    const auto wanted_in = [&](int64 i, int h) {
        return uniform(a.seen[word_of(begin, at.tile, (i - begin) >> 5) + at.sub_block[h]], at.lane);
    };
    int64 last = begin;  // later chunks have no trained splats
    for (int64 i = begin; i < end; i += 32)
        if (learning(i, wanted_in(i, 0) | wanted_in(i, 1))) last = i + 1;

    for (int64 i = begin; i < last; i += 32) {
        const uint hits[HALVES] = {wanted_in(i, 0), wanted_in(i, 1)};
        const uint wanted = hits[0] | hits[1];
        if (wanted == 0u) continue;  // uniform over the warp
        const uint learn = learning(i, wanted);
        bool mine_is_plain = false;
        if (wanted >> at.lane & 1u) {
            const uint splat = a.entries[i + at.lane] >> 8;
            fetch_record(a.records, splat, records, at.lane);
            rows[at.warp][at.lane] = a.slots ? uint(a.slots[i + at.lane]) * 4u + uint(at.warp) : splat;
            mine_is_plain = plain_for_warp(a.view, at, records);
        }
        const uint plain = __ballot_sync(FULL_MASK, mine_is_plain);
        __syncwarp();
        for_each_splat(wanted, plain, [&](auto is_plain, int j, uint bit) {
            const Record<float> s = record_of(records[0][j], records[1][j], records[2][j], records[3][j]);
            const float dx = x - s.cx, dy = y - s.cy;
            PlaneAt<float> planes[HALVES];
            planes_of(s, dx, dy, planes);
            Vec3<float> sum = {0.f, 0.f, 0.f};
#pragma unroll
            for (int h = 0; h < HALVES; ++h) {
                if (!(hits[h] & bit)) continue;
                const Hit<float> hit = hit_of<decltype(is_plain)::value>(s, planes[h], dx, dy + float(4 * h), limits);
                composite_color_vjp(hit, limits, g[h], T[h], sum);
            }
            if (!(learn & bit)) return;  // uniform over the warp
            float v[4] = {sum.x, sum.y, sum.z, 0.f};
            const float mine = transpose_reduce<4>(v, at.lane);
            if (!(at.lane & 7)) atomicAdd(a.gradients + 4 * int64(rows[at.warp][j]) + (at.lane >> 3), mine);
        });
        __syncwarp();  // the records are overwritten in the next iteration
    }
}

extern "C" __global__ void __launch_bounds__(128) project_colors_vjp(ProjectColorsArguments a) {
    const int64 i = int64(blockIdx.x) * blockDim.x + threadIdx.x;
    if (i >= a.count) return;
    const int rest = int(a.sh_rest);
    const CoefficientGradients to = {a.g_sh0 ? a.g_sh0 + 3 * i : nullptr,
                                     a.g_shN ? a.g_shN + 3 * a.sh_rest * i : nullptr};
    if (a.tile_counts[i] == 0 || (a.learns && !a.learns[i])) {
        if (to.first) to.first[0] = to.first[1] = to.first[2] = 0.f;
        for (int k = 0; to.rest && k < 3 * rest; ++k) to.rest[k] = 0.f;
        return;
    }
    const float* m = a.means + 3 * i;
    float4* row = reinterpret_cast<float4*>(a.gradients) + i;
    const float4 g = *row;
    if (a.clears) *row = {0.f, 0.f, 0.f, 0.f};
    float inverse_distance;
    const Vec3<float> direction =
        direction_of(Vec3<float>{m[0], m[1], m[2]} - center_of<float>(a.view.camera), inverse_distance);
    const Coefficients sh = {a.sh0 + 3 * i, a.shN + 3 * a.sh_rest * i};
    color_vjp(a.view.sh_degree, sh, rest, to, direction, {g.x, g.y, g.z});
}

}  // namespace gs2d
