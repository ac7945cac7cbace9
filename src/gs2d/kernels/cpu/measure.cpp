// Measurements of the rasterizer for benchmarks: time per pass, exact amounts of work, memory. Rendering and training
// do not use this file.
#include <string.h>

#include "cpu/export.h"
#include "cpu/frame.h"
#include "cpu/planes.h"
#include "cpu/stages.h"
#include "cpu/threads.h"

namespace gs2d_shared {
__thread int64_t stage_ns[STAGES];
}

namespace gs2d {

namespace {

struct PairCounts {
    int64_t visible, lanes;
};

// Replays one tile like the backward pass. A pair is visible if a pixel that has not stopped uses the splat.
PairCounts count_tile(const Frame& f, int64_t tile, const BlendLimits<V>& limits) {
    alignas(64) real T[BLOCKS][LANES];
    const TileArea area = tile_area(f, tile);
    for (int b = 0; b < BLOCKS; ++b)
        store(T[b], keep(lanes_inside(block_x(b), block_y(b), area.width, area.height), V(1)));
    const Centres centres(f, area);
    PairCounts counts = {0, 0};
    const Entry* entry = &f.entries[f.tile_begin[tile]];
    for (int32_t i = 0; i < f.tile_count[tile]; ++i, ++entry) {
        const real* const record = &f.records[size_t(entry->splat()) * RECORD];
        const Record<V> s = broadcast(record);
        const V zc = reciprocal(s.iz);
        SplatPlanes planes;
        planes.set(record, centres);
        for (uint32_t blocks = entry->blocks; blocks; blocks &= blocks - 1) {
            const int b = __builtin_ctz(blocks);
            const Hit<V> h = hit_at(s, zc, planes.at(b, centres), entry->plain(), centres, b, limits);
            const V before = load(T[b]), after = fnma(min(h.alpha, limits.alpha_max), before, before);
            counts.visible += __builtin_popcount(bits((h.alpha > V(0)) & (before > V(0))));
            counts.lanes += LANES;
            store(T[b], keep(after >= limits.transmittance_min, after));
        }
    }
    return counts;
}

}  // namespace
}  // namespace gs2d

using namespace gs2d;

// Writes the nanoseconds of the last forward and backward pass of the calling thread, in the order of enum Stage.
// Returns the number of stages.
GS2D_EXPORT int gs2d_stage_times(int64_t* ns) {
    memcpy(ns, stage_ns, sizeof stage_ns);
    return STAGES;
}

// Counts the work of the view of a forward pass: visible (pixel, splat) pairs; lane pairs that the backward pass
// computes; (tile, splat) entries before and after the forward pass; splats in the view; slots of the largest chunk of
// the last backward pass.
GS2D_EXPORT int gs2d_frame_counts(Frame* frame, int64_t counts[6]) {
    const Frame& f = *frame;
    const BlendLimits<V> limits = limits_of(f.view);
    Buffer<PairCounts> tiles;
    if (!tiles.reserve(f.tiles)) return 1;
    parallel_for(f.tiles, [&](int64_t tile) { tiles[tile] = count_tile(f, tile, limits); });
    memset(counts, 0, 6 * sizeof(int64_t));
    for (int64_t t = 0; t < f.tiles; ++t) {
        counts[0] += tiles[t].visible;
        counts[1] += tiles[t].lanes;
        counts[3] += f.tile_count[t];
    }
    counts[2] = f.tile_begin[f.tiles];
    counts[4] = f.visible;
    counts[5] = f.largest_chunk;
    tiles.release();
    return 0;
}
