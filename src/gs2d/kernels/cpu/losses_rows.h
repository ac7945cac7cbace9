// Scratch rows for the image losses, padded with zeros on both sides, so that windows and vectors may extend beyond the
// ends of a row.
#pragma once

#include <cstdlib>
#include <cstring>

#include "cpu/simd.h"
#include "cpu/threads.h"

namespace gs2d {

constexpr int64_t MARGIN = 16;  // reals on either side of a row: at least 5 pixels of 3 channels, in whole cache lines

// Length of a row of n reals, rounded up to whole vectors of every instruction set.
GS2D_HD int64_t row_length(int64_t n) { return (n + 31) / 32 * 32; }
// Stride between rows.
GS2D_HD int64_t row_stride(int64_t n) { return row_length(n) + 2 * MARGIN; }

// Zeroed memory for rows, aligned to a cache line. The pointer is null if out of memory.
struct Scratch {
    void* block;
    real* data;
    explicit Scratch(int64_t reals) : block(std::calloc(static_cast<size_t>(reals) * sizeof(real) + 64, 1)) {
        data = reinterpret_cast<real*>((reinterpret_cast<uintptr_t>(block) + 63) / 64 * 64);
    }
    ~Scratch() { std::free(block); }
    Scratch(const Scratch&) = delete;
    Scratch& operator=(const Scratch&) = delete;
    bool failed() const { return block == nullptr; }
    // Returns the first real after the left margin of row r, for rows of stride `stride`.
    real* row(int64_t r, int64_t stride) const { return data + r * stride + MARGIN; }
};

// Fills a row with 1 at valid and 0 at ignored pixels, each `channels` times; all 1 without a mask. Padding stays 0.
inline void fill_validity(const uint8_t* mask, int64_t width, int channels, real* validity) {
    if (mask == nullptr) {
        for (int64_t i = 0; i < width * channels; ++i) validity[i] = real(1);
    } else if (channels == 1) {
        for (int64_t i = 0; i < width; ++i) validity[i] = mask[i] ? real(1) : real(0);
    } else {
        for (int64_t i = 0; i < width; ++i) {
            const real v = mask[i] ? real(1) : real(0);
            for (int c = 0; c < channels; ++c) validity[i * channels + c] = v;
        }
    }
}

// Counts valid pixels.
inline int64_t count_valid(const uint8_t* mask, int64_t pixels) {
    if (mask == nullptr) return pixels;
    int64_t count = 0;
    for (int64_t i = 0; i < pixels; ++i) count += mask[i] != 0;
    return count;
}

// Returns the rows per piece for the thread pool if a piece computes `overlap` additional rows. The result of a loss
// does not depend on it, since each row is computed the same way wherever the image is split.
inline int64_t rows_per_piece(int64_t height, int64_t overlap) {
    const int64_t wanted = (height + 2 * get_threads() - 1) / (2 * get_threads());
    return get_threads() == 1 ? height : wanted < 4 * overlap ? 4 * overlap : wanted;
}

}  // namespace gs2d
