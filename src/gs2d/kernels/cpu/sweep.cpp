// Plane sweep of one image (torch version: training/start/plane_sweep.py). For each pixel and depth, computes the
// normalised cross-correlation of its patch with patches of other images, averaged over the two best images. The result
// is the best depth, its score and the scores of the adjacent depths. Bands of rows are independent, so the result does
// not depend on the number of threads.
#include <algorithm>
#include <atomic>
#include <cstdint>
#include <cstdlib>

#include "cpu/simd.h"
#include "cpu/export.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

// Pointers in a loop do not alias.
#if defined(__clang__)
#define GS2D_APART _Pragma("clang loop vectorize(assume_safety)")
#else
#define GS2D_APART _Pragma("GCC ivdep")
#endif

constexpr int64_t BAND = 32;  // rows per piece, plus `radius` rows on both sides

}  // namespace

// Arrays are contiguous. Depths are monotonic.
struct SweepArguments {
    int64_t height, width, planes, neighbours, radius;
    const real* image;       // [height, width], grey
    const uint8_t* wanted;   // [height, width]: 0 = skip this pixel
    const real* const* others;  // [neighbours] images, each [height + 1, width + 1]; last row and column repeated
    const int64_t* sizes;    // [neighbours, 2]: height, width
    const real* turned;      // [neighbours, 3, 3]: K_n R K^-1, with K_n of the neighbour
    const real* moved;       // [neighbours, 3]: K_n t
    const real* depths;      // [planes]
    real noise;              // variance of image noise
    real* best;              // [height, width], -1 if unknown
    int32_t* plane;          // [height, width]
    real* before;            // [height, width]: scores of the adjacent planes
    real* after;
};

namespace {

int64_t mirrored(int64_t i, int64_t size) {
    if (i < 0) i = -i;
    if (i >= size) i = 2 * (size - 1) - i;
    return std::clamp<int64_t>(i, 0, size - 1);
}

// Mirrors a row at both ends, as far as patches reach.
void mirror_ends(real* row, int64_t width, int64_t radius) {
    for (int64_t k = 1; k <= radius; ++k) {
        row[-k] = row[mirrored(-k, width)];
        row[width - 1 + k] = row[mirrored(width - 1 + k, width)];
    }
}

// Samples columns [left, right) of an image row from another image at a depth; `inside`: visible in that image.
void fetch(const SweepArguments& a, int64_t n, int64_t y, real depth, int64_t left, int64_t right, real* out,
           real* inside) {
    const real *t = a.turned + 9 * n, *m = a.moved + 3 * n, *other = a.others[n];
    const int64_t rows = a.sizes[2 * n], columns = a.sizes[2 * n + 1], stride = columns + 1;
    const real v = real(y) + real(0.5);
    const V x0 = V((t[1] * v + t[2]) * depth + m[0]), dx = V(t[0] * depth), none = V(real(0)), one = V(real(1));
    const V y0 = V((t[4] * v + t[5]) * depth + m[1]), dy = V(t[3] * depth), half = V(real(0.5));
    const V z0 = V((t[7] * v + t[8]) * depth + m[2]), dz = V(t[6] * depth), least = V(real(1e-9));
    const V width = V(real(columns)), height = V(real(rows)), last_x = width - one, last_y = height - one;
    for (int64_t x = left; x < right; x += LANES) {
        const V u = (V(real(x)) + iota()) + half, z = z0 + dz * u, over = one / max(z, least);
        const V px = (x0 + dx * u) * over, py = (y0 + dy * u) * over;
        const M shown = (z > none) & (px > none) & (py > none) & (px < width) & (py < height);
        store(inside + x, keep(shown, one));
        const V cx = min(max(px - half, none), last_x), cy = min(max(py - half, none), last_y);
        const V i = whole(cx), j = whole(cy), fx = cx - i, fy = cy - j;
        const LaneInts at = row_major(ints_of(j), static_cast<int>(stride), ints_of(i));
        V top, right_of_top, bottom, right_of_bottom;
        gather_pairs(other, at, top, right_of_top);
        gather_pairs(other + stride, at, bottom, right_of_bottom);
        top = top * (one - fx) + right_of_top * fx;
        bottom = bottom * (one - fx) + right_of_bottom * fx;
        store(out + x, top * (one - fy) + bottom * fy);
    }
}

// Buffers for a band, with `radius` more columns on both sides. Some also contain the adjacent rows, the others only
// the rows of the band. Vectors extend beyond the last requested column; the values there are not used.
struct Band {
    Band(int64_t width, int64_t rows, int64_t radius)
        : radius(radius),
          stride(width + 2 * radius + LANES),
          room(static_cast<real*>(std::calloc(size_t(stride * (6 * (rows + 2 * radius) + 5 * rows)), sizeof(real)))) {
        real* next = room == nullptr ? nullptr : room + radius;
        if (next == nullptr) return;
        for (real** of : {&fetched, &inside, &own, &means, &squares, &products})
            *of = next, next += (rows + 2 * radius) * stride;
        for (real** of : {&own_mean, &variance, &first, &second, &last}) *of = next, next += rows * stride;
    }
    ~Band() { std::free(room); }
    Band(const Band&) = delete;

    const int64_t radius, stride;
    real *fetched, *inside, *own;       // pointers to column 0
    real *means, *squares, *products;  // sums over patch columns
    real *own_mean, *variance, *first, *second, *last;

    bool failed() const { return room == nullptr; }

