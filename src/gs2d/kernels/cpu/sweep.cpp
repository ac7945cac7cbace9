// A plane sweep of one image (training/plane_sweep.py has the same in torch, and judges this): for each pixel and depth,
// the normalised cross-correlation of its patch with what other images show there, averaged over the two best of them;
// kept are the best depth, its score and those of the depths beside it. Bands of rows share nothing, so the result is the
// same for any number of threads.
#include <algorithm>
#include <atomic>
#include <cstdint>
#include <cstdlib>

#include "cpu/simd.h"
#include "cpu/export.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

// The arrays of a loop do not overlap.
#if defined(__clang__)
#define GS2D_APART _Pragma("clang loop vectorize(assume_safety)")
#else
#define GS2D_APART _Pragma("GCC ivdep")
#endif

constexpr int64_t BAND = 32;  // rows of a piece; each is compared with `radius` more on both sides

}  // namespace

// Arrays are contiguous. Depths go from one end of the sweep to the other.
struct SweepArguments {
    int64_t height, width, planes, neighbours, radius;
    const real* image;       // [height, width], grey
    const uint8_t* wanted;   // [height, width]: 0 = nothing is asked of this pixel
    const real* const* others;  // [neighbours] images
    const int64_t* sizes;    // [neighbours, 2]: height, width
    const real* turned;      // [neighbours, 3, 3]: other K R K^-1
    const real* moved;       // [neighbours, 3]: other K t
    const real* depths;      // [planes]
    real noise;              // variance that is no texture
    real* best;              // [height, width], -1 where nothing is known
    int32_t* plane;          // [height, width]
    real* before;            // [height, width]: scores of the planes beside the best one
    real* after;
};

namespace {

int64_t mirrored(int64_t i, int64_t size) {
    if (i < 0) i = -i;
    if (i >= size) i = 2 * (size - 1) - i;
    return std::clamp<int64_t>(i, 0, size - 1);
}

// Means over (2 radius + 1)^2 pixels, `rows` of them, of an image [rows + 2 radius, width] whose columns are mirrored at
// its ends; only columns [left, right) are made. `sums` is [rows + 2 radius, width] of room.
void box(const real* from, int64_t rows, int64_t width, int64_t left, int64_t right, int64_t radius, real* sums,
         real* to) {
    const int64_t inner_left = std::max(left, radius), inner_right = std::max(inner_left, std::min(right, width - radius));
    const auto at_edge = [&](const real* row, int64_t x) {
        real sum = 0;
        for (int64_t k = -radius; k <= radius; ++k) sum += row[mirrored(x + k, width)];
        return sum;
    };
    for (int64_t y = 0; y < rows + 2 * radius; ++y) {
        const real* row = from + y * width;
        real* out = sums + y * width;
        for (int64_t x = left; x < std::min(right, inner_left); ++x) out[x] = at_edge(row, x);
        for (int64_t x = inner_left; x < inner_right; ++x) out[x] = row[x - radius];
        for (int64_t k = 1 - radius; k <= radius; ++k) {
            for (int64_t x = inner_left; x < inner_right; ++x) out[x] += row[x + k];
        }
        for (int64_t x = std::max(inner_right, left); x < right; ++x) out[x] = at_edge(row, x);
    }
    const real share = real(1) / real((2 * radius + 1) * (2 * radius + 1));
    for (int64_t y = 0; y < rows; ++y) {
        real* out = to + y * width;
        std::copy(sums + y * width + left, sums + y * width + right, out + left);
        for (int64_t k = 1; k <= 2 * radius; ++k) {
            const real* row = sums + (y + k) * width;
            for (int64_t x = left; x < right; ++x) out[x] += row[x];
        }
        for (int64_t x = left; x < right; ++x) out[x] *= share;
    }
}

// One row of the image, columns [left, right), as another shows it at a depth; `inside` where it does.
void fetch(const SweepArguments& a, int64_t n, int64_t y, real depth, int64_t left, int64_t right, real* __restrict out,
           real* __restrict inside) {
    const real *t = a.turned + 9 * n, *m = a.moved + 3 * n;
    const real* __restrict other = a.others[n];
    const int64_t rows = a.sizes[2 * n], columns = a.sizes[2 * n + 1];
    const int32_t stride = int32_t(columns), last_column = int32_t(columns - 1), last_row = int32_t(rows - 1);
    const real high_x = real(last_column), high_y = real(last_row), v = real(y) + real(0.5);
    const real x0 = (t[1] * v + t[2]) * depth + m[0], dx = t[0] * depth;
    const real y0 = (t[4] * v + t[5]) * depth + m[1], dy = t[3] * depth;
    const real z0 = (t[7] * v + t[8]) * depth + m[2], dz = t[6] * depth;
    GS2D_APART
    for (int32_t x = int32_t(left); x < int32_t(right); ++x) {
        const real u = real(x) + real(0.5), z = z0 + dz * u, front = z > real(1e-9) ? z : real(1e-9);
        const real over = real(1) / front, px = (x0 + dx * u) * over, py = (y0 + dy * u) * over;
        const bool shown = z > 0 && px > 0 && py > 0 && px < real(columns) && py < real(rows);
        inside[x] = shown ? real(1) : real(0);
        real cx = px - real(0.5), cy = py - real(0.5);
        cx = cx > 0 ? cx : 0, cy = cy > 0 ? cy : 0;
        cx = cx < high_x ? cx : high_x, cy = cy < high_y ? cy : high_y;
        const int32_t i = int32_t(cx), j = int32_t(cy);
        const int32_t right_of = i < last_column ? i + 1 : i, below = j < last_row ? j + 1 : j;
        const real fx = cx - real(i), fy = cy - real(j);
        const real top = other[j * stride + i] * (1 - fx) + other[j * stride + right_of] * fx;
        const real bottom = other[below * stride + i] * (1 - fx) + other[below * stride + right_of] * fx;
        out[x] = top * (1 - fy) + bottom * fy;
    }
}

// Room for a band: arrays of its rows with those beside them, and of its rows alone.
struct Band {
    real *fetched, *squared, *crossed, *inside, *sums, *own;
    real *mean, *square, *cross, *own_mean, *variance, *first, *second, *last;

