// Depth order, then lists of splats per tile: a counting sort in depth order needs no key per entry.
#include "cpu/frame.h"
#include "cpu/stages.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

constexpr int64_t CHUNKS = 16;  // pieces of the depth order; fixed, so that lists do not depend on threads

#if defined(GS2D_DOUBLE)
using Key = uint64_t;
constexpr int PASSES = 6;
#else
using Key = uint32_t;
constexpr int PASSES = 3;
#endif
constexpr int DIGIT = 11, DIGITS = 1 << DIGIT;

struct Item {
    Key key;  // bits of z_c > 0: positive floats sort like integers
    uint32_t splat;
};

// Stable radix sort, least significant digit first: equal depths stay in index order. Returns where the result is.
Item* radix_sort(Item* items, Item* other, int64_t n, uint32_t (*counts)[DIGITS]) {
    memset(counts, 0, sizeof(*counts) * PASSES);
    for (int64_t i = 0; i < n; ++i)
        for (int p = 0; p < PASSES; ++p) ++counts[p][(items[i].key >> (DIGIT * p)) & (DIGITS - 1)];
    for (int p = 0; p < PASSES; ++p) {
        uint32_t* c = counts[p];
        const int shift = DIGIT * p;
        if (c[(items[0].key >> shift) & (DIGITS - 1)] == n) continue;  // the same digit everywhere
        uint32_t at = 0;
        for (int d = 0; d < DIGITS; ++d) {
            const uint32_t here = c[d];
            c[d] = at;
            at += here;
        }
        for (int64_t i = 0; i < n; ++i) other[c[(items[i].key >> shift) & (DIGITS - 1)]++] = items[i];
        Item* swap = items;
        items = other, other = swap;
    }
    return items;
}

bool sort_by_depth(Frame& f) {
    if (!f.sort_memory.reserve(2 * f.count * sizeof(Item) + sizeof(uint32_t[PASSES][DIGITS])) || !f.order.reserve(f.count) ||
        !f.ordered_rects.reserve(f.count))
        return false;
    Item* items = reinterpret_cast<Item*>(f.sort_memory.data);
    auto* counts = reinterpret_cast<uint32_t(*)[DIGITS]>(items + 2 * f.count);
    int64_t n = 0;
    for (int64_t i = 0; i < f.count; ++i) {
        const real z = f.records[i * RECORD + 8];
        const TileRect r = f.rects[i];
        memcpy(&items[n].key, &z, sizeof z);
        items[n].splat = static_cast<uint32_t>(i);
        n += r.x1 > r.x0;
    }
    f.visible = n;
    if (n == 0) return true;
    const Item* sorted = radix_sort(items, items + n, n, counts);
    parallel_ranges(n, 16384, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
            f.order[i] = sorted[i].splat;
            f.ordered_rects[i] = f.rects[sorted[i].splat];
        }
    });
    return true;
}

}  // namespace

bool bin_splats(Frame& f) {
    const int64_t tiles = f.tiles;
    StageClock clock;
    if (!sort_by_depth(f)) return false;
    clock.done(SORT);
    if (!f.histogram.reserve(CHUNKS * tiles) || !f.tile_begin.reserve(tiles + 1)) return false;
    const int64_t grain = (f.visible + CHUNKS - 1) / CHUNKS;
    parallel_for(CHUNKS, [&](int64_t c) {
        uint32_t* h = &f.histogram[c * tiles];
        memset(h, 0, tiles * sizeof(uint32_t));
        for (int64_t i = c * grain; i < (c + 1) * grain && i < f.visible; ++i) {
            const TileRect r = f.ordered_rects[i];
            for (int y = r.y0; y < r.y1; ++y)
                for (int x = r.x0; x < r.x1; ++x) ++h[int64_t(y) * f.tiles_x + x];
        }
    });
    int64_t at = 0;
    for (int64_t t = 0; t < tiles; ++t) {
        f.tile_begin[t] = at;
        uint32_t in_tile = 0;  // from here on the histogram holds positions within the tile
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
            const TileRect r = f.ordered_rects[i];
            const uint32_t splat = f.order[i];
            for (int y = r.y0; y < r.y1; ++y)
                for (int x = r.x0; x < r.x1; ++x) {
                    const int64_t t = int64_t(y) * f.tiles_x + x;
                    f.entries[f.tile_begin[t] + h[t]++].splat = splat;
                }
        }
    });
    clock.done(BIN);
    return true;
}

bool index_slots(Frame& f) {
    if (!f.slot_begin.reserve(f.tiles + 1)) return false;
    f.slot_begin[0] = 0;
    for (int64_t t = 0; t < f.tiles; ++t) f.slot_begin[t + 1] = f.slot_begin[t] + f.tile_count[t];
    const int64_t slots = f.slot_begin[f.tiles];
    if (!f.splat_slots.reserve(slots) || !f.splat_begin.reserve(f.count + 2)) return false;
    int64_t* begin = f.splat_begin.data;
    memset(begin, 0, (f.count + 2) * sizeof(int64_t));
    for (int64_t t = 0; t < f.tiles; ++t) {
        const Entry* e = &f.entries[f.tile_begin[t]];
        for (int32_t i = 0; i < f.tile_count[t]; ++i) ++begin[e[i].splat + 2];
    }
    for (int64_t i = 0; i < f.count; ++i) begin[i + 2] += begin[i + 1];
    for (int64_t t = 0; t < f.tiles; ++t) {
        const Entry* e = &f.entries[f.tile_begin[t]];
        for (int32_t i = 0; i < f.tile_count[t]; ++i)
            f.splat_slots[begin[e[i].splat + 1]++] = static_cast<uint32_t>(f.slot_begin[t] + i);
    }
    return true;  // filling has moved every begin to its end, which is the next one's begin: begin[i] is right again
}

}  // namespace gs2d
