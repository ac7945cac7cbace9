// Normal consistency of a rendered normal image with the normals of a depth image: value and gradients in one pass.
//
// Two forms: the official mean(1 - alpha <n, N>) with alpha detached, and the paper's per-splat mean(alpha - <n, N>)
// with nothing detached. N depends on the depths of the four neighbours, so the depth gradient is gathered from the
// four adjacent pixels, without atomics. In the padded copy, background depths are 0; outside the image and at ignored
// pixels they are `absent`, which makes N undefined for adjacent pixels. Pixels without N have no gradient.
#include "core/losses.h"
#include "cpu/export.h"
#include "cpu/losses_rows.h"

namespace gs2d {
namespace {

constexpr int64_t HALO = 2;  // rows of depth that the gradient of a row depends on

struct Images {
    const real *normal, *depth, *alpha;
    const uint8_t* mask;
    const real* weights;       // per pixel, or null
    const double* intrinsics;  // fx, fy, cx, cy
    const double* rotation;    // world to camera, row-major
    int64_t height, width;
    double scale;  // factor of the gradients: cotangent / valid pixels
    bool per_splat, at_camera;  // at_camera: see makes_normal
    real *normal_gradient, *depth_gradient, *alpha_gradient;  // all null, or at least the first two set
    double* rows;                                             // the variable part of the sum of each row
};

// Processes one piece of rows [begin, end).
class Piece {
  public:
    Piece(const Images& images, int64_t begin, int64_t end)
        : im(images),
          begin(begin),
          end(end),
          length(row_length(im.width)),
          stride(row_stride(im.width)),
          depths(end - begin + 2 * HALO),
          centres(end - begin + 2),
          scratch(stride * (depths + 2 * centres + 6)),
          absent(real(im.at_camera ? -1 : 0)),
          fx(real(im.intrinsics[0])),
          fy(real(im.intrinsics[1])) {
        for (int k = 0; k < 9; ++k) rotation[k] = V(real(im.rotation[k]));
    }

    bool run() {
        if (scratch.failed()) return false;
        for (int64_t i = 0; im.at_camera && i < stride * depths; ++i) scratch.data[i] = absent;
        for (int64_t y = begin - HALO; y < end + HALO; ++y) read_depth(y);
        const int64_t reach = im.depth_gradient ? 1 : 0;
        for (int64_t y = begin - reach; y < end + reach; ++y) {
            if (y >= 0 && y < im.height) centre_row(y);
        }
        for (int64_t y = begin; im.depth_gradient && y < end; ++y) depth_gradient_row(y);
        return true;
    }

  private:
    // Padded rows by image row: depth, and the pullbacks with respect to the horizontal and vertical differences.
    real* depth_row(int64_t y) const { return scratch.row(y - begin + HALO, stride); }
    real* pull_x(int64_t y) const { return scratch.row(depths + y - begin + 1, stride); }
    real* pull_y(int64_t y) const { return scratch.row(depths + centres + y - begin + 1, stride); }
    real* plane(int k) const { return scratch.row(depths + 2 * centres + k, stride); }

    void read_depth(int64_t y) {
        if (y < 0 || y >= im.height) return;  // outside the image
        const real* from = im.depth + y * im.width;
        real* to = depth_row(y);
        fill_validity(im.mask ? im.mask + y * im.width : nullptr, im.width, 1, to);
        for (int64_t i = 0; i < length; i += LANES) {
            const V z = im.width - i >= LANES ? load(from + i) : load_first(from + i, left_at(i));
            store(to + i, select(load(to + i) > V(real(0)), keep(was_hit(z), z), V(absent)));
        }
    }
    int left_at(int64_t i) const {
        return static_cast<int>(im.width - i < 0 ? 0 : im.width - i < LANES ? im.width - i : LANES);
    }

