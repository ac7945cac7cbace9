// Backward pass over the splats of a tile, instantiated in backward.cpp and features_vjp.cpp. There are two files
// because compiler inlining depends on the amount of code in a file.
#pragma once

#include "cpu/features.h"
#include "cpu/frame.h"
#include "cpu/gradient_sums.h"
#include "cpu/planes.h"

namespace gs2d {
namespace {

// Per pixel of the tile, in block order: state, then the members of PixelGradient<V>.
enum Plane {
    T, S, RED, GREEN, BLUE, ALPHA, NX, NY, NZ, DEPTH, MEDIAN, MEDIAN_BELOW, DIST2, DIST1, DEPTH0, TRANSMITTANCE, Z, PLANES
};
using Planes = real (*)[PIXELS];

inline PixelGradient<V> load_gradient(const Planes s, int b) {
    const auto at = [&](Plane p) { return load(&s[p][b * LANES]); };
    return {at(RED),   at(GREEN),  at(BLUE),         at(ALPHA), at(NX),    at(NY),    at(NZ),
            at(DEPTH), at(MEDIAN), at(MEDIAN_BELOW), at(DIST2), at(DIST1), at(DEPTH0), at(TRANSMITTANCE), at(Z)};
}

constexpr int AHEAD = 8;  // prefetch distance for the scattered records, in splats

// Marks the end of a block: the pixels behind its last splat with gradients are not needed.
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

// A splat without gradients updates only T and S, with the same arithmetic as below, so later splats keep their bits.
template <bool Geo, bool Dist>
__attribute__((noinline)) void pass_by(const real* record, bool plain, uint32_t blocks, Planes s,
                                       const Centres& centres, const BlendLimits<V>& limits) {
    const Record<V> splat = broadcast(record);
    const V zc = reciprocal(splat.iz);
    SplatPlanes planes;
    planes.set(record, centres);
    for (; blocks; blocks &= blocks - 1) {
        const int b = __builtin_ctz(blocks);
        const Hit<V> h = hit_at(splat, zc, planes.at(b, centres), plain, centres, b, limits);
        V pixel_T = load(&s[T][b * LANES]), pixel_S = load(&s[S][b * LANES]);
        weigh_vjp<Geo, Dist, false>(splat, h.depth, h.inverse_depth, h.alpha, limits, load_gradient(s, b), pixel_T, pixel_S);
        store(&s[T][b * LANES], pixel_T);
        store(&s[S][b * LANES], pixel_S);
    }
}

constexpr bool COLORS_FIT = REGISTERS >= 32;  // true if colours fit in registers during the update of T and S

// (splat, block) pairs of consecutive splats, processed in passes: planes, alphas, updates of T and S, and the sums of
// each splat. Short dependency chains let many pairs overlap, and the small state of each pass fits in registers.
struct Batch {
    // maximum of one splat; a larger batch would evict the pixels from the L1 cache
    static constexpr int PAIRS = BLOCKS;
    alignas(64) real depth[PAIRS][LANES], inverse_depth[PAIRS][LANES], rho[PAIRS][LANES];
    real alpha[PAIRS][LANES];                              // finally dL/d ln(alpha)
    real I[PAIRS][LANES];                                  // dL/d(1 / z)
    real w[PAIRS][LANES];                                  // weight, if colours are processed afterwards
    M ray[PAIRS];                                          // set for splats that are not plain
    uint8_t block[PAIRS + BLOCKS], splat[PAIRS + BLOCKS];  // `splat` counts within the batch
    // Per splat. Its pairs end at `end`; filtered: the low-pass filter determined rho for at least one of them.
    SplatPlanes planes[PAIRS];
    const real* record[PAIRS];
    uint8_t end[PAIRS], filtered[PAIRS];
    uint32_t others = 0;  // bit mask of splats that are not plain
    int pairs = 0, splats = 0;

    bool has_room(uint32_t blocks) const { return pairs + __builtin_popcount(blocks) <= PAIRS; }

