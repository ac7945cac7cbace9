// Pixels of one tile in block order, and the exact footprint test of a splat against all blocks of a tile.
#pragma once

#include "cpu/frame.h"

namespace gs2d {

constexpr int PIXELS = TILE * TILE;

// First pixel of block b, relative to the tile.
inline int block_x(int b) { return b % BLOCKS_X * BLOCK_W; }
inline int block_y(int b) { return b / BLOCKS_X * BLOCK_H; }

struct TileArea {
    int x0, y0, width, height;  // first pixel; number of pixels inside the image
};
inline TileArea tile_area(const Frame& f, int64_t tile) {
    TileArea a;
    a.x0 = static_cast<int>(tile % f.tiles_x) * TILE;
    a.y0 = static_cast<int>(tile / f.tiles_x) * TILE;
    a.width = f.view.width - a.x0 < TILE ? f.view.width - a.x0 : TILE;
    a.height = f.view.height - a.y0 < TILE ? f.view.height - a.y0 : TILE;
    return a;
}

// Returns the index in block order of a pixel of a tile.
inline int block_order(int x, int y) {
    return ((y / BLOCK_H) * BLOCKS_X + x / BLOCK_W) * LANES + (y % BLOCK_H) * BLOCK_W + x % BLOCK_W;
}

// Four pixels of a row, the unit in which images are rearranged.
typedef real Four __attribute__((vector_size(4 * sizeof(real))));
inline Four load4(const real* p) {
    Four v;
    memcpy(&v, p, sizeof v);
    return v;
}
inline void store4(real* p, Four v) { memcpy(p, &v, sizeof v); }

template <int C> inline void split4(const real* from, real* to) {
    if constexpr (C == 1) {
        store4(to, load4(from));
    } else {
        static_assert(C == 3 && BLOCK_W == 4);
        const Four a = load4(from), b = load4(from + 4), c = load4(from + 8);
        store4(to, __builtin_shufflevector(__builtin_shufflevector(a, b, 0, 3, 6, 6), c, 0, 1, 2, 5));
        store4(to + PIXELS, __builtin_shufflevector(__builtin_shufflevector(a, b, 1, 4, 7, 7), c, 0, 1, 2, 6));
        store4(to + 2 * PIXELS, __builtin_shufflevector(__builtin_shufflevector(a, b, 2, 5, 5, 5), c, 0, 1, 4, 7));
    }
}
template <int C> inline void join4(const real* from, real* to) {
    if constexpr (C == 1) {
        store4(to, load4(from));
    } else {
        static_assert(C == 3);
        const Four r = load4(from), g = load4(from + PIXELS), b = load4(from + 2 * PIXELS);
        store4(to, __builtin_shufflevector(__builtin_shufflevector(r, g, 0, 4, 1, 1), b, 0, 1, 4, 2));
        store4(to + 4, __builtin_shufflevector(__builtin_shufflevector(r, g, 5, 5, 2, 6), b, 0, 5, 2, 3));
        store4(to + 8, __builtin_shufflevector(__builtin_shufflevector(r, g, 3, 3, 7, 7), b, 6, 1, 2, 7));
    }
}

// Converts an interleaved image to C consecutive planes in block order; 0 outside the image, and if the image is null.
template <int C> inline void read_planes(const real* image, int image_width, const TileArea& a, real* out) {
    if (!image || a.width < TILE || a.height < TILE) memset(out, 0, sizeof(real) * C * PIXELS);
    if (!image) return;
    const real* from = image + (int64_t(a.y0) * image_width + a.x0) * C;
    // Constant bounds give compact code, so many rows are loaded at once.
    if (a.width == TILE && a.height == TILE) {
        for (int y = 0; y < TILE; ++y, from += int64_t(image_width) * C)
            for (int x = 0; x < TILE; x += 4) split4<C>(from + x * C, out + block_order(x, y));
        return;
    }
    for (int y = 0; y < a.height; ++y, from += int64_t(image_width) * C) {
        int x = 0;
        for (; x + 4 <= a.width; x += 4) split4<C>(from + x * C, out + block_order(x, y));
        for (; x < a.width; ++x)
            for (int c = 0; c < C; ++c) out[c * PIXELS + block_order(x, y)] = from[x * C + c];
    }
}

template <int C> inline void write_planes(const real* values, real* image, int image_width, const TileArea& a) {
    real* to = image + (int64_t(a.y0) * image_width + a.x0) * C;
    if (a.width == TILE && a.height == TILE) {
        for (int y = 0; y < TILE; ++y, to += int64_t(image_width) * C)
            for (int x = 0; x < TILE; x += 4) join4<C>(values + block_order(x, y), to + x * C);
        return;
    }
    for (int y = 0; y < a.height; ++y, to += int64_t(image_width) * C) {
        int x = 0;
        for (; x + 4 <= a.width; x += 4) join4<C>(values + block_order(x, y), to + x * C);
        for (; x < a.width; ++x)
            for (int c = 0; c < C; ++c) to[x * C + c] = values[c * PIXELS + block_order(x, y)];
    }
}

// Cache lines of one tile row in several images; `at` is the address for the first row of the first tile.
struct RowLines {
    struct Line {
        const real* at;
        int channels;
    } lines[80];  // of all images and their gradients, in double
    int count = 0, width;
    explicit RowLines(const View& view) : width(view.width) {}
    void add(const real* image, int channels) {
        if (!image) return;
        constexpr int FETCH = LINE / sizeof(real);
        for (int i = 0; i < channels * TILE; i += FETCH) lines[count++] = {image + i, channels};
        const bool aligned =
            reinterpret_cast<uintptr_t>(image) % LINE == 0 && size_t(width) * channels * sizeof(real) % LINE == 0;
        if (!aligned) lines[count++] = {image + channels * TILE - 1, channels};
    }
};

// Prefetches the scattered rows of a tile during other work, a few lines in each of `times` calls, because a CPU drops
// most of many simultaneous requests. The lines go to the L2 cache, because the L1 cache is full.
class RowsAhead {
  public:
    // Does not prefetch beyond the last tile.
    RowsAhead(const Frame& f, const RowLines& row, int64_t tile, int times) : row_(row) {
        if (tile >= f.tiles || times == 0) return;
        const TileArea a = tile_area(f, tile);
        first_ = int64_t(a.y0) * row.width + a.x0, left_ = a.height * row.count;
        each_ = (left_ + times - 1) / times;
    }
    inline __attribute__((always_inline)) void ask() {  // inlined: gcc drops calls to functions that only prefetch
        for (int n = each_ < left_ ? each_ : left_; n > 0; --n, --left_) {
            __builtin_prefetch(row_.lines[at_].at + first_ * row_.lines[at_].channels, 0, 2);
            if (++at_ == row_.count) at_ = 0, first_ += row_.width;
        }
    }

