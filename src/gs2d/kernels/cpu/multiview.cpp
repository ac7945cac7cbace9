// Comparison of patches of two views, LANES pixels at a time: values and gradients in one pass.
#include <cstdlib>

#include "core/multiview.h"
#include "cpu/export.h"
#include "cpu/simd.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

constexpr int64_t GROUPS = 8;  // vectors of pixels per piece

// An image interpolated between pixel centres; border values extend beyond the border.
struct Image {
    const real* pixels;
    int width, right, below;  // offsets of the next column and row, 0 at the border
    V last_x, last_y, before_x, before_y;
    Image(const real* pixels, int64_t width, int64_t height)
        : pixels(pixels),
          width(static_cast<int>(width)),
          right(width > 1),
          below(height > 1 ? static_cast<int>(width) : 0),
          last_x(V(real(width - 1))),
          last_y(V(real(height - 1))),
          before_x(V(real(width > 1 ? width - 2 : 0))),
          before_y(V(real(height > 1 ? height - 2 : 0))) {}
    Sampled<V> operator()(V x, V y) const {
        x = min(max(x, V(real(0))), last_x), y = min(max(y, V(real(0))), last_y);
        const V i = min(whole(x), before_x), j = min(whole(y), before_y);
        const LaneInts at = row_major(ints_of(j), width, ints_of(i));
        const V a = gather(pixels, at), b = gather(pixels + right, at);
        const V c = gather(pixels + below, at), d = gather(pixels + below + right, at);
        return between(a, b, c, d, x - i, y - j);
    }
    M contains(V x, V y) const {
        return (x >= V(real(0))) & (x <= last_x) & (y >= V(real(0))) & (y <= last_y);
    }
};

// LANES pixels of the view. Lanes that are not chosen repeat a chosen pixel.
struct Pixels {
    int64_t first;  // index of the first of P pixels
    int count;
    M chosen;
    V depth;
    Vec3<V> q, ray;
    LaneInts at;  // index into the flattened image

    // Returns false if no lane is chosen.
    bool set(const CompareArguments<real>& a, const Lens<V>& lens, int64_t first_patch) {
        first = first_patch, count = static_cast<int>(a.count - first < LANES ? a.count - first : LANES);
        uint32_t which = 0;
        int64_t some = -1;
        for (int k = 0; k < count; ++k)
            if (a.chosen[first + k]) which |= 1u << k, some = a.index[first + k];
        if (some < 0) return false;
        alignas(64) real of[6][LANES];
        for (int k = 0; k < LANES; ++k) {
            const int64_t pixel = which >> k & 1 ? a.index[first + k] : some;
            of[0][k] = a.depth[pixel], of[1][k] = real(pixel % a.width), of[2][k] = real(pixel / a.width);
            for (int c = 0; c < 3; ++c) of[3 + c][k] = a.normal[3 * pixel + c];
        }
        const V x = load(of[1]), y = load(of[2]);
        chosen = mask_of(which), depth = load(of[0]), q = {load(of[3]), load(of[4]), load(of[5])};
        ray = {(x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, V(real(1))};
        at = row_major(ints_of(y), static_cast<int>(a.width), ints_of(x));
        return true;
    }
};

// A patch pixel: its grey values in both views relative to the centre pixel, and derivatives with respect to the plane.
struct Grey {
    V a, b;
    Vec3<V> pull;
};

class Comparison {
    // Stores the k-th value of each valid lane in row + k of the motion gradients.
    auto rows_from(int row, const Pixels& p, M counts) const {
        return [this, row, &p, counts](int k, V v) { leave(a.motion_gradients, row + k, p, keep(counts, v)); };
    }

  public:
    explicit Comparison(const CompareArguments<real>& a)
        : a(a),
          here(lens_of<V, real>(a.lens)),
          there(lens_of<V, real>(a.source_lens)),
          surface_lens(lens_of<V, real>(a.source_lens, double(a.depth_width) / double(a.source_width),
                                        double(a.depth_height) / double(a.source_height))),
          motion(motion_of<V>(a.motion)),
          source(a.source, a.source_width, a.source_height),
          surface(a.source_depth, a.depth_width, a.depth_height) {}

