// Pixels of a thread, and shared code of the forward and backward passes.
#pragma once

#include "cuda/common.h"

namespace gs2d {

// Plain channels in addition to the three of sh0, blended with the same weights.
struct Features {
    int64 count;              // F, a multiple of CHANNELS
    const float* values;      // [N, F]
    const float* background;  // [F]
    float* images;            // [F, H, W]
    const float* upstream;    // [F, H, W]; the backward pass only, like the next member
    float* gradients;         // [N, F], or a row per slot (blend_vjp.cu); zeros on entry
};
constexpr int CHANNELS = 8;  // channels processed together

constexpr int HALVES = 2;  // pixels per thread; the second is four rows below the first

// Returns the first of the 8 words of chunk c of a tile. The index is unique without a prefix sum.
__device__ __forceinline__ int64 word_of(int64 begin, int tile, int64 chunk) {
    return 8 * ((begin >> 5) + tile + chunk);
}

// Unrolled by hand, so that the caller's loops can be unrolled.
__device__ __forceinline__ uint or_over_warp(uint bits) {
    bits |= __shfl_xor_sync(FULL_MASK, bits, 16);
    bits |= __shfl_xor_sync(FULL_MASK, bits, 8);
    bits |= __shfl_xor_sync(FULL_MASK, bits, 4);
    bits |= __shfl_xor_sync(FULL_MASK, bits, 2);
    return bits | __shfl_xor_sync(FULL_MASK, bits, 1);
}

// Returns a word that is the same for all lanes, in a form that lets the compiler treat branches on it as uniform.
__device__ __forceinline__ uint uniform(uint word, int lane) { return __ballot_sync(FULL_MASK, word >> lane & 1u); }

struct Place {  // position of a thread
    int lane, warp, tile;
    int x, y;  // first pixel
    uint sub_block[HALVES];
    bool inside[HALVES];
};

__device__ __forceinline__ Place place_of(const View& v, const int* tiles) {
    Place p;
    p.lane = threadIdx.x & 31, p.warp = threadIdx.x >> 5;
    p.tile = tiles ? tiles[blockIdx.x] : int(blockIdx.x);
    p.x = p.tile % v.tiles_x * TILE_PX + (p.warp & 1) * 8 + (p.lane & 7);
    p.y = p.tile / v.tiles_x * TILE_PX + (p.warp >> 1) * 8 + (p.lane >> 3);
    for (int h = 0; h < HALVES; ++h) {
        p.sub_block[h] = uint((p.warp >> 1) * 4 + h * 2 + (p.warp & 1));
        p.inside[h] = p.x < v.width && p.y + 4 * h < v.height;
    }
    return p;
}

__device__ __forceinline__ void fetch_record(const float* records, int64 splat, float4 (*to)[32], int lane) {
    const float4* from = reinterpret_cast<const float4*>(records + RECORD * splat);
#pragma unroll
    for (int k = 0; k < 4; ++k) to[k][lane] = from[k];
}

// Returns whether the splat whose record this lane has fetched is plain (core/blend.h) at all 8x8 pixels of the warp.
__device__ __forceinline__ bool plain_for_warp(const View& v, const Place& at, float4 (*records)[32]) {
    const Record<float> s =
        record_of(records[0][at.lane], records[1][at.lane], records[2][at.lane], records[3][at.lane]);
    const float x = float(at.x - (at.lane & 7) + 4), y = float(at.y - (at.lane >> 3) + 4);
    // with a margin of half a pixel
    return is_plain(x - s.cx, y - s.cy, s.ai, s.bi, s.iz, plain_from(s, v.lowpass_px), v.near, 4.f);
}

// Evaluates the splat plane at the pixels of a thread; dx, dy belong to the first pixel.
__device__ __forceinline__ void planes_of(const Record<float>& s, float dx, float dy, PlaneAt<float>* p) {
    p[0] = plane_at(s, dx, dy);
    p[1] = {fma(4.f, s.bu, p[0].X), fma(4.f, s.bv, p[0].Y), fma(4.f, s.bi, p[0].I)};
}

template <bool PLAIN>
__device__ __forceinline__ Hit<float> hit_of(const Record<float>& s, const PlaneAt<float>& p, float dx, float dy,
                                             const BlendLimits<float>& k) {
    if constexpr (!PLAIN) return intersect(s, p, reciprocal(s.iz), dx, dy, k);
    Hit<float> hit = meet_plane(p);
    hit.alpha = plain_alpha_of(s.log2_opacity, hit.rho, k);
    return hit;
}

struct Yes {
    static constexpr bool value = true;
};
struct No {
    static constexpr bool value = false;
};

// Calls step(Yes or No: plain; j, bit j) for the selected splats of a chunk, in order. Runs of plain splats, which are
// the most frequent, have a separate loop without the code for other splats.
template <class F> __device__ __forceinline__ void for_each_splat(uint wanted, uint plain, F&& step) {
    while (wanted) {
        const uint others = wanted & ~plain;
        uint run = wanted & ((others & (0u - others)) - 1u);
        wanted &= ~run;
        for (; run; run &= run - 1) step(Yes(), __ffs(int(run)) - 1, run & (0u - run));
        const uint bit = wanted & (0u - wanted);
        wanted &= wanted - 1;
        if (bit) step(No(), __ffs(int(bit)) - 1, bit);
    }
}

}  // namespace gs2d
