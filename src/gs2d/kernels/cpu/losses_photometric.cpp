// L1, SSIM and L2 of an image [H, W, 3], and the gradient of their weighted sum, in one pass over the rows.
//
// A row of W interleaved pixels has 3 W reals; the window taps are 3 reals apart, so channels need no planes. Each
// piece of rows moves down the image with two ring buffers of horizontally blurred rows: the moments x, x^2 + y^2, x y
// (and y, unless its blur is passed in), and the derivatives of SSIM with respect to the blurred moments. SSIM is
// computed 5 rows behind the input and the gradient 10 rows behind, ROWS rows at a time to share most of their input
// rows. All buffers fit in the L2 cache.
#include "core/losses.h"
#include "cpu/export.h"
#include "cpu/losses_rows.h"

namespace gs2d {
namespace {

constexpr int RADIUS = SSIM_RADIUS, TAPS = SSIM_TAPS;

// Applies the window to 11 values `at(k)`, k = -5..5.
template <class F> GS2D_HD V window(F at) {
    V sum = V(real(SSIM_WINDOW[0])) * at(0);
#pragma GCC unroll 8
    for (int k = 1; k <= RADIUS; ++k) sum = fma(V(real(SSIM_WINDOW[k])), at(-k) + at(k), sum);
    return sum;
}

void blur_row(const real* in, real* out, int64_t length) {
#if defined(GS2D_OWN_AFTER)  // an unaligned load of 64 bytes takes two cycles
    V before = load(in - LANES), here = load(in);
    for (int64_t i = 0; i < length; i += LANES) {
        const V next = load(in + i + LANES);
        const V taps[TAPS] = {after<1>(before, here),  after<4>(before, here),  after<7>(before, here),
                              after<10>(before, here), after<13>(before, here), here,
                              after<3>(here, next),    after<6>(here, next),    after<9>(here, next),
                              after<12>(here, next),   after<15>(here, next)};
        store(out + i, window([&](int k) { return taps[RADIUS + k]; }));
        before = here, here = next;
    }
#else
    for (int64_t i = 0; i < length; i += LANES) store(out + i, window([&](int k) { return load(in + i + 3 * k); }));
#endif
}

constexpr int ROWS = 4;                  // rows computed together
constexpr int NEEDED = TAPS - 1 + ROWS;  // input rows that their blur needs

// Horizontally blurred rows around y of `MAPS` maps: row y of map m is row (y mod NEEDED) * MAPS + m.
struct Ring {
    real* data;
    int64_t stride;
    int maps;
    static int64_t slot(int64_t y) { return (y + 1024 * NEEDED) % NEEDED; }
    real* row(int64_t y, int map) const { return data + (slot(y) * maps + map) * stride + MARGIN; }
    void clear(int64_t y, int64_t length) const {
        for (int map = 0; map < maps; ++map) std::memset(row(y, map), 0, static_cast<size_t>(length) * sizeof(real));
    }
    // Applies the vertical window to rows y .. y + count - 1 of a map; row r is written to out + r * stride.
    void blur(int64_t y, int count, int map, int64_t length, real* out) const {
        const real* rows[NEEDED];
        for (int k = 0; k < NEEDED; ++k) rows[k] = row(y + k - RADIUS, map);
        if (count == ROWS) return blur_rows<ROWS>(rows, length, out);
        for (int r = 0; r < count; ++r) blur_rows<1>(rows + r, length, out + r * stride);
    }

  private:
    template <int R> void blur_rows(const real* const* rows, int64_t length, real* out) const {
        for (int64_t i = 0; i < length; i += LANES) {
            V v[TAPS - 1 + R];
#pragma GCC unroll 16
            for (int k = 0; k < TAPS - 1 + R; ++k) v[k] = load(rows[k] + i);
#pragma GCC unroll 16
            for (int r = 0; r < R; ++r) store(out + r * stride + i, window([&](int k) { return v[r + RADIUS + k]; }));
        }
    }
};

struct Images {
    const real *rendered, *target, *target_mean;
    const uint8_t* mask;
    int64_t height, width;
    double l1_scale, ssim_scale, l2_scale;  // gradient factors: cotangent / (valid pixels * 3)
    real* gradient;
    double *l1_rows, *ssim_rows, *l2_rows;  // sums of each row
};

enum Moment { MEAN, SQUARES, PRODUCT, TARGET_MEAN, MOMENTS };
enum Derivative { D_MEAN, D_SQUARES, D_PRODUCT, DERIVATIVES };

// Processes one piece of rows [begin, end).
class Piece {
  public:
    Piece(const Images& images, int64_t begin, int64_t end)
        : im(images),
          begin(begin),
          end(end),
          n(3 * images.width),
          length(row_length(n)),
          stride(row_stride(n)),
          known(images.target_mean != nullptr),
          maps(known ? MOMENTS - 1 : MOMENTS),
          scratch(stride * (2 + MOMENTS + ROWS * (int(DERIVATIVES) + int(MOMENTS)) + NEEDED * (maps + DERIVATIVES))) {}

