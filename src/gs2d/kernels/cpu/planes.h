// A splat's plane at the pixels of a tile. It is affine in the pixel, so that it is the sum of a part that depends on the lane
// alone and one that depends on the block alone: three additions for each block. Everything that walks a tile's splats takes
// the plane from here, so that all of it decides alike.
#pragma once

#include "cpu/tile.h"

namespace gs2d {

// Pixel centres of a tile's blocks: of the lanes, in columns and rows of blocks; and first pixels of blocks.
struct Centres {
    alignas(64) real x[BLOCKS_X][LANES], y[BLOCKS / BLOCKS_X][LANES], first_x[BLOCKS], first_y[BLOCKS];
    explicit Centres(const TileArea& a) {
        for (int i = 0; i < BLOCKS_X; ++i) store(x[i], lane_x(a.x0) + V(real(i * BLOCK_W)));
        for (int i = 0; i < BLOCKS / BLOCKS_X; ++i) store(y[i], lane_y(a.y0) + V(real(i * BLOCK_H)));
        for (int b = 0; b < BLOCKS; ++b) first_x[b] = real(a.x0 + block_x(b)), first_y[b] = real(a.y0 + block_y(b));
    }
    V at_x(int b) const { return load(x[b % BLOCKS_X]); }
    V at_y(int b) const { return load(y[b / BLOCKS_X]); }
};

struct SplatPlanes {
    // Of X, Y, I. Aligned to a vector, not more: many of them a power of two apart would share few sets of the first cache.
    alignas(LANES * sizeof(real)) real lane[3][LANES], block[3][BLOCKS];

    inline __attribute__((always_inline)) void set(const real* record, const Centres& centres) {
        const V cx = V(record[0]), cy = V(record[1]), zero = V(0), constant[3] = {zero, zero, V(record[8])};
        for (int k = 0; k < 3; ++k) {
            const V a = V(record[2 + 2 * k]), b = V(record[3 + 2 * k]);
            store(lane[k], fma(a, lane_x(0), b * lane_y(0)));
            for (int i = 0; i < BLOCKS; i += LANES) {
                const V dx = load(centres.first_x + i) - cx, dy = load(centres.first_y + i) - cy;
                store(block[k] + i, fma(a, dx, fma(b, dy, constant[k])));
            }
        }
    }
    PlaneAt<V> at(int b) const {
        return {load(lane[0]) + V(block[0][b]), load(lane[1]) + V(block[1][b]), load(lane[2]) + V(block[2][b])};
    }
};

// Whether each of some splats is plain all over a tile: lane j * ROWS is for splats[j].
inline M plain_over_tile(const Frame& f, const uint32_t* splats, real tile_x, real tile_y) {
    constexpr int N = BlockRows::SPLATS;
    const real *centre[N], *slopes[N], *more[N];
    for (int j = 0; j < N; ++j) {
        centre[j] = &f.records[size_t(splats[j]) * RECORD], slopes[j] = centre[j] + 6;
        more[j] = &f.cull[splats[j]].inv_y2;
    }
    V a[4], b[4], c[4];
    spread(centre, a), spread(slopes, b), spread(more, c);
    const V dx = V(tile_x + real(TILE / 2)) - a[0], dy = V(tile_y + real(TILE / 2)) - a[1];
    return is_plain(dx, dy, b[0], b[1], b[2], c[3], V(real(f.view.near)), V(real(TILE / 2)));  // half a pixel to spare
}

// A splat at block b, where its plane is `plane`. Plain: as `Entry` says.
inline Hit<V> hit_at(const Record<V>& s, V zc, const PlaneAt<V>& plane, bool plain, const Centres& centres, int b,
                     const BlendLimits<V>& k) {
    if (!plain) return intersect(s, plane, zc, centres.at_x(b) - s.cx, centres.at_y(b) - s.cy, k);
    Hit<V> h = meet_plane(plane);
    h.alpha = plain_alpha_of(s.log2_opacity, h.rho, k);
    return h;
}

}  // namespace gs2d
