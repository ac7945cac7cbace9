// Bounds of the rays of tiles and blocks, and which of them a splat may reach (core/rays.h: RayReach).
//
// A bound is a direction m, and the largest distance of a unit ray of its pixels from m, a chord. A splat with the
// direction d is missed by all of them if |d - m| exceeds the bound's chord and the splat's: the triangle inequality.
#pragma once

#include "cpu/tile.h"

namespace gs2d {

// Bounds as one array per member, in whole vectors. Without pixels the chord is very negative: nothing is reached.
struct BoundArrays {
    real *x, *y, *z, *chord, *side;  // side: largest side of a pixel, radians
};
template <int N> struct RayBounds {
    static constexpr int COUNT = (N + LANES - 1) / LANES * LANES;
    alignas(64) real x[COUNT], y[COUNT], z[COUNT], chord[COUNT], side[COUNT];
    BoundArrays arrays() { return {x, y, z, chord, side}; }
};

// Areas are squares of AREA x AREA tiles. The buffer of a frame holds the bound of all rays, those of the areas, and
// those of the tiles of each area.
constexpr int AREA = 8;
using AreaTiles = RayBounds<AREA * AREA>;
inline int64_t whole_vectors(int64_t n) { return (n + 15) / 16 * 16; }  // and cache lines
inline RayBounds<1>& bound_of_view(const Frame& f) { return *reinterpret_cast<RayBounds<1>*>(f.areas.data); }
inline BoundArrays bounds_of_areas(const Frame& f) {
    real* const first = reinterpret_cast<real*>(f.areas.data + sizeof(RayBounds<1>));
    const int64_t n = whole_vectors(f.area_count);
    return {first, first + n, first + 2 * n, first + 3 * n, first + 4 * n};
}
inline AreaTiles* tiles_of_areas(const Frame& f) {
    return reinterpret_cast<AreaTiles*>(bounds_of_areas(f).x + 5 * whole_vectors(f.area_count));
}

struct RayBound {
    Vec3<real> sum = {0, 0, 0};
    real chord2 = -1, side2 = 0;
    void add(Vec3<real> ray) { sum = sum + ray; }
    void point() {
        const real length = sqrt(dot(sum, sum));
        sum = length > real(1e-6) ? (1 / length) * sum : Vec3<real>{0, 0, 1};
    }
    // Includes another bound, after `point`.
    void include(const RayBound& other) {
        if (other.chord2 < 0) return;
        const Vec3<real> d = other.sum - sum;
        const real chord = sqrt(dot(d, d)) + sqrt(other.chord2) + real(1e-6);
        chord2 = max(chord2, chord * chord), side2 = max(side2, other.side2);
    }
    void store_to(BoundArrays to, int64_t i) const {
        to.x[i] = sum.x, to.y[i] = sum.y, to.z[i] = sum.z, to.side[i] = sqrt(side2);
        to.chord[i] = chord2 < 0 ? real(-1e9) : sqrt(chord2) + real(2e-6);
    }
};

constexpr real NO_RAY = real(0.99e12);  // pixels per steradian, from which on a pixel has no ray (render/rays.py)

// Returns the squared distances of directions from a bound.
inline V distance2(V x, V y, V z, Vec3<V> d) {
    const V dx = x - d.x, dy = y - d.y, dz = z - d.z;
    return fma(dx, dx, fma(dy, dy, dz * dz));
}

// The part of the test of a bound that is the same for all bounds. With h = k row2 -+ (c row0 + s row1) for a direction
// (c, s) of the splat's plane, its pixels have h . r >= 0 (docs/math.md, "Footprint"), and h . r <= h . m + |h| |r - m|.
struct PlaneReach {
    static constexpr int DIRECTIONS = 4;  // and the opposite ones
    Vec3<V> row0, row1, row2;             // row2 times k
    V length[DIRECTIONS], slack;