    bool run() {
        if (scratch.failed()) return false;
        int64_t r = 0;
        rendered = scratch.row(r++, stride);
        validity = scratch.row(r++, stride);
        if (im.mask == nullptr) fill_validity(nullptr, im.width, 3, validity);
        products = scratch.row(r, stride), r += MOMENTS;
        derivatives = scratch.row(r, stride), r += DERIVATIVES * ROWS;
        blurred = scratch.row(r, stride), r += MOMENTS * ROWS;
        moments = {scratch.data + r * stride, stride, maps}, r += NEEDED * maps;
        pullbacks = {scratch.data + r * stride, stride, DERIVATIVES};
        const int64_t reach = im.gradient ? RADIUS : 0;  // SSIM rows beyond the piece that its gradient needs
        const int64_t last = end + reach + RADIUS;
        for (int64_t y = begin - reach - RADIUS; y < last; y += ROWS) {
            const int count = last - y < ROWS ? static_cast<int>(last - y) : ROWS;
            for (int k = 0; k < count; ++k) input_row(y + k);
            from(begin - reach, y - RADIUS, count, [&](int64_t first, int n) { ssim_rows(first, n); });
            if (im.gradient) from(begin, y - 2 * RADIUS, count, [&](int64_t first, int n) { gradient_rows(first, n); });
        }
        return true;
    }

  private:
    bool inside(int64_t y) const { return y >= 0 && y < im.height; }
    bool mine(int64_t y) const { return y >= begin && y < end; }
    const uint8_t* mask_row(int64_t y) const { return im.mask ? im.mask + y * im.width : nullptr; }
    // A row of an image, i < length. Values beyond its end are 0; nothing beyond the image is read.
    struct Row {
        const real* at;
        int64_t n;
        GS2D_HD V load(int64_t i) const {
            return n - i >= LANES ? gs2d::load(at + i) : load_first(at + i, static_cast<int>(n - i > 0 ? n - i : 0));
        }
    };
    Row row_of(const real* image, int64_t y) const { return {image + y * n, n}; }
    // Returns the rendered row, or a copy with the target at ignored pixels.
    Row rendered_row(int64_t y) const {
        const Row given = row_of(im.rendered, y), wanted = row_of(im.target, y);
        if (im.mask == nullptr) return given;
        fill_validity(mask_row(y), im.width, 3, validity);
        for (int64_t i = 0; i < length; i += LANES)
            store(rendered + i, select(load(validity + i) > V(real(0)), given.load(i), wanted.load(i)));
        return {rendered, length};
    }

    void input_row(int64_t y) {
        if (!inside(y)) return moments.clear(y, length);
        const Row x = rendered_row(y), target = row_of(im.target, y);
        V l1 = V(real(0)), l2 = l1;
        for (int64_t i = 0; i < length; i += LANES) {
            const V u = x.load(i), v = target.load(i);
            store(products + MEAN * stride + i, u);
            store(products + SQUARES * stride + i, fma(u, u, v * v));
            store(products + PRODUCT * stride + i, u * v);
            if (!known) store(products + TARGET_MEAN * stride + i, v);
            l1 += abs(u - v);
            l2 = fma(u - v, u - v, l2);
        }
        if (mine(y)) im.l1_rows[y] = double(sum(l1)), im.l2_rows[y] = double(sum(l2));
        for (int m = 0; m < maps; ++m) blur_row(products + m * stride, moments.row(y, m), length);
    }

