// The record of a splat for a camera with any ray per pixel (rule 25; docs/math.md, "Rays"), instead of the pinhole's.
//
// With P = [s_u t_u, s_v t_v, p] in the camera frame, the unit ray r intersects the plane at (u, v, 1) = z P^-1 r, where
// z is the distance from the camera: X = row0 . r, Y = row1 . r, I = row2 . r = 1 / z, u = X z, v = Y z. The record
// holds the rows of P^-1. Rows 0 and 1 are at right angles to p, row2 . p = 1.
#pragma once

#include "core/project.h"

namespace gs2d {

// Field order is the memory order.
template <class V> struct Record {
    Vec3<V> row0, row1, row2;
    V log2_opacity;
    V red, green, blue;
    V nx, ny, nz;       // world frame, facing the camera
    Vec3<V> direction;  // p / |p|
    V iz;               // 1 / |p|
};
constexpr int RECORD_FIELDS = 20;

// Gradients of a record, summed over pixels. Those of `direction` and `iz` are from filtered pairs only, which the
// densification signal excludes.
template <class V> struct RecordGradient {
    Vec3<V> row0, row1, row2;
    V ln_opacity;
    V red, green, blue;
    V nx, ny, nz;
    Vec3<V> direction;
    V iz;
    V abs_x, abs_y;  // sums of absolute values for the densification signal
};
constexpr int GRADIENT_EXTRA = 4;  // abs_x and abs_y are the last two

// Two unit vectors at right angles to a unit vector and to each other: the axes x and y, turned with z (or -z) to it.
template <class V> struct Perpendicular {
    Vec3<V> first, second;
};
template <class V> GS2D_HD Perpendicular<V> perpendicular(Vec3<V> d) {
    const V one = V(1.0f), sign = select(d.z < V(0.0f), -one, one), a = -one / (sign + d.z), b = d.x * d.y * a;
    return {{fma(sign * d.x * d.x, a, one), sign * b, -sign * d.x}, {b, fma(d.y * d.y, a, sign), -d.y}};
}

// Computes the record without the colour.
template <class V, class S>
GS2D_HD Record<V> project(const SplatParameters<V>& s, const Frame3<V>& f, const PinholeCamera<S>&) {
    Record<V> r;
    r.row0 = f.row0, r.row1 = f.row1, r.row2 = f.row2;
    r.log2_opacity = -log2(V(S(1)) + exp(-s.logit));  // log2 of the sigmoid
    r.nx = f.sign * f.n_world.x, r.ny = f.sign * f.n_world.y, r.nz = f.sign * f.n_world.z;
    r.direction = direction_of(f.p, r.iz);
    return r;
}

// The densification signal (rule 13) per half an image: the gradient of p moved at right angles to it.
template <class V, class S>
GS2D_HD Probe<V> probe_of(const Record<V>& r, const RecordGradient<V>& g, const PinholeCamera<S>& cam) {
    const Vec3<V> gp = -dot(g.row0, r.row2) * r.row0 + -dot(g.row1, r.row2) * r.row1 + -dot(g.row2, r.row2) * r.row2;
    const Perpendicular<V> e = perpendicular(r.direction);
    const V distance = V(S(1)) / r.iz;
    return {dot(gp, e.first) * (distance * V(S(1) / cam.fx)), dot(gp, e.second) * (distance * V(S(1) / cam.fy))};
}

// Vector-Jacobian product of `project`. `g_direction`, the gradient with respect to f.to_splat, comes from sh.h.
template <class V, class S>
GS2D_HD ParameterGradient<V> project_vjp(const SplatParameters<V>& s, const Frame3<V>& f, const Record<V>& r,
                                         const RecordGradient<V>& g, Vec3<V> g_direction, const PinholeCamera<S>& cam) {
    ParameterGradient<V> out;
    const auto column = [&](Vec3<V> row) {  // of dL/dP = -R^T G R^T with R = P^-1, G = dL/dR
        return -dot(g.row0, row) * f.row0 + -dot(g.row1, row) * f.row1 + -dot(g.row2, row) * f.row2;
    };
    const Vec3<V> ga = column(f.row0), gb = column(f.row1);
    Vec3<V> gp = column(f.row2);
    const Probe<V> probe = probe_of(r, g, cam);
    out.probe_x = probe.x, out.probe_y = probe.y;
    const V along = fma(r.iz, g.iz, dot(g.direction, r.direction));
    gp = axpy(r.iz, axpy(-along, r.direction, g.direction), gp);
    parameters_vjp(s, f, ga, gb, gp, {g.nx, g.ny, g.nz}, g.ln_opacity, g_direction, cam, out);
    return out;
}

// What culling needs of a splat. A chord is the distance of two unit vectors.
template <class V> struct RayReach {
    V chord;  // between p and a ray that touches the sphere of radius k max(s_u, s_v) around p; 2 from within it
    V disc;   // radius of the low-pass disc, px
    V k;      // radius of the disc on the splat's plane; all three slightly widened to allow for rounding
    V plain_from;  // times the side of a pixel in radians: the least 1 / z from which on the plane determines rho
};

// Returns the chord for the disc rho3d <= k^2, not widened.
template <class V> GS2D_HD V exact_chord(const Frame3<V>& f, const Record<V>& r, V k2) {
    const V one = V(1.0f), two = V(2.0f), ratio = sqrt(k2 * max(dot(f.a, f.a), dot(f.b, f.b))) * r.iz;
    const V rest = sqrt(max(fnma(ratio, ratio, one), V(0.0f)));
    return select(ratio < one, ratio * sqrt(two / (one + rest)), two);
}

template <class V> GS2D_HD RayReach<V> ray_reach(const Frame3<V>& f, const Record<V>& r, V k2, V lowpass_px) {
    const V wide2 = fma(k2, V(1.0002f), V(1e-4f)), k = sqrt(wide2);
    // rho3d = |(X, Y)|^2 z^2 is at most lambda |p / |p| - r|^2 z^2, lambda the largest eigenvalue of
    // [[row0.row0, row0.row1], [., row1.row1]].
    const V xx = dot(r.row0, r.row0), yy = dot(r.row1, r.row1), xy = dot(r.row0, r.row1), half = V(0.5f);
    const V d = half * (xx - yy);
    return {exact_chord(f, r, wide2) + V(1e-6f), lowpass_px * k, k,
            V(1.001f) * lowpass_px * sqrt(half * (xx + yy) + sqrt(fma(d, d, xy * xy)))};
}

}  // namespace gs2d
