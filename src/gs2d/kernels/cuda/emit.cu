// Builds one entry list per tile from splats in depth order: emission before the stable sort by tile, then ranges.
//
// A candidate is a pair of a splat and a tile of its rectangle. It is tested exactly against the eight 8x4 sub-blocks
// of the tile; candidates that reach no sub-block get the sentinel key `tiles`, which sorts behind all tiles. Sub-block
// b covers columns (b & 1) * 8 and rows (b >> 1) * 4 of its tile.
#include "cuda/common.h"

namespace gs2d {

struct EmitArguments {
    int width, height, tiles_x, tiles_y;
    float near;
    int64 candidates;  // ends[visible - 1], or the capacity; candidates beyond the capacity are dropped
    int64 visible;
    const void* order;  // [visible] int64, or uint32 (`emit_sorted`): splats by depth
    const void* ends;   // [visible], same type: running sum of tile_counts in depth order
    const float *cull, *records;
    const ushort* rects;
    void* keys;      // [candidates] int16 or int32: tile, or the sentinel
    uint* payloads;  // [candidates]: splat << 8 | mask of sub-blocks
    int exact;       // 0: every candidate gets all sub-blocks (tests)
};

struct RangeArguments {
    int64 candidates;
    const void* keys;          // sorted
    const int64* permutation;  // permutation of the sort; null if the sort moved the payloads
    const uint* payloads;
    uint* entries;  // [candidates]: payloads in sorted order
    int64* ranges;  // [tiles + 1, 2]: begin and end of each tile's entries; zeros on entry
};

// Returns the first splat in depth order whose candidates end after `candidate`.
template <class Place>
__device__ __forceinline__ int64 owner_of(const Place* ends, int64 visible, int64 candidate) {
    int64 low = 0, high = visible - 1;
    while (low < high) {
        const int64 middle = (low + high) >> 1;
        if (int64(ends[middle]) > candidate)
            high = middle;
        else
            low = middle + 1;
    }
    return low;
}

template <class Key, class Place> __device__ __forceinline__ void emit(const EmitArguments& a) {
    const int64 i = int64(blockIdx.x) * blockDim.x + threadIdx.x;
    if (i >= a.candidates) return;
    const Place *order = static_cast<const Place*>(a.order), *ends = static_cast<const Place*>(a.ends);
    if (i >= int64(ends[a.visible - 1])) {  // unused capacity
        static_cast<Key*>(a.keys)[i] = Key(a.tiles_x * a.tiles_y), a.payloads[i] = 0u;
        return;
    }
    const int64 place = owner_of(ends, a.visible, i), splat = int64(order[place]);
    const int from_last = int(int64(ends[place]) - 1 - i);
    const ushort* rect = a.rects + 4 * splat;
    const int x0 = rect[0], y0 = rect[1], columns = rect[2] - x0, rows = rect[3] - y0;
    const int j = columns * rows - 1 - from_last;
    const int tile_x = x0 + j % columns, tile_y = y0 + j / columns;
    const int left = tile_x * TILE_PX, top = tile_y * TILE_PX;

    uint mask = 0xffu;
    if (a.exact) {
        const float *cull = a.cull + 8 * splat, *record = a.records + RECORD * splat;
        const Culling culling(cull, left, top);
        if (culling.unbounded) {
            mask = blocks_outlined(cull, record, left, top, a.near, a.width, a.height);
        } else {
            mask = 0;
#pragma unroll
            for (int b = 0; b < 8; ++b) mask |= uint(culling.reaches_block(b)) << b;
        }
    }
    if (left + 8 >= a.width) mask &= 0x55u;  // outside the image
    for (int b = 2; b < 8; b += 2)
        if (top + 2 * b >= a.height) mask &= (1u << b) - 1u;
    static_cast<Key*>(a.keys)[i] = Key(mask ? tile_y * a.tiles_x + tile_x : a.tiles_x * a.tiles_y);
    a.payloads[i] = uint(splat) << 8 | mask;
}

template <class Key> __device__ __forceinline__ void find_ranges(const RangeArguments& a) {
    const int64 i = int64(blockIdx.x) * blockDim.x + threadIdx.x;
    if (i >= a.candidates) return;
    const Key* keys = static_cast<const Key*>(a.keys);
    if (a.permutation) a.entries[i] = a.payloads[a.permutation[i]];
    const int key = keys[i];
    if (i == 0 || keys[i - 1] != key) {
        a.ranges[2 * int64(key)] = i;
        if (i > 0) a.ranges[2 * int64(keys[i - 1]) + 1] = i;
    }
    if (i == a.candidates - 1) a.ranges[2 * int64(key) + 1] = a.candidates;
}

extern "C" __global__ void __launch_bounds__(128) emit_entries_16(EmitArguments a) { emit<short, int64>(a); }
extern "C" __global__ void __launch_bounds__(128) emit_entries_32(EmitArguments a) { emit<int, int64>(a); }
extern "C" __global__ void __launch_bounds__(128) emit_sorted_16(EmitArguments a) { emit<short, uint>(a); }
extern "C" __global__ void __launch_bounds__(128) emit_sorted_32(EmitArguments a) { emit<int, uint>(a); }
extern "C" __global__ void __launch_bounds__(128) find_ranges_16(RangeArguments a) { find_ranges<short>(a); }
extern "C" __global__ void __launch_bounds__(128) find_ranges_32(RangeArguments a) { find_ranges<int>(a); }

}  // namespace gs2d
