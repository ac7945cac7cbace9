// Gradients of the blending: tile by tile, front to back, in batches of splats; the sums of a splat stay in registers.
// Each (tile, splat) pair has its own gradient slot (gradient_sums.h), so the order of the tiles does not affect the
// result.
#include "cpu/features.h"
#include "cpu/frame.h"
#include "cpu/gradient_sums.h"
#include "cpu/planes.h"
#include "cpu/stages.h"
#include "cpu/threads.h"
#include "cpu/tile_vjp.h"

namespace gs2d {
namespace {

// Upstream gradients for PixelGradient, and S = the sum of w s over all splats, computed from the image totals.
void start(const Frame& f, const Images& images, const ImageGradients& g, const TileArea& a, Planes s) {
    const View& v = f.view;
    const int W = v.width;
    const int64_t pixels = int64_t(W) * v.height;
    alignas(64) real total[8][PIXELS], dist[4][PIXELS];  // dist: upstream, image, M1, M2
    read_planes<3>(g.color, W, a, s[RED]);
    read_planes<3>(g.normal, W, a, s[NX]);
    read_planes<3>(images.color, W, a, total[0]);
    read_planes<3>(g.normal ? images.normal : nullptr, W, a, total[3]);
    read_planes<1>(g.alpha, W, a, s[ALPHA]);
    read_planes<1>(g.depth_mean, W, a, s[DEPTH]);
    read_planes<1>(g.depth_median, W, a, s[MEDIAN]);
    read_planes<1>(g.depth_mean ? images.depth_mean : nullptr, W, a, total[6]);
    read_planes<1>(images.alpha, W, a, total[7]);
    read_planes<1>(&f.saved[0], W, a, s[T]);
    if (g.distortion) {
        read_planes<1>(g.distortion, W, a, dist[0]);
        read_planes<1>(images.distortion, W, a, dist[1]);
        read_planes<1>(&f.saved[pixels], W, a, dist[2]);
        read_planes<1>(&f.saved[2 * pixels], W, a, dist[3]);
        read_planes<1>(&f.saved[3 * pixels], W, a, s[DEPTH0]);
    }
    const V bg[3] = {V(real(v.background[0])), V(real(v.background[1])), V(real(v.background[2]))};
    const double lever = v.far * v.near / (v.far - v.near);
    for (int b = 0; b < BLOCKS; ++b) {
        const auto at = [&](real* plane) { return load(plane + b * LANES); };
        const auto put = [&](real* plane, V value) { store(plane + b * LANES, value); };
        const V final_T = at(s[T]), alpha = at(total[7]), mean = at(total[6]);
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
        if (g.distortion) {
            const V gx = at(dist[0]);
            sum = fma(V(2) * gx, at(dist[1]), sum);  // a pair contributes to both of its splats
            PixelGradient<V> p;
            p.alpha = ga;
            add_distortion(gx * V(real(lever * lever)), alpha, at(dist[2]), at(dist[3]), p);
            ga = p.alpha;
            put(s[DIST2], p.distortion2), put(s[DIST1], p.distortion1);
        }
        put(s[ALPHA], ga);
        put(s[S], sum);
        put(s[MEDIAN_BELOW], max(final_T, V(real(0.5))));
        const M inside = lanes_inside(block_x(b), block_y(b), a.width, a.height);
        put(s[T], keep(inside, V(1)));
    }
}

// Adds the contribution of the depth by transmittance; called after `start`.
__attribute__((noinline)) void start_transmittance(const Frame& f, const real* upstream, const real* alpha,
                                                   const TileArea& a, Planes s) {
    const int W = f.view.width;
    const int64_t pixels = int64_t(W) * f.view.height;
    alignas(64) real read[4][PIXELS];
    read_planes<1>(upstream, W, a, read[0]);
    read_planes<1>(&f.depth_slope[0], W, a, read[1]);
    read_planes<1>(&f.depth_slope[pixels], W, a, read[2]);
    read_planes<1>(alpha, W, a, read[3]);
    for (int i = 0; i < PIXELS; i += LANES) {
        PixelGradient<V> p;
        p.alpha = V(0);
        add_transmittance(load(&read[0][i]), load(&read[1][i]), load(&read[2][i]), load(&read[3][i]), p);
        store(&s[ALPHA][i], load(&s[ALPHA][i]) + p.alpha);
        store(&s[S][i], fma(p.alpha, load(&read[3][i]), load(&s[S][i])));
        store(&s[TRANSMITTANCE][i], p.transmittance), store(&s[Z][i], p.z);
    }
}

RowLines images_read(const Frame& f, const Images& images, const ImageGradients& g) {
    const int64_t pixels = int64_t(f.view.width) * f.view.height;
    RowLines lines(f.view);
    lines.add(g.color, 3), lines.add(g.normal, 3), lines.add(images.color, 3),
        lines.add(g.normal ? images.normal : nullptr, 3);
    lines.add(g.alpha, 1), lines.add(g.depth_mean, 1), lines.add(g.depth_median, 1), lines.add(g.distortion, 1);
    if (g.depth_transmittance) {
        lines.add(g.depth_transmittance, 1);
        for (int k = 0; k < 2; ++k) lines.add(&f.depth_slope[k * pixels], 1);
    }
    lines.add(images.alpha, 1), lines.add(g.depth_mean ? images.depth_mean : nullptr, 1), lines.add(&f.saved[0], 1);
    if (!g.distortion) return lines;
    lines.add(images.distortion, 1);
    for (int k = 1; k < 4; ++k) lines.add(&f.saved[k * pixels], 1);
    return lines;
}

// Computes gradients of the colours only, not of geometry and opacity.
void tile_color_vjp(const Frame& f, int64_t tile, Slots to, const uint8_t* rows, Planes s, const TileArea& area,
                    const BlendLimits<V>& limits, RowsAhead next, TileFeatures) {
    const Centres centres(f, area);
    const Entry* entry = &f.entries[f.tile_begin[tile]];
    const int32_t count = f.tile_count[tile];
    Interest interest(entry, count, rows);
    for (int32_t i = 0; i < count && interest.blocks; ++i, ++entry) {
        next.ask();
        if (i + AHEAD < count) __builtin_prefetch(&f.records[size_t(entry[AHEAD].splat()) * RECORD]);
        const real* const record = &f.records[size_t(entry->splat()) * RECORD];
        const Record<V> splat = broadcast(record);
        const V zc = reciprocal(splat.iz);
        SplatPlanes planes;
        planes.set(record, centres);
        const bool wanted = !rows || rows[entry->splat()];
        Vec3<V> sum = {V(0), V(0), V(0)};
        for (uint32_t blocks = entry->blocks & interest.blocks; blocks; blocks &= blocks - 1) {
            const int b = __builtin_ctz(blocks);
            const auto at = [&](Plane p) { return load(&s[p][b * LANES]); };
            V pixel_T = at(T);
            const Hit<V> hit = hit_at(splat, zc, planes.at(b, centres), entry->plain(), centres, b, limits);
            composite_color_vjp(hit, limits, {at(RED), at(GREEN), at(BLUE)}, pixel_T, sum);
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

TileVjp variant(bool geo, bool dist, bool abs, bool trans, bool color_only, bool features) {
    if (features) return feature_variant(dist, abs);
    if (color_only) return tile_color_vjp;
    if (trans && dist) return abs ? tile_vjp<true, true, true, true> : tile_vjp<true, true, false, true>;
    if (trans) return abs ? tile_vjp<true, false, true, true> : tile_vjp<true, false, false, true>;
    if (dist) return abs ? tile_vjp<true, true, true> : tile_vjp<true, true, false>;
    if (geo) return abs ? tile_vjp<true, false, true> : tile_vjp<true, false, false>;
    return abs ? tile_vjp<false, false, true> : tile_vjp<false, false, false>;
}

}  // namespace

bool blend_tiles_vjp(Frame& f, const Images& images, const ImageGradients& g, int64_t sh_rest,
                     const ParameterGradients& out, bool geometry, const Features* features) {
    StageClock clock;
    GradientSums sums(f, sh_rest, out, features);
    if (!sums.prepare() || (features && !reserve_feature_planes(f, features->count))) return false;
    clock.done(INDEX_SLOTS);
    const bool dist = g.distortion != nullptr;
    const bool geo = dist || g.normal || g.depth_mean || g.depth_median;
    const bool abs = out.probe && out.probe_columns == 4;
    const TileVjp vjp = variant(geo, dist, abs, g.depth_transmittance, !geometry, features);
    BlendLimits<V> limits = limits_of(f.view);
    limits.inv_depth_width = V(f.inv_depth_width);
    const RowLines read = images_read(f, images, g);
    sums.for_each_tile([&](int64_t tile, int64_t next, Slots to, real* feature_slots, int64_t piece) {
        alignas(64) real planes[PLANES][PIXELS];
        const TileArea area = tile_area(f, tile);
        start(f, images, g, area, planes);
        if (g.depth_transmittance) start_transmittance(f, g.depth_transmittance, images.alpha, area, planes);
        TileFeatures further;
        FeaturePairs pairs;
        if (features) {
            real* const upstream = feature_planes(f, features->count, piece);
            start_features(f, *features, images.alpha, area, upstream, planes[ALPHA], planes[S]);
            further = {features, upstream, feature_slots, &pairs};
        }
        vjp(f, tile, to, out.rows, planes, area, limits, RowsAhead(f, read, next, f.tile_count[tile]), further);
    });
    clock.done(BLEND_BACKWARD);
    return true;
}

}  // namespace gs2d
