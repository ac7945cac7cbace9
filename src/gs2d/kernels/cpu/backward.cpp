// Gradients of the blending: tile by tile, front to back, some splats at a time, the sums over a splat's pixels in registers.
// Every (tile, splat) has its own slot of gradients (gradient_sums.h), so nothing depends on the order of the tiles.
#include "cpu/features.h"
#include "cpu/frame.h"
#include "cpu/gradient_sums.h"
#include "cpu/planes.h"
#include "cpu/stages.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

// Per pixel of the tile, in block order: state, then what PixelGradient<V> holds.
enum Plane {
    T, S, RED, GREEN, BLUE, ALPHA, NX, NY, NZ, DEPTH, MEDIAN, MEDIAN_BELOW, DIST2, DIST1, DEPTH0, TRANSMITTANCE, Z, PLANES
};
using Planes = real (*)[PIXELS];

inline PixelGradient<V> load_gradient(const Planes s, int b) {
    const auto at = [&](Plane p) { return load(&s[p][b * LANES]); };
    return {at(RED),   at(GREEN),  at(BLUE),         at(ALPHA), at(NX),    at(NY),    at(NZ),
            at(DEPTH), at(MEDIAN), at(MEDIAN_BELOW), at(DIST2), at(DIST1), at(DEPTH0), at(TRANSMITTANCE), at(Z)};
}

// Upstream gradients as PixelGradient wants them, and S = the sum over all splats of w s, from the image's totals.
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
            sum = fma(V(2) * gx, at(dist[1]), sum);  // each pair counts for both of its splats
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

// The part of the depth by transmittance, after `start`, which is as short as without it.
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

constexpr int AHEAD = 8;  // records lie far apart: ask for them this many splats early

// Up to where a block is of interest: behind its last splat that has gradients, nothing needs its pixels any more.
struct Interest {
    uint32_t blocks = ALL_BLOCKS;
    int32_t last[BLOCKS];
    Interest(const Entry* entries, int32_t count, const uint8_t* rows) {
        if (!rows) return;
        blocks = 0;
        for (int32_t i = 0; i < count; ++i) {
            if (!rows[entries[i].splat()]) continue;
            blocks |= entries[i].blocks;
            for (uint32_t left = entries[i].blocks; left; left &= left - 1) last[__builtin_ctz(left)] = i;
        }
    }
    void passed(const Entry& entry, int32_t i) {
        for (uint32_t left = entry.blocks; left; left &= left - 1)
            blocks &= ~(uint32_t(last[__builtin_ctz(left)] == i) << __builtin_ctz(left));
    }
};

// A splat without gradients: only T and S move on. The same arithmetic as below, so the splats behind it get the same bits.
template <bool Geo, bool Dist>
__attribute__((noinline)) void pass_by(const real* record, bool plain, uint32_t blocks, Planes s,
                                       const Centres& centres, const BlendLimits<V>& limits) {
    const Record<V> splat = broadcast(record);
    const V zc = reciprocal(splat.iz);
    SplatPlanes planes;
    planes.set(record, centres);
    for (; blocks; blocks &= blocks - 1) {
        const int b = __builtin_ctz(blocks);
        const Hit<V> h = hit_at(splat, zc, planes.at(b), plain, centres, b, limits);
        V pixel_T = load(&s[T][b * LANES]), pixel_S = load(&s[S][b * LANES]);
        weigh_vjp<Geo, Dist, false>(splat, h.depth, h.inverse_depth, h.alpha, limits, load_gradient(s, b), pixel_T, pixel_S);
        store(&s[T][b * LANES], pixel_T);
        store(&s[S][b * LANES], pixel_S);
    }
}

constexpr bool COLORS_FIT = REGISTERS >= 32;  // the registers hold them beside what moves T and S on

// Pairs (splat, block) of some splats in a row. They are worked on in passes, each with a short chain of operations, so that
// those of many pairs overlap, and with little enough to remember for the registers: the planes; alphas; what moves T and S
// on; and the sums, splat by splat.
struct Batch {
    // as many as a splat may have; more would push the pixels out of the first cache
    static constexpr int PAIRS = BLOCKS;
    alignas(64) real depth[PAIRS][LANES], inverse_depth[PAIRS][LANES], rho[PAIRS][LANES];
    real alpha[PAIRS][LANES];                              // in the end dL/d ln(alpha)
    real I[PAIRS][LANES];                                  // dL/d(1 / z)
    real w[PAIRS][LANES];                                  // weight, where colours come after it
    M ray[PAIRS];                                          // of splats that are not plain
    uint8_t block[PAIRS + BLOCKS], splat[PAIRS + BLOCKS];  // `splat` counts within the batch
    // Of each splat. Its pairs are those before `end`; filtered: the low-pass filter decided one of them.
    SplatPlanes planes[PAIRS];
    const real* record[PAIRS];
    uint8_t end[PAIRS], filtered[PAIRS];
    uint32_t others = 0;  // a bit for each splat that is not plain
    int pairs = 0, splats = 0;

