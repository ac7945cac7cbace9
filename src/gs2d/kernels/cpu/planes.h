// A splat plane at the pixels of a tile. The plane is affine in the pixel position, so it is the sum of a per-lane part
// and a per-block part: three additions per block. All passes over the splats of a tile use this code, so they take the
// same branches.
#pragma once

#include "cpu/tile.h"
#if GS2D_RAYS
#include "cpu/ray_bounds.h"
#endif

namespace gs2d {

constexpr int BLOCKS_Y = BLOCKS / BLOCKS_X;

#if GS2D_RAYS
constexpr int DIRECTION = 16, INVERSE_DISTANCE = 19;  // in a record

// The rays of a tile. Passes call them pixel centres, as for a pinhole camera.
struct Centres {
    const TileRays rays;
    Centres(const Frame& f, const TileArea& a) : rays(f, a) {}
    RayFrom<V> from(Vec3<V> direction, int b) const {
        return {rays.at(b), direction - rays.at(b), load(rays.density + b * LANES)};
    }
};

struct TileBounds : RayTileBounds {
    TileBounds(const Centres& centres, const TileArea&) : RayTileBounds(centres.rays) {}
};

// The rows of the record. A plane is not affine in the pixel here, so it is evaluated at the rays.
struct SplatPlanes {
    alignas(LANES * sizeof(real)) real rows[16];  // and the log2 opacity
    inline __attribute__((always_inline)) void set(const real* record, const Centres&) {
        for (int k = 0; k < 16; k += LANES) store(rows + k, load(record + k));
    }
    PlaneAt<V> at(int b, const Centres& centres) const {
        const Vec3<V> r = centres.rays.at(b);
        const auto along = [&](const real* row) { return dot(Vec3<V>{V(row[0]), V(row[1]), V(row[2])}, r); };
        return {along(rows), along(rows + 3), along(rows + 6)};
    }
    V log2_opacity(int) const { return V(rows[9]); }
};
using PlanesByBlock = SplatPlanes;

// Intersects a splat that is not plain at block b.
inline Hit<V> meet_at(const real* record, const PlaneAt<V>& plane, const Centres& centres, int b,
                      const BlendLimits<V>& k) {
    const real* const d = record + DIRECTION;
    const RayFrom<V> at = centres.from({V(d[0]), V(d[1]), V(d[2])}, b);
    const V iz = V(record[INVERSE_DISTANCE]);
    return meet(plane, iz, reciprocal(iz), at.density * dot(at.away, at.away), k);
}

// Evaluates a splat at block b, where its plane is `plane`. `plain`: see `Entry`.
inline Hit<V> hit_at(const Record<V>& s, V zc, const PlaneAt<V>& plane, bool plain, const Centres& centres, int b,
                     const BlendLimits<V>& k) {
    if (plain) {
        Hit<V> h = meet_plane(plane);
        h.alpha = plain_alpha_of(s.log2_opacity, h.rho, k);
        return h;
    }
    const RayFrom<V> at = centres.from(s.direction, b);
    Hit<V> h = meet(plane, s.iz, zc, at.density * dot(at.away, at.away), k);
    h.alpha = alpha_of(log2_alpha_of(s.log2_opacity, h, k), k);
    return h;
}
#else
// Pixel centres of a tile. `x` and `y`: lane positions per column and row of blocks. `first_x` and `first_y`: first
// pixel of each block. `column_x`: the same for one row of blocks, each value four times. `row_y`: first row of each
// row of blocks, in all lanes.
struct Centres {
    alignas(64) real x[BLOCKS_X][LANES], y[BLOCKS_Y][LANES], first_x[BLOCKS], first_y[BLOCKS];
    alignas(64) real column_x[BLOCKS_X * 4], row_y[BLOCKS_Y][LANES];
    Centres(const Frame&, const TileArea& a) {
        for (int i = 0; i < BLOCKS_X; ++i) store(x[i], lane_x(a.x0) + V(real(i * BLOCK_W)));
        for (int i = 0; i < BLOCKS_Y; ++i) store(y[i], lane_y(a.y0) + V(real(i * BLOCK_H)));
        for (int b = 0; b < BLOCKS; ++b) first_x[b] = real(a.x0 + block_x(b)), first_y[b] = real(a.y0 + block_y(b));
        for (int i = 0; i < BLOCKS_X * 4; ++i) column_x[i] = first_x[i / 4];
        for (int i = 0; i < BLOCKS_Y; ++i) store(row_y[i], V(first_y[i * BLOCKS_X]));
    }
    V at_x(int b) const { return load(x[b % BLOCKS_X]); }
    V at_y(int b) const { return load(y[b / BLOCKS_X]); }
};

// Computes the per-lane parts of X, Y and I.
inline __attribute__((always_inline)) void set_lanes(const real* record, real (&lane)[3][LANES]) {
    for (int k = 0; k < 3; ++k) store(lane[k], fma(V(record[2 + 2 * k]), lane_x(0), V(record[3 + 2 * k]) * lane_y(0)));
}

struct SplatPlanes {
    // Aligned to a vector only: a power-of-two stride would map many splats to a few sets of the L1 cache.
    alignas(LANES * sizeof(real)) real lane[3][LANES], block[3][BLOCKS];

