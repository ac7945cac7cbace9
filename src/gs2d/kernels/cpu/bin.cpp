// Sorts splats by depth, then builds the splat lists of the tiles by a counting sort, which needs no key per entry.
#include "cpu/frame.h"
#include "cpu/stages.h"
#include "cpu/threads.h"
#if GS2D_RAYS
#include "cpu/ray_bounds.h"
#endif

namespace gs2d {
namespace {

// Calls visit(tile) for each tile of the visible splat i.
template <class F> inline void for_each_tile(const Frame& f, int64_t i, F&& visit) {
#if GS2D_RAYS
    constexpr int64_t AHEAD = 16;  // prefetch distance
    if (i + AHEAD < f.visible) __builtin_prefetch(&f.ray_tiles[f.order[i + AHEAD].splat]);
    for_each_ray_tile(f, f.order[i].splat, visit);
#else
    const TileRect r = f.ordered_rects[i];
    for (int y = r.y0; y < r.y1; ++y)
        for (int x = r.x0; x < r.x1; ++x) visit(int64_t(y) * f.tiles_x + x);
#endif
}

constexpr int64_t CHUNKS = 16;  // pieces of the depth order; fixed, so that the lists do not depend on the thread count

constexpr int DIGIT = 11, DIGITS = 1 << DIGIT, PASSES = (8 * sizeof(DepthKey) + DIGIT - 1) / DIGIT;

// Stable radix sort, least significant digit first, so equal depths stay in index order. Returns the buffer that
// contains the result.
DepthItem* radix_sort(DepthItem* items, DepthItem* other, int64_t n, uint32_t (*counts)[DIGITS]) {
    memset(counts, 0, sizeof(*counts) * PASSES);
    for (int64_t i = 0; i < n; ++i)
        for (int p = 0; p < PASSES; ++p) ++counts[p][(items[i].key >> (DIGIT * p)) & (DIGITS - 1)];
    for (int p = 0; p < PASSES; ++p) {
        uint32_t* c = counts[p];
        const int shift = DIGIT * p;
        if (c[(items[0].key >> shift) & (DIGITS - 1)] == n) continue;  // all items have the same digit
        uint32_t at = 0;
        for (int d = 0; d < DIGITS; ++d) {
            const uint32_t here = c[d];
            c[d] = at;
            at += here;
        }
        for (int64_t i = 0; i < n; ++i) other[c[(items[i].key >> shift) & (DIGITS - 1)]++] = items[i];
        DepthItem* swap = items;
        items = other, other = swap;
    }
    return items;
}

void sort_by_depth(Frame& f) {
    uint32_t counts[PASSES][DIGITS];
    DepthItem* const items = f.order;
    int64_t n = 0;
    for (int64_t i = 0; i < f.count; ++i) {
        const TileRect r = f.rects[i];
        items[n].key = items[i].key;
        items[n].splat = static_cast<uint32_t>(i);
        n += r.x1 > r.x0;
    }
    f.visible = n;
    if (n == 0) return;
    f.order = radix_sort(items, items + f.count, n, counts);
    DepthItem* const spare = f.order == items ? items + f.count : items;  // `items` is free by then and large enough
    static_assert(sizeof(DepthItem) >= sizeof(TileRect));
    f.ordered_rects = reinterpret_cast<TileRect*>(spare);
    parallel_ranges(n, 16384, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) f.ordered_rects[i] = f.rects[f.order[i].splat];
    });
}

}  // namespace

bool bin_splats(Frame& f) {
    const int64_t tiles = f.tiles;
    StageClock clock;
    sort_by_depth(f);
    clock.done(SORT);
    if (!f.histogram.reserve(CHUNKS * tiles) || !f.tile_begin.reserve(tiles + 1)) return false;
    const int64_t grain = (f.visible + CHUNKS - 1) / CHUNKS;
    parallel_for(CHUNKS, [&](int64_t c) {
        uint32_t* h = &f.histogram[c * tiles];
        memset(h, 0, tiles * sizeof(uint32_t));
        for (int64_t i = c * grain; i < (c + 1) * grain && i < f.visible; ++i)
            for_each_tile(f, i, [&](int64_t tile) { ++h[tile]; });
    });
    int64_t at = 0;
    for (int64_t t = 0; t < tiles; ++t) {
        f.tile_begin[t] = at;
        uint32_t in_tile = 0;  // from here on, the histogram holds positions within the tile
        for (int64_t c = 0; c < CHUNKS; ++c) {
            const uint32_t here = f.histogram[c * tiles + t];
            f.histogram[c * tiles + t] = in_tile;
            in_tile += here;
        }
        at += in_tile;
    }
    f.tile_begin[tiles] = at;
    if (!f.entries.reserve(at)) return false;
    parallel_for(CHUNKS, [&](int64_t c) {
        uint32_t* h = &f.histogram[c * tiles];
        for (int64_t i = c * grain; i < (c + 1) * grain && i < f.visible; ++i) {
            const uint32_t splat = f.order[i].splat;
            for_each_tile(f, i, [&](int64_t tile) { f.entries[f.tile_begin[tile] + h[tile]++].word = splat; });
        }
    });
    clock.done(BIN);
    return true;
}

}  // namespace gs2d
