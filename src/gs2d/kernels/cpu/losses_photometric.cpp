// L1 and SSIM of an image [H, W, 3], with the gradient of any weighted sum of both, in one pass over the rows.
//
// A row of W interleaved pixels is 3 W reals; the window's taps are 3 reals apart, so that channels need no planes. Each
// piece of rows runs down the image with two rings of 11 horizontally blurred rows: of the moments x, x^2 + y^2, x y (and
// y, unless its blur is given), and of SSIM's derivatives by the blurred moments. 5 rows behind the input a row of SSIM
// is finished, 10 rows behind it a row of the gradient. Everything stays in the second-level cache.
#include "core/losses.h"
#include "cpu/export.h"
#include "cpu/losses_rows.h"

namespace gs2d {
namespace {

constexpr int RADIUS = SSIM_RADIUS, TAPS = SSIM_TAPS;

// The window over 11 values `at(k)`, k = -5..5.
template <class F> GS2D_HD V window(F at) {
    V sum = V(real(SSIM_WINDOW[0])) * at(0);
    for (int k = 1; k <= RADIUS; ++k) sum = fma(V(real(SSIM_WINDOW[k])), at(-k) + at(k), sum);
    return sum;
}

void blur_row(const real* in, real* out, int64_t length) {
    for (int64_t i = 0; i < length; i += LANES) store(out + i, window([&](int k) { return load(in + i + 3 * k); }));
}

// The horizontally blurred rows y - 5 .. y + 5 of `MAPS` maps: row y of map m is row (y mod 11) * MAPS + m.
struct Ring {
    real* data;
    int64_t stride;
    int maps;
    static int64_t slot(int64_t y) { return (y + 1024 * TAPS) % TAPS; }
    real* row(int64_t y, int map) const { return data + (slot(y) * maps + map) * stride + MARGIN; }
    void clear(int64_t y, int64_t length) const {
        for (int map = 0; map < maps; ++map) std::memset(row(y, map), 0, static_cast<size_t>(length) * sizeof(real));
    }
};

// Pointers to the 11 rows around y of one map.
struct Column {
    const real* rows[TAPS];
    Column(const Ring& ring, int64_t y, int map) {
        for (int k = 0; k < TAPS; ++k) rows[k] = ring.row(y + k - RADIUS, map);
    }
    GS2D_HD V blur(int64_t i) const {
        return window([&](int k) { return load(rows[k + RADIUS] + i); });
    }
};

struct Images {
    const real *rendered, *target, *target_mean;
    const uint8_t* mask;
    int64_t height, width;
    double l1_scale, ssim_scale;  // of the gradient: cotangent / (valid pixels * 3)
    real* gradient;
    double *l1_rows, *ssim_rows;  // sums of each row
};

enum Moment { MEAN, SQUARES, PRODUCT, TARGET_MEAN, MOMENTS };
enum Derivative { D_MEAN, D_SQUARES, D_PRODUCT, DERIVATIVES };

// One piece of rows [begin, end).
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
          scratch(stride * (1 + 1 + MOMENTS + DERIVATIVES + TAPS * (maps + DERIVATIVES))) {}

    bool run() {
        if (scratch.failed()) return false;
        int64_t r = 0;
        rendered = scratch.row(r++, stride);
        validity = scratch.row(r++, stride);
        if (im.mask == nullptr) fill_validity(nullptr, im.width, 3, validity);
        products = scratch.row(r, stride), r += MOMENTS;
        derivatives = scratch.row(r, stride), r += DERIVATIVES;
        moments = {scratch.data + r * stride, stride, maps}, r += TAPS * maps;
        pullbacks = {scratch.data + r * stride, stride, DERIVATIVES};
        const int64_t reach = im.gradient ? RADIUS : 0;  // rows of SSIM beyond the piece that its gradient needs
        for (int64_t y = begin - reach - RADIUS; y < end + reach + RADIUS; ++y) {
            input_row(y);
            if (y - RADIUS >= begin - reach) ssim_row(y - RADIUS);
            if (im.gradient && y - 2 * RADIUS >= begin) gradient_row(y - 2 * RADIUS);
        }
        return true;
    }

   private:
    bool inside(int64_t y) const { return y >= 0 && y < im.height; }
    bool mine(int64_t y) const { return y >= begin && y < end; }
    const uint8_t* mask_row(int64_t y) const { return im.mask ? im.mask + y * im.width : nullptr; }
    // A row of an image, i < length: zero beyond its end. Nothing behind the image is read.
    struct Row {
        const real* at;
        int64_t n;
        GS2D_HD V load(int64_t i) const {
            return n - i >= LANES ? gs2d::load(at + i) : load_first(at + i, static_cast<int>(n - i > 0 ? n - i : 0));
        }
    };
    Row row_of(const real* image, int64_t y) const { return {image + y * n, n}; }
    // The rendered row; where pixels are ignored, a copy that holds the target there.
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
        V l1 = V(real(0));
        for (int64_t i = 0; i < length; i += LANES) {
            const V u = x.load(i), v = target.load(i);
            store(products + MEAN * stride + i, u);
            store(products + SQUARES * stride + i, fma(u, u, v * v));
            store(products + PRODUCT * stride + i, u * v);
            store(products + TARGET_MEAN * stride + i, v);
            l1 += abs(u - v);
        }
        if (mine(y)) im.l1_rows[y] = double(sum(l1));
        for (int m = 0; m < maps; ++m) blur_row(products + m * stride, moments.row(y, m), length);
    }

