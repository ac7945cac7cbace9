// Splat errors: the sum over a splat's footprint of |its colour - image| (rule 17 of the contract).
#include "cpu/frame.h"
#include "cpu/planes.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

enum Plane { RED, GREEN, BLUE, COUNTS, PLANES };  // COUNTS is 1 for pixels that count, else 0

// Copies the image in block order, tile after tile.
bool load_target(Frame& f, const real* image, const uint8_t* mask) {
    if (!f.target.reserve(size_t(f.tiles) * PLANES * PIXELS)) return false;
    parallel_for(f.tiles, [&](int64_t tile) {
        real* to = &f.target[size_t(tile) * PLANES * PIXELS];
        const TileArea a = tile_area(f, tile);
        read_planes<3>(image, f.view.width, a, to);
        for (int y = 0; y < TILE; ++y)
            for (int x = 0; x < TILE; ++x) {
                const bool inside = x < a.width && y < a.height;
                const bool counts = inside && (!mask || mask[int64_t(a.y0 + y) * f.view.width + a.x0 + x]);
                to[COUNTS * PIXELS + block_order(x, y)] = counts;
            }
    });
    return true;
}

inline V difference(const Record<V>& s, const real* target, int b) {
    const auto at = [&](Plane p) { return load(target + p * PIXELS + b * LANES); };
    return (abs(s.red - at(RED)) + abs(s.green - at(GREEN)) + abs(s.blue - at(BLUE)));
}

// Returns the pixels of block b that count for the splat.
inline M counts(const Hit<V>& h, const BlendLimits<V>& limits, V cutoff2, const real* target, int b) {
    return (h.rho <= cutoff2) & (h.depth >= limits.near) & (load(target + COUNTS * PIXELS + b * LANES) > V(0));
}

// Lists the entries of each splat in tile order.
bool list_entries(Frame& f) {
    const int64_t entries = f.tile_begin[f.tiles];
    if (!f.splat_slots.reserve(entries) || !f.splat_begin.reserve(f.count + 2)) return false;
    int64_t* begin = f.splat_begin.data;
    memset(begin, 0, (f.count + 2) * sizeof(int64_t));
    for (int64_t e = 0; e < entries; ++e) ++begin[f.entries[e].splat() + 2];
    for (int64_t i = 0; i < f.count; ++i) begin[i + 2] += begin[i + 1];
    for (int64_t e = 0; e < entries; ++e) f.splat_slots[begin[f.entries[e].splat() + 1]++] = static_cast<uint32_t>(e);
    // Filling moved each begin to its end, which is the next begin, so begin[i] is correct again.
    return true;
}

}  // namespace

#if !GS2D_RAYS  // else the lists of tiles are used
bool splat_errors(Frame& f, const real* image, const uint8_t* mask, real* errors) {
    if (!load_target(f, image, mask)) return false;
    const BlendLimits<V> limits = limits_of(f.view);
    const V cutoff2 = V(real(f.view.error_cutoff * f.view.error_cutoff)), lx = lane_x(0), ly = lane_y(0);
    parallel_ranges(f.count, 256, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
            const TileRect r = f.rects[i];
            errors[i] = 0;
            if (r.x1 <= r.x0) continue;
            const Record<V> s = broadcast(&f.records[i * RECORD]);
            const V zc = reciprocal(s.iz);
            uint32_t same[LANES], touched[LANES];
            for (uint32_t& splat : same) splat = static_cast<uint32_t>(i);
            const Footprints footprint(f, same);
            const int columns = r.x1 - r.x0, tiles = columns * (r.y1 - r.y0);
            const auto tile_x = [&](int t) { return real((r.x0 + t % columns) * TILE); };
            const auto tile_y = [&](int t) { return real((r.y0 + t / columns) * TILE); };
            V total = V(0);
            for (int t = 0; t < tiles; ++t) {
                if (t % LANES == 0) {
                    alignas(64) real x[LANES], y[LANES];
                    for (int k = 0; k < LANES; ++k) x[k] = tile_x(t + k), y[k] = tile_y(t + k);
                    blocks_touched(f, footprint, load(x), load(y), touched);
                }
                const real x0 = tile_x(t), y0 = tile_y(t);
                const real* target = &f.target[(size_t(y0) / TILE * f.tiles_x + size_t(x0) / TILE) * PLANES * PIXELS];
                for (uint32_t left = touched[t % LANES]; left; left &= left - 1) {
                    const int b = __builtin_ctz(left);
                    const V x = lx + V(x0 + real(block_x(b))), y = ly + V(y0 + real(block_y(b)));
                    const Hit<V> h = intersect(s, zc, x - s.cx, y - s.cy, limits);
                    total = total + keep(counts(h, limits, cutoff2, target, b), difference(s, target, b));
                }
            }
            errors[i] = sum(total);
        }
    });
    return true;
}

