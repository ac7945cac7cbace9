// Smoothness of a rendered normal image where the photograph has no texture: value and gradient in one pass.
//
// Each pixel gathers the gradients of its four pairs, without atomics. In the padded copy, weights are 0 outside the
// image and at ignored pixels, where normals are 0, too.
#include "core/losses.h"
#include "cpu/export.h"
#include "cpu/losses_rows.h"

namespace gs2d {
namespace {

struct Images {
    const real *normal, *alpha;
    const uint8_t *flatness, *mask;
    int64_t height, width;
    double scale;    // factor of the gradient: cotangent / valid pixels
    real* gradient;  // or null
    double* rows;    // the sum of each row
};

// Processes one piece of rows [begin, end).
class Piece {
  public:
    Piece(const Images& images, int64_t begin, int64_t end)
        : im(images),
          begin(begin),
          end(end),
          stride(row_stride(im.width)),
          copied(end - begin + 2 * SMOOTH_REACH),
          scratch(stride * (4 * copied + 3)) {}

    bool run() {
        if (scratch.failed()) return false;
        for (int64_t y = begin - SMOOTH_REACH; y < end + SMOOTH_REACH; ++y) {
            if (y >= 0 && y < im.height) read(y);
        }
        for (int64_t y = begin; y < end; ++y) gather(y);
        return true;
    }

  private:
    // Padded row y of the copy: components 0 to 2 of the normal, 3 the weight.
    real* row(int k, int64_t y) const { return scratch.row(k * copied + y - begin + SMOOTH_REACH, stride); }
    Vec3<V> normal_at(int64_t y, int64_t i) const { return {load(row(0, y) + i), load(row(1, y) + i), load(row(2, y) + i)}; }

    void read(int64_t y) {
        for (int64_t i = 0, at = y * im.width; i < im.width; ++i, ++at) {
            if (im.mask && !im.mask[at]) continue;
            for (int k = 0; k < 3; ++k) row(k, y)[i] = im.normal[3 * at + k];
            row(3, y)[i] = im.alpha[at] > real(0.5) ? real(im.flatness[at]) / real(255) : real(0);
        }
    }

    void gather(int64_t y) {
        real* out[3];
        for (int k = 0; k < 3; ++k) out[k] = scratch.row(4 * copied + k, stride);
        const V scale = V(real(im.scale));
        V total = V(real(0));
        for (int64_t i = 0; i < im.width; i += LANES) {
            const Vec3<V> n = normal_at(y, i);
            const V w = load(row(3, y) + i);
            const auto pair = [&](int64_t y2, int64_t i2) {
                return bend_point<V>(n, normal_at(y2, i2), min(w, load(row(3, y2) + i2)));
            };
            const BendPoint<V> right = pair(y, i + SMOOTH_REACH), below = pair(y + SMOOTH_REACH, i);
            total += right.value + below.value;
            if (im.gradient == nullptr) continue;
            const BendPoint<V> left = pair(y, i - SMOOTH_REACH), above = pair(y - SMOOTH_REACH, i);
            const Vec3<V> g = (right.gradient + left.gradient) + (below.gradient + above.gradient);
            store(out[0] + i, scale * g.x), store(out[1] + i, scale * g.y), store(out[2] + i, scale * g.z);
        }
        im.rows[y] = double(sum(total));
        for (int64_t i = 0; im.gradient && i < im.width; ++i) {
            for (int k = 0; k < 3; ++k) im.gradient[3 * (y * im.width + i) + k] = out[k][i];
        }
    }

    const Images& im;
    const int64_t begin, end, stride, copied;
    const Scratch scratch;
};

}  // namespace
}  // namespace gs2d

using namespace gs2d;

// value = losses.formulas.normal_smoothness; gradient [H, W, 3] of it by the normals, times `cotangent`, or null.
// Returns 0, or 1 if out of memory.
GS2D_EXPORT int gs2d_normal_smoothness(const real* normal, const real* alpha, const uint8_t* flatness,
                                       const uint8_t* mask, int64_t height, int64_t width, double cotangent,
                                       real* gradient, double* value) {
    *value = 0;
    auto* rows = static_cast<double*>(std::malloc(static_cast<size_t>(height + 1) * sizeof(double)));
    if (rows == nullptr) return 1;
    const int64_t valid = count_valid(mask, height * width);
    const double count = static_cast<double>(valid > 0 ? valid : 1);
    const Images images{normal, alpha, flatness, mask, height, width, cotangent / count, gradient, rows};
    int failed = 0;
    parallel_ranges(height, rows_per_piece(height, SMOOTH_REACH), [&](int64_t begin, int64_t end) {
        if (!Piece(images, begin, end).run()) __atomic_store_n(&failed, 1, __ATOMIC_RELAXED);
    });
    for (int64_t y = 0; !failed && y < height; ++y) *value += rows[y];
    *value /= count;
    std::free(rows);
    return failed;
}
