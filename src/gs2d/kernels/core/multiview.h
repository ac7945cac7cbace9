// Two views of one surface: a patch warped by its pixel's plane, and the round trip of a pixel to the other view.
// Formulas and gradients: docs/math.md, "Two views"; torch version: losses/view_pair.py.
//
// A pixel with depth d along its ray (z = 1) and a rendered normal q defines a plane. Its point X = d ray has the
// coordinates R X + t in the neighbour. Positions are in px from the centre of the first pixel of an image; so are cx
// and cy of a `Lens`.
#pragma once

#include "core/base.h"

namespace gs2d {

constexpr double MIN_COSINE = 0.1;        // between normal and ray; planes below are too edge-on to warp
constexpr double MIN_SCALE = 0.1;         // depth in the neighbour / depth in the view; patches below are too close
constexpr double MIN_NORMAL = 1e-4;       // minimum length of a rendered normal
constexpr double ROUND_TRIP_EPS = 1e-12;  // px^2, added under the square root of a distance to keep gradients finite

// Numbers of rows in CompareArguments, and first rows in `motion_gradients`: the similarity with respect to R, t and
// the world rotation, then the round trip with respect to R and t.
constexpr int VALUE_ROWS = 2, GRADIENT_ROWS = 5, MOTION_ROWS = 33;
constexpr int TURN_ROW = 0, SHIFT_ROW = 9, WORLD_ROW = 12, TRIP_TURN_ROW = 21, TRIP_SHIFT_ROW = 30;

// P pixels of a view and one neighbour. R is the array type.
template <class R> struct CompareArguments {
    long long count, width, height, source_width, source_height, depth_width, depth_height, radius;
    double lens[4], source_lens[4];  // fx, fy, cx, cy, as in `Camera`
    double texture, occluded;        // as in `MultiView`
    const R *depth, *normal;         // [H, W] world units, [H, W, 3] world frame
    const R* motion;                 // [21]: R and t from view to neighbour, then the rotation from world to view
    const long long* index;          // [P] index into the flattened image
    const unsigned char* chosen;     // [P]: 1 if the patch is inside the image and d > 0
    const R *reference, *source;     // [H, W], [h, w] grey
    const unsigned char* clear;      // [h, w]
    const R* source_depth;           // [depth_height, depth_width] of the whole image, world units; 0: no hit
    R* values;                       // [2, P]: weight * (1 - NCC), weight * error
    R* gradients;                    // [5, P]: row 0 of `values` by depth and normal, row 1 by depth; or null
    R* motion_gradients;             // [33, P]: row 0 of `values` by `motion`, row 1 by its R and t; or null
};

template <class V> using MaskOf = decltype(V(0.f) < V(0.f));

template <class V> struct Lens {
    V fx, fy, cx, cy;
};
// Converts the intrinsics of an image, or of a resized copy of it.
template <class V, class R> GS2D_HD Lens<V> lens_of(const double* lens, double by_x = 1., double by_y = 1.) {
    return {V(R(lens[0] * by_x)), V(R(lens[1] * by_y)), V(R(lens[2] * by_x - 0.5)), V(R(lens[3] * by_y - 0.5))};
}

template <class V> struct Rows3 {
    Vec3<V> x, y, z;
};
template <class V> GS2D_HD Vec3<V> times(const Rows3<V>& m, Vec3<V> v) {
    return {dot(m.x, v), dot(m.y, v), dot(m.z, v)};
}
template <class V> GS2D_HD Vec3<V> transposed_times(const Rows3<V>& m, Vec3<V> v) {
    return axpy(v.x, m.x, axpy(v.y, m.y, v.z * m.z));
}

template <class V> struct Motion {
    Rows3<V> turn;   // rotation from view to neighbour
    Vec3<V> shift;   // translation, world units
    Rows3<V> world;  // rotation from world to view
};
template <class V, class R> GS2D_HD Motion<V> motion_of(const R* m) {
    return {{{V(m[0]), V(m[1]), V(m[2])}, {V(m[3]), V(m[4]), V(m[5])}, {V(m[6]), V(m[7]), V(m[8])}},
            {V(m[9]), V(m[10]), V(m[11])},
            {{V(m[12]), V(m[13]), V(m[14])}, {V(m[15]), V(m[16]), V(m[17])}, {V(m[18]), V(m[19]), V(m[20])}}};
}

// An image interpolated between pixel centres, and its derivatives.
template <class V> struct Sampled {
    V value, by_x, by_y;
};
// Bilinear interpolation at (x, y) in the unit square; a b is the upper row, c d the lower row.
template <class V> GS2D_HD Sampled<V> between(V a, V b, V c, V d, V x, V y) {
    const V right = b - a, bend = (d - c) - right;
    const V by_x = fma(bend, y, right), by_y = fma(bend, x, c - a);
    return {fma(y, by_y, fma(x, right, a)), by_x, by_y};
}

// The plane of a pixel as a linear map A from rays of the view to rays of the neighbour,
// A r = R r + t (q . r) / (q . X). A maps one px to the right, one px down and the pixel ray to `right`, `down` and
// `middle`. Depths are in units of d.
template <class V> struct PatchPlane {
    Vec3<V> right, down, middle;
    MaskOf<V> planar;                              // faces the camera and is not too edge-on
    Vec3<V> normal;                                // q in the camera frame of the view
    V along, inverse, inverse_depth, slope_x, slope_y;  // q . ray; 1 / (q . X); 1 / d; q / (q . X)
};

template <class V>
GS2D_HD PatchPlane<V> patch_plane(V depth, Vec3<V> q, Vec3<V> ray, const Motion<V>& m, const Lens<V>& lens) {
    const V one = V(1.f);
    PatchPlane<V> p;
    p.normal = times(m.world, q);
    p.along = dot(p.normal, ray);
    const V length = dot(p.normal, p.normal);
    const V edge_on = V(float(MIN_COSINE * MIN_COSINE)) * length * dot(ray, ray);
    p.planar = (p.along * p.along > edge_on) & (p.along < V(0.f)) & (length > V(float(MIN_NORMAL * MIN_NORMAL)));
    p.inverse = one / select(p.planar, depth * p.along, one);
    p.inverse_depth = one / depth;
    p.slope_x = keep(p.planar, p.normal.x * p.inverse), p.slope_y = keep(p.planar, p.normal.y * p.inverse);
    const V px = one / lens.fx, py = one / lens.fy;
    const Rows3<V>& r = m.turn;
    p.right = px * axpy(p.slope_x, m.shift, Vec3<V>{r.x.x, r.y.x, r.z.x});
    p.down = py * axpy(p.slope_y, m.shift, Vec3<V>{r.x.y, r.y.y, r.z.y});
    p.middle = axpy(p.inverse_depth, m.shift, times(r, ray));  // q . ray / (q . X) = 1 / d
    return p;
}

// Gradient of a scalar with respect to R and t.
template <class V> struct MotionGrad {
    Rows3<V> turn;
    Vec3<V> shift;
};
template <class V> GS2D_HD Rows3<V> outer(Vec3<V> a, Vec3<V> b) { return {a.x * b, a.y * b, a.z * b}; }
template <class V> GS2D_HD Rows3<V> operator+(const Rows3<V>& a, const Rows3<V>& b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
}
// Calls leave(k, weight * element k), row by row.
template <class V, class Leave> GS2D_HD void each_of(const Rows3<V>& m, V weight, Leave leave) {
    leave(0, weight * m.x.x), leave(1, weight * m.x.y), leave(2, weight * m.x.z);
    leave(3, weight * m.y.x), leave(4, weight * m.y.y), leave(5, weight * m.y.z);
    leave(6, weight * m.z.x), leave(7, weight * m.z.y), leave(8, weight * m.z.z);
}
template <class V, class Leave> GS2D_HD void each_of(const Vec3<V>& v, V weight, Leave leave) {
    leave(0, weight * v.x), leave(1, weight * v.y), leave(2, weight * v.z);
}

// Gradients computed from the cotangents of `right`, `down` and `middle`.
template <class V> struct PatchPlaneGrad {
    V depth;
    Vec3<V> normal, right, down;  // for q in the view's frame; per unit of a ray
};

template <class V>
GS2D_HD PatchPlaneGrad<V> patch_plane_vjp(const PatchPlane<V>& p, Vec3<V> g_right, Vec3<V> g_down, Vec3<V> g_middle,
                                          V depth, Vec3<V> ray, const Motion<V>& m, const Lens<V>& lens) {
    const Vec3<V> right = (V(1.f) / lens.fx) * g_right, down = (V(1.f) / lens.fy) * g_down;
    const V g_x = dot(right, m.shift), g_y = dot(down, m.shift);
    const V g_offset = -(p.inverse * fma(g_x, p.slope_x, g_y * p.slope_y));  // with respect to q . X
    const V by_ray = g_offset * depth;
    const Vec3<V> normal = {fma(g_x, p.inverse, by_ray * ray.x), fma(g_y, p.inverse, by_ray * ray.y), by_ray};
    const V by_shift = p.inverse_depth * p.inverse_depth * dot(g_middle, m.shift);
    return {fma(g_offset, p.along, -by_shift), normal, right, down};
}

template <class V>
GS2D_HD MotionGrad<V> motion_grad(const PatchPlane<V>& p, const PatchPlaneGrad<V>& g, Vec3<V> g_middle, Vec3<V> ray) {
    Rows3<V> turn = outer(g_middle, ray);
    turn.x.x = turn.x.x + g.right.x, turn.y.x = turn.y.x + g.right.y, turn.z.x = turn.z.x + g.right.z;
    turn.x.y = turn.x.y + g.down.x, turn.y.y = turn.y.y + g.down.y, turn.z.y = turn.z.y + g.down.z;
    return {turn, axpy(p.slope_x, g.right, axpy(p.slope_y, g.down, p.inverse_depth * g_middle))};
}

// Position of a patch pixel in the neighbour: x and y of the ray (z = 1), and 1 / depth in units of 1 / d.
template <class V> struct PatchPlace {
    V x, y, inverse;
};
template <class V> GS2D_HD PatchPlace<V> patch_place(Vec3<V> h) {
    const V inverse = V(1.f) / max(h.z, V(float(MIN_SCALE)));
    return {h.x * inverse, h.y * inverse, inverse};
}
// Returns d grey / d h from the derivatives of the sample.
template <class V> GS2D_HD Vec3<V> patch_pull(const PatchPlace<V>& p, const Sampled<V>& s, const Lens<V>& there) {
    const V x = (s.by_x * there.fx) * p.inverse, y = (s.by_y * there.fy) * p.inverse;
    return {x, y, -fma(x, p.x, y * p.y)};
}

// Sums over the pixels of two patches; grey values are relative to the centre pixel.
template <class V> struct PatchSums {
    V a, b, aa, bb, ab;
    GS2D_HD void add(V x, V y) {
        a = a + x, b = b + y, aa = fma(x, x, aa), bb = fma(y, y, bb), ab = fma(x, y, ab);
    }
};

// d NCC / d b_i = by_a (a_i - mean_a) - by_b (b_i - mean_b); the means have the same reference as the sums.
template <class V> struct PatchNcc {
    V value, by_a, by_b, mean_a, mean_b;
    MaskOf<V> valid;  // both patches have texture: at least `texture`, in the neighbour half of it
};

template <class V> GS2D_HD PatchNcc<V> patch_ncc(const PatchSums<V>& s, V pixels, V texture) {
    const V one = V(1.f), least = texture * texture * pixels, least_there = V(0.25f) * least;
    const V mean_a = s.a / pixels, mean_b = s.b / pixels;
    const V aa = fnma(mean_a, s.a, s.aa), bb = fnma(mean_b, s.b, s.bb), ab = fnma(mean_a, s.b, s.ab);
    const V inverse_a = one / sqrt(max(aa, least)), inverse_b = one / sqrt(max(bb, least_there));
    const V by_a = inverse_a * inverse_b, value = ab * by_a;
    const MaskOf<V> valid = (aa > least) & (bb > least_there);
    return {value, by_a, value * (inverse_b * inverse_b), mean_a, mean_b, valid};
}

// The round trip of a pixel to the neighbour's surface and back.
template <class V> struct RoundTrip {
    V error, by_depth;  // px; derivative with respect to the depth
    MaskOf<V> back;     // the round trip succeeds
    Vec3<V> met;        // intersection with the neighbour's surface, minus t
    Vec3<V> by_seen, by_met, by_returned;  // derivatives with respect to R X + t, `met`, and R^T met
};

// `there` is the lens of the neighbour's depth map, which `read` samples. `is_clear` returns whether a patch may be
// compared around the point that a neighbour ray (z = 1) hits.
template <class V, class Read, class Clear>
GS2D_HD RoundTrip<V> round_trip(V depth, Vec3<V> ray, const Motion<V>& m, const Lens<V>& here, const Lens<V>& there,
                                V last_x, V last_y, Read read, Clear is_clear) {
    const V zero = V(0.f), one = V(1.f);
    const Vec3<V> turned = times(m.turn, ray), X = axpy(depth, turned, m.shift);
    const MaskOf<V> front = X.z > V(float(MIN_SCALE)) * depth;
    const V inverse = one / select(front, X.z, one);
    const V u = X.x * inverse, v = X.y * inverse;
    const V x = fma(there.fx, u, there.cx), y = fma(there.fy, v, there.cy);
    const Sampled<V> z = read(x, y);
    const MaskOf<V> inside = (x >= zero) & (x <= last_x) & (y >= zero) & (y <= last_y);
    const Vec3<V> met = {fma(z.value, u, -m.shift.x), fma(z.value, v, -m.shift.y), z.value - m.shift.z};
    const Vec3<V> b = transposed_times(m.turn, met);
    const MaskOf<V> before = b.z > zero;
    const V scale = one / select(before, b.z, one);
    const V dx = here.fx * fma(b.x, scale, -ray.x), dy = here.fy * fma(b.y, scale, -ray.y);
    const V error = sqrt(fma(dx, dx, fma(dy, dy, V(float(ROUND_TRIP_EPS)))));
    const V gx = (dx / error) * (here.fx * scale), gy = (dy / error) * (here.fy * scale);
    const Vec3<V> by_returned = {gx, gy, -(scale * fma(gx, b.x, gy * b.y))};
    const Vec3<V> by_met = times(m.turn, by_returned);
    const V by_z = fma(by_met.x, u, fma(by_met.y, v, by_met.z));
    const V by_u = fma(z.value, by_met.x, by_z * (z.by_x * there.fx));
    const V by_v = fma(z.value, by_met.y, by_z * (z.by_y * there.fy));
    const Vec3<V> by_seen = {inverse * by_u, inverse * by_v, -(inverse * fma(by_u, u, by_v * v))};
    const MaskOf<V> back = front & inside & (z.value > zero) & before & is_clear(u, v);
    return {error, dot(by_seen, turned), back, met, by_seen, by_met, by_returned};
}

template <class V> GS2D_HD MotionGrad<V> motion_grad(const RoundTrip<V>& t, V depth, Vec3<V> ray) {
    return {outer(t.by_seen, depth * ray) + outer(t.met, t.by_returned), t.by_seen - t.by_met};
}

}  // namespace gs2d