  private:
    real* const room;
};

// Sums over the patch columns in a row at `at`: an image, its square, and its product with the swept image.
void sum_columns(const Band& b, const real* image, int64_t at, int64_t left, int64_t right) {
    const real *row = image + at - b.radius, *own = b.own + at - b.radius;
    for (int64_t x = left; x < right; x += LANES) {
        V u = load(row + x), mean = u, square = u * u, product = u * load(own + x);
        for (int64_t k = 1; k <= 2 * b.radius; ++k) {
            u = load(row + x + k);
            mean = mean + u, square = square + u * u, product = product + u * load(own + x + k);
        }
        store(b.means + at + x, mean), store(b.squares + at + x, square), store(b.products + at + x, product);
    }
}

// Returns the mean over the patch rows starting at `from`.
GS2D_HD V mean_of_rows(const Band& b, const real* from, V share) {
    V sum = load(from);
    for (int64_t k = 1; k <= 2 * b.radius; ++k) sum = sum + load(from + k * b.stride);
    return sum * share;
}

GS2D_HD V variance_of(V square, V mean, V noise) { return max(square - mean * mean, V(real(0))) + noise; }

V share_of(const Band& b) { return V(real(1) / real((2 * b.radius + 1) * (2 * b.radius + 1))); }

// Computes the patch statistics of the swept image in a row of the band.
void keep_own(const SweepArguments& a, const Band& b, int64_t row, int64_t left, int64_t right) {
    const V share = share_of(b), noise = V(a.noise);
    for (int64_t x = left; x < right; x += LANES) {
        const V mean = mean_of_rows(b, b.means + row + x, share);
        store(b.own_mean + row + x, mean);
        store(b.variance + row + x, variance_of(mean_of_rows(b, b.squares + row + x, share), mean, noise));
    }
}

// Merges the scores of a band row with one image into the best two. Patches start at that row of the sums.
void add_scores(const SweepArguments& a, const Band& b, int64_t row, int64_t left, int64_t right) {
    const V share = share_of(b), noise = V(a.noise), none = V(real(-1));
    const real* inside = b.inside + row + b.radius * b.stride;
    for (int64_t x = left; x < right; x += LANES) {
        const int64_t at = row + x;
        const V mean = mean_of_rows(b, b.means + at, share), square = mean_of_rows(b, b.squares + at, share);
        const V common = mean_of_rows(b, b.products + at, share) - mean * load(b.own_mean + at);
        const V ncc = common / sqrt(variance_of(square, mean, noise) * load(b.variance + at));
        const V score = select(load(inside + x) > V(real(0)), ncc, none);
        const V best = load(b.first + at), less = select(score < best, score, best), next = load(b.second + at);
        store(b.second + at, select(less > next, less, next));
        store(b.first + at, select(score > best, score, best));
    }
}

// Computes the score of a plane and keeps the best one; `at` is the row in the result arrays.
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

// Processes a band; returns false if out of memory.
bool sweep_band(const SweepArguments& a, int64_t begin, int64_t end) {
    const int64_t W = a.width, H = a.height, r = a.radius, rows = end - begin, tall = rows + 2 * r;
    int64_t left = W, right = 0;  // range of requested columns
    for (int64_t i = begin * W; i < end * W; ++i) {
        if (!a.wanted[i]) continue;
        left = std::min(left, i % W), right = std::max(right, i % W + 1);
    }
    std::fill(a.best + begin * W, a.best + end * W, real(-1));
    std::fill(a.plane + begin * W, a.plane + end * W, 0);
    if (left >= right) return true;
    const int64_t wide_left = std::max<int64_t>(0, left - r), wide_right = std::min(W, right + r);
    const Band b(W, rows, r);
    if (b.failed()) return false;
    for (int64_t y = 0; y < tall; ++y) {
        const real* row = a.image + mirrored(begin + y - r, H) * W;
        std::copy(row, row + W, b.own + y * b.stride);
        mirror_ends(b.own + y * b.stride, W, r);
        sum_columns(b, b.own, y * b.stride, left, right);
    }
    for (int64_t y = 0; y < rows; ++y) {
        keep_own(a, b, y * b.stride, left, right);
        std::fill_n(b.last + y * b.stride, W, real(-1));
    }
    for (int64_t d = 0; d < a.planes; ++d) {
        for (real* scores : {b.first, b.second}) std::fill_n(scores, (rows - 1) * b.stride + W, real(-1));
        for (int64_t n = 0; n < a.neighbours; ++n) {
            for (int64_t y = 0; y < tall; ++y) {
                const int64_t at = y * b.stride;
                fetch(a, n, mirrored(begin + y - r, H), a.depths[d], wide_left, wide_right, b.fetched + at, b.inside + at);
                mirror_ends(b.fetched + at, W, r);
                sum_columns(b, b.fetched, at, left, right);
            }
            for (int64_t y = 0; y < rows; ++y) add_scores(a, b, y * b.stride, left, right);
        }
        for (int64_t y = 0; y < rows; ++y) keep_best(a, b, d, y * b.stride, (begin + y) * W, left, right);
    }
    return true;
}

}  // namespace
}  // namespace gs2d

using namespace gs2d;

// Returns 1, or 0 if out of memory.
GS2D_EXPORT int gs2d_sweep(const SweepArguments* arguments) {
    std::atomic<bool> whole{true};
    parallel_ranges(arguments->height, BAND, [&](int64_t begin, int64_t end) {
        if (!sweep_band(*arguments, begin, end)) whole = false;
    });
    return whole;
}