    PlaneReach(Vec3<V> a, Vec3<V> b, Vec3<V> c, V k) : row0(a), row1(b), row2(k * c) {
        const auto length_of = [](Vec3<V> v) { return sqrt(dot(v, v)); };
        const Vec3<V> sum = row0 + row1, difference = row1 - row0;
        const V h = V(real(0.70710678118654752));
        const Vec3<V> across[DIRECTIONS] = {row0, h * sum, row1, h * difference};
        for (int i = 0; i < DIRECTIONS; ++i)
            length[i] = max(length_of(row2 + across[i]), length_of(row2 - across[i]));
        slack = V(real(4e-6)) * (length_of(row0) + length_of(row1) + length_of(row2));
    }
    // Returns where the disc may reach bounds with directions m.
    inline __attribute__((always_inline)) M reaches(Vec3<V> m, V chord) const {
        const V h = V(real(0.70710678118654752));
        const V X = dot(row0, m), Y = dot(row1, m), I = dot(row2, m) + slack;
        return (abs(X) <= fma(length[0], chord, I)) & (abs(h * (X + Y)) <= fma(length[1], chord, I)) &
               (abs(Y) <= fma(length[2], chord, I)) & (abs(h * (Y - X)) <= fma(length[3], chord, I));
    }
};

// Returns which bounds i to i + LANES a splat may reach.
inline M reached(BoundArrays b, int64_t i, Vec3<V> direction, V chord, V disc) {
    const V reach = load(b.chord + i) + max(chord, fma(disc, load(b.side + i), V(real(1e-6))));
    return (distance2(load(b.x + i), load(b.y + i), load(b.z + i), direction) <= reach * reach) & (reach >= V(0));
}

// Leaves out those of the bounds that only the sphere reaches.
inline M refined(M sphere, BoundArrays b, int64_t i, Vec3<V> direction, const PlaneReach& plane, V disc) {
    const Vec3<V> m = {load(b.x + i), load(b.y + i), load(b.z + i)};
    const V chord = load(b.chord + i), reach = chord + fma(disc, load(b.side + i), V(real(1e-6)));
    return sphere & (plane.reaches(m, chord) | (distance2(m.x, m.y, m.z, direction) <= reach * reach));
}

// Calls visit(area, mask of its tiles) for the areas with tiles that a splat may reach.
template <class F> inline void for_each_ray_area(const Frame& f, int64_t splat, F&& visit) {
    const CullRecord& c = f.cull[splat];
    const Vec3<V> d = {V(c.x), V(c.y), V(c.z)};
    const V chord = V(c.chord), disc = V(c.disc);
    const BoundArrays areas = bounds_of_areas(f);
    const real* const r = &f.records[splat * RECORD];
    const PlaneReach plane({V(r[0]), V(r[1]), V(r[2])}, {V(r[3]), V(r[4]), V(r[5])}, {V(r[6]), V(r[7]), V(r[8])}, V(c.k));
    for (int64_t a = 0; a < f.area_count; a += LANES)
        for (uint32_t left = bits(reached(areas, a, d, chord, disc)); left; left &= left - 1) {
            const int64_t area = a + __builtin_ctz(left);
            uint64_t tiles = 0;
            const BoundArrays bounds = tiles_of_areas(f)[area].arrays();
            for (int i = 0; i < AREA * AREA; i += LANES) {
                const M sphere = reached(bounds, i, d, chord, disc);
                if (any(sphere)) tiles |= uint64_t(bits(refined(sphere, bounds, i, d, plane, disc))) << i;
            }
            if (tiles) visit(area, tiles);
        }
}

// Finds the tiles of a splat; returns whether there are any.
inline bool find_ray_tiles(Frame& f, int64_t splat) {
    RayTiles found = {};
    for_each_ray_area(f, splat, [&](int64_t area, uint64_t tiles) {
        if (found.areas < RayTiles::KEPT) found.area[found.areas] = int32_t(area), found.tiles[found.areas] = tiles;
        ++found.areas;
    });
    f.ray_tiles[splat] = found;
    return found.areas > 0;
}

// Calls visit(tile) for the tiles of a splat, in a fixed order.
template <class F> inline void for_each_ray_tile(const Frame& f, int64_t splat, F&& visit) {
    const RayTiles& found = f.ray_tiles[splat];
    const int areas_x = (f.tiles_x + AREA - 1) / AREA;
    const auto of_area = [&](int64_t a, uint64_t tiles) {
        const int64_t first = a / areas_x * AREA * f.tiles_x + a % areas_x * AREA;
        for (; tiles; tiles &= tiles - 1) {
            const int t = __builtin_ctzll(tiles);
            visit(first + int64_t(t / AREA) * f.tiles_x + t % AREA);
        }
    };
    if (found.areas > RayTiles::KEPT) return for_each_ray_area(f, splat, of_area);
    for (int k = 0; k < found.areas; ++k) of_area(found.area[k], found.tiles[k]);
}

// Computes f.areas; returns false if out of memory.
bool bound_rays(Frame& f);

// Rays of a tile in block order. Pixels outside the image have the ray of a pixel in it.
struct TileRays {
    alignas(64) real x[PIXELS], y[PIXELS], z[PIXELS], density[PIXELS];
    TileRays(const Frame& f, const TileArea& a) {
        const real* const map = static_cast<const real*>(f.view.rays);
        const bool inside = a.width == TILE && a.height == TILE;
        for (int j = 0; j < TILE; ++j) {
            const real* const row = map + (int64_t(a.y0 + (j < a.height ? j : 0)) * f.view.width + a.x0) * 4;
            for (int i = 0; i < TILE; i += 4) {
                Four p[4];
                for (int k = 0; k < 4; ++k) p[k] = load4(row + 4 * (inside || i + k < a.width ? i + k : 0));
                const Four xy0 = __builtin_shufflevector(p[0], p[1], 0, 4, 1, 5),
                           xy1 = __builtin_shufflevector(p[2], p[3], 0, 4, 1, 5),
                           zd0 = __builtin_shufflevector(p[0], p[1], 2, 6, 3, 7),
                           zd1 = __builtin_shufflevector(p[2], p[3], 2, 6, 3, 7);
                const int to = block_order(i, j);
                store4(x + to, __builtin_shufflevector(xy0, xy1, 0, 1, 4, 5));
                store4(y + to, __builtin_shufflevector(xy0, xy1, 2, 3, 6, 7));
                store4(z + to, __builtin_shufflevector(zd0, zd1, 0, 1, 4, 5));
                store4(density + to, __builtin_shufflevector(zd0, zd1, 2, 3, 6, 7));
            }
        }
    }
    Vec3<V> at(int b) const { return {load(x + b * LANES), load(y + b * LANES), load(z + b * LANES)}; }
    V density_at(int b) const { return load(density + b * LANES); }
};

// The larger of two bounds' sizes with the same direction, by lanes, from rays and the squares of the sides of pixels.
struct LaneBound {
    V chord2 = V(-1), side2 = V(0);
    void widen(Vec3<V> ray, V density, M shown, Vec3<real> m) {
        chord2 = max(chord2, select(shown, distance2(ray.x, ray.y, ray.z, {V(m.x), V(m.y), V(m.z)}), V(-1)));
        side2 = max(side2, keep(shown, V(1) / density));
    }
    RayBound bound(Vec3<real> m) const {
        alignas(64) real chords[LANES], sides[LANES];
        store(chords, chord2), store(sides, side2);
        RayBound found = {m, -1, 0};
        for (int i = 0; i < LANES; ++i)
            found.chord2 = max(found.chord2, chords[i]), found.side2 = max(found.side2, sides[i]);
        return found;
    }
};

// Bounds of the blocks of a tile, and of all of it.
struct RayTileBounds {
    RayBounds<BLOCKS> blocks;
    RayBounds<1> tile;
    bool has_holes = false;  // a pixel has no ray