    // Calls f for those of `count` rows, starting at y, that are not above `least`.
    template <class F> static void from(int64_t least, int64_t y, int count, F f) {
        const int64_t above = least > y ? least - y : 0;
        if (above < count) f(y + above, static_cast<int>(count - above));
    }
    real* derivative(int d, int r) const { return derivatives + (d * ROWS + r) * stride; }
    V blurred_at(int map, int r, int64_t i) const { return load(blurred + (map * ROWS + r) * stride + i); }

    // Computes SSIM of rows y .. y + count - 1 and its derivatives, blurred horizontally.
    void ssim_rows(int64_t y, int count) {
        for (int m = 0; m < maps; ++m) moments.blur(y, count, m, length, blurred + m * ROWS * stride);
        for (int r = 0; r < count; ++r) ssim_row(y + r, r);
    }

    void ssim_row(int64_t y, int r) {
        if (!inside(y)) return pullbacks.clear(y, length);
        if (im.mask != nullptr) fill_validity(mask_row(y), im.width, 3, validity);
        const Row mean = row_of(im.target_mean, known ? y : 0);
        real* const to[DERIVATIVES] = {derivative(D_MEAN, r), derivative(D_SQUARES, r), derivative(D_PRODUCT, r)};
        V total = V(real(0));
        for (int64_t i = 0; i < length; i += LANES) {
            const V b = known ? mean.load(i) : blurred_at(TARGET_MEAN, r, i);
            const SsimPoint<V> point =
                ssim_point<V>(blurred_at(MEAN, r, i), b, blurred_at(SQUARES, r, i), blurred_at(PRODUCT, r, i));
            const V valid = load(validity + i);
            total = fma(valid, point.value, total);
            store(to[D_MEAN] + i, valid * point.d_mean);
            store(to[D_SQUARES] + i, valid * point.d_squares);
            store(to[D_PRODUCT] + i, valid * point.d_product);
        }
        if (mine(y)) im.ssim_rows[y] = double(sum(total));
        if (!im.gradient) return;
        for (int d = 0; d < DERIVATIVES; ++d) blur_row(to[d], pullbacks.row(y, d), length);
    }

    void gradient_rows(int64_t y, int count) {
        for (int d = 0; d < DERIVATIVES; ++d) pullbacks.blur(y, count, d, length, blurred + d * ROWS * stride);
        for (int r = 0; r < count; ++r) gradient_row(y + r, r);
    }

    void gradient_row(int64_t y, int r) {
        const Row x = rendered_row(y), target = row_of(im.target, y);
        const V l1_scale = V(real(im.l1_scale)), ssim_scale = V(real(im.ssim_scale)), two = V(real(2));
        const V l2_scale = V(real(im.l2_scale));
        real* out = im.gradient + y * n;
        for (int64_t i = 0; i < n; i += LANES) {
            const V u = x.load(i), v = target.load(i);
            const V ssim = fma(two * u, blurred_at(D_SQUARES, r, i),
                               fma(v, blurred_at(D_PRODUCT, r, i), blurred_at(D_MEAN, r, i)));
            const V by_pixel = fma(l2_scale, l2_slope(u, v), l1_scale * l1_sign(u, v));
            const V all = load(validity + i) * fma(ssim_scale, ssim, by_pixel);
            if (n - i >= LANES) {
                store(out + i, all);
            } else {
                store_first(out + i, all, static_cast<int>(n - i));
            }
        }
    }

    const Images& im;
    const int64_t begin, end, n, length, stride;
    const bool known;  // the blurred target is passed in
    const int maps;
    const Scratch scratch;
    real *rendered = nullptr, *validity = nullptr;                         // all 1 without a mask
    real *products = nullptr, *derivatives = nullptr, *blurred = nullptr;  // row r of map m: m * ROWS + r
    Ring moments{}, pullbacks{};
};

double ordered_sum(const double* values, int64_t n) {
    double total = 0;
    for (int64_t i = 0; i < n; ++i) total += values[i];
    return total;
}

}  // namespace
}  // namespace gs2d

using namespace gs2d;