    bool has_room(uint32_t blocks) const { return pairs + __builtin_popcount(blocks) <= PAIRS; }

    // No branch depends on `blocks`: none could be foreseen.
    void add(const real* splat_record, bool plain, uint32_t blocks, const Centres& centres) {
        memset(&splat[pairs], splats, BLOCKS);
        for (int first = 0; first < BLOCKS; first += 8) {
            const uint32_t byte = blocks >> first & 255u;
            uint64_t numbers;
            memcpy(&numbers, BIT_NUMBERS.of[byte], sizeof numbers);
            numbers += 0x0101010101010101u * uint64_t(first);  // to each byte
            memcpy(&block[pairs], &numbers, sizeof numbers);
            pairs += __builtin_popcount(byte);
        }
        planes[splats].set(splat_record, centres);
        record[splats] = splat_record, filtered[splats] = 0;
        others |= uint32_t(!plain) << splats;
        end[splats++] = uint8_t(pairs);
    }
};

// All of them as if they were plain, which most are; then those that are not once more.
template <bool WithInverse> inline void find_hits(Batch& w, const Centres& centres, const BlendLimits<V>& limits) {
    const auto put = [&](int i, const Hit<V>& h) {
        store(w.depth[i], h.depth), store(w.rho[i], h.rho);
        if constexpr (WithInverse) store(w.inverse_depth[i], h.inverse_depth);
    };
    for (int i = 0; i < w.pairs; ++i) put(i, meet_plane(w.planes[w.splat[i]].at(w.block[i])));
    for (int i = 0; i < w.pairs; ++i)
        store(w.alpha[i], plain_alpha_of(V(w.record[w.splat[i]][9]), load(w.rho[i]), limits));
    for (uint32_t left = w.others; left; left &= left - 1) {
        const int j = __builtin_ctz(left);
        const Record<V> s = broadcast(w.record[j]);
        const V zc = reciprocal(s.iz);
        M filtered = V(1) < V(0);
        for (int i = j ? w.end[j - 1] : 0; i < w.end[j]; ++i) {
            const Hit<V> h = hit_at(s, zc, w.planes[j].at(w.block[i]), false, centres, w.block[i], limits);
            put(i, h);
            store(w.alpha[i], h.alpha);
            w.ray[i] = h.ray;
            filtered = filtered | and_not(h.alpha > V(0), h.ray);
        }
        w.filtered[j] = any(filtered);
    }
}

// Further channels of a tile, or nothing.
struct TileFeatures {
    const Features* all = nullptr;
    const real* upstream = nullptr;  // [rows, FEATURE_STRIDE]
    real* slots = nullptr;           // [slots, rows], from the next splat's on
    FeaturePairs* pairs = nullptr;
    int done = 0;  // of `pairs`: those that have their weight
};

// Takes the splats of so many entries: their part of dL/dw.
void begin_features(TileFeatures& t, const Entry* entries, int count) {
    FeaturePairs& pairs = *t.pairs;
    pairs.pairs = pairs.splats = t.done = 0;
    for (int i = 0; i < count; ++i) pairs.add(entries[i], *t.all);
    memset(pairs.of_pair, 0, sizeof pairs.of_pair[0] * pairs.pairs);
    for_each_channels(feature_rows(t.all->count), [&](auto n, int64_t c) {
        constexpr int N = decltype(n)::value;
        pairs.for_each_splat([&](int j, int first, int end) {
            V values[N];
            load_channels<N>(*t.all, pairs.splat[j], c, values);
            for (int i = first; i < end; ++i) {
                const real* const at = t.upstream + c * FEATURE_STRIDE + pairs.block[i] * LANES;
                V sums[4] = {load(pairs.of_pair[i]), V(0), V(0), V(0)};  // so that none waits for the one before
                for (int k = 0; k < N; ++k) sums[k % 4] = fma(load(at + k * FEATURE_STRIDE), values[k], sums[k % 4]);
                store(pairs.of_pair[i], (sums[0] + sums[1]) + (sums[2] + sums[3]));
            }
        });
    });
}

