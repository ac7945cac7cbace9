// Gradients of the blending, front to back, with the layout of blend.cu: a warp owns 8x8 pixels, a thread two of them.
//
// The words of the forward pass say which splats a warp must look at: no culling again. A splat's 16 sums are reduced over
// the warp by a transposing reduction (16 shuffles), after which 16 lanes hold one sum each and add it to the splat's
// gradient record: one 64-byte line. The order of those additions varies from run to run, and with it the last digits.
#include "cuda/pixels.h"

namespace gs2d {

struct BlendVjpArguments {
    View view;
    const float* records;
    const uint* entries;
    const int64* ranges;
    const int* tiles;
    const uint* seen;
    const float *color, *alpha, *normal, *depth_mean, *distortion, *final_T, *moments;  // of the forward pass
    const float *g_color, *g_alpha, *g_normal, *g_depth_mean, *g_depth_median, *g_distortion;  // null: no gradient
    float* gradients;  // [N, 16], zeros on entry
    float* extras;     // [N, 4]: low-pass centre, absolute densification signal; zeros on entry
};

// One value of a plane that may be absent.
__device__ __forceinline__ float at_or_zero(const float* plane, int64 i) { return plane ? plane[i] : 0.f; }

// The upstream gradient as composite_vjp wants it, and S = the sum over all splats of w s, from the image's totals.
template <bool GEO, bool DIST>
__device__ __forceinline__ PixelGradient<float> upstream_of(const BlendVjpArguments& a, int64 i, float& S) {
    const float* bg = a.view.background;
    const float T = a.final_T[i], alpha = a.alpha[i];
    PixelGradient<float> g = {};
    g.red = at_or_zero(a.g_color, 3 * i), g.green = at_or_zero(a.g_color, 3 * i + 1), g.blue = at_or_zero(a.g_color, 3 * i + 2);
    g.alpha = fnma(g.red, bg[0], fnma(g.green, bg[1], fnma(g.blue, bg[2], at_or_zero(a.g_alpha, i))));
    S = fma(g.red, fnma(T, bg[0], a.color[3 * i]),
            fma(g.green, fnma(T, bg[1], a.color[3 * i + 1]), g.blue * fnma(T, bg[2], a.color[3 * i + 2])));
    if constexpr (GEO) {
        if (a.g_normal) {
            g.nx = a.g_normal[3 * i], g.ny = a.g_normal[3 * i + 1], g.nz = a.g_normal[3 * i + 2];
            S = fma(g.nx, a.normal[3 * i], fma(g.ny, a.normal[3 * i + 1], fma(g.nz, a.normal[3 * i + 2], S)));
        }
        // depth_mean = D / alpha: dD = g / alpha, dalpha = -g mean / alpha
        g.depth = at_or_zero(a.g_depth_mean, i) / (alpha > 0.f ? alpha : 1.f);
        g.alpha = fnma(g.depth, a.depth_mean[i], g.alpha);
        S = fma(g.depth, a.depth_mean[i] * alpha, S);
        g.median = at_or_zero(a.g_depth_median, i), g.median_below = max(T, 0.5f);
    }
    S = fma(g.alpha, alpha, S);
    if constexpr (DIST) {
        S = fma(2.f * a.g_distortion[i], a.distortion[i], S);  // each pair counts for both of its splats
        g.distortion = a.g_distortion[i] * a.view.distortion_scale, g.total = alpha;
        g.M1 = a.moments[3 * i], g.M2 = a.moments[3 * i + 1], g.inverse_depth0 = a.moments[3 * i + 2];
    }
    return g;
}

// One exchange of the transposing reduction: the lanes with `STEP` set keep the upper half of the values.
template <int WIDTH, int STEP> __device__ __forceinline__ void fold(float (&v)[16], int lane) {
    const bool upper = lane & STEP;
#pragma unroll
    for (int k = 0; k < WIDTH; ++k) {
        const float kept = upper ? v[k + WIDTH] : v[k], given = upper ? v[k] : v[k + WIDTH];
        v[k] = kept + __shfl_xor_sync(FULL_MASK, given, STEP);
    }
}

// Sum over the warp of value lane / 2.
__device__ __forceinline__ float transpose_reduce(float (&v)[16], int lane) {
    fold<8, 16>(v, lane), fold<4, 8>(v, lane), fold<2, 4>(v, lane), fold<1, 2>(v, lane);
    return v[0] + __shfl_xor_sync(FULL_MASK, v[0], 1);
}

__device__ __forceinline__ float sum_over_warp(float v) {
#pragma unroll
    for (int step = 16; step > 0; step >>= 1) v = v + __shfl_xor_sync(FULL_MASK, v, step);
    return v;
}

template <bool ABS>
__device__ __forceinline__ void add_gradient(const BlendVjpArguments& a, int64 splat, const RecordGradient<float>& g, int lane) {
    float v[16] = {g.cx, g.cy, g.au, g.bu, g.av, g.bv, g.az, g.bz, g.zc, g.ln_opacity, g.red, g.green, g.blue, g.nx, g.ny, g.nz};
    const float sum = transpose_reduce(v, lane);
    if (!(lane & 1)) atomicAdd(a.gradients + 16 * splat + (lane >> 1), sum);
    if (ABS || __any_sync(FULL_MASK, g.lowpass_cx != 0.f || g.lowpass_cy != 0.f)) {  // the same for all lanes
        const float x = sum_over_warp(g.lowpass_cx), y = sum_over_warp(g.lowpass_cy);
        float abs_x = 0.f, abs_y = 0.f;
        if constexpr (ABS) abs_x = sum_over_warp(g.abs_x), abs_y = sum_over_warp(g.abs_y);
        const float mine = lane == 0 ? x : lane == 1 ? y : lane == 2 ? abs_x : abs_y;
        if (lane < (ABS ? 4 : 2)) atomicAdd(a.extras + 4 * splat + lane, mine);
    }
}

template <bool GEO, bool DIST, bool ABS>
__device__ __forceinline__ void blend_vjp(const BlendVjpArguments& a, float4 (*records)[32]) {
    const Place at = place_of(a.view, a.tiles);
    const BlendLimits<float> limits = limits_of(a.view);
    PixelGradient<float> g[HALVES];
    float T[HALVES], S[HALVES];
#pragma unroll
    for (int h = 0; h < HALVES; ++h) {
        g[h] = {}, T[h] = 0.f, S[h] = 0.f;
        if (!at.inside[h]) continue;
        T[h] = 1.f;
        g[h] = upstream_of<GEO, DIST>(a, int64(at.y + 4 * h) * a.view.width + at.x, S[h]);
    }
    const float x = float(at.x) + 0.5f, y = float(at.y) + 0.5f;
    const int64 begin = a.ranges[2 * int64(at.tile)], end = a.ranges[2 * int64(at.tile) + 1];

    for (int64 i = begin; i < end; i += 32) {
        const uint* words = a.seen + word_of(begin, at.tile, (i - begin) >> 5);
        const uint hits[HALVES] = {words[at.sub_block[0]], words[at.sub_block[1]]};
        const uint wanted = hits[0] | hits[1];
        if (wanted == 0u) continue;  // the same for all lanes
        const uint entry = i + at.lane < end ? a.entries[i + at.lane] : 0u;
        if (wanted >> at.lane & 1u) {
            fetch_record(a.records, entry >> 8, records, at.lane);
            records[4][at.lane].x = __int_as_float(int(entry >> 8));
        }
        __syncwarp();
        for (uint todo = wanted; todo; todo &= todo - 1) {
            const int j = __ffs(int(todo)) - 1;
            const Record<float> s = record_of(records[0][j], records[1][j], records[2][j], records[3][j]);
            const float inverse_zc = DIST ? 1.f / s.zc : 0.f;
            PairSums<float> sums = {};
#pragma unroll
            for (int h = 0; h < HALVES; ++h) {
                if (!(hits[h] >> j & 1u)) continue;
                const float dx = x - s.cx, dy = y + float(4 * h) - s.cy;
                const Hit<float> hit = intersect(s, dx, dy, limits);
                composite_vjp<GEO, DIST, ABS>(s, inverse_zc, dx, dy, hit, limits, g[h], T[h], S[h], sums);
            }
            add_gradient<ABS>(a, __float_as_int(records[4][j].x), finish(s, sums, limits), at.lane);
        }
        __syncwarp();
    }
}

// GEO: normal or depth images have gradients (or the distortion has: DIST). ABS: the AbsGS signal is wanted.
extern "C" __global__ void __launch_bounds__(128) blend_vjp_color(BlendVjpArguments a) {
    __shared__ float4 records[4][5][32];  // warp, quarter of a record (and the row), entry
    blend_vjp<false, false, false>(a, records[threadIdx.x >> 5]);
}

extern "C" __global__ void __launch_bounds__(128) blend_vjp_color_abs(BlendVjpArguments a) {
    __shared__ float4 records[4][5][32];  // warp, quarter of a record (and the row), entry
    blend_vjp<false, false, true>(a, records[threadIdx.x >> 5]);
}

extern "C" __global__ void __launch_bounds__(128) blend_vjp_geometry(BlendVjpArguments a) {
    __shared__ float4 records[4][5][32];  // warp, quarter of a record (and the row), entry
    blend_vjp<true, false, false>(a, records[threadIdx.x >> 5]);
}

extern "C" __global__ void __launch_bounds__(128) blend_vjp_geometry_abs(BlendVjpArguments a) {
    __shared__ float4 records[4][5][32];  // warp, quarter of a record (and the row), entry
    blend_vjp<true, false, true>(a, records[threadIdx.x >> 5]);
}

extern "C" __global__ void __launch_bounds__(128) blend_vjp_distortion(BlendVjpArguments a) {
    __shared__ float4 records[4][5][32];  // warp, quarter of a record (and the row), entry
    blend_vjp<true, true, false>(a, records[threadIdx.x >> 5]);
}

extern "C" __global__ void __launch_bounds__(128) blend_vjp_distortion_abs(BlendVjpArguments a) {
    __shared__ float4 records[4][5][32];  // warp, quarter of a record (and the row), entry
    blend_vjp<true, true, true>(a, records[threadIdx.x >> 5]);
}

}  // namespace gs2d