    void ssim_row(int64_t y) {
        if (!inside(y)) return pullbacks.clear(y, length);
        if (im.mask != nullptr) fill_validity(mask_row(y), im.width, 3, validity);
        const Row mean = row_of(im.target_mean, known ? y : 0);
        const Column a(moments, y, MEAN), s(moments, y, SQUARES), p(moments, y, PRODUCT);
        const Column b(moments, y, known ? MEAN : TARGET_MEAN);
        V total = V(real(0));
        for (int64_t i = 0; i < length; i += LANES) {
            const V b_i = known ? mean.load(i) : b.blur(i);
            const SsimPoint<V> point = ssim_point<V>(a.blur(i), b_i, s.blur(i), p.blur(i));
            const V valid = load(validity + i);
            total = fma(valid, point.value, total);
            store(derivatives + D_MEAN * stride + i, valid * point.d_mean);
            store(derivatives + D_SQUARES * stride + i, valid * point.d_squares);
            store(derivatives + D_PRODUCT * stride + i, valid * point.d_product);
        }
        if (mine(y)) im.ssim_rows[y] = double(sum(total));
        if (!im.gradient) return;
        for (int d = 0; d < DERIVATIVES; ++d) blur_row(derivatives + d * stride, pullbacks.row(y, d), length);
    }

    void gradient_row(int64_t y) {
        const Row x = rendered_row(y), target = row_of(im.target, y);
        const Column dm(pullbacks, y, D_MEAN), ds(pullbacks, y, D_SQUARES), dp(pullbacks, y, D_PRODUCT);
        const V l1_scale = V(real(im.l1_scale)), ssim_scale = V(real(im.ssim_scale)), two = V(real(2));
        real* out = im.gradient + y * n;
        for (int64_t i = 0; i < n; i += LANES) {
            const V u = x.load(i), v = target.load(i);
            const V ssim = fma(two * u, ds.blur(i), fma(v, dp.blur(i), dm.blur(i)));
            const V both = load(validity + i) * fma(ssim_scale, ssim, l1_scale * l1_sign(u, v));
            if (n - i >= LANES) {
                store(out + i, both);
            } else {
                store_first(out + i, both, static_cast<int>(n - i));
            }
        }
    }

    const Images& im;
    const int64_t begin, end, n, length, stride;
    const bool known;  // the target's blur is given
    const int maps;
    const Scratch scratch;
    real *rendered = nullptr, *validity = nullptr;  // all 1 without a mask
    real *products = nullptr, *derivatives = nullptr;
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

// values = (mean L1, mean SSIM) over valid pixels and channels; gradient (or null) = l1_cotangent dL1/drendered +
// ssim_cotangent dSSIM/drendered. `mask` (bytes, 0 = ignore) and `target_mean` (of gs2d_blur) may be null.
// Returns 0, or 1 when there is no memory.
GS2D_EXPORT int gs2d_photometric(const real* rendered, const real* target, const uint8_t* mask, const real* target_mean,
                                 int64_t height, int64_t width, double l1_cotangent, double ssim_cotangent,
                                 real* gradient, double* values) {
    values[0] = values[1] = 0;
    auto* rows = static_cast<double*>(std::malloc(static_cast<size_t>(2 * height + 1) * sizeof(double)));
    if (rows == nullptr) return 1;
    const int64_t valid = count_valid(mask, height * width);
    const double scale = 1.0 / static_cast<double>(valid > 0 ? 3 * valid : 1);
    const Images images{rendered, target, target_mean, mask, height, width, l1_cotangent * scale, ssim_cotangent * scale,
                        gradient, rows, rows + height};
    int failed = 0;
    parallel_ranges(height, rows_per_piece(height, 2 * RADIUS), [&](int64_t begin, int64_t end) {
        if (!Piece(images, begin, end).run()) __atomic_store_n(&failed, 1, __ATOMIC_RELAXED);
    });
    if (!failed) {
        values[0] = ordered_sum(images.l1_rows, height) * scale;
        values[1] = ordered_sum(images.ssim_rows, height) * scale;
    }
    std::free(rows);
    return failed;
}

// The window over an image [H, W, 3], zero outside: bit for bit what gs2d_photometric computes for its target.
GS2D_EXPORT int gs2d_blur(const real* image, int64_t height, int64_t width, real* out) {
    int failed = 0;
    const int64_t n = 3 * width, length = row_length(n), stride = row_stride(n);
    parallel_ranges(height, rows_per_piece(height, RADIUS), [&](int64_t begin, int64_t end) {
        const Scratch scratch(stride * (1 + TAPS));
        if (scratch.failed()) return __atomic_store_n(&failed, 1, __ATOMIC_RELAXED);
        real* in = scratch.row(0, stride);
        const Ring ring{scratch.data + stride, stride, 1};
        for (int64_t y = begin - RADIUS; y < end + RADIUS; ++y) {
            if (y >= 0 && y < height) {
                std::memcpy(in, image + y * n, static_cast<size_t>(n) * sizeof(real));
                blur_row(in, ring.row(y, 0), length);
            } else {
                ring.clear(y, length);
            }
            if (y - RADIUS < begin) continue;
            const Column column(ring, y - RADIUS, 0);
            for (int64_t i = 0; i < n; i += LANES) {
                const int left = static_cast<int>(n - i < LANES ? n - i : LANES);
                store_first(out + (y - RADIUS) * n + i, column.blur(i), left);
            }
        }
    });
    return failed;
}

// Mean over valid pixels of one map [H, W].
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
