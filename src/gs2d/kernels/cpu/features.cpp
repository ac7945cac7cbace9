// Blending of further channels: a second pass over the entries of the forward pass recomputes their weights.
#include "cpu/features.h"

#include "cpu/planes.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

// Adds the splats to the planes and clears the batch.
void blend_pairs(const Features& features, FeaturePairs& pairs, real* planes) {
    for_each_channels(feature_rows(features.count), [&](auto n, int64_t c) {
        constexpr int N = decltype(n)::value;
        pairs.for_each_splat([&](int j, int first, int end) {
            V values[N];
            load_channels<N>(features, pairs.splat[j], c, values);
            for (int i = first; i < end; ++i) {
                const V w = load(pairs.of_pair[i]);
                real* const at = planes + c * FEATURE_STRIDE + pairs.block[i] * LANES;
                for (int k = 0; k < N; ++k)
                    store(at + k * FEATURE_STRIDE, fma(w, values[k], load(at + k * FEATURE_STRIDE)));
            }
        });
    });
    pairs.pairs = pairs.splats = 0;
}

void blend_tile(const Frame& f, int64_t tile, const Features& features, real* planes, const BlendLimits<V>& limits) {
    constexpr int AHEAD = 8;  // prefetch distance for the scattered records
    const int64_t count = features.count;
    const TileArea area = tile_area(f, tile);
    const Centres centres(f, area);
    alignas(64) real T[PIXELS];
    for (int b = 0; b < BLOCKS; ++b)
        store(&T[b * LANES], keep(lanes_inside(block_x(b), block_y(b), area.width, area.height), V(1)));
    memset(planes, 0, sizeof(real) * feature_rows(count) * FEATURE_STRIDE);
    FeaturePairs pairs;
    const Entry* entry = &f.entries[f.tile_begin[tile]];
    const int32_t entries = f.tile_count[tile];
    for (int32_t i = 0; i < entries; ++i, ++entry) {
        if (i + AHEAD < entries) __builtin_prefetch(&f.records[size_t(entry[AHEAD].splat()) * RECORD]);
        const real* const record = &f.records[size_t(entry->splat()) * RECORD];
        const Record<V> splat = broadcast(record);
        const V zc = reciprocal(splat.iz);
        SplatPlanes plane;
        plane.set(record, centres);
        const int first = pairs.pairs;
        pairs.add(*entry, features);
        for (int p = first; p < pairs.pairs; ++p) {
            const int b = pairs.block[p];
            const Hit<V> hit = hit_at(splat, zc, plane.at(b, centres), entry->plain(), centres, b, limits);
            V pixel_T = load(&T[b * LANES]);
            store(pairs.of_pair[p], pass_weight(hit, limits, pixel_T));
            store(&T[b * LANES], pixel_T);
        }
        if (pairs.splats == FeaturePairs::SPLATS) blend_pairs(features, pairs, planes);
    }
    blend_pairs(features, pairs, planes);
    read_planes<1>(&f.saved[0], f.view.width, area, T);  // final transmittance, also for stopped pixels
    for (int64_t c = 0; c < count; ++c) {
        real* const plane = planes + c * FEATURE_STRIDE;
        const V background = V(features.background[c]);
        for (int i = 0; i < PIXELS; i += LANES) store(plane + i, fma(load(&T[i]), background, load(plane + i)));
    }
    for_each_pixel(area, f.view.width, count, features.color, [&](int i, real* to) {
        for (int64_t c = 0; c < count; ++c) to[c] = planes[c * FEATURE_STRIDE + i];
    });
}

}  // namespace

bool reserve_feature_planes(Frame& f, int64_t count) {
    return f.feature_planes.reserve(size_t(get_threads()) * feature_rows(count) * FEATURE_STRIDE);
}

bool blend_features(Frame& f, const Features& features) {
    if (!reserve_feature_planes(f, features.count)) return false;
    const BlendLimits<V> limits = limits_of(f.view);
    memset(static_cast<void*>(f.taken.data), 0, f.groups());
    parallel_for(get_threads(), [&](int64_t piece) {
        real* const planes = feature_planes(f, features.count, piece);
        share_out(0, f.groups(), f.taken.data, [&](int64_t group) {
            for (int64_t tile = group * GROUP; tile < (group + 1) * GROUP && tile < f.tiles; ++tile)
                blend_tile(f, tile, features, planes, limits);
        });
    });
    return true;
}

void start_features(const Frame& f, const Features& features, const real* alpha_image, const TileArea& area, real* planes,
                    real* g_alpha, real* S) {
    const int W = f.view.width;
    const int64_t count = features.count, to_color = features.color - features.upstream;
    alignas(64) real final_T[PIXELS], alpha[PIXELS];
    read_planes<1>(&f.saved[0], W, area, final_T);
    read_planes<1>(alpha_image, W, area, alpha);
    memset(planes, 0, sizeof(real) * feature_rows(count) * FEATURE_STRIDE);
    for_each_pixel(area, W, count, features.upstream, [&](int i, const real* g) {
        for (int64_t c = 0; c < count; ++c) planes[c * FEATURE_STRIDE + i] = g[c];
        V parts[4] = {V(0), V(0), V(0), V(0)};  // products with the image; products with the background
        for (int64_t c = 0; c < count; c += LANES) {
            const int n = count - c < LANES ? int(count - c) : LANES;
            const V some = load_first(g + c, n);
            parts[0] = fma(some, load_first(g + to_color + c, n), parts[0]);
            parts[1] = fma(some, load_first(features.background + c, n), parts[1]);
        }
        real along[4];
        transpose_reduce<4>(parts, along);
        S[i] += along[0] - (final_T[i] + alpha[i]) * along[1];  // the blended image excludes the background
        g_alpha[i] -= along[1];
    });
}

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
                V sums[4] = {load(pairs.of_pair[i]), V(0), V(0), V(0)};  // independent sums: shorter dependency chains
                for (int k = 0; k < N; ++k) sums[k % 4] = fma(load(at + k * FEATURE_STRIDE), values[k], sums[k % 4]);
                store(pairs.of_pair[i], (sums[0] + sums[1]) + (sums[2] + sums[3]));
            }
        });
    });
}

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

}  // namespace gs2d