  private:
    const RowLines& row_;
    int64_t first_ = 0;  // first pixel of the row
    int left_ = 0, at_ = 0, each_ = 0;
};

#if !GS2D_RAYS  // else cpu/ray_bounds.h has its own
// Inputs of the footprint test of LANES splats against a tile, and which splats are unbounded.
struct Footprints {
    V ex, ey, slope, half, inv_y2, y_right, disc2, plain_from;  // from the cull record
    V cx, cy, au, bu, av, bv, ai, bi, iz;                       // from the record

    // Loads splats[0 .. LANES).
    Footprints(const Frame& f, const uint32_t* splats) {
        const real *rows[LANES], *records[LANES];
        for (int i = 0; i < LANES; ++i)
            rows[i] = &f.cull[splats[i]].ex, records[i] = &f.records[size_t(splats[i]) * RECORD];
        V c[8], r[RECORD];
        columns_of_8(rows, c);
        for (int k = 0; k < RECORD; k += LANES) {
            for (int i = 0; i < LANES; ++i) r[k + i] = load(records[i] + k);
            transpose(r + k);
        }
        ex = c[0], ey = c[1], slope = c[2], half = c[3], inv_y2 = c[4], y_right = c[5], disc2 = c[6], plain_from = c[7];
        cx = r[0], cy = r[1], au = r[2], bu = r[3], av = r[4], bv = r[5], ai = r[6], bi = r[7], iz = r[8];
    }
};

// Like blocks_touched for splats without an ellipse: writes only their masks.
__attribute__((noinline)) inline void outlined_blocks(const Frame& f, const Footprints& s, V tile_x, V tile_y,
                                                      uint32_t* masks) {
    const View& v = f.view;
    const Outline<V> outline = outline_of(s.au, s.bu, s.av, s.bv, s.ai, s.bi, s.iz, s.cx, s.cy, s.ex, -s.disc2,
                                          V(real(v.near)), V(real(v.width)), V(real(v.height)));
    LaneInts touched = {};
    for (int y = BLOCKS / BLOCKS_X - 1; y >= 0; --y) {
        const V first = tile_y + V(real(y * BLOCK_H) + real(0.5)) - s.cy;
        V left, right;
        reach_in_rows(outline, first, first + V(real(BLOCK_H - 1)), left, right);
        touched = shifted<BLOCKS_X>(touched);
        for (int x = 0; x < BLOCKS_X; ++x) {
            const V x0 = tile_x + V(real(x * BLOCK_W) + real(0.5)) - s.cx, x1 = x0 + V(real(BLOCK_W - 1));
            touched = with_bits(touched, (right >= x0) & (left <= x1), 1u << x);
        }
    }
    alignas(64) uint32_t found[LANES];
    store(found, touched);
    for (uint32_t left = bits(s.disc2 < V(0)); left; left &= left - 1)
        masks[__builtin_ctz(left)] = found[__builtin_ctz(left)];
}

// Sets bit b of masks[i] if the ellipse or low-pass disc of splat i reaches a pixel centre of block b, or nearly so. A
// footprint reaches each row of blocks in one interval. tile_x, tile_y: first pixel of the tile.
inline void blocks_touched(const Frame& f, const Footprints& s, V tile_x, V tile_y, uint32_t* masks) {
    const Chords<V> chords = {s.ex - tile_x, s.ey - tile_y, s.slope,       s.half, s.inv_y2,
                              s.y_right,     s.cx - tile_x, s.cy - tile_y, s.disc2};
    LaneInts touched = {};
    V last = V(real(TILE) - real(0.5));  // last pixel centre of a row of blocks
#pragma GCC unroll 1
    for (int y = BLOCKS / BLOCKS_X; y > 0; --y, last = last - V(real(BLOCK_H))) {
        V left, right;
        reach_in_rows(chords, last - V(real(BLOCK_H - 1)), last, left, right);
        touched = shifted<BLOCKS_X>(touched);
        for (int x = 0; x < BLOCKS_X; ++x) {
            const V x0 = V(real(x * BLOCK_W) + real(0.5)), x1 = V(real(x * BLOCK_W + BLOCK_W - 1) + real(0.5));
            touched = with_bits(touched, (right >= x0) & (left <= x1), 1u << x);
        }
    }
    store(masks, touched);
    if (any(s.disc2 < V(0))) outlined_blocks(f, s, tile_x, tile_y, masks);
    if (!f.view.exact_masks)
        for (int i = 0; i < LANES; ++i) masks[i] = ALL_BLOCKS;
}
#endif

}  // namespace gs2d
