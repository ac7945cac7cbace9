// Gradients of the blending: tile by tile, splat by splat, front to back, the sums over a splat's pixels in registers.
// Every (tile, splat) has its own slot of gradients (gradient_sums.h), so nothing depends on the order of the tiles.
#include "cpu/frame.h"
#include "cpu/gradient_sums.h"
#include "cpu/stages.h"
#include "cpu/threads.h"
#include "cpu/tile.h"

namespace gs2d {
namespace {

// Per pixel of the tile, in block order: state, then what PixelGradient<V> holds.
enum Plane {
    T, S, RED, GREEN, BLUE, ALPHA, NX, NY, NZ, DEPTH, MEDIAN, MEDIAN_BELOW, DIST, TOTAL, M1, M2, DEPTH0, PLANES
};
using Planes = real (*)[PIXELS];

inline PixelGradient<V> load_gradient(const Planes s, int b) {
    const auto at = [&](Plane p) { return load(&s[p][b * LANES]); };
    return {at(RED), at(GREEN), at(BLUE), at(ALPHA), at(NX), at(NY), at(NZ), at(DEPTH), at(MEDIAN), at(MEDIAN_BELOW),
            at(DIST), at(TOTAL), at(M1), at(M2), at(DEPTH0)};
}

// Upstream gradients as PixelGradient wants them, and S = the sum over all splats of w s, from the image's totals.
void start(const Frame& f, const Images& images, const ImageGradients& g, const TileArea& a, Planes s) {
    const View& v = f.view;
    const int W = v.width;
    const int64_t pixels = int64_t(W) * v.height;
    alignas(64) real total[7][PIXELS], g_dist[PIXELS];
    read_planes<3>(g.color, W, a, s[RED]);
    read_planes<3>(g.normal, W, a, s[NX]);
    read_planes<3>(images.color, W, a, total[0]);
    read_planes<3>(g.normal ? images.normal : nullptr, W, a, total[3]);
    read_planes<1>(g.alpha, W, a, s[ALPHA]);
    read_planes<1>(g.depth_mean, W, a, s[DEPTH]);
    read_planes<1>(g.depth_median, W, a, s[MEDIAN]);
    read_planes<1>(g.distortion, W, a, g_dist);
    read_planes<1>(g.depth_mean ? images.depth_mean : nullptr, W, a, total[6]);
    read_planes<1>(images.alpha, W, a, s[TOTAL]);
    read_planes<1>(&f.saved[0], W, a, s[T]);
    if (g.distortion) {
        read_planes<1>(images.distortion, W, a, s[DIST]);
        read_planes<1>(&f.saved[pixels], W, a, s[M1]);
        read_planes<1>(&f.saved[2 * pixels], W, a, s[M2]);
        read_planes<1>(&f.saved[3 * pixels], W, a, s[DEPTH0]);
    }
    const V bg[3] = {V(real(v.background[0])), V(real(v.background[1])), V(real(v.background[2]))};
    const double lever = v.far * v.near / (v.far - v.near);
    for (int b = 0; b < BLOCKS; ++b) {
        const auto at = [&](real* plane) { return load(plane + b * LANES); };
        const auto put = [&](real* plane, V value) { store(plane + b * LANES, value); };
        const V final_T = at(s[T]), alpha = at(s[TOTAL]), mean = at(total[6]);
        V ga = at(s[ALPHA]), sum = V(0);
        for (int c = 0; c < 3; ++c) {
            const V gc = at(s[RED + c]);
            ga = fnma(gc, bg[c], ga);
            sum = fma(gc, fnma(final_T, bg[c], at(total[c])), sum);
            sum = fma(at(s[NX + c]), at(total[3 + c]), sum);
        }
        // depth_mean = D / alpha: dD = g / alpha, dalpha = -g mean / alpha
        const V gd = at(s[DEPTH]) / select(alpha > V(0), alpha, V(1));
        ga = fnma(gd, mean, ga);
        sum = fma(ga, alpha, fma(gd, mean * alpha, sum));
        put(s[DEPTH], gd);
        put(s[ALPHA], ga);
        if (g.distortion) {
            const V gx = at(g_dist);
            sum = fma(V(2) * gx, at(s[DIST]), sum);  // each pair counts for both of its splats
            put(s[DIST], gx * V(real(lever * lever)));
        }
        put(s[S], sum);
        put(s[MEDIAN_BELOW], max(final_T, V(real(0.5))));
        const M inside = lanes_inside(block_x(b), block_y(b), a.width, a.height);
        put(s[T], keep(inside, V(1)));
    }
}

// The rows of a tile lie far apart: ask for those of the next tile while this one is worked on.
void prefetch_tile(const Frame& f, const Images& images, const ImageGradients& g, int64_t tile) {
    if (tile >= f.tiles) return;
    const TileArea a = tile_area(f, tile);
    const int64_t W = f.view.width, pixels = W * f.view.height;
    const real* const rgb[] = {g.color, g.normal, images.color, g.normal ? images.normal : nullptr};
    const real* const gray[] = {g.alpha, g.depth_mean, g.depth_median, g.distortion, images.alpha, &f.saved[0],
                                g.depth_mean ? images.depth_mean : nullptr, g.distortion ? images.distortion : nullptr,
                                g.distortion ? &f.saved[pixels] : nullptr, g.distortion ? &f.saved[2 * pixels] : nullptr,
                                g.distortion ? &f.saved[3 * pixels] : nullptr};
    for (int y = 0; y < a.height; ++y) {
        const int64_t at = (a.y0 + y) * W + a.x0;
        for (const real* image : rgb)
            if (image)
                for (int i = 0; i < 3 * a.width; i += 16) __builtin_prefetch(image + 3 * at + i);
        for (const real* image : gray)
            if (image) __builtin_prefetch(image + at);
    }
}

// What the first pass over a splat's blocks leaves for the second.
struct Hits {
    alignas(64) real u[BLOCKS][LANES], v[BLOCKS][LANES], Q[BLOCKS][LANES], rq[BLOCKS][LANES], rho[BLOCKS][LANES], alpha[BLOCKS][LANES];
    M ray[BLOCKS];
};

constexpr int AHEAD = 8;  // records lie far apart: ask for them this many splats early

// Up to where a block is of interest: behind its last splat that has gradients, nothing needs its pixels any more.
struct Interest {
    uint32_t blocks = ALL_BLOCKS;
    int32_t last[BLOCKS];
    Interest(const Entry* entries, int32_t count, const uint8_t* rows) {
        if (!rows) return;
        blocks = 0;
        for (int32_t i = 0; i < count; ++i) {
            if (!rows[entries[i].splat]) continue;
            blocks |= entries[i].blocks;
            for (uint32_t left = entries[i].blocks; left; left &= left - 1) last[__builtin_ctz(left)] = i;
        }
    }
    void passed(const Entry& entry, int32_t i) {
        for (uint32_t left = entry.blocks; left; left &= left - 1) blocks &= ~(uint32_t(last[__builtin_ctz(left)] == i) << __builtin_ctz(left));
    }
};

// A splat without gradients: only T and S move on. The same arithmetic as below, so the splats behind it get the same bits.
template <bool Geo, bool Dist>
__attribute__((noinline)) void pass_by(const real* record, uint32_t blocks, Planes s, V lx, V ly, const BlendLimits<V>& limits) {
    const Record<V> splat = broadcast(record);
    const V inverse_zc = V(real(1) / record[8]), zero = V(0);
    for (; blocks; blocks &= blocks - 1) {
        const int b = __builtin_ctz(blocks);
        const V dx = lx + V(real(block_x(b))) - splat.cx, dy = ly + V(real(block_y(b))) - splat.cy;
        const Hit<V> h = intersect(splat, dx, dy, limits);
        V pixel_T = load(&s[T][b * LANES]), pixel_S = load(&s[S][b * LANES]);
        PairSums<V> nobody = {zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero,
                              zero, zero, zero, zero, zero, zero, zero, zero, zero, zero};  // the compiler drops them
        composite_vjp<Geo, Dist, false>(splat, inverse_zc, dx, dy, h, limits, load_gradient(s, b), pixel_T, pixel_S, nobody);
        store(&s[T][b * LANES], pixel_T);
        store(&s[S][b * LANES], pixel_S);
    }
}

// Two passes per splat: intersections first, whose long chains then overlap, and compositing after.
template <bool Geo, bool Dist, bool Abs>
void tile_vjp(const Frame& f, int64_t tile, Slots to, const uint8_t* rows, Planes s, const TileArea& area, const BlendLimits<V>& limits) {
    alignas(64) real px[BLOCKS][LANES], py[BLOCKS][LANES];
    const V lx = lane_x(area.x0), ly = lane_y(area.y0);
    for (int b = 0; b < BLOCKS; ++b) store(px[b], lx + V(real(block_x(b)))), store(py[b], ly + V(real(block_y(b))));
    Hits hits;
    const Entry* entry = &f.entries[f.tile_begin[tile]];
    const int32_t count = f.tile_count[tile];
    Interest interest(entry, count, rows);
    for (int32_t at = 0; at < count && interest.blocks; ++at, ++entry) {
        if (at + AHEAD < count) __builtin_prefetch(&f.records[size_t(entry[AHEAD].splat) * RECORD]);
        const real* record = &f.records[size_t(entry->splat) * RECORD];
        if (rows) {
            if (!rows[entry->splat]) {
                pass_by<Geo, Dist>(record, entry->blocks & interest.blocks, s, lx, ly, limits);
                continue;
            }
            interest.passed(*entry, at);
        }
        const Record<V> splat = broadcast(record);
        const V inverse_zc = V(real(1) / record[8]), zero = V(0);
        bool filtered = false;  // whether the low-pass filter decided any pair
        int i = 0;
        for (uint32_t blocks = entry->blocks; blocks; blocks &= blocks - 1, ++i) {
            const int b = __builtin_ctz(blocks);
            const Hit<V> h = intersect(splat, load(px[b]) - splat.cx, load(py[b]) - splat.cy, limits);
            store(hits.u[i], h.u), store(hits.v[i], h.v), store(hits.rq[i], h.rq), store(hits.rho[i], h.rho), store(hits.alpha[i], h.alpha);
            if constexpr (Dist || Abs) store(hits.Q[i], h.Q);
            hits.ray[i] = h.ray;
            filtered |= any(and_not(h.alpha > zero, h.ray));
        }
        PairSums<V> sums = {zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero,
                            zero, zero, zero, zero, zero, zero, zero, zero, zero, zero};
        i = 0;
        for (uint32_t blocks = entry->blocks; blocks; blocks &= blocks - 1, ++i) {
            const int b = __builtin_ctz(blocks);
            Hit<V> h = {load(hits.u[i]), load(hits.v[i]), zero, load(hits.rq[i]), load(hits.rho[i]), load(hits.alpha[i]), hits.ray[i]};
            if constexpr (Dist || Abs) h.Q = load(hits.Q[i]);
            V pixel_T = load(&s[T][b * LANES]), pixel_S = load(&s[S][b * LANES]);
            composite_vjp<Geo, Dist, Abs>(splat, inverse_zc, load(px[b]) - splat.cx, load(py[b]) - splat.cy, h, limits,
                                          load_gradient(s, b), pixel_T, pixel_S, sums);
            store(&s[T][b * LANES], pixel_T);
            store(&s[S][b * LANES], pixel_S);
        }
        RecordGradient<V> g = finish(splat, sums, limits);
        if (!to.extras) g.cx = g.cx + g.lowpass_cx, g.cy = g.cy + g.lowpass_cy;  // nobody asks for them apart
        const V fields[16] = {g.cx, g.cy, g.au, g.bu, g.av, g.bv, g.az, g.bz,
                              g.zc, g.ln_opacity, g.red, g.green, g.blue, g.nx, g.ny, g.nz};
        transpose_reduce<GRADIENT>(fields, to.gradients);
        if (to.extras) {
            *to.has_extra = Abs || filtered;
            const V extra[4] = {g.lowpass_cx, g.lowpass_cy, g.abs_x, g.abs_y};
            if (Abs || filtered) transpose_reduce<GRADIENT_EXTRA>(extra, to.extras);
        }
        to = to.from(1);
    }
}

// Only the colours' gradients: no geometry, no opacity.
void tile_color_vjp(const Frame& f, int64_t tile, Slots to, const uint8_t* rows, Planes s, const TileArea& area,
                    const BlendLimits<V>& limits) {
    const V lx = lane_x(area.x0), ly = lane_y(area.y0);
    const Entry* entry = &f.entries[f.tile_begin[tile]];
    const int32_t count = f.tile_count[tile];
    Interest interest(entry, count, rows);
    for (int32_t i = 0; i < count && interest.blocks; ++i, ++entry) {
        if (i + AHEAD < count) __builtin_prefetch(&f.records[size_t(entry[AHEAD].splat) * RECORD]);
        const Record<V> splat = broadcast(&f.records[size_t(entry->splat) * RECORD]);
        const bool wanted = !rows || rows[entry->splat];
        Vec3<V> sum = {V(0), V(0), V(0)};
        for (uint32_t blocks = entry->blocks & interest.blocks; blocks; blocks &= blocks - 1) {
            const int b = __builtin_ctz(blocks);
            const auto at = [&](Plane p) { return load(&s[p][b * LANES]); };
            const V dx = lx + V(real(block_x(b))) - splat.cx, dy = ly + V(real(block_y(b))) - splat.cy;
            V pixel_T = at(T);
            composite_color_vjp(intersect(splat, dx, dy, limits), limits, {at(RED), at(GREEN), at(BLUE)}, pixel_T, sum);
            store(&s[T][b * LANES], pixel_T);
        }
        if (!wanted) continue;
        if (rows) interest.passed(*entry, i);
        const V fields[4] = {sum.x, sum.y, sum.z, V(0)};
        memset(to.gradients, 0, GRADIENT * sizeof(real));
        transpose_reduce<4>(fields, to.gradients + 10);  // red, green, blue
        if (to.extras) *to.has_extra = 0;
        to = to.from(1);
    }
}

using TileVjp = void (*)(const Frame&, int64_t, Slots, const uint8_t*, Planes, const TileArea&, const BlendLimits<V>&);

TileVjp variant(bool geo, bool dist, bool abs, bool color_only) {
    if (color_only) return tile_color_vjp;
    if (dist) return abs ? tile_vjp<true, true, true> : tile_vjp<true, true, false>;
    if (geo) return abs ? tile_vjp<true, false, true> : tile_vjp<true, false, false>;
    return abs ? tile_vjp<false, false, true> : tile_vjp<false, false, false>;
}

}  // namespace

bool blend_tiles_vjp(Frame& f, const Images& images, const ImageGradients& g, int64_t sh_rest, const ParameterGradients& out) {
    StageClock clock;
    GradientSums sums(f, sh_rest, out);
    if (!sums.prepare()) return false;
    clock.done(INDEX_SLOTS);
    const bool dist = g.distortion != nullptr;
    const bool geo = dist || g.normal || g.depth_mean || g.depth_median;
    const TileVjp vjp = variant(geo, dist, out.probe && out.probe_columns == 4, !wants_geometry(out));
    const BlendLimits<V> limits = limits_of(f.view);
    sums.for_each_tile([&](int64_t tile, int64_t next, Slots to) {
        prefetch_tile(f, images, g, next);
        alignas(64) real planes[PLANES][PIXELS];
        const TileArea area = tile_area(f, tile);
        start(f, images, g, area, planes);
        vjp(f, tile, to, out.rows, planes, area, limits);
    });
    clock.done(BLEND_BACKWARD);
    return true;
}

}  // namespace gs2d
