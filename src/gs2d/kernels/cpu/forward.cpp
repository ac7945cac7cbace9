// Blending, front to back, one tile per task: block by block, with the pixel state in registers.
#include "cpu/frame.h"
#include "cpu/planes.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

constexpr int CHUNK = 256;  // entries per batch; their state fits in the L1 cache

// Members of Pixel<V>, stored in memory between chunks.
enum Plane { RED, GREEN, BLUE, NX, NY, NZ, ALPHA, DEPTH, MEDIAN, DISTORTION, T, M1_TWICE, M2, DEPTH0, PLANES };

struct TileState {
    alignas(64) real planes[PLANES][PIXELS];
    M live[BLOCKS];
    bool finished[BLOCKS];
};

// A splat that reaches the tile.
struct Candidate {
    PlanesByBlock planes;
    real record[RECORD];
    LaneBits seen[BLOCKS];  // live pixels of the block that use the splat
    uint8_t filtered;       // nonzero if the splat is not plain
};

struct TileWork {
    alignas(64) Candidate candidates[CHUNK];
    uint32_t splats[CHUNK];
    uint8_t plain[CHUNK];
    uint32_t touched[CHUNK + LANES], list[CHUNK + LANES];  // read and written a vector at a time
    TileState state;

    // Block lists contain byte offsets from the first candidate, so no multiplication is needed.
    Candidate& at(uint32_t offset) {
        return *reinterpret_cast<Candidate*>(reinterpret_cast<char*>(candidates) + offset);
    }
    const Candidate& at(uint32_t offset) const { return const_cast<TileWork*>(this)->at(offset); }
};

inline Pixel<V> load_pixel(const TileState& s, int b) {
    const auto at = [&](Plane p) { return load(&s.planes[p][b * LANES]); };
    return {at(T),     at(ALPHA),  at(RED),    at(GREEN),    at(BLUE), at(NX),         at(NY),   at(NZ),
            at(DEPTH), at(MEDIAN), at(DEPTH0), at(M1_TWICE), at(M2),   at(DISTORTION), s.live[b]};
}

inline void store_pixel(TileState& s, int b, const Pixel<V>& p) {
    const auto at = [&](Plane k, V v) { store(&s.planes[k][b * LANES], v); };
    at(T, p.T), at(ALPHA, p.alpha), at(RED, p.red), at(GREEN, p.green), at(BLUE, p.blue), at(NX, p.nx), at(NY, p.ny);
    at(NZ, p.nz), at(DEPTH, p.depth), at(MEDIAN, p.median), at(DEPTH0, p.inverse_depth0), at(M1_TWICE, p.M1_twice),
        at(M2, p.M2);
    at(DISTORTION, p.distortion);
    s.live[b] = p.live;
    s.finished[b] = !any(p.live);
}

// BATCH splats are intersected and then composited. Intersections do not depend on the pixel state, so many of them
// overlap, and the state stays in registers during compositing.
constexpr int BATCH = 8;
// gcc would unroll all 8 rounds and, with 16 registers, spill the state in each round
constexpr int UNROLL = REGISTERS >= 32 ? 2 : 1;

// Results of the intersections, one row per splat.
struct Batch {
    alignas(64) real log2_alpha[BATCH][LANES], depth[BATCH][LANES], inverse_depth[BATCH][LANES];
};

template <bool Early>
inline void composite_batch(TileWork& w, const uint32_t* list, int count, int b, Batch& batch,
                            const BlendLimits<V>& limits, Pixel<V>& p) {
    const auto weigh = [&](int i) {
        const V log2_alpha = load(batch.log2_alpha[i]);
        w.at(list[i]).seen[b] = LaneBits(bits(p.live & (log2_alpha >= limits.log2_alpha_min)));
        return composite_weight<Early>(alpha_of(log2_alpha, limits), load(batch.depth[i]), load(batch.inverse_depth[i]),
                                       limits, p);
    };
    const auto add = [&](int i, V weight) {
        accumulate(broadcast(w.at(list[i]).record), weight, load(batch.depth[i]), p);
    };
    if constexpr (REGISTERS >= 32) {
#pragma GCC unroll UNROLL
        for (int i = 0; i < count; ++i) add(i, weigh(i));
    } else {  // the pixel state does not fit in registers: process it in two halves
#pragma GCC unroll UNROLL
        for (int i = 0; i < count; ++i) store(batch.log2_alpha[i], weigh(i));
#pragma GCC unroll UNROLL
        for (int i = 0; i < count; ++i) add(i, load(batch.log2_alpha[i]));
    }
}

