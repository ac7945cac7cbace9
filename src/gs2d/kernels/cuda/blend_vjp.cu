// Gradients of the blending, front to back, with the layout of blend.cu: a warp has 8x8 pixels, a thread two of them.
//
// The mask words of the forward pass select the splats of a warp, without repeated culling. The 16 sums of a splat are
// reduced over the warp by a transposing reduction (16 shuffles). Then 16 lanes hold one sum each and add it to the
// gradient record of the splat, a line of 64 bytes. The order of these additions, and thus the last digits, vary
// between runs.
#include "cuda/pixels.h"
#include "cuda/reduce.h"

namespace gs2d {

struct BlendVjpArguments {
    View view;
    const float* records;
    const uint* entries;
    const int64* ranges;
    const int* tiles;
    const uint* seen;
    const float *color, *alpha, *normal, *depth_mean, *distortion, *final_T, *moments;         // of the forward pass
    const float *g_color, *g_alpha, *g_normal, *g_depth_mean, *g_depth_median, *g_distortion;  // null: no gradient
    const uchar* learns;  // [N], 0: no gradient; null: all have gradients
    const int64* slots;   // [entries]: candidate index of each entry, or null
    float* gradients;     // [N, 16], zeros on entry; with slots [4 * candidates, 16]
    float* extras;        // low-pass centre and absolute densification signal: 4 columns, same rows as `gradients`
    const float *depth_transmittance, *slope, *g_depth_transmittance;  // from transmittance.cu; TRANS only
    Features features;  // FEAT only: `learns` is null; with slots features.gradients is [4 * candidates, F]
    Pieces pieces;      // of the forward pass; FEAT needs whole lists
};

// Returns a value of a plane, 0 if the plane is null.
__device__ __forceinline__ float at_or_zero(const float* plane, int64 i) { return plane ? plane[i] : 0.f; }

// Computes the upstream gradient for composite_vjp, and S = the sum of w s over all splats, from the image totals.
template <bool GEO, bool DIST, bool TRANS, bool FEAT>
__device__ __forceinline__ PixelGradient<float> upstream_of(const BlendVjpArguments& a, int64 i, float& S) {
    const float* bg = a.view.background;
    const float T = a.final_T[i], alpha = a.alpha[i];
    PixelGradient<float> g = {};
    g.red = at_or_zero(a.g_color, 3 * i), g.green = at_or_zero(a.g_color, 3 * i + 1),
    g.blue = at_or_zero(a.g_color, 3 * i + 2);
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
    if constexpr (FEAT)
        for (int64 c = 0, k = i; c < a.features.count; ++c, k += int64(a.view.width) * a.view.height) {
            const float up = a.features.upstream[k], behind = a.features.background[c];
            g.alpha = fnma(up, behind, g.alpha);
            S = fma(up, fnma(T, behind, a.features.images[k]), S);
        }
    if constexpr (TRANS)
        add_transmittance(a.g_depth_transmittance[i], a.depth_transmittance[i], a.slope[i], alpha, g);
    S = fma(g.alpha, alpha, S);
    if constexpr (DIST) {
        S = fma(2.f * a.g_distortion[i], a.distortion[i], S);  // a pair contributes to both of its splats
        add_distortion(a.g_distortion[i] * a.view.distortion_scale, alpha, a.moments[3 * i], a.moments[3 * i + 1], g);
        g.inverse_depth0 = a.moments[3 * i + 2];
    }
    return g;
}

// Returns the sum of w s over the splats in front of this block's piece.
template <bool GEO, bool DIST>
__device__ __forceinline__ float sum_in_front(const Pieces& pieces, int h, const PixelGradient<float>& g) {
    Pixel<float> p;
    for_each_sum<DIST>(p, [&](int k, float& v) { v = state_of(pieces, blockIdx.x, k, h); });
    float S = fma(g.red, p.red, fma(g.green, p.green, fma(g.blue, p.blue, g.alpha * p.alpha)));
    if constexpr (GEO) S = fma(g.nx, p.nx, fma(g.ny, p.ny, fma(g.nz, p.nz, fma(g.depth, p.depth, S))));
    if constexpr (DIST) S = fma(g.distortion2, p.M2, fma(g.distortion1, 0.5f * p.M1_twice, S));
    return S;
}

// `row` is the splat, or with slots the slot of this entry and warp.
template <bool ABS, bool PLAIN>
__device__ __forceinline__ void add_gradient(const BlendVjpArguments& a, int64 row, const RecordGradient<float>& g,
                                             int lane) {
    float v[16] = {g.cx, g.cy,         g.au,  g.bu,    g.av,   g.bv, g.ai, g.bi,
                   g.iz, g.ln_opacity, g.red, g.green, g.blue, g.nx, g.ny, g.nz};
    const float sum = transpose_reduce<16>(v, lane);
    if (!(lane & 1)) atomicAdd(a.gradients + 16 * row + (lane >> 1), sum);
    if constexpr (PLAIN && !ABS) return;  // plain splats do not use the low-pass filter
    if constexpr (ABS) {
        float extra[4] = {g.lowpass_cx, g.lowpass_cy, g.abs_x, g.abs_y};
        const float mine = transpose_reduce<4>(extra, lane);
        if (!(lane & 7)) atomicAdd(a.extras + 4 * row + (lane >> 3), mine);
    } else if (__any_sync(FULL_MASK, g.lowpass_cx != 0.f || g.lowpass_cy != 0.f)) {  // uniform over the warp
        float extra[2] = {g.lowpass_cx, g.lowpass_cy};
        const float mine = transpose_reduce<2>(extra, lane);
        if (!(lane & 15)) atomicAdd(a.extras + 4 * row + (lane >> 4), mine);
    }
}

// The upstream gradients of the inner loop, in shared memory; each thread reads only its own values.
template <bool GEO, bool TRANS = false> struct Upstream {
    float4 color[HALVES][128];             // red, green, blue, alpha
    float4 normal[HALVES][GEO ? 128 : 1];  // normal and depth
    float2 median[HALVES][GEO ? 128 : 1];  // median and median_below
    float2 depth[HALVES][TRANS ? 128 : 1];  // depth by transmittance: factor and depth
    __device__ __forceinline__ void put(int h, const PixelGradient<float>& g) {
        color[h][threadIdx.x] = {g.red, g.green, g.blue, g.alpha};
        if constexpr (!GEO) return;
        const int i = GEO ? threadIdx.x : 0;
        normal[h][i] = {g.nx, g.ny, g.nz, g.depth}, median[h][i] = {g.median, g.median_below};
        if constexpr (TRANS) depth[h][threadIdx.x] = {g.transmittance, g.z};
    }
    __device__ __forceinline__ void get(int h, PixelGradient<float>& g) const {
        const float4 c = color[h][threadIdx.x];
        g.red = c.x, g.green = c.y, g.blue = c.z, g.alpha = c.w;
        if constexpr (!GEO) return;
        const int i = GEO ? threadIdx.x : 0;
        const float4 n = normal[h][i];
        const float2 m = median[h][i];
        g.nx = n.x, g.ny = n.y, g.nz = n.z, g.depth = n.w, g.median = m.x, g.median_below = m.y;
        if constexpr (TRANS) g.transmittance = depth[h][threadIdx.x].x, g.z = depth[h][threadIdx.x].y;
    }
};

struct Staged {  // 32 splats of a warp
    float4 records[4][32];
    uint rows[32];
};

// Shared-memory values for the pairs of PART splats: first the features' part of dL/dw, then the weight.
constexpr int PART = 16;
using PairValues = float (*)[HALVES][128];
__device__ __forceinline__ float& value_of(PairValues values, int j, int h) {
    return values[j & (PART - 1)][h][threadIdx.x];
}

// Calls step(first channel, upstream gradients of the thread's pixels) for CHANNELS channels at a time.
template <class F>
__device__ __forceinline__ void for_each_channels(const BlendVjpArguments& a, const Place& at, F&& step) {
    const int64 pixels = int64(a.view.width) * a.view.height, i = int64(at.y) * a.view.width + at.x;
    for (int64 c = 0; c < a.features.count; c += CHANNELS) {
        float g[HALVES][CHANNELS];
#pragma unroll
        for (int h = 0; h < HALVES; ++h)
#pragma unroll
            for (int k = 0; k < CHANNELS; ++k)
                g[h][k] = at.inside[h] ? a.features.upstream[(c + k) * pixels + i + 4 * h * a.view.width] : 0.f;
        step(c, g);
    }
}

// Computes the features' part of dL/dw of each selected splat; each gradient of a pixel is read once for all splats.
__device__ __forceinline__ void weigh_features(const BlendVjpArguments& a, const Place& at, const Staged& staged,
                                               uint wanted, PairValues to) {
    for (int j = 0; j < PART; ++j) value_of(to, j, 0) = value_of(to, j, 1) = 0.f;
    for_each_channels(a, at, [&](int64 c, const float (&g)[HALVES][CHANNELS]) {
        for (uint left = wanted; left; left &= left - 1) {
            const int j = __ffs(int(left)) - 1;
            const float* values = a.features.values + int64(staged.rows[j]) * a.features.count + c;
            float v[CHANNELS];
#pragma unroll
            for (int k = 0; k < CHANNELS; k += 4) {
                const float4 four = *reinterpret_cast<const float4*>(values + k);
                v[k] = four.x, v[k + 1] = four.y, v[k + 2] = four.z, v[k + 3] = four.w;
            }
#pragma unroll
            for (int h = 0; h < HALVES; ++h) {
                float sum = value_of(to, j, h);
#pragma unroll
                for (int k = 0; k < CHANNELS; ++k) sum = fma(v[k], g[h][k], sum);
                value_of(to, j, h) = sum;
            }
        }
    });
}

// Returns the row of `gradients` and `extras` for splat j of a chunk: with slots, the row of this entry and warp.
template <bool FEAT>
__device__ __forceinline__ int64 gradient_row(const BlendVjpArguments& a, const Place& at, const Staged& staged,
                                              int64 chunk, int j) {
    if (FEAT && a.slots) return 4 * a.slots[chunk + j] + at.warp;
    return staged.rows[j];
}

// Adds the feature gradients of the selected splats, from their weights. `chunk` is the first entry of the chunk.
__device__ __forceinline__ void add_features(const BlendVjpArguments& a, const Place& at, const Staged& staged,
                                             int64 chunk, uint wanted, PairValues weights) {
    for_each_channels(a, at, [&](int64 c, const float (&g)[HALVES][CHANNELS]) {
        for (uint left = wanted; left; left &= left - 1) {  // uniform over the warp
            const int j = __ffs(int(left)) - 1;
            const float first = value_of(weights, j, 0), second = value_of(weights, j, 1);
            float v[CHANNELS];
#pragma unroll
            for (int k = 0; k < CHANNELS; ++k) v[k] = fma(first, g[0][k], second * g[1][k]);
            const float mine = transpose_reduce<CHANNELS>(v, at.lane);
            float* row = a.features.gradients + gradient_row<true>(a, at, staged, chunk, j) * a.features.count + c;
            if (at.lane % (32 / CHANNELS) == 0) atomicAdd(row + at.lane / (32 / CHANNELS), mine);
        }
    });
}

template <bool GEO, bool DIST, bool ABS, bool TRANS = false, bool FEAT = false>
__device__ __forceinline__ void blend_vjp(const BlendVjpArguments& a, Staged& staged, Upstream<GEO, TRANS>& upstream,
                                          PairValues pairs = nullptr) {
    const Pieces pieces = FEAT ? Pieces{} : a.pieces;
    const Part part = part_of(pieces, a.ranges, a.tiles);
    if (part.tile < 0) return;
    const Place at = place_of(a.view, part.tile);
    const BlendLimits<float> limits = limits_of(a.view);
    PixelGradient<float> g[HALVES];  // registers hold only members that are not in `upstream`
    float T[HALVES], S[HALVES];
#pragma unroll
    for (int h = 0; h < HALVES; ++h) {
        g[h] = {}, T[h] = 0.f, S[h] = 0.f;
        if (at.inside[h]) {
            T[h] = in_front(pieces, part, h, limits.transmittance_min);
            g[h] = upstream_of<GEO, DIST, TRANS, FEAT>(a, int64(at.y + 4 * h) * a.view.width + at.x, S[h]);
            if (part.pieces > 1) S[h] = S[h] - sum_in_front<GEO, DIST>(pieces, h, g[h]);
        }
        upstream.put(h, g[h]);
    }
    const float x = float(at.x) + 0.5f, y = float(at.y) + 0.5f;
    const int begin = part.begin, count = part.count;

    for (int chunk = 0; 32 * chunk < count; ++chunk) {
        const int i = begin + 32 * chunk;
        const uint* words = a.seen + word_of(begin, part.tile, chunk);
        const uint hits[HALVES] = {uniform(words[at.sub_block[0]], at.lane), uniform(words[at.sub_block[1]], at.lane)};
        const uint wanted = hits[0] | hits[1];
        if (wanted == 0u) continue;  // uniform over the warp
        bool learns = true, mine_is_plain = false;
        if (wanted >> at.lane & 1u) {
            const uint splat = a.entries[i + at.lane] >> 8;
            if (a.learns) learns = a.learns[splat];
            fetch_record(a.records, splat, staged.records, at.lane);
            // Feature values are read by splat, so the feature code looks up the slot when it writes.
            staged.rows[at.lane] = !FEAT && a.slots ? uint(a.slots[i + at.lane]) * 4u + uint(at.warp) : splat;
            mine_is_plain = plain_for_warp(a.view, at, staged.records);
        }
        const uint plain = __ballot_sync(FULL_MASK, mine_is_plain);
        const uint learning = __ballot_sync(FULL_MASK, learns);
        __syncwarp();
        const auto step = [&](auto is_plain, int j, uint bit) {
            constexpr bool PLAIN = decltype(is_plain)::value;
            const auto& r = staged.records;
            const Record<float> s = record_of(r[0][j], r[1][j], r[2][j], r[3][j]);
            const float dx = x - s.cx, first_dy = y - s.cy;
            PlaneAt<float> planes[HALVES];
            planes_of(s, dx, first_dy, planes);
            PairSums<float> sums = {};
#pragma unroll
            for (int h = 0; h < HALVES; ++h) {
                if constexpr (FEAT)
                    if (!(hits[h] & bit)) value_of(pairs, j, h) = 0.f;
                if (!(hits[h] & bit)) continue;
                const float dy = first_dy + float(4 * h);
                const Hit<float> hit = hit_of<PLAIN>(s, planes[h], dx, dy, limits);
                upstream.get(h, g[h]);
                const float w = composite_vjp<GEO, DIST, ABS, TRANS, !PLAIN, true, FEAT>(
                    s, dx, dy, hit, limits, g[h], T[h], S[h], sums, FEAT ? value_of(pairs, j, h) : 0.f);
                if constexpr (FEAT) value_of(pairs, j, h) = w;
            }
            if (!(learning & bit)) return;  // uniform over the warp
            finish_column(dx, sums);
            const int64 row = gradient_row<FEAT>(a, at, staged, i, j);
            add_gradient<ABS, PLAIN>(a, row, finish(s, ABS ? reciprocal(s.iz) : 0.f, sums, limits), at.lane);
        };
        if constexpr (!FEAT) {
            for_each_splat(wanted, plain, step);
        } else {
            for (int first = 0; first < 32; first += PART) {
                const uint part = wanted & (((1u << PART) - 1u) << first);
                if (part == 0u) continue;  // uniform over the warp
                weigh_features(a, at, staged, part, pairs);
                for_each_splat(part, plain, step);
                add_features(a, at, staged, i, part, pairs);
            }
        }
        __syncwarp();  // the records are overwritten in the next iteration
    }
}

// Minimum blocks per multiprocessor; sm_75 has shared memory for three or four.
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ < 800
constexpr int BLOCKS = 4;
#else
constexpr int BLOCKS = 7;
#endif

// Outputs with gradients: GEO: normal or depth images (or the distortion, DIST); TRANS: depth by transmittance; FEAT:
// further channels. ABS: computes the AbsGS signal.
extern "C" __global__ void __launch_bounds__(128, BLOCKS) blend_vjp_color(BlendVjpArguments a) {
    __shared__ Staged staged[4];
    __shared__ Upstream<false> upstream;
    blend_vjp<false, false, false>(a, staged[threadIdx.x >> 5], upstream);
}

extern "C" __global__ void __launch_bounds__(128, BLOCKS) blend_vjp_color_abs(BlendVjpArguments a) {
    __shared__ Staged staged[4];
    __shared__ Upstream<false> upstream;
    blend_vjp<false, false, true>(a, staged[threadIdx.x >> 5], upstream);
}

extern "C" __global__ void __launch_bounds__(128, BLOCKS) blend_vjp_geometry(BlendVjpArguments a) {
    __shared__ Staged staged[4];
    __shared__ Upstream<true> upstream;
    blend_vjp<true, false, false>(a, staged[threadIdx.x >> 5], upstream);
}

extern "C" __global__ void __launch_bounds__(128, BLOCKS) blend_vjp_geometry_abs(BlendVjpArguments a) {
    __shared__ Staged staged[4];
    __shared__ Upstream<true> upstream;
    blend_vjp<true, false, true>(a, staged[threadIdx.x >> 5], upstream);
}

extern "C" __global__ void __launch_bounds__(128, 5) blend_vjp_distortion(BlendVjpArguments a) {
    __shared__ Staged staged[4];
    __shared__ Upstream<true> upstream;
    blend_vjp<true, true, false>(a, staged[threadIdx.x >> 5], upstream);
}

extern "C" __global__ void __launch_bounds__(128, 5) blend_vjp_distortion_abs(BlendVjpArguments a) {
    __shared__ Staged staged[4];
    __shared__ Upstream<true> upstream;
    blend_vjp<true, true, true>(a, staged[threadIdx.x >> 5], upstream);
}

extern "C" __global__ void __launch_bounds__(128, 5) blend_vjp_transmittance(BlendVjpArguments a) {
    __shared__ Staged staged[4];
    __shared__ Upstream<true, true> upstream;
    blend_vjp<true, false, false, true>(a, staged[threadIdx.x >> 5], upstream);
}

extern "C" __global__ void __launch_bounds__(128, 5) blend_vjp_transmittance_abs(BlendVjpArguments a) {
    __shared__ Staged staged[4];
    __shared__ Upstream<true, true> upstream;
    blend_vjp<true, false, true, true>(a, staged[threadIdx.x >> 5], upstream);
}

extern "C" __global__ void __launch_bounds__(128, 5) blend_vjp_distortion_transmittance(BlendVjpArguments a) {
    __shared__ Staged staged[4];
    __shared__ Upstream<true, true> upstream;
    blend_vjp<true, true, false, true>(a, staged[threadIdx.x >> 5], upstream);
}

extern "C" __global__ void __launch_bounds__(128, 5) blend_vjp_distortion_transmittance_abs(BlendVjpArguments a) {
    __shared__ Staged staged[4];
    __shared__ Upstream<true, true> upstream;
    blend_vjp<true, true, true, true>(a, staged[threadIdx.x >> 5], upstream);
}

extern "C" __global__ void __launch_bounds__(128, 4) features_vjp(BlendVjpArguments a) {
    __shared__ Staged staged[4];
    __shared__ Upstream<true> upstream;
    __shared__ float pairs[PART][HALVES][128];
    blend_vjp<true, false, false, false, true>(a, staged[threadIdx.x >> 5], upstream, pairs);
}

extern "C" __global__ void __launch_bounds__(128, 4) features_vjp_abs(BlendVjpArguments a) {
    __shared__ Staged staged[4];
    __shared__ Upstream<true> upstream;
    __shared__ float pairs[PART][HALVES][128];
    blend_vjp<true, false, true, false, true>(a, staged[threadIdx.x >> 5], upstream, pairs);
}

extern "C" __global__ void __launch_bounds__(128, 4) features_vjp_distortion(BlendVjpArguments a) {
    __shared__ Staged staged[4];
    __shared__ Upstream<true> upstream;
    __shared__ float pairs[PART][HALVES][128];
    blend_vjp<true, true, false, false, true>(a, staged[threadIdx.x >> 5], upstream, pairs);
}

extern "C" __global__ void __launch_bounds__(128, 4) features_vjp_distortion_abs(BlendVjpArguments a) {
    __shared__ Staged staged[4];
    __shared__ Upstream<true> upstream;
    __shared__ float pairs[PART][HALVES][128];
    blend_vjp<true, true, true, false, true>(a, staged[threadIdx.x >> 5], upstream, pairs);
}

}  // namespace gs2d