// Writes the slots of those splats, from the weights.
void finish_features(TileFeatures& t) {
    const FeaturePairs& pairs = *t.pairs;
    const int64_t rows = feature_rows(t.all->count);
    for_each_channels(rows, [&](auto n, int64_t c) {
        constexpr int N = decltype(n)::value;
        pairs.for_each_splat([&](int j, int first, int end) {
            V sums[N];
            for (int k = 0; k < N; ++k) sums[k] = V(0);
            for (int i = first; i < end; ++i) {
                const V w = load(pairs.of_pair[i]);
                const real* const at = t.upstream + c * FEATURE_STRIDE + pairs.block[i] * LANES;
                for (int k = 0; k < N; ++k) sums[k] = fma(w, load(at + k * FEATURE_STRIDE), sums[k]);
            }
            for (int k = 0; k < N; k += 4) transpose_reduce<4>(sums + k, t.slots + j * rows + c + k);
        });
    });
    t.slots += pairs.splats * rows;
}

// One pair: T and S move on; what its sums need is left in the batch.
template <bool Geo, bool Dist, bool Trans, bool Feat>
inline PairGradient<V> weigh_pair(Batch& w, int i, const Record<V>& splat, const PixelGradient<V>& g, Planes s,
                                  const BlendLimits<V>& limits, V features = V(0)) {
    const int at = w.block[i] * LANES;
    V pixel_T = load(&s[T][at]), pixel_S = load(&s[S][at]);
    const V inverse_depth = Dist || Trans ? load(w.inverse_depth[i]) : V(0);
    const PairGradient<V> p =
        weigh_vjp<Geo, Dist, Trans, Feat>(splat, load(w.depth[i]), inverse_depth, load(w.alpha[i]), limits, g,
                                              pixel_T, pixel_S, features);
    store(&s[T][at], pixel_T), store(&s[S][at], pixel_S);
    store(w.alpha[i], p.ln_alpha);
    if constexpr (Geo) store(w.I[i], p.I);
    return p;
}

// Of one splat, whose pairs these are. Colors: add_colors is left to do, for which the weights are there.
template <bool Geo, bool Abs, bool Filtered, bool Colors>
inline void sum_pairs(const Batch& w, int j, int first, int end, const Record<V>& splat, const Planes s,
                      const Centres& centres, PairSums<V>& sums) {
    const auto pair = [&](int i) -> PairGradient<V> {
        return {Colors ? load(w.w[i]) : V(0), load(w.alpha[i]), Geo ? load(w.I[i]) : V(0)};
    };
    const auto geometry = [&](int i) {
        const int b = w.block[i];
        const PairGradient<V> p = pair(i);
        const PlaneAt<V> plane = w.planes[j].at(b);  // again: cheaper than to remember u and v
        const V depth = load(w.depth[i]), t = p.ln_alpha * depth, tz = t * depth;
        V tu = tz * plane.X, tv = tz * plane.Y;
        M ray;
        if constexpr (Filtered) ray = w.ray[i], tu = keep(ray, tu), tv = keep(ray, tv);
        add_geometry<Geo, Abs, Filtered, false>(splat, centres.at_x(b) - splat.cx, centres.at_y(b) - splat.cy, t, tu,
                                                tv, load(w.rho[i]), Abs ? load(w.inverse_depth[i]) : V(0), ray, p,
                                                sums);
    };
    for (int i = first; i < end; ++i) geometry(i);
    if constexpr (Colors)
        for (int i = first; i < end; ++i) add_colors<Geo>(load_gradient(s, w.block[i]), pair(i), sums);
}

template <bool Abs>
inline void write_slot(const Record<V>& splat, const PairSums<V>& sums, bool filtered, const Slots& to,
                       const BlendLimits<V>& limits) {
    RecordGradient<V> g = finish(splat, Abs ? reciprocal(splat.iz) : V(0), sums, limits);
    if (!to.extras) g.cx = g.cx + g.lowpass_cx, g.cy = g.cy + g.lowpass_cy;  // nobody asks for them apart
    const V fields[16] = {g.cx, g.cy,         g.au,  g.bu,    g.av,   g.bv, g.ai, g.bi,
                          g.iz, g.ln_opacity, g.red, g.green, g.blue, g.nx, g.ny, g.nz};
    transpose_reduce<GRADIENT>(fields, to.gradients);
    if (!to.extras) return;
    *to.has_extra = Abs || filtered;
    const V extra[4] = {g.lowpass_cx, g.lowpass_cy, g.abs_x, g.abs_y};
    if (Abs || filtered) transpose_reduce<GRADIENT_EXTRA>(extra, to.extras);
}