// values = (mean L1, mean SSIM, mean L2) over valid pixels and channels; gradient (or null) = l1_cotangent
// dL1/drendered + ssim_cotangent dSSIM/drendered + l2_cotangent dL2/drendered. `mask` (bytes, 0 = ignore) and
// `target_mean` (of gs2d_blur) may be null. Returns 0, or 1 if out of memory.
GS2D_EXPORT int gs2d_photometric(const real* rendered, const real* target, const uint8_t* mask, const real* target_mean,
                                 int64_t height, int64_t width, double l1_cotangent, double ssim_cotangent,
                                 double l2_cotangent, real* gradient, double* values) {
    values[0] = values[1] = values[2] = 0;
    auto* rows = static_cast<double*>(std::malloc(static_cast<size_t>(3 * height + 1) * sizeof(double)));
    if (rows == nullptr) return 1;
    const int64_t valid = count_valid(mask, height * width);
    const double scale = 1.0 / static_cast<double>(valid > 0 ? 3 * valid : 1);
    const Images images{rendered,
                        target,
                        target_mean,
                        mask,
                        height,
                        width,
                        l1_cotangent * scale,
                        ssim_cotangent * scale,
                        l2_cotangent * scale,
                        gradient,
                        rows,
                        rows + height,
                        rows + 2 * height};
    int failed = 0;
    parallel_ranges(height, rows_per_piece(height, 2 * RADIUS), [&](int64_t begin, int64_t end) {
        if (!Piece(images, begin, end).run()) __atomic_store_n(&failed, 1, __ATOMIC_RELAXED);
    });
    if (!failed) {
        values[0] = ordered_sum(images.l1_rows, height) * scale;
        values[1] = ordered_sum(images.ssim_rows, height) * scale;
        values[2] = ordered_sum(images.l2_rows, height) * scale;
    }
    std::free(rows);
    return failed;
}

// Applies the window to an image [H, W, 3], zero outside; bit-identical to the target blur of gs2d_photometric.
GS2D_EXPORT int gs2d_blur(const real* image, int64_t height, int64_t width, real* out) {
    int failed = 0;
    const int64_t n = 3 * width, length = row_length(n), stride = row_stride(n);
    parallel_ranges(height, rows_per_piece(height, RADIUS), [&](int64_t begin, int64_t end) {
        const Scratch scratch(stride * (2 + NEEDED));
        if (scratch.failed()) return __atomic_store_n(&failed, 1, __ATOMIC_RELAXED);
        real *in = scratch.row(0, stride), *blurred = scratch.row(1, stride);
        const Ring ring{scratch.data + 2 * stride, stride, 1};
        for (int64_t y = begin - RADIUS; y < end + RADIUS; ++y) {
            if (y >= 0 && y < height) {
                std::memcpy(in, image + y * n, static_cast<size_t>(n) * sizeof(real));
                blur_row(in, ring.row(y, 0), length);
            } else {
                ring.clear(y, length);
            }
            if (y - RADIUS < begin) continue;
            ring.blur(y - RADIUS, 1, 0, length, blurred);
            std::memcpy(out + (y - RADIUS) * n, blurred, static_cast<size_t>(n) * sizeof(real));
        }
    });
    return failed;
}

// Computes the mean of a map [H, W] over valid pixels.
GS2D_EXPORT int gs2d_masked_mean(const real* map, const uint8_t* mask, int64_t height, int64_t width, double* value) {
    *value = 0;
    const int64_t valid = count_valid(mask, height * width), length = row_length(width);
    auto* rows = static_cast<double*>(std::malloc(static_cast<size_t>(height + 1) * sizeof(double)));
    if (rows == nullptr) return 1;
    int failed = 0;
    parallel_ranges(height, rows_per_piece(height, 16), [&](int64_t begin, int64_t end) {
        const Scratch scratch(2 * row_stride(width));
        if (scratch.failed()) return __atomic_store_n(&failed, 1, __ATOMIC_RELAXED);
        real *in = scratch.row(0, row_stride(width)), *validity = scratch.row(1, row_stride(width));
        for (int64_t y = begin; y < end; ++y) {
            std::memcpy(in, map + y * width, static_cast<size_t>(width) * sizeof(real));
            fill_validity(mask ? mask + y * width : nullptr, width, 1, validity);
            V total = V(real(0));
            for (int64_t i = 0; i < length; i += LANES) total += keep(load(validity + i) > V(real(0)), load(in + i));
            rows[y] = double(sum(total));
        }
    });
    if (!failed) *value = ordered_sum(rows, height) / static_cast<double>(valid > 0 ? valid : 1);
    std::free(rows);
    return failed;
}