    // Does not branch on `blocks`, since such branches are unpredictable.
    void add(const real* splat_record, bool plain, uint32_t blocks, const Centres& centres) {
        memset(&splat[pairs], splats, BLOCKS);
        for (int first = 0; first < BLOCKS; first += 8) {
            const uint32_t byte = blocks >> first & 255u;
            uint64_t numbers;
            memcpy(&numbers, BIT_NUMBERS.of[byte], sizeof numbers);
            numbers += 0x0101010101010101u * uint64_t(first);  // added to each byte
            memcpy(&block[pairs], &numbers, sizeof numbers);
            pairs += __builtin_popcount(byte);
        }
        planes[splats].set(splat_record, centres);
        record[splats] = splat_record, filtered[splats] = 0;
        others |= uint32_t(!plain) << splats;
        end[splats++] = uint8_t(pairs);
    }
};

// Processes all splats as plain, since most are, then repeats those that are not.
template <bool WithInverse> inline void find_hits(Batch& w, const Centres& centres, const BlendLimits<V>& limits) {
    const auto put = [&](int i, const Hit<V>& h) {
        store(w.depth[i], h.depth), store(w.rho[i], h.rho);
        if constexpr (WithInverse) store(w.inverse_depth[i], h.inverse_depth);
    };
    for (int i = 0; i < w.pairs; ++i) put(i, meet_plane(w.planes[w.splat[i]].at(w.block[i], centres)));
    for (int i = 0; i < w.pairs; ++i)
        store(w.alpha[i], plain_alpha_of(V(w.record[w.splat[i]][9]), load(w.rho[i]), limits));
    for (uint32_t left = w.others; left; left &= left - 1) {
        const int j = __builtin_ctz(left);
        const Record<V> s = broadcast(w.record[j]);
        const V zc = reciprocal(s.iz);
        M filtered = V(1) < V(0);
        for (int i = j ? w.end[j - 1] : 0; i < w.end[j]; ++i) {
            const Hit<V> h = hit_at(s, zc, w.planes[j].at(w.block[i], centres), false, centres, w.block[i], limits);
            put(i, h);
            store(w.alpha[i], h.alpha);
            w.ray[i] = h.ray;
            filtered = filtered | and_not(h.alpha > V(0), h.ray);
        }
        w.filtered[j] = any(filtered);
    }
}

// Processes one pair: updates T and S, and stores the inputs of its sums in the batch.
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

// Sums the pairs of one splat. Colors: add_colors follows and uses the stored weights.
template <bool Geo, bool Abs, bool Filtered, bool Colors>
inline void sum_pairs(const Batch& w, int j, int first, int end, const Record<V>& splat, const Planes s,
                      const Centres& centres, PairSums<V>& sums) {
    const auto pair = [&](int i) -> PairGradient<V> {
        return {Colors ? load(w.w[i]) : V(0), load(w.alpha[i]), Geo ? load(w.I[i]) : V(0)};
    };
#if GS2D_RAYS
    const Perpendicular<V> e = perpendicular(splat.direction);
    const Vec3<V> unit_x = {dot(splat.row0, e.first), dot(splat.row1, e.first), dot(splat.row2, e.first)},
                  unit_y = {dot(splat.row0, e.second), dot(splat.row1, e.second), dot(splat.row2, e.second)};
#endif
    const auto geometry = [&](int i) {
        const int b = w.block[i];
        const PairGradient<V> p = pair(i);
        const PlaneAt<V> plane = w.planes[j].at(b, centres);  // recomputed, which is cheaper than storing u and v
        const V depth = load(w.depth[i]), t = p.ln_alpha * depth, tz = t * depth;
        V tu = tz * plane.X, tv = tz * plane.Y;
        M ray;
        if constexpr (Filtered) ray = w.ray[i], tu = keep(ray, tu), tv = keep(ray, tv);
#if GS2D_RAYS
        add_geometry<Geo, Abs, Filtered>(centres.from(splat.direction, b), unit_x, unit_y, t, tu, tv, load(w.rho[i]),
                                         Abs ? load(w.inverse_depth[i]) : V(0), ray, p, sums);
#else
        add_geometry<Geo, Abs, Filtered, false>(splat, centres.at_x(b) - splat.cx, centres.at_y(b) - splat.cy, t, tu,
                                                tv, load(w.rho[i]), Abs ? load(w.inverse_depth[i]) : V(0), ray, p,
                                                sums);
#endif
    };
    for (int i = first; i < end; ++i) geometry(i);
    if constexpr (Colors)
        for (int i = first; i < end; ++i) add_colors<Geo>(load_gradient(s, w.block[i]), pair(i), sums);
}

template <bool Abs>
inline void write_slot(const Record<V>& splat, const PairSums<V>& sums, bool filtered, const Slots& to,
                       const BlendLimits<V>& limits) {
    RecordGradient<V> g = finish(splat, Abs ? reciprocal(splat.iz) : V(0), sums, limits);
#if GS2D_RAYS
    (void)filtered;
    const V zero = V(0);
    const V rows[16] = {g.row0.x, g.row0.y,     g.row0.z, g.row1.x, g.row1.y, g.row1.z, g.row2.x, g.row2.y,
                        g.row2.z, g.ln_opacity, g.red,    g.green,  g.blue,   g.nx,     g.ny,     g.nz};
    const V others[4] = {g.direction.x, g.direction.y, g.direction.z, g.iz}, extra[4] = {zero, zero, g.abs_x, g.abs_y};
    transpose_reduce<16>(rows, to.gradients);
    transpose_reduce<4>(others, to.gradients + 16);
    for (int k = RECORD_FIELDS; k < GRADIENT; ++k) to.gradients[k] = 0;
    if (!to.extras) return;
    *to.has_extra = Abs;
    if (Abs) transpose_reduce<GRADIENT_EXTRA>(extra, to.extras);
#else
    if (!to.extras) g.cx = g.cx + g.lowpass_cx, g.cy = g.cy + g.lowpass_cy;  // not needed separately
    const V fields[16] = {g.cx, g.cy,         g.au,  g.bu,    g.av,   g.bv, g.ai, g.bi,
                          g.iz, g.ln_opacity, g.red, g.green, g.blue, g.nx, g.ny, g.nz};
    transpose_reduce<GRADIENT>(fields, to.gradients);
    if (!to.extras) return;
    *to.has_extra = Abs || filtered;
    const V extra[4] = {g.lowpass_cx, g.lowpass_cy, g.abs_x, g.abs_y};
    if (Abs || filtered) transpose_reduce<GRADIENT_EXTRA>(extra, to.extras);
#endif
}

// Empties the batch; returns the slot of the next splat.
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
        PairSums<V> sums = {
#if GS2D_RAYS
                            zero,
#endif
                            zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero,
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
    const Centres centres(f, area);
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

}  // namespace

using TileVjp = void (*)(const Frame&, int64_t, Slots, const uint8_t*, Planes, const TileArea&, const BlendLimits<V>&,
                         RowsAhead, TileFeatures);

// Instantiations with gradients of further channels.
TileVjp feature_variant(bool dist, bool abs);

}  // namespace gs2d
