// Which pixels a thread owns, and what both directions of the blending do alike.
#pragma once

#include "cuda/common.h"

namespace gs2d {

constexpr int HALVES = 2;  // pixels per thread: the second lies four rows below the first

// Chunk c of a tile's entries owns the 8 words at this place: unique, without a scan.
__device__ __forceinline__ int64 word_of(int64 begin, int tile, int64 chunk) { return 8 * ((begin >> 5) + tile + chunk); }

__device__ __forceinline__ uint or_over_warp(uint bits) {
#pragma unroll
    for (int step = 16; step > 0; step >>= 1) bits |= __shfl_xor_sync(FULL_MASK, bits, step);
    return bits;
}

// A word that is the same for all lanes, in a form that lets the compiler know it: branches on it are uniform.
__device__ __forceinline__ uint uniform(uint word, int lane) { return __ballot_sync(FULL_MASK, word >> lane & 1u); }

struct Place {  // of a thread
    int lane, warp, tile;
    int x, y;              // first pixel
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

}  // namespace gs2d
