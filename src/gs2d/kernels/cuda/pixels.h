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

// Long lists are cut into pieces, each with a block of its own, so that no warp blends thousands of splats in sequence.
// `table` is from order.cu, `states` from blend.cu.
struct Pieces {
    int64 capacity;  // blocks for pieces, before those of the tiles; 0: no list is cut
    int* table;      // [capacity + 1, PIECE_ROW]: tile or -1, first piece of the tile, and for each warp, if it is the
                     // first piece, the number of blended pieces; the last row begins with the length of a piece
    float* states;   // [capacity, PIECE_STATE, 256]: transmittance of the previous piece; sums of the pieces in front
};
constexpr int PIECE_ROW = 6, PIECE_STATE = 15;  // same in cuda_works.py

// Returns in how many pieces a list is cut; their lengths are at least `length`.
__device__ __forceinline__ int pieces_in(int64 count, int64 length) {
    return count < 2 * length ? 1 : int(count / length);
}

struct Place {  // position of a thread
    int lane, warp, tile;
    int x, y;  // first pixel
    uint sub_block[HALVES];
    bool inside[HALVES];
};

__device__ __forceinline__ Place place_of(const View& v, int tile) {
    Place p;
    p.lane = threadIdx.x & 31, p.warp = threadIdx.x >> 5, p.tile = tile;
    p.x = p.tile % v.tiles_x * TILE_PX + (p.warp & 1) * 8 + (p.lane & 7);
    p.y = p.tile / v.tiles_x * TILE_PX + (p.warp >> 1) * 8 + (p.lane >> 3);
    for (int h = 0; h < HALVES; ++h) {
        p.sub_block[h] = uint((p.warp >> 1) * 4 + h * 2 + (p.warp & 1));
        p.inside[h] = p.x < v.width && p.y + 4 * h < v.height;
    }
    return p;
}

__device__ __forceinline__ Place place_of(const View& v, const int* tiles) {
    return place_of(v, tiles ? tiles[blockIdx.x] : int(blockIdx.x));
}

struct Part {  // the entries of a block
    int tile;  // -1: none
    int begin, count;  // there are fewer than 2^31 entries
    int first, pieces;  // first piece of the tile and their number; 1: the whole list
};

// `earlier`: return the piece that many places in front instead.
__device__ __forceinline__ Part part_of(const Pieces& p, const int64* ranges, const int* tiles, int earlier = 0) {
    const int block = int(blockIdx.x) - int(p.capacity);
    Part part = {block < 0 ? p.table[PIECE_ROW * blockIdx.x] : tiles ? tiles[block] : block, 0, 0, 0, 1};
    if (part.tile < 0) return part;
    part.begin = int(ranges[2 * int64(part.tile)]);
    part.count = int(ranges[2 * int64(part.tile) + 1]) - part.begin;
    if (p.capacity == 0) return part;
    const int pieces = pieces_in(part.count, p.table[PIECE_ROW * p.capacity]);
    if (block >= 0) {
        if (pieces > 1) part.tile = -1;
        return part;
    }
    part.first = p.table[PIECE_ROW * blockIdx.x + 1], part.pieces = pieces;
    const int number = int(blockIdx.x) - part.first - earlier;
    if (number < 0) part.tile = -1;
    const int64 chunks = (part.count + 31) >> 5;  // whole chunks, so that the words of chunks keep their places
    const int begin = 32 * int(chunks * number / pieces), end = 32 * int(chunks * (number + 1) / pieces);
    part.begin += begin, part.count = (end < part.count ? end : part.count) - begin;
    return part;
}

__device__ __forceinline__ float& state_of(const Pieces& p, int piece, int value, int h) {
    return p.states[((int64(piece) * PIECE_STATE + value) * HALVES + h) * 128 + threadIdx.x];
}

// Returns the transmittance in front of this block's entries.
__device__ __forceinline__ float in_front(const Pieces& p, const Part& part, int h, float transmittance_min) {
    float T = 1.f;
    for (int piece = part.first + 1; part.pieces > 1 && piece <= int(blockIdx.x); ++piece)
        T = T * state_of(p, piece, 0, h);
    return T < transmittance_min ? 0.f : T;
}

// Calls step(index of the value in a piece's state, sum of the pixel).
template <bool DIST, class P, class F> __device__ __forceinline__ void for_each_sum(P& p, F&& step) {
    step(1, p.T), step(2, p.median), step(3, p.alpha), step(4, p.red), step(5, p.green), step(6, p.blue);
    step(7, p.nx), step(8, p.ny), step(9, p.nz), step(10, p.depth);
    if constexpr (DIST) step(11, p.inverse_depth0), step(12, p.M1_twice), step(13, p.M2), step(14, p.distortion);
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