// Process all splats as plain, since most are, then repeat those that are not.
inline void intersect_batch(const TileWork& w, const uint32_t* list, int count, int b, const Centres& centres,
                            Batch& batch, const BlendLimits<V>& limits) {
    uint32_t others = 0;
#pragma GCC unroll UNROLL
    for (int i = 0; i < count; ++i) {
        const Candidate& c = w.at(list[i]);
        const Hit<V> h = meet_plane(c.planes.at(b, centres));
        store(batch.depth[i], h.depth), store(batch.inverse_depth[i], h.inverse_depth);
        store(batch.log2_alpha[i], log2_alpha_of(c.planes.log2_opacity(b), h.rho));
        others |= uint32_t(c.filtered) << i;
    }
    for (; others; others &= others - 1) {
        const int i = __builtin_ctz(others);
        const Candidate& c = w.at(list[i]);
        const Hit<V> h = meet_at(c.record, c.planes.at(b, centres), centres, b, limits);
        store(batch.depth[i], h.depth), store(batch.inverse_depth[i], h.inverse_depth);
        store(batch.log2_alpha[i], log2_alpha_of(c.planes.log2_opacity(b), h, limits));
    }
}

void blend_block(TileWork& w, int b, int n, const Centres& centres, const BlendLimits<V>& limits) {
    const int count = multiples_with_bit<sizeof(Candidate)>(w.touched, n, b, w.list);
    if (count == 0) return;
    Pixel<V> p = load_pixel(w.state, b);
    for (int j = 0; j < count; j += BATCH) {
        Batch batch;
        const int m = count - j < BATCH ? count - j : BATCH;
        intersect_batch(w, w.list + j, m, b, centres, batch, limits);
        if (any(p.live & ((p.alpha <= V(0)) | (p.T > V(real(0.5))))))
            composite_batch<true>(w, w.list + j, m, b, batch, limits, p);
        else
            composite_batch<false>(w, w.list + j, m, b, batch, limits, p);
        if (!any(p.live)) break;
    }
    store_pixel(w.state, b, p);
}

// Collects the chunk entries that reach a live block, with their records in consecutive memory.
int gather(const Frame& f, TileWork& w, const Entry* entries, int n, const TileBounds& bounds, const Centres& centres) {
    uint32_t wanted = 0;
    for (int b = 0; b < BLOCKS; ++b) wanted |= uint32_t(!w.state.finished[b]) << b;
    int m = 0;
    constexpr int AHEAD = 16;  // prefetch distance for the scattered data of splats
    for (int i = 0; i < n; i += LANES) {
        uint32_t splats[LANES], touched[LANES];
        for (int j = 0; j < LANES; ++j) {
            splats[j] = entries[i + j < n ? i + j : n - 1].splat();
            if (i + j + AHEAD < n) {
                __builtin_prefetch(&f.cull[entries[i + j + AHEAD].splat()]);
                __builtin_prefetch(&f.records[size_t(entries[i + j + AHEAD].splat()) * RECORD]);
            }
        }
        const Footprints footprints(f, splats);
        blocks_touched(f, footprints, bounds, touched);
        const uint32_t plain = bits(plain_over_tile(f, footprints, bounds));
        for (int j = 0; j < LANES && i + j < n; ++j) {
            const uint32_t blocks = touched[j] & wanted;
            w.splats[m] = splats[j];
            w.plain[m] = plain >> j & 1;
            w.touched[m] = blocks;
            m += blocks != 0;
        }
    }
    for (int i = 0; i < m; ++i) {
        const real* const record = &f.records[size_t(w.splats[i]) * RECORD];
        Candidate& c = w.candidates[i];
        for (int k = 0; k < RECORD; k += LANES) store(c.record + k, load(record + k));
        c.planes.set(record, centres);
        memset(c.seen, 0, sizeof c.seen);
        c.filtered = !w.plain[i];
    }
    return m;
}

void start(TileState& s, const TileArea& area) {
    memset(s.planes, 0, sizeof s.planes);
    for (int i = 0; i < PIXELS; ++i) s.planes[T][i] = 1;
    for (int b = 0; b < BLOCKS; ++b) {
        s.live[b] = lanes_inside(block_x(b), block_y(b), area.width, area.height);
        s.finished[b] = !any(s.live[b]);
    }
}