    // Computes the values of row y, the gradients of its own pixels, and pullbacks for the neighbours.
    void centre_row(int64_t y) {
        const real *z = depth_row(y), *above = depth_row(y - 1), *below = depth_row(y + 1);
        real *qx = plane(0), *qy = plane(1), *qz = plane(2), *a = plane(3), *validity = plane(4), *w = plane(5);
        const real* q = im.normal + y * 3 * im.width;
        for (int64_t i = 0; i < im.width; ++i) {
            qx[i] = q[3 * i];
            qy[i] = q[3 * i + 1];
            qz[i] = q[3 * i + 2];
        }
        std::memcpy(a, im.alpha + y * im.width, static_cast<size_t>(im.width) * sizeof(real));
        if (im.weights) std::memcpy(w, im.weights + y * im.width, static_cast<size_t>(im.width) * sizeof(real));
        fill_validity(im.mask ? im.mask + y * im.width : nullptr, im.width, 1, validity);
        const bool mine = y >= begin && y < end;
        const V zero = V(real(0)), one = V(real(1));
        const V offset_y = V(real(double(y) + 0.5 - im.intrinsics[3]));
        V total = zero;
        for (int64_t i = 0; i < length; i += LANES) {
            const V l = load(z + i - 1), r = load(z + i + 1), u = load(above + i), d = load(below + i);
            const M defined = makes_normal<V>(l, r, u, d, im.at_camera) & (load(validity + i) > zero);
            const V offset_x = iota() + V(real(double(i) + 0.5 - im.intrinsics[2]));
            const DepthNormal<V> f = depth_normal<V>(l, r, u, d, offset_x, offset_y, fx, fy);
            const Vec3<V> world = {load(qx + i), load(qy + i), load(qz + i)};
            const Vec3<V> camera = {dot({rotation[0], rotation[1], rotation[2]}, world),
                                    dot({rotation[3], rotation[4], rotation[5]}, world),
                                    dot({rotation[6], rotation[7], rotation[8]}, world)};
            const V cosine = dot(camera, f.direction), alpha = load(a + i);
            const V of_pixel = im.weights ? load(w + i) : one, scale = of_pixel * V(real(im.scale));
            total += keep(defined, of_pixel * (im.per_splat ? alpha - cosine : alpha * cosine));
            if (im.depth_gradient == nullptr) continue;
            const V weight = im.per_splat ? -scale : -(scale * alpha);
            const DepthNormalGrad<V> g = depth_normal_vjp<V>(f, weight * camera, offset_x, offset_y, fx, fy);
            store(pull_x(y) + i, keep(defined, g.x));
            store(pull_y(y) + i, keep(defined, g.y));
            const Vec3<V> n = weight * f.direction;  // camera frame; R^T transforms it to the world frame
            store(qx + i, keep(defined, dot({rotation[0], rotation[3], rotation[6]}, n)));
            store(qy + i, keep(defined, dot({rotation[1], rotation[4], rotation[7]}, n)));
            store(qz + i, keep(defined, dot({rotation[2], rotation[5], rotation[8]}, n)));
            store(a + i, keep(defined, scale));
        }
        if (!mine) return;
        im.rows[y] = double(sum(total));
        if (im.depth_gradient == nullptr) return;
        real* out = im.normal_gradient + y * 3 * im.width;
        for (int64_t i = 0; i < im.width; ++i) {
            out[3 * i] = qx[i];
            out[3 * i + 1] = qy[i];
            out[3 * i + 2] = qz[i];
        }
        if (im.alpha_gradient == nullptr) return;
        std::memcpy(im.alpha_gradient + y * im.width, a, static_cast<size_t>(im.width) * sizeof(real));
    }

    void depth_gradient_row(int64_t y) {
        const real *z = depth_row(y), *gx = pull_x(y);
        const real *z2 = depth_row(y - 2), *z_2 = depth_row(y + 2), *g1 = pull_y(y - 1), *g_1 = pull_y(y + 1);
        for (int64_t i = 0; i < im.width; i += LANES) {
            const V from_left = load(gx + i - 1) * load(z + i - 2), from_right = load(gx + i + 1) * load(z + i + 2);
            const V from_above = load(g1 + i) * load(z2 + i), from_below = load(g_1 + i) * load(z_2 + i);
            const V gradient = (from_left - from_right) + (from_above - from_below);
            store_first(im.depth_gradient + y * im.width + i, keep(was_hit(load(z + i)), gradient), left_at(i));
        }
    }

    const Images& im;
    const int64_t begin, end, length, stride, depths, centres;
    const Scratch scratch;
    const real absent;  // depth outside the image and at ignored pixels
    const V fx, fy;
    V rotation[9];
};

}  // namespace
}  // namespace gs2d

using namespace gs2d;

// value = mean over valid pixels of 1 - alpha <n, N> (1 for pixels without N), or with per_splat of alpha - <n, N> (0
// for pixels without N). Terms are weighted by `weights` [H, W] if not null; at_camera: see makes_normal. Gradients are
// scaled by `cotangent`: normal [H, W, 3] (world frame) and depth [H, W], both null or neither, and alpha (null in the
// official form). Returns 0, or 1 if out of memory.
GS2D_EXPORT int gs2d_normal_consistency(const real* normal, const real* depth, const real* alpha, const uint8_t* mask,
                                        const real* weights, const double* intrinsics, const double* rotation,
                                        int64_t height, int64_t width, int per_splat, int at_camera, double cotangent,
                                        real* normal_gradient, real* depth_gradient, real* alpha_gradient,
                                        double* value) {
    *value = 0;
    auto* rows = static_cast<double*>(std::malloc(static_cast<size_t>(height + 1) * sizeof(double)));
    if (rows == nullptr) return 1;
    const int64_t valid = count_valid(mask, height * width);
    const double count = static_cast<double>(valid > 0 ? valid : 1);
    const Images images{normal,
                        depth,
                        alpha,
                        mask,
                        weights,
                        intrinsics,
                        rotation,
                        height,
                        width,
                        cotangent / count,
                        per_splat != 0,
                        at_camera != 0,
                        normal_gradient,
                        depth_gradient,
                        alpha_gradient,
                        rows};
    int failed = 0;
    parallel_ranges(height, rows_per_piece(height, HALO), [&](int64_t begin, int64_t end) {
        if (!Piece(images, begin, end).run()) __atomic_store_n(&failed, 1, __ATOMIC_RELAXED);
    });
    double total = 0;
    for (int64_t y = 0; !failed && y < height; ++y) total += rows[y];
    double constant = static_cast<double>(valid);
    if (weights) {
        constant = 0;
        for (int64_t i = 0; i < height * width; ++i) constant += mask == nullptr || mask[i] ? double(weights[i]) : 0.0;
    }
    *value = (per_splat ? total : constant - total) / count;
    std::free(rows);
    return failed;
}
