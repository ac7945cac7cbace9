// Channels besides the three of a splat's colour, as planes of a tile: pixels in block order per channel.
#pragma once

#include "cpu/tile.h"

namespace gs2d {

// Pairs (splat, block) of consecutive splats of a tile. With many splats per batch, the planes of some channels stay in
// the first-level cache for all pairs.
struct FeaturePairs {
    static constexpr int SPLATS = 32;
    alignas(64) real of_pair[SPLATS * BLOCKS][LANES];  // the weight; in the backward pass, before it, the part of dL/dw
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

// Calls f(number of channels, first channel) for groups of channels that fit the registers.
template <class F> inline void for_each_channels(int64_t rows, F&& f) {
    constexpr int MANY = REGISTERS / 2;
    int64_t c = 0;
    for (; c + MANY <= rows; c += MANY) f(ChannelCount<MANY>(), c);
    for (; c < rows; c += 4) f(ChannelCount<4>(), c);
}

// Some channels of a splat in all lanes; 0 beyond the last one.
template <int N> inline void load_channels(const Features& features, uint32_t splat, int64_t c, V (&values)[N]) {
    const real* const from = features.values + splat * features.count + c;
    if (c + N <= features.count) {
        for (int k = 0; k < N; ++k) values[k] = V(from[k]);
    } else {
        for (int k = 0; k < N; ++k) values[k] = V(c + k < features.count ? from[k] : real(0));
    }
}

// Calls f(pixel of a tile in block order, where its further channels are in an image [H, W, 3 + F]) for those inside.
template <class Image, class F>
inline void for_each_pixel(const TileArea& area, int image_width, int64_t count, Image* image, F&& f) {
    for (int y = 0; y < area.height; ++y)
        for (int x = 0; x < area.width; ++x)
            f(block_order(x, y), image + (int64_t(area.y0 + y) * image_width + area.x0 + x) * (3 + count) + 3);
}

// From a channel to the next. Not a power of two: rows of those would share few sets of the first cache.
constexpr int FEATURE_STRIDE = PIXELS + LANES;

// Rows for a number of channels, which are processed in groups of four.
inline int64_t feature_rows(int64_t count) { return (count + 3) / 4 * 4; }

// Allocates the planes of each thread; false if memory is short.
bool reserve_feature_planes(Frame& f, int64_t count);
inline real* feature_planes(const Frame& f, int64_t count, int64_t piece) {
    return &f.feature_planes[size_t(piece * feature_rows(count)) * FEATURE_STRIDE];
}

// Reads the upstream gradients of a tile into `planes`, and adds what follows from the totals of the channels to the
// gradient of alpha and to S, both in block order (backward.cpp).
void start_features(const Frame& f, const Features& features, const real* alpha_image, const TileArea& area, real* planes,
                    real* g_alpha, real* S);

// Further channels of a tile, or nothing.
struct TileFeatures {
    const Features* all = nullptr;
    const real* upstream = nullptr;  // [rows, FEATURE_STRIDE]
    real* slots = nullptr;           // [slots, rows], from the next splat's on
    FeaturePairs* pairs = nullptr;
    int done = 0;  // of `pairs`: those that have their weight
};

// Takes the splats of so many entries: their part of dL/dw.
void begin_features(TileFeatures& t, const Entry* entries, int count);

// Writes the slots of those splats, from the weights.
void finish_features(TileFeatures& t);

}  // namespace gs2d