void write(const Frame& f, TileState& s, const TileArea& a, const Images& out) {
    const View& v = f.view;
    const V bg[3] = {V(real(v.background[0])), V(real(v.background[1])), V(real(v.background[2]))};
    const double lever = v.far * v.near / (v.far - v.near);
    for (int i = 0; i < PIXELS; i += LANES) {
        const V t = load(&s.planes[T][i]), alpha = load(&s.planes[ALPHA][i]);
        for (int c = 0; c < 3; ++c) store(&s.planes[RED + c][i], fma(t, bg[c], load(&s.planes[RED + c][i])));
        const V depth = load(&s.planes[DEPTH][i]) / select(alpha > V(0), alpha, V(1));
        store(&s.planes[DEPTH][i], depth);
        store(&s.planes[DISTORTION][i], load(&s.planes[DISTORTION][i]) * V(real(lever * lever)));
        store(&s.planes[M1_TWICE][i], load(&s.planes[M1_TWICE][i]) * V(real(0.5)));  // M1
    }
    const int64_t pixels = int64_t(v.width) * v.height;
    write_planes<3>(s.planes[RED], out.color, v.width, a);
    write_planes<3>(s.planes[NX], out.normal, v.width, a);
    write_planes<1>(s.planes[ALPHA], out.alpha, v.width, a);
    write_planes<1>(s.planes[DEPTH], out.depth_mean, v.width, a);
    write_planes<1>(s.planes[MEDIAN], out.depth_median, v.width, a);
    write_planes<1>(s.planes[DISTORTION], out.distortion, v.width, a);
    const Plane saved[4] = {T, M1_TWICE, M2, DEPTH0};
    for (int k = 0; k < 4; ++k) write_planes<1>(s.planes[saved[k]], &f.saved[k * pixels], v.width, a);
}

RowLines images_written(const Frame& f, const Images& out) {
    const int64_t pixels = int64_t(f.view.width) * f.view.height;
    RowLines lines(f.view);
    lines.add(out.color, 3), lines.add(out.normal, 3);
    lines.add(out.alpha, 1), lines.add(out.depth_mean, 1), lines.add(out.depth_median, 1), lines.add(out.distortion, 1);
    for (int k = 0; k < 4; ++k) lines.add(&f.saved[k * pixels], 1);
    return lines;
}

void blend_tile(Frame& f, int64_t tile, const Images& out, const RowLines& written, const BlendLimits<V>& limits) {
    TileWork w;
    const TileArea area = tile_area(f, tile);
    const Centres centres(f, area);
    const TileBounds bounds(centres, area);
    start(w.state, area);
    RowsAhead rows(f, written, tile, BLOCKS);
    Entry* const begin = &f.entries[f.tile_begin[tile]];
    Entry* const end = &f.entries[f.tile_begin[tile + 1]];
    Entry* kept = begin;
    for (Entry* e = begin; e < end; e += CHUNK) {
        const int n = gather(f, w, e, end - e < CHUNK ? static_cast<int>(end - e) : CHUNK, bounds, centres);
        bool live = false;
        for (int b = 0; b < BLOCKS; ++b) {
            rows.ask();
            if (!w.state.finished[b]) blend_block(w, b, n, centres, limits);
            live |= !w.state.finished[b];
        }
        for (int i = 0; i < n; ++i) {
            const uint32_t seen = nonzero(w.candidates[i].seen);
            *kept = {w.splats[i] | uint32_t(w.plain[i]) << 31, seen};
            kept += seen != 0;
        }
        if (!live) break;
    }
    f.tile_count[tile] = static_cast<int32_t>(kept - begin);
    write(f, w.state, area, out);
}

}  // namespace

bool blend_tiles(Frame& f, const Images& out) {
    if (!f.tile_count.reserve(f.tiles) || !f.taken.reserve(f.groups())) return false;
    if (!f.saved.reserve(4 * size_t(f.view.width) * f.view.height)) return false;
    const BlendLimits<V> limits = limits_of(f.view);
    const RowLines written = images_written(f, out);
    memset(static_cast<void*>(f.taken.data), 0, f.groups());
    parallel_for(get_threads(), [&](int64_t) {
        share_out(0, f.groups(), f.taken.data, [&](int64_t group) {
            for (int64_t tile = group * GROUP; tile < (group + 1) * GROUP && tile < f.tiles; ++tile)
                blend_tile(f, tile, out, written, limits);
        });
    });
    return true;
}

}  // namespace gs2d