// Empties the batch; returns where the next splat's slot is.
template <bool Geo, bool Dist, bool Abs, bool Trans, bool Feat>
__attribute__((noinline)) Slots finish_batch(Batch& w, Slots to, Planes s, const Centres& centres,
                                             const BlendLimits<V>& limits, TileFeatures& features) {
    constexpr bool WEIGHTS_FIRST = !COLORS_FIT || Feat;
    find_hits<Dist || Abs || Trans>(w, centres, limits);
    if constexpr (WEIGHTS_FIRST)
        for (int i = 0; i < w.pairs; ++i) {
            const PixelGradient<V> g = load_gradient(s, w.block[i]);
            const Record<V> splat = broadcast(w.record[w.splat[i]]);
            if constexpr (Feat) {
                real* const of_pair = features.pairs->of_pair[features.done++];
                const V weight = weigh_pair<Geo, Dist, Trans, true>(w, i, splat, g, s, limits, load(of_pair)).w;
                store(w.w[i], weight), store(of_pair, weight);
            } else {
                store(w.w[i], weigh_pair<Geo, Dist, Trans, false>(w, i, splat, g, s, limits).w);
            }
        }
    for (int j = 0, first = 0; j < w.splats; first = w.end[j++], to = to.from(1)) {
        const V zero = V(0);
        PairSums<V> sums = {zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero,
                            zero, zero, zero, zero, zero, zero, zero, zero, zero, zero};
        const Record<V> splat = broadcast(w.record[j]);
        if constexpr (!WEIGHTS_FIRST) {  // both read the same pixels
            int i = first;
            do {
                const PixelGradient<V> g = load_gradient(s, w.block[i]);
                add_colors<Geo>(g, weigh_pair<Geo, Dist, Trans, false>(w, i, splat, g, s, limits), sums);
            } while (++i < w.end[j]);
        }
        if (w.filtered[j])
            sum_pairs<Geo, Abs, true, WEIGHTS_FIRST>(w, j, first, w.end[j], splat, s, centres, sums);
        else
            sum_pairs<Geo, Abs, false, WEIGHTS_FIRST>(w, j, first, w.end[j], splat, s, centres, sums);
        write_slot<Abs>(splat, sums, w.filtered[j], to, limits);
    }
    w.pairs = w.splats = 0, w.others = 0;
    return to;
}

template <bool Geo, bool Dist, bool Abs, bool Trans = false, bool Feat = false>
void tile_vjp(const Frame& f, int64_t tile, Slots to, const uint8_t* rows, Planes s, const TileArea& area,
              const BlendLimits<V>& limits, RowsAhead next, TileFeatures features) {
    const Centres centres(area);
    Batch batch;
    const Entry* entry = &f.entries[f.tile_begin[tile]];
    const int32_t count = f.tile_count[tile];
    Interest interest(entry, count, rows);
    for (int32_t at = 0; at < count && interest.blocks; ++at, ++entry) {
        if constexpr (Feat)
            if (at % FeaturePairs::SPLATS == 0) {
                if (batch.splats) to = finish_batch<Geo, Dist, Abs, Trans, Feat>(batch, to, s, centres, limits, features);
                if (at > 0) finish_features(features);
                begin_features(features, entry, count - at < FeaturePairs::SPLATS ? count - at : FeaturePairs::SPLATS);
            }
        next.ask();
        if (at + AHEAD < count) __builtin_prefetch(&f.records[size_t(entry[AHEAD].splat()) * RECORD]);
        const real* record = &f.records[size_t(entry->splat()) * RECORD];
        const bool learns = !rows || rows[entry->splat()];
        if (batch.splats && !(learns && batch.has_room(entry->blocks)))
            to = finish_batch<Geo, Dist, Abs, Trans, Feat>(batch, to, s, centres, limits, features);
        if (!learns) {
            pass_by<Geo, Dist>(record, entry->plain(), entry->blocks & interest.blocks, s, centres, limits);
            continue;
        }
        if (rows) interest.passed(*entry, at);
        batch.add(record, entry->plain(), entry->blocks, centres);
    }
    if (batch.splats) finish_batch<Geo, Dist, Abs, Trans, Feat>(batch, to, s, centres, limits, features);
    if constexpr (Feat) finish_features(features);
}

// Only the colours' gradients: no geometry, no opacity.
void tile_color_vjp(const Frame& f, int64_t tile, Slots to, const uint8_t* rows, Planes s, const TileArea& area,
                    const BlendLimits<V>& limits, RowsAhead next, TileFeatures) {
    const Centres centres(area);
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
            const Hit<V> hit = hit_at(splat, zc, planes.at(b), entry->plain(), centres, b, limits);
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

using TileVjp = void (*)(const Frame&, int64_t, Slots, const uint8_t*, Planes, const TileArea&, const BlendLimits<V>&,
                         RowsAhead, TileFeatures);

TileVjp variant(bool geo, bool dist, bool abs, bool trans, bool color_only, bool features) {
    if (features && dist) return abs ? tile_vjp<true, true, true, false, true> : tile_vjp<true, true, false, false, true>;
    if (features) return abs ? tile_vjp<true, false, true, false, true> : tile_vjp<true, false, false, false, true>;
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