    inline __attribute__((always_inline)) void set(const real* record, const Centres& centres) {
        const V cx = V(record[0]), cy = V(record[1]), zero = V(0), constant[3] = {zero, zero, V(record[8])};
        set_lanes(record, lane);
        for (int k = 0; k < 3; ++k) {
            const V a = V(record[2 + 2 * k]), b = V(record[3 + 2 * k]);
            for (int i = 0; i < BLOCKS; i += LANES) {
                const V dx = load(centres.first_x + i) - cx, dy = load(centres.first_y + i) - cy;
                store(block[k] + i, fma(a, dx, fma(b, dy, constant[k])));
            }
        }
    }
    PlaneAt<V> at(int b, const Centres&) const {
        return {load(lane[0]) + V(block[0][b]), load(lane[1]) + V(block[1][b]), load(lane[2]) + V(block[2][b])};
    }
};

// The same values for passes that visit block after block with many splats each. The values of a block are consecutive
// and followed by the log2 opacity, so a splat at a block touches few cache lines.
struct PlanesByBlock {
    alignas(LANES * sizeof(real)) real lane[3][LANES], block[BLOCKS][4];

    inline __attribute__((always_inline)) void set(const real* record, const Centres& centres) {
        constexpr int PARTS = BLOCKS_X * 4 / LANES;  // vectors per row of blocks
        set_lanes(record, lane);
        V a, b, constant, dx[PARTS];
        unzip_planes(record + 2, a, b, constant);
        for (int i = 0; i < PARTS; ++i) dx[i] = load(centres.column_x + i * LANES) - V(record[0]);
        for (int y = 0; y < BLOCKS_Y; ++y) {
            const V row = fma(b, load(centres.row_y[y]) - V(record[1]), constant);
            for (int i = 0; i < PARTS; ++i) store(block[y * BLOCKS_X] + i * LANES, fma(a, dx[i], row));
        }
    }
    PlaneAt<V> at(int b, const Centres&) const {
        const real* const p = block[b];
        return {load(lane[0]) + V(p[0]), load(lane[1]) + V(p[1]), load(lane[2]) + V(p[2])};
    }
    V log2_opacity(int b) const { return V(block[b][3]); }
};

// The first pixel of a tile, for the tests of its splats.
struct TileBounds {
    V x, y;
    TileBounds(const Centres&, const TileArea& a) : x(V(real(a.x0))), y(V(real(a.y0))) {}
};
inline void blocks_touched(const Frame& f, const Footprints& s, const TileBounds& tile, uint32_t* masks) {
    blocks_touched(f, s, tile.x, tile.y, masks);
}

// Returns which splats are plain over the whole tile.
inline M plain_over_tile(const Frame& f, const Footprints& s, const TileBounds& tile) {
    const V half = V(real(TILE / 2));  // includes a margin of half a pixel
    return is_plain(tile.x + half - s.cx, tile.y + half - s.cy, s.ai, s.bi, s.iz, s.plain_from, V(real(f.view.near)),
                    half);
}

// Intersects a splat that is not plain at block b.
inline Hit<V> meet_at(const real* record, const PlaneAt<V>& plane, const Centres& centres, int b,
                      const BlendLimits<V>& k) {
    const V iz = V(record[8]), dx = centres.at_x(b) - V(record[0]), dy = centres.at_y(b) - V(record[1]);
    return meet(plane, iz, reciprocal(iz), fma(dx, dx, dy * dy), k);
}

// Evaluates a splat at block b, where its plane is `plane`. `plain`: see `Entry`.
inline Hit<V> hit_at(const Record<V>& s, V zc, const PlaneAt<V>& plane, bool plain, const Centres& centres, int b,
                     const BlendLimits<V>& k) {
    if (!plain) return intersect(s, plane, zc, centres.at_x(b) - s.cx, centres.at_y(b) - s.cy, k);
    Hit<V> h = meet_plane(plane);
    h.alpha = plain_alpha_of(s.log2_opacity, h.rho, k);
    return h;
}
#endif

}  // namespace gs2d