    void run(int64_t first, Grey* greys) const {
        Pixels p;
        if (!p.set(a, here, first)) {
            leave_nothing(a.values, VALUE_ROWS, p), leave_nothing(a.gradients, GRADIENT_ROWS, p);
            return leave_nothing(a.motion_gradients, MOTION_ROWS, p);
        }
        const auto clear = [this](V u, V v) { return is_clear(u, v); };
        const RoundTrip<V> trip = round_trip(p.depth, p.ray, motion, here, surface_lens, surface.last_x, surface.last_y,
                                             surface, clear);
        const M counts = trip.back & p.chosen & (trip.error < V(real(a.occluded)));
        const V weight = keep(counts, exp(-trip.error));
        leave(a.values, 1, p, keep(counts, weight * trip.error));
        if (a.gradients) leave(a.gradients, 4, p, keep(counts, weight * trip.by_depth));
        if (a.motion_gradients) {
            const MotionGrad<V> g = motion_grad(trip, p.depth, p.ray);
            each_of(g.turn, weight, rows_from(TRIP_TURN_ROW, p, counts));
            each_of(g.shift, weight, rows_from(TRIP_SHIFT_ROW, p, counts));
        }
        compare(p, weight, greys);
    }

  private:
    const CompareArguments<real>& a;
    const Lens<V> here, there, surface_lens;
    const Motion<V> motion;
    const Image source, surface;

    void leave(real* rows, int row, const Pixels& p, V values) const {
        store_first(rows + row * a.count + p.first, values, p.count);
    }

    void leave_nothing(real* rows, int count, const Pixels& p) const {
        for (int row = 0; rows != nullptr && row < count; ++row) leave(rows, row, p, V(real(0)));
    }

    M is_clear(V u, V v) const {
        alignas(64) real column[LANES], row[LANES];
        const V half = V(real(0.5)), x = fma(there.fx, u, there.cx) + half, y = fma(there.fy, v, there.cy) + half;
        store(column, whole(min(max(x, V(real(0))), source.last_x)));
        store(row, whole(min(max(y, V(real(0))), source.last_y)));
        uint32_t found = 0;
        for (int k = 0; k < LANES; ++k)
            found |= uint32_t(a.clear[int64_t(row[k]) * a.source_width + int64_t(column[k])] != 0) << k;
        return mask_of(found);
    }

    void compare(const Pixels& p, V weight, Grey* greys) const {
        const PatchPlane<V> plane = patch_plane(p.depth, p.q, p.ray, motion, here);
        M valid = plane.planar & (weight > V(real(0))) & is_inside(plane);
        const int side = static_cast<int>(2 * a.radius + 1);
        const PatchNcc<V> ncc = patch_ncc(sample(p, plane, greys), V(real(side * side)), V(real(a.texture)));
        valid = valid & ncc.valid;
        leave(a.values, 0, p, keep(valid, weight * (V(real(1)) - ncc.value)));
        if (a.gradients == nullptr) return;
        const V zero = V(real(0));
        Vec3<V> right = {zero, zero, zero}, down = right, middle = right;
        for (int64_t j = -a.radius; j <= a.radius; ++j) {
            Vec3<V> row = {zero, zero, zero};
            for (int64_t i = -a.radius; i <= a.radius; ++i, ++greys) {
                const V by_grey = fma(ncc.by_a, greys->a - ncc.mean_a, -(ncc.by_b * (greys->b - ncc.mean_b)));
                const Vec3<V> pull = by_grey * greys->pull;
                row = row + pull, right = axpy(V(real(i)), pull, right);
            }
            middle = middle + row, down = axpy(V(real(j)), row, down);
        }
        const PatchPlaneGrad<V> g = patch_plane_vjp(plane, right, down, middle, p.depth, p.ray, motion, here);
        const Vec3<V> normal = transposed_times(motion.world, g.normal);
        const V by_ncc = -weight;
        leave(a.gradients, 0, p, keep(valid, by_ncc * g.depth));
        each_of(normal, by_ncc, [&](int k, V v) { leave(a.gradients, 1 + k, p, keep(valid, v)); });
        if (a.motion_gradients == nullptr) return;
        const MotionGrad<V> m = motion_grad(plane, g, middle, p.ray);
        each_of(m.turn, by_ncc, rows_from(TURN_ROW, p, valid));
        each_of(m.shift, by_ncc, rows_from(SHIFT_ROW, p, valid));
        each_of(outer(g.normal, p.q), by_ncc, rows_from(WORLD_ROW, p, valid));
    }

