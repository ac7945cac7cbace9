// Loads and stores up to LANES pixels of an image as vectors; lanes beyond the last pixel are 0.
#pragma once

#include <cstring>

#include "cpu/simd.h"

namespace gs2d {

inline void load_pixels(const real* image, int64_t first, int64_t pixels, V* planes) {
    if (pixels - first >= LANES) return load_packed<3>(image + 3 * first, planes);
    real rest[3 * LANES] = {};
    std::memcpy(rest, image + 3 * first, static_cast<size_t>(3 * (pixels - first)) * sizeof(real));
    load_packed<3>(rest, planes);
}
inline void store_pixels(real* image, int64_t first, int64_t pixels, const V* planes) {
    if (pixels - first >= LANES) return store_packed<3>(image + 3 * first, planes);
    real rest[3 * LANES];
    store_packed<3>(rest, planes);
    std::memcpy(image + 3 * first, rest, static_cast<size_t>(3 * (pixels - first)) * sizeof(real));
}
inline V load_plane(const real* plane, int64_t first, int64_t pixels) {
    const int64_t left = pixels - first;
    return left >= LANES ? load(plane + first) : load_first(plane + first, static_cast<int>(left));
}

}  // namespace gs2d