    Band(int64_t tall, int64_t rows) : room(static_cast<real*>(std::malloc(size_t(6 * tall + 8 * rows) * sizeof(real)))) {
        real* next = room;
        for (real** of : {&fetched, &squared, &crossed, &inside, &sums, &own}) *of = next, next += tall;
        for (real** of : {&mean, &square, &cross, &own_mean, &variance, &first, &second, &last}) *of = next, next += rows;
    }
    ~Band() { std::free(room); }
    Band(const Band&) = delete;

    real* const room;
};

// Scores with one image, columns [left, right) of the row at `row` (at `tall` in arrays with the rows beside a band): the
// best two so far.
void add_scores(const SweepArguments& a, const Band& b, int64_t row, int64_t tall, int64_t left, int64_t right) {
    const real *inside = b.inside + tall, *mean = b.mean + row, *square = b.square + row, *cross = b.cross + row;
    const real *own_mean = b.own_mean + row, *variance = b.variance + row, noise = a.noise;
    real *first = b.first + row, *second = b.second + row;
    GS2D_APART
    for (int64_t x = left; x < right; ++x) {
        const real over = square[x] - mean[x] * mean[x], spread = (over > 0 ? over : 0) + noise;
        const real ncc = (cross[x] - mean[x] * own_mean[x]) / sqrt(spread * variance[x]);
        const real score = inside[x] > 0 ? ncc : real(-1), best = first[x], next = second[x];
        const real less = score < best ? score : best;
        second[x] = less > next ? less : next;
        first[x] = score > best ? score : best;
    }
}

// What a plane is worth, and whether that is the best so far; `at` is the row in the arrays of results.
void keep_best(const SweepArguments& a, const Band& b, int64_t plane, int64_t row, int64_t at, int64_t left, int64_t right) {
    const real *first = b.first + row, *second = a.neighbours > 1 ? b.second + row : first;
    real *last = b.last + row, *best = a.best + at, *before = a.before + at, *after = a.after + at;
    int32_t* best_plane = a.plane + at;
    const int32_t now = int32_t(plane);
    GS2D_APART
    for (int64_t x = left; x < right; ++x) {
        const real score = (first[x] + second[x]) * real(0.5), previous = last[x], old = best[x];
        const bool better = now == 0 || score > old, beside = best_plane[x] == now - 1;
        before[x] = better ? previous : before[x];
        after[x] = better || beside ? score : after[x];
        best[x] = better ? score : old;
        best_plane[x] = better ? now : best_plane[x];
        last[x] = score;
    }
}

// False where there is no memory for it.
bool sweep_band(const SweepArguments& a, int64_t begin, int64_t end) {
    const int64_t W = a.width, H = a.height, r = a.radius, rows = end - begin, tall = rows + 2 * r;
    int64_t left = W, right = 0;  // columns of which something is wanted
    for (int64_t i = begin * W; i < end * W; ++i) {
        if (!a.wanted[i]) continue;
        left = std::min(left, i % W), right = std::max(right, i % W + 1);
    }
    std::fill(a.best + begin * W, a.best + end * W, real(-1));
    std::fill(a.plane + begin * W, a.plane + end * W, 0);
    if (left >= right) return true;
    const int64_t wide_left = std::max<int64_t>(0, left - r), wide_right = std::min(W, right + r);
    const Band b(tall * W, rows * W);
    if (!b.room) return false;
    for (int64_t y = 0; y < tall; ++y) {
        const real* row = a.image + mirrored(begin + y - r, H) * W;
        for (int64_t x = 0; x < W; ++x) b.own[y * W + x] = row[x], b.squared[y * W + x] = row[x] * row[x];
    }
    box(b.own, rows, W, left, right, r, b.sums, b.own_mean);
    box(b.squared, rows, W, left, right, r, b.sums, b.variance);
    for (int64_t y = 0; y < rows; ++y) {
        for (int64_t x = left; x < right; ++x) {
            const int64_t i = y * W + x;
            const real spread = b.variance[i] - b.own_mean[i] * b.own_mean[i];
            b.variance[i] = (spread > 0 ? spread : 0) + a.noise;
        }
    }
    std::fill(b.last, b.last + rows * W, real(-1));
    for (int64_t d = 0; d < a.planes; ++d) {
        std::fill(b.first, b.first + rows * W, real(-1));
        std::fill(b.second, b.second + rows * W, real(-1));
        for (int64_t n = 0; n < a.neighbours; ++n) {
            for (int64_t y = 0; y < tall; ++y) {
                const int64_t at = y * W;
                fetch(a, n, mirrored(begin + y - r, H), a.depths[d], wide_left, wide_right, &b.fetched[at], &b.inside[at]);
                for (int64_t x = wide_left; x < wide_right; ++x) {
                    b.squared[at + x] = b.fetched[at + x] * b.fetched[at + x];
                    b.crossed[at + x] = b.fetched[at + x] * b.own[at + x];
                }
            }
            box(b.fetched, rows, W, left, right, r, b.sums, b.mean);
            box(b.squared, rows, W, left, right, r, b.sums, b.square);
            box(b.crossed, rows, W, left, right, r, b.sums, b.cross);
            for (int64_t y = 0; y < rows; ++y) add_scores(a, b, y * W, (y + r) * W, left, right);
        }
        for (int64_t y = 0; y < rows; ++y) keep_best(a, b, d, y * W, (begin + y) * W, left, right);
    }
    return true;
}

}  // namespace
}  // namespace gs2d

using namespace gs2d;

// 1 where all was done, 0 where memory was short.
GS2D_EXPORT int gs2d_sweep(const SweepArguments* arguments) {
    std::atomic<bool> whole{true};
    parallel_ranges(arguments->height, BAND, [&](int64_t begin, int64_t end) {
        if (!sweep_band(*arguments, begin, end)) whole = false;
    });
    return whole;
}