    // The warped square is convex, so its corners bound the patch.
    M is_inside(const PatchPlane<V>& plane) const {
        const V r = V(real(a.radius));
        M inside = plane.planar;
        for (int corner = 0; corner < 4; ++corner) {
            const V i = corner & 1 ? r : -r, j = corner & 2 ? r : -r;
            const Vec3<V> h = axpy(i, plane.right, axpy(j, plane.down, plane.middle));
            const PatchPlace<V> at = patch_place(h);
            inside = inside & (h.z > V(real(MIN_SCALE))) &
                     source.contains(fma(there.fx, at.x, there.cx), fma(there.fy, at.y, there.cy));
        }
        return inside;
    }

    // Sums over the patches; `greys` keeps the inputs of the gradient.
    PatchSums<V> sample(const Pixels& p, const PatchPlane<V>& plane, Grey* greys) const {
        const auto look = [&](int64_t j, int64_t i, Vec3<V> row) {
            const PatchPlace<V> at = patch_place(axpy(V(real(i)), plane.right, row));
            const Sampled<V> s = source(fma(there.fx, at.x, there.cx), fma(there.fy, at.y, there.cy));
            return Grey{gather(a.reference + j * a.width + i, p.at), s.value, patch_pull(at, s, there)};
        };
        const V zero = V(real(0));
        const Grey first = look(0, 0, plane.middle);
        PatchSums<V> sums = {zero, zero, zero, zero, zero};
        for (int64_t j = -a.radius; j <= a.radius; ++j) {
            const Vec3<V> row = axpy(V(real(j)), plane.down, plane.middle);
            for (int64_t i = -a.radius; i <= a.radius; ++i, ++greys) {
                *greys = look(j, i, row);
                greys->a -= first.a, greys->b -= first.b;
                sums.add(greys->a, greys->b);
            }
        }
        return sums;
    }
};

}  // namespace
}  // namespace gs2d

using namespace gs2d;

// Fills `values`, `gradients` and `motion_gradients`. Writes the pixel sums of the first [2] and of the last [33] to
// `sums`. Returns 0, or 1 if out of memory.
GS2D_EXPORT int gs2d_compare_views(const CompareArguments<real>* arguments, double* sums) {
    const CompareArguments<real>& a = *arguments;
    const Comparison comparison(a);
    const size_t side = static_cast<size_t>(2 * a.radius + 1), line = alignof(Grey);
    int failed = 0;
    parallel_ranges((a.count + LANES - 1) / LANES, GROUPS, [&](int64_t begin, int64_t end) {
        void* const block = std::malloc(side * side * sizeof(Grey) + line);
        if (block == nullptr) return __atomic_store_n(&failed, 1, __ATOMIC_RELAXED);
        const uintptr_t aligned = (reinterpret_cast<uintptr_t>(block) + line - 1) / line * line;
        for (int64_t i = begin; i < end; ++i) comparison.run(i * LANES, reinterpret_cast<Grey*>(aligned));
        std::free(block);
    });
    const auto sum_rows = [&](const real* rows, int count, double* to) {
        for (int row = 0; row < count; ++row, rows += a.count) {
            to[row] = 0;
            for (int64_t k = 0; k < a.count; ++k) to[row] += double(rows[k]);
        }
    };
    sum_rows(a.values, VALUE_ROWS, sums);
    if (a.motion_gradients != nullptr) sum_rows(a.motion_gradients, MOTION_ROWS, sums + VALUE_ROWS);
    return failed;
}