#endif

namespace {

template <bool Occlusion> bool listed_errors(Frame& f, const real* image, const uint8_t* mask, real* errors) {
    if (!bin_splats(f) || !list_entries(f) || !load_target(f, image, mask) || !f.saved.reserve(f.tile_begin[f.tiles]))
        return false;
    const BlendLimits<V> limits = limits_of(f.view);
    const V cutoff2 = V(real(f.view.error_cutoff * f.view.error_cutoff));
    parallel_for(f.tiles, [&](int64_t tile) {
        const TileArea a = tile_area(f, tile);
        const real* target = &f.target[size_t(tile) * PLANES * PIXELS];
        const Centres centres(f, a);
        const TileBounds bounds(centres, a);
        [[maybe_unused]] const V lx = lane_x(a.x0), ly = lane_y(a.y0);
        alignas(64) real T[PIXELS];
        for (real& t : T) t = 1;
        uint32_t touched[LANES];
        for (int64_t begin = f.tile_begin[tile], end = f.tile_begin[tile + 1], e = begin; e < end; ++e) {
            if ((e - begin) % LANES == 0) {
                uint32_t splats[LANES];
                for (int k = 0; k < LANES; ++k) splats[k] = f.entries[e + k < end ? e + k : end - 1].splat();
                blocks_touched(f, Footprints(f, splats), bounds, touched);
            }
            const uint32_t splat = f.entries[e].splat();
            const Record<V> s = broadcast(&f.records[size_t(splat) * RECORD]);
            const V zc = reciprocal(s.iz);
            V total = V(0);
            for (uint32_t left = touched[(e - begin) % LANES]; left; left &= left - 1) {
                const int b = __builtin_ctz(left);
#if GS2D_RAYS
                const Hit<V> h = hit_at(s, zc, plane_at(s, centres.rays.at(b)), false, centres, b, limits);
#else
                const V x = lx + V(real(block_x(b))), y = ly + V(real(block_y(b)));
                const Hit<V> h = intersect(s, zc, x - s.cx, y - s.cy, limits);
#endif
                const V t = load(&T[b * LANES]), alpha = min(h.alpha, limits.alpha_max);
                const V after = fnma(alpha, t, t);
                const M open = after >= limits.transmittance_min;
                store(&T[b * LANES], keep(open, after));  // stopped pixels stay at 0
                total = total + keep(counts(h, limits, cutoff2, target, b) & (Occlusion ? open : V(0) <= V(0)),
                                     difference(s, target, b));
            }
            f.saved[e] = sum(total);
        }
    });
    for (int64_t i = 0; i < f.count; ++i) {
        errors[i] = 0;
        for (int64_t k = f.splat_begin[i]; k < f.splat_begin[i + 1]; ++k) errors[i] += f.saved[f.splat_slots[k]];
    }
    return true;
}

}  // namespace

bool occluded_splat_errors(Frame& f, const real* image, const uint8_t* mask, real* errors) {
    return listed_errors<true>(f, image, mask, errors);
}
#if GS2D_RAYS
bool splat_errors(Frame& f, const real* image, const uint8_t* mask, real* errors) {
    return listed_errors<false>(f, image, mask, errors);
}
#endif

}  // namespace gs2d
