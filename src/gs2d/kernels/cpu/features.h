// Channels other than the splat colour, stored as planes of a tile: pixels in block order per channel.
#pragma once

#include "cpu/tile.h"

namespace gs2d {

// (splat, block) pairs of consecutive splats of a tile. Large batches keep the planes of a few channels in the L1 cache
// for all pairs.
struct FeaturePairs {
    static constexpr int SPLATS = 32;
    alignas(64) real of_pair[SPLATS * BLOCKS][LANES];  // weight; in the backward pass first the part of dL/dw
    uint8_t block[SPLATS * BLOCKS];
    uint32_t splat[SPLATS];
    int end[SPLATS];  // end of each splat's pairs
    int pairs = 0, splats = 0;
    void add(const Entry& entry, const Features& features) {
        const char* const values = reinterpret_cast<const char*>(features.values + entry.splat() * features.count);
        for (size_t at = 0; at < features.count * sizeof(real); at += LINE) __builtin_prefetch(values + at);
        for (uint32_t left = entry.blocks; left; left &= left - 1) block[pairs++] = uint8_t(__builtin_ctz(left));
        splat[splats] = entry.splat(), end[splats++] = pairs;
    }
    // Calls f(j, first pair, end) for each splat.
    template <class F> void for_each_splat(F&& f) const {
        for (int j = 0, first = 0; j < splats; first = end[j++]) f(j, first, end[j]);
    }
};

template <int N> struct ChannelCount {
    static constexpr int value = N;
};

// Calls f(number of channels, first channel) for groups of channels that fit in registers.
template <class F> inline void for_each_channels(int64_t rows, F&& f) {
    constexpr int MANY = REGISTERS / 2;
    int64_t c = 0;
    for (; c + MANY <= rows; c += MANY) f(ChannelCount<MANY>(), c);
    for (; c < rows; c += 4) f(ChannelCount<4>(), c);
}

// Broadcasts some channels of a splat to all lanes; channels beyond the last one are 0.
template <int N> inline void load_channels(const Features& features, uint32_t splat, int64_t c, V (&values)[N]) {
    const real* const from = features.values + splat * features.count + c;
    if (c + N <= features.count) {
        for (int k = 0; k < N; ++k) values[k] = V(from[k]);
    } else {
        for (int k = 0; k < N; ++k) values[k] = V(c + k < features.count ? from[k] : real(0));
    }
}

// Calls f(pixel index in block order, pointer to its channels in an image [H, W, 3 + F]) for each pixel in the image.
template <class Image, class F>
inline void for_each_pixel(const TileArea& area, int image_width, int64_t count, Image* image, F&& f) {
    for (int y = 0; y < area.height; ++y)
        for (int x = 0; x < area.width; ++x)
            f(block_order(x, y), image + (int64_t(area.y0 + y) * image_width + area.x0 + x) * (3 + count) + 3);
}

// Stride between channels. A power of two would map the rows to only a few L1 cache sets.
constexpr int FEATURE_STRIDE = PIXELS + LANES;

// Number of rows for `count` channels, which are processed in groups of four.
inline int64_t feature_rows(int64_t count) { return (count + 3) / 4 * 4; }

// Allocates the planes of each thread; returns false if out of memory.
bool reserve_feature_planes(Frame& f, int64_t count);
inline real* feature_planes(const Frame& f, int64_t count, int64_t piece) {
    return &f.feature_planes[size_t(piece * feature_rows(count)) * FEATURE_STRIDE];
}

// Reads the upstream gradients of a tile into `planes`. Adds the contribution of the channel totals to the gradient of
// alpha and to S, both in block order (backward.cpp).
void start_features(const Frame& f, const Features& features, const real* alpha_image, const TileArea& area, real* planes,
                    real* g_alpha, real* S);

// Further channels of a tile; empty if `all` is null.
struct TileFeatures {
    const Features* all = nullptr;
    const real* upstream = nullptr;  // [rows, FEATURE_STRIDE]
    real* slots = nullptr;           // [slots, rows], beginning with the next splat
    FeaturePairs* pairs = nullptr;
    int done = 0;  // number of `pairs` whose weight is stored
};

// Takes the splats of `count` entries and computes their part of dL/dw.
void begin_features(TileFeatures& t, const Entry* entries, int count);

// Writes the slots of the pending splats from the weights.
void finish_features(TileFeatures& t);

}  // namespace gs2d
