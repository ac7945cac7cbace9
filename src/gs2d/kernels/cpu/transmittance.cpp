// Depth by transmittance, computed after the blending and only on request. The pairs of a tile are intersected again
// and stored by block; then each pixel searches its own pairs along its ray.
#include "cpu/frame.h"
#include "cpu/planes.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

// alpha and 1 / z of the pairs of a tile, by block; alpha is 0 for pixels that did not blend the splat.
struct Pairs {
    Buffer<real> values;  // [pairs, 2, LANES]
    int64_t begin[BLOCKS + 1];
    ~Pairs() { values.release(); }
    real* at(int64_t i) { return values.data + 2 * LANES * i; }
};

// Stores the pairs of a tile; returns false if out of memory.
bool gather(const Frame& f, int64_t tile, const TileArea& area, const BlendLimits<V>& limits, Pairs& pairs) {
    const Entry* const entries = &f.entries[f.tile_begin[tile]];
    const int32_t count = f.tile_count[tile];
    int64_t next[BLOCKS] = {}, total = 0;
    for (int32_t i = 0; i < count; ++i)
        for (uint32_t left = entries[i].blocks; left; left &= left - 1) ++next[__builtin_ctz(left)];
    for (int b = 0; b < BLOCKS; ++b) pairs.begin[b] = total, total += next[b], next[b] = pairs.begin[b];
    pairs.begin[BLOCKS] = total;
    if (!pairs.values.reserve(2 * LANES * size_t(total))) return false;

    const Centres centres(f, area);
    alignas(64) real T[BLOCKS][LANES];
    for (int b = 0; b < BLOCKS; ++b)
        store(T[b], keep(lanes_inside(block_x(b), block_y(b), area.width, area.height), V(1)));
    for (int32_t i = 0; i < count; ++i) {
        const real* const record = &f.records[size_t(entries[i].splat()) * RECORD];
        const Record<V> splat = broadcast(record);
        const V zc = reciprocal(splat.iz);
        SplatPlanes planes;
        planes.set(record, centres);
        for (uint32_t left = entries[i].blocks; left; left &= left - 1) {
            const int b = __builtin_ctz(left);
            const Hit<V> h = hit_at(splat, zc, planes.at(b, centres), entries[i].plain(), centres, b, limits);
            const V alpha = min(h.alpha, limits.alpha_max), before = load(T[b]), after = fnma(alpha, before, before);
            const M goes_on = after >= limits.transmittance_min;
            store(T[b], keep(goes_on, after));
            store(pairs.at(next[b]), keep(goes_on, alpha));
            store(pairs.at(next[b]++) + LANES, h.inverse_depth);
        }
    }
    return true;
}

// Searches the pixels of a block; `depth` holds the initial guess.
void search(Pairs& pairs, int b, V alpha, V inv_width, real* depth, real* slope) {
    const int64_t begin = pairs.begin[b], end = pairs.begin[b + 1];
    const M hit = alpha > V(0);
    const V level = fnma(V(real(0.5)), alpha, V(1)), first = load(depth);
    V least = V(real(1e30)), most = V(0);
    Transmittance<V> t = {V(1), V(0)};
    for (int64_t i = begin; i < end; ++i) {
        const V weight = load(pairs.at(i)), inverse = load(pairs.at(i) + LANES);
        const M blended = weight > V(0);
        least = min(least, select(blended, inverse, least)), most = max(most, keep(blended, inverse));
        pass_pair(weight, inverse, first, inv_width, t);
    }
    DepthSearch<V> s = begin_search(first, least, most, inv_width, hit);
    for (int step = 1; advance(t, level, inv_width, V(SEARCH_TOLERANCE<real>), s), any(s.open); ++step) {
        if (step == MAX_SEARCH_STEPS) break;
        t = {V(1), V(0)};
        for (int64_t i = begin; i < end; ++i) pass_pair(load(pairs.at(i)), load(pairs.at(i) + LANES), s.z, inv_width, t);
    }
    store(depth, keep(hit, s.z));
    store(slope, select(hit, slope_of(s.fall, alpha, s.z, inv_width), V(1)));
}

}  // namespace

bool find_transmittance_depth(Frame& f, const real* alpha, const real* median, double width, real* depth) {
    const int64_t pixels = int64_t(f.view.width) * f.view.height;
    if (!f.depth_slope.reserve(2 * size_t(pixels))) return false;
    f.inv_depth_width = real(1 / width);
    const BlendLimits<V> limits = limits_of(f.view);
    const V inv_width = V(f.inv_depth_width);
    std::atomic<bool> enough_memory = true;
    memset(static_cast<void*>(f.taken.data), 0, f.groups());
    parallel_for(get_threads(), [&](int64_t) {
        Pairs pairs;
        alignas(64) real planes[3][PIXELS];  // alpha, depth, slope
        share_out(0, f.groups(), f.taken.data, [&](int64_t group) {
            for (int64_t tile = group * GROUP; tile < (group + 1) * GROUP && tile < f.tiles; ++tile) {
                const TileArea area = tile_area(f, tile);
                if (!gather(f, tile, area, limits, pairs)) {
                    enough_memory = false;
                    return;
                }
                read_planes<1>(alpha, f.view.width, area, planes[0]);
                read_planes<1>(median, f.view.width, area, planes[1]);
                for (int b = 0; b < BLOCKS; ++b)
                    search(pairs, b, load(&planes[0][b * LANES]), inv_width, &planes[1][b * LANES],
                           &planes[2][b * LANES]);
                write_planes<1>(planes[1], depth, f.view.width, area);
                write_planes<1>(planes[1], &f.depth_slope[0], f.view.width, area);
                write_planes<1>(planes[2], &f.depth_slope[pixels], f.view.width, area);
            }
        });
    });
    return enough_memory;
}

}  // namespace gs2d