    explicit RayTileBounds(const TileRays& rays) {
        RayBound all;
        for (int b = 0; b < BLOCKS; ++b) {
            const Vec3<V> r = rays.at(b);
            const V density = rays.density_at(b);
            const M shown = density < V(NO_RAY);
            has_holes |= any(invert(shown));
            RayBound block;  // rays of hidden pixels are 0
            block.add({sum(r.x), sum(r.y), sum(r.z)});
            all.add(block.sum);
            block.point();
            LaneBound lanes;
            lanes.widen(r, density, shown, block.sum);
            lanes.bound(block.sum).store_to(blocks.arrays(), b);
        }
        all.point();
        LaneBound lanes;
        for (int b = 0; b < BLOCKS; ++b)
            lanes.widen(rays.at(b), rays.density_at(b), rays.density_at(b) < V(NO_RAY), all.sum);
        const RayBound bound = lanes.bound(all.sum);
        for (int i = 0; i < RayBounds<1>::COUNT; ++i) bound.store_to(tile.arrays(), i);
    }
};

// Inputs of the tests of LANES splats against the blocks of a tile.
struct Footprints {
    Vec3<V> row0, row1, row2, direction;
    V chord, disc, k, plain_from;

    Footprints(const Frame& f, const uint32_t* splats) {
        const real *rows[LANES], *records[LANES];
        for (int i = 0; i < LANES; ++i)
            rows[i] = &f.cull[splats[i]].chord, records[i] = &f.records[size_t(splats[i]) * RECORD];
        V c[8], r[RECORD];
        columns_of_8(rows, c);
        for (int k = 0; k < 9; k += LANES) {
            for (int i = 0; i < LANES; ++i) r[k + i] = load(records[i] + k);
            transpose(r + k);
        }
        row0 = {r[0], r[1], r[2]}, row1 = {r[3], r[4], r[5]}, row2 = {r[6], r[7], r[8]};
        chord = c[0], disc = c[1], k = c[2], plain_from = c[3], direction = {c[4], c[5], c[6]};
    }
};

// Returns which splats are plain over the whole tile.
inline M plain_over_tile(const Frame& f, const Footprints& s, const RayTileBounds& bounds) {
    const RayBounds<1>& t = bounds.tile;
    const Vec3<V> m = {V(t.x[0]), V(t.y[0]), V(t.z[0])};
    const V middle = dot(s.row2, m), range = V(t.chord[0]) * sqrt(dot(s.row2, s.row2));
    const M holes = V(real(bounds.has_holes)) > V(0);
    return and_not((middle - range >= s.plain_from * V(t.side[0])) &
                       ((middle + range) * V(real(f.view.near)) < V(real(0.9999))),
                   holes);
}

// Sets bit b of masks[i] if splat i may reach a pixel of block b.
inline void blocks_touched(const Frame& f, const Footprints& s, const RayTileBounds& bounds, uint32_t* masks) {
    const PlaneReach plane(s.row0, s.row1, s.row2, s.k);
    LaneInts touched = {};
    for (int b = BLOCKS - 1; b >= 0; --b) {
        const RayBounds<BLOCKS>& t = bounds.blocks;
        const Vec3<V> m = {V(t.x[b]), V(t.y[b]), V(t.z[b])};
        const V chord = V(t.chord[b]), away2 = distance2(m.x, m.y, m.z, s.direction), sphere = chord + s.chord;
        const V disc = chord + fma(s.disc, V(t.side[b]), V(real(1e-6)));
        const M in = ((away2 <= sphere * sphere) & plane.reaches(m, chord)) | (away2 <= disc * disc);
        touched = with_bits(touched, in & (chord >= V(0)), 1u << b);
    }
    store(masks, touched);
    if (!f.view.exact_masks)
        for (int i = 0; i < LANES; ++i) masks[i] = ALL_BLOCKS;
}

}  // namespace gs2d
