// Conversion of splat parameters to a screen record, and its gradient (docs/math.md, "Projection").
//
// With P = [s_u t_u, s_v t_v, p] in the camera frame, a pixel ray r = ((x - cx)/fx, (y - cy)/fy, 1) intersects the
// plane at (u, v, 1) = z P^-1 r. The record holds P^-1 per pixel, centred on the projected splat, for float32
// precision: with d the pixel's offset from the projected centre,
//     X = au dx + bu dy,  Y = av dx + bv dy,  I = iz + ai dx + bi dy,  z = 1 / I,  u = X z,  v = Y z,  iz = 1 / z_c.
// The rows of P^-1 are (t_v x p) / (s_u n.p), (p x t_u) / (s_v n.p), n / (n.p), with n = t_u x t_v.
#pragma once

#include "core/base.h"
#include "core/sh.h"

namespace gs2d {

template <class V> using mask_t = decltype(V() < V());

// Rule 23: splats beyond these limits are culled, so that no square overflows float32 (same limits: render/types.py).
constexpr double MAX_SIZE = 1e9;          // world units: coordinates in the camera frame, scales
constexpr double MIN_SIZE = 1e-18;       // world units: smaller scales are set to this value
constexpr double MAX_COLOR = 1e15;        // sum of the absolute coefficients of a colour
constexpr double MIN_QUATERNION = 1e-15;  // largest component; smaller quaternions count as zero

// A pinhole camera; x_cam = R x_world + t. S is a scalar.
template <class S> struct PinholeCamera {
    S R[9], t[3], center[3];
    S fx, fy, cx, cy;
};

template <class V> struct SplatParameters {
    Vec3<V> mean;
    V qw, qx, qy, qz;
    V log_su, log_sv;
    V logit;
};

template <class V> struct Probe {  // the densification signal of rule 13
    V x, y;
};

#if !GS2D_RAYS  // else core/rays.h has its own record
// The screen record: 16 reals, one cache line in float. Field order is the memory order.
template <class V> struct Record {
    V cx, cy, au, bu, av, bv, ai, bi, iz;
    V log2_opacity;
    V red, green, blue;
    V nx, ny, nz;  // world frame, facing the camera
};
constexpr int RECORD = 16;

// Gradients of a record, summed over pixels. `cx` and `cy` sum the pairs that hit the plane; `lowpass_cx` and
// `lowpass_cy` sum the filtered pairs, which the densification signal excludes.
template <class V> struct RecordGradient {
    V cx, cy, au, bu, av, bv, ai, bi, iz;
    V ln_opacity;
    V red, green, blue;
    V nx, ny, nz;
    V lowpass_cx, lowpass_cy;
    V abs_x, abs_y;  // sums of absolute values for the densification signal, per px
};
constexpr int GRADIENT = RECORD, GRADIENT_EXTRA = 4;  // lowpass_cx to abs_y are extra
#endif

// Intermediate values of both passes.
template <class V> struct Frame3 {
    V qw, qx, qy, qz, inverse_norm;  // unit quaternion, 1 / |quat|
    Vec3<V> tu, tv, n_world;         // world
    Vec3<V> p, a, b, n;              // camera frame: centre, s_u t_u, s_v t_v, normal
    Vec3<V> row0, row1, row2;        // of P^-1
    V sign;                          // +1, or -1 if t_w faces away from the camera
    Vec3<V> to_splat;                // unit, world
    V inverse_distance;
};

template <class V, class S> GS2D_HD Vec3<V> rotate(const S* R, Vec3<V> a) {
    return {fma(V(R[0]), a.x, fma(V(R[1]), a.y, V(R[2]) * a.z)), fma(V(R[3]), a.x, fma(V(R[4]), a.y, V(R[5]) * a.z)),
            fma(V(R[6]), a.x, fma(V(R[7]), a.y, V(R[8]) * a.z))};
}
template <class V, class S> GS2D_HD Vec3<V> rotate_back(const S* R, Vec3<V> a) {
    return {fma(V(R[0]), a.x, fma(V(R[3]), a.y, V(R[6]) * a.z)), fma(V(R[1]), a.x, fma(V(R[4]), a.y, V(R[7]) * a.z)),
            fma(V(R[2]), a.x, fma(V(R[5]), a.y, V(R[8]) * a.z))};
}

template <class V, class S> GS2D_HD Vec3<V> center_of(const PinholeCamera<S>& cam) {
    return {V(cam.center[0]), V(cam.center[1]), V(cam.center[2])};
}

// Returns the unit vector along d, and 1 / |d|.
template <class V> GS2D_HD Vec3<V> direction_of(Vec3<V> d, V& inverse_length) {
    inverse_length = V(1.0f) / sqrt(dot(d, d));
    return inverse_length * d;
}

// Returns the largest absolute component of the quaternion.
template <class V> GS2D_HD V longest_of(const SplatParameters<V>& s) {
    return max(max(abs(s.qw), abs(s.qx)), max(abs(s.qy), abs(s.qz)));
}

template <class V, class S> GS2D_HD Frame3<V> frame_of(const SplatParameters<V>& s, const PinholeCamera<S>& cam) {
    Frame3<V> f;
    const V one = V(S(1)), two = V(S(2)), tiny = V(S(MIN_SIZE));
    // The factor 2^-80 prevents overflow of squares of large quaternions; others are multiplied by 1, which is exact.
    const V shrink = select(longest_of(s) > V(S(1e15)), V(S(8.271806125530277e-25)), one);
    const V qw = s.qw * shrink, qx = s.qx * shrink, qy = s.qy * shrink, qz = s.qz * shrink;
    const V inverse = one / sqrt(fma(qw, qw, fma(qx, qx, fma(qy, qy, qz * qz))));
    f.inverse_norm = inverse * shrink;
    f.qw = qw * inverse, f.qx = qx * inverse, f.qy = qy * inverse, f.qz = qz * inverse;
    const V xx = f.qx * f.qx, yy = f.qy * f.qy, zz = f.qz * f.qz;
    const V xy = f.qx * f.qy, xz = f.qx * f.qz, yz = f.qy * f.qz, wx = f.qw * f.qx, wy = f.qw * f.qy, wz = f.qw * f.qz;
    f.tu = {one - two * (yy + zz), two * (xy + wz), two * (xz - wy)};
    f.tv = {two * (xy - wz), one - two * (xx + zz), two * (yz + wx)};
    f.n_world = {two * (xz + wy), two * (yz - wx), one - two * (xx + yy)};

    f.p = rotate(cam.R, s.mean) + Vec3<V>{V(cam.t[0]), V(cam.t[1]), V(cam.t[2])};
    const Vec3<V> tu = rotate(cam.R, f.tu), tv = rotate(cam.R, f.tv);
    f.n = rotate(cam.R, f.n_world);
    const V su = max(exp(s.log_su), tiny), sv = max(exp(s.log_sv), tiny);
    f.a = su * tu, f.b = sv * tv;
    // A splat that is exactly edge-on has no inverse, so n.p is kept away from 0; the low-pass filter draws it.
    const V nd = dot(f.n, f.p), floor = V(S(1e-7)) * sqrt(dot(f.p, f.p));
    const V inv = one / select(abs(nd) >= floor, nd, select(nd < V(S(0)), -floor, floor));
    f.row0 = (inv / su) * cross(tv, f.p);
    f.row1 = (inv / sv) * cross(f.p, tu);
    f.row2 = inv * f.n;

    const Vec3<V> d = s.mean - center_of<V>(cam);
    f.to_splat = direction_of(d, f.inverse_distance);
    f.sign = select(dot(f.n_world, d) > V(S(0)), V(S(-1)), one);
    return f;
}

// Rules 16 and 23, except for the colour: returns whether all parameters are finite and their squares fit in float32.
// False for NaN.
template <class V> GS2D_HD mask_t<V> in_range(const SplatParameters<V>& p, const Frame3<V>& f) {
    // an eighth of each value, so that finite values have a finite sum (gcc 12 folds 0 * x to 0 with -fno-signed-zeros)
    const V part = V(0.125f), limit = V(float(MAX_SIZE));
    const V size = part * abs(p.logit) + part * abs(p.qw) + part * abs(p.qx) + part * abs(p.qy) + part * abs(p.qz) +
                   part * abs(p.log_su) + part * abs(p.log_sv);
    return (size <= V(3.402823466e38f)) & (longest_of(p) >= V(float(MIN_QUATERNION))) & (abs(f.p.x) <= limit) &
           (abs(f.p.y) <= limit) & (abs(f.p.z) <= limit) & (exp(p.log_su) <= limit) & (exp(p.log_sv) <= limit);
}

// The same test for the sum of the absolute coefficients of a colour.
template <class V> GS2D_HD mask_t<V> color_in_range(V sum) { return sum <= V(float(MAX_COLOR)); }

#if !GS2D_RAYS
// Computes the record without the colour.
template <class V, class S>
GS2D_HD Record<V> project(const SplatParameters<V>& s, const Frame3<V>& f, const PinholeCamera<S>& cam) {
    Record<V> r;
    const V kx = V(S(1) / cam.fx), ky = V(S(1) / cam.fy);
    r.cx = fma(V(cam.fx), f.p.x / f.p.z, V(cam.cx));
    r.cy = fma(V(cam.fy), f.p.y / f.p.z, V(cam.cy));
    r.au = kx * f.row0.x, r.bu = ky * f.row0.y;
    r.av = kx * f.row1.x, r.bv = ky * f.row1.y;
    r.ai = kx * f.row2.x, r.bi = ky * f.row2.y;
    r.iz = V(S(1)) / f.p.z;
    r.log2_opacity = -log2(V(S(1)) + exp(-s.logit));  // log2 of the sigmoid
    r.nx = f.sign * f.n_world.x, r.ny = f.sign * f.n_world.y, r.nz = f.sign * f.n_world.z;
    return r;
}
#endif

template <class V> struct ParameterGradient {
    Vec3<V> mean;
    V qw, qx, qy, qz, log_su, log_sv, logit;
    V probe_x, probe_y;  // z_c dL/d(Tu.z), z_c dL/d(Tv.z), per px; without the low-pass branch
};

// Sets all gradients but those of the probe from those of the columns of P, a, b and p, and of the record's normal and
// ln_opacity. `g_direction`, the gradient with respect to f.to_splat, comes from sh.h.
template <class V, class S>
GS2D_HD void parameters_vjp(const SplatParameters<V>& s, const Frame3<V>& f, Vec3<V> ga, Vec3<V> gb, Vec3<V> gp,
                            Vec3<V> g_normal, V g_ln_opacity, Vec3<V> g_direction, const PinholeCamera<S>& cam,
                            ParameterGradient<V>& out) {
    const V two = V(S(2));
    out.log_su = dot(ga, f.a);
    out.log_sv = dot(gb, f.b);
    const V su = sqrt(dot(f.a, f.a)), sv = sqrt(dot(f.b, f.b));
    const Vec3<V> gu = rotate_back(cam.R, su * ga), gv = rotate_back(cam.R, sv * gb);  // gradients of t_u, t_v
    const Vec3<V> gn = f.sign * g_normal;
    const V w = f.qw, x = f.qx, y = f.qy, z = f.qz;
    const V d21 = gv.z - gn.y, d02 = gn.x - gu.z, d10 = gu.y - gv.x;  // antisymmetric and symmetric parts
    const V s01 = gv.x + gu.y, s02 = gn.x + gu.z, s12 = gn.y + gv.z;
    const V hw = fma(x, d21, fma(y, d02, z * d10));
    const V hx = fma(w, d21, fma(y, s01, z * s02)) - two * x * (gv.y + gn.z);
    const V hy = fma(w, d02, fma(x, s01, z * s12)) - two * y * (gu.x + gn.z);
    const V hz = fma(w, d10, fma(x, s02, y * s12)) - two * z * (gu.x + gv.y);
    const V along = fma(w, hw, fma(x, hx, fma(y, hy, z * hz))), k = two * f.inverse_norm;
    out.qw = k * fnma(along, w, hw), out.qx = k * fnma(along, x, hx);
    out.qy = k * fnma(along, y, hy), out.qz = k * fnma(along, z, hz);

    const V radial = dot(g_direction, f.to_splat);
    out.mean = rotate_back(cam.R, gp) + f.inverse_distance * axpy(-radial, f.to_splat, g_direction);
    out.logit = g_ln_opacity * (V(S(1)) / (V(S(1)) + exp(s.logit)));  // d ln o / d logit = 1 - o
}

#if !GS2D_RAYS
// Vector-Jacobian product of `project`. `g_direction`, the gradient with respect to f.to_splat, comes from sh.h.
template <class V, class S>
GS2D_HD ParameterGradient<V> project_vjp(const SplatParameters<V>& s, const Frame3<V>& f, const Record<V>& r,
                                         const RecordGradient<V>& g, Vec3<V> g_direction, const PinholeCamera<S>& cam) {
    ParameterGradient<V> out;
    const V kx = V(S(1) / cam.fx), ky = V(S(1) / cam.fy);
    // dL/dP = -R^T G R^T with R = P^-1, G = dL/dR (its third column is 0).
    const V g00 = kx * g.au, g01 = ky * g.bu, g10 = kx * g.av, g11 = ky * g.bv, g20 = kx * g.ai, g21 = ky * g.bi;
    const auto column = [&](Vec3<V> row) {  // column of dL/dP that belongs to this row of R
        const V x0 = fma(g00, row.x, g01 * row.y), x1 = fma(g10, row.x, g11 * row.y), x2 = fma(g20, row.x, g21 * row.y);
        return -x0 * f.row0 + -x1 * f.row1 + -x2 * f.row2;
    };
    const Vec3<V> ga = column(f.row0), gb = column(f.row1);
    Vec3<V> gp = column(f.row2);
    const V fx_z = V(cam.fx) * r.iz, fy_z = V(cam.fy) * r.iz;
    gp.x = fma(fx_z, g.cx, gp.x);
    gp.y = fma(fy_z, g.cy, gp.y);
    out.probe_x = gp.x * (f.p.z * kx);
    out.probe_y = gp.y * (f.p.z * ky);
    gp.x = fma(fx_z, g.lowpass_cx, gp.x);
    gp.y = fma(fy_z, g.lowpass_cy, gp.y);
    const V slide = fma(fx_z * f.p.x, g.cx + g.lowpass_cx, fy_z * f.p.y * (g.cy + g.lowpass_cy));
    gp.z = fnma(r.iz, fma(r.iz, g.iz, slide), gp.z);  // iz = 1 / z_c

    parameters_vjp(s, f, ga, gb, gp, {g.nx, g.ny, g.nz}, g.ln_opacity, g_direction, cam, out);
    return out;
}

// Computes the gradient of the camera intrinsics for one splat (docs/math.md, "Camera").
template <class V> struct IntrinsicsGradient {
    V fx, fy, cx, cy;
};
template <class V, class S>
GS2D_HD IntrinsicsGradient<V> intrinsics_vjp(const Frame3<V>& f, const Record<V>& r, const RecordGradient<V>& g,
                                             const PinholeCamera<S>& cam) {
    const V cx = g.cx + g.lowpass_cx, cy = g.cy + g.lowpass_cy;
    const V kx = V(S(1) / cam.fx), ky = V(S(1) / cam.fy);
    const V along_x = fma(g.au, r.au, fma(g.av, r.av, g.ai * r.ai)),
            along_y = fma(g.bu, r.bu, fma(g.bv, r.bv, g.bi * r.bi));
    return {fnma(kx, along_x, cx * (f.p.x * r.iz)), fnma(ky, along_y, cy * (f.p.y * r.iz)), cx, cy};
}

// The footprint of the disc rho3d <= k^2 and the low-pass disc.
template <class V> struct Footprint {
    // |pixel - e| in the metric (a, b, c) is at most 1 inside the ellipse; slightly widened to allow for rounding.
    V ex, ey, a, b, c;
    V slope, half, inv_y2, y_right;  // the same ellipse by rows: see Chords in tile.h
    V disc2;                         // low-pass disc: radius^2, widened
    V k;                             // radius of the disc on the splat's plane, widened
    V x_min, y_min, x_max, y_max;    // exact box of both, px, not clipped
    mask_t<V> crosses;               // the disc reaches the camera plane, so it has neither ellipse nor box
    mask_t<V> unbounded;             // crosses, or too close to it for a reliable ellipse
};

// Rule 19: handling of a splat whose disc rho3d <= error_cutoff^2 reaches the camera plane.
constexpr int NEAR_PLANE_DRAW = 0, NEAR_PLANE_CULL = 1, NEAR_PLANE_BOX = 2;

// Returns whether the disc rho3d <= k^2 reaches the camera plane.
template <class V> GS2D_HD mask_t<V> reaches_camera_plane(const Frame3<V>& f, V k2) {
    return invert(k2 * fma(f.a.z, f.a.z, f.b.z * f.b.z) < f.p.z * f.p.z);
}

// Screen offsets from the projected centre: (x z, y z, z) = (xu, xv, 0; yu, yv, 0; a.z, b.z, z_c) (u, v, 1).
template <class V> struct ScreenAxes {
    V xu, xv, yu, yv;
};

template <class V, class S> GS2D_HD ScreenAxes<V> screen_axes(const Frame3<V>& f, const PinholeCamera<S>& cam) {
    const V inv_z = V(S(1)) / f.p.z, rx = f.p.x * inv_z, ry = f.p.y * inv_z;
    return {V(cam.fx) * fnma(rx, f.a.z, f.a.x), V(cam.fx) * fnma(rx, f.b.z, f.b.x), V(cam.fy) * fnma(ry, f.a.z, f.a.y),
            V(cam.fy) * fnma(ry, f.b.z, f.b.y)};
}

// Rule 19, "box": centre and half side, in px, of the official square around a disc that reaches the camera plane. The
// formula is that of an ellipse's box, applied to a hyperbola. Not finite if the disc only touches the plane.
template <class V> struct Square {
    V x, y, half;
};

template <class V, class S>
GS2D_HD Square<V> official_square(const Frame3<V>& f, const Record<V>& r, V k2, S lowpass_px,
                                  const PinholeCamera<S>& cam) {
    const ScreenAxes<V> s = screen_axes(f, cam);
    const V scale = -k2 / fnma(f.p.z, f.p.z, k2 * fma(f.a.z, f.a.z, f.b.z * f.b.z));  // < 0
    const V ex = -scale * fma(s.xu, f.a.z, s.xv * f.b.z), ey = -scale * fma(s.yu, f.a.z, s.yv * f.b.z);
    const V sxx = fma(ex, ex, scale * fma(s.xu, s.xu, s.xv * s.xv)),
            syy = fma(ey, ey, scale * fma(s.yu, s.yu, s.yv * s.yv));
    return {r.cx + ex, r.cy + ey, max(sqrt(max(max(sxx, syy), V(S(1e-4)))), V(lowpass_px) * sqrt(k2))};
}

template <class V, class S>
GS2D_HD Footprint<V> footprint(const Frame3<V>& f, const Record<V>& r, V k2, S lowpass_px,
                               const PinholeCamera<S>& cam) {
    Footprint<V> o;
    const V zero = V(S(0)), one = V(S(1));
    const ScreenAxes<V> s = screen_axes(f, cam);
    const V xu = s.xu, xv = s.xv, yu = s.yu, yv = s.yv;
    const V zz = f.p.z * f.p.z, reach = k2 * fma(f.a.z, f.a.z, f.b.z * f.b.z), d = reach - zz;
    o.crosses = d >= zero;
    const V scale = -k2 / select(o.crosses, -zz, d);  // > 0
    const V ex = -scale * fma(xu, f.a.z, xv * f.b.z), ey = -scale * fma(yu, f.a.z, yv * f.b.z);
    const V sxx = fma(ex, ex, scale * fma(xu, xu, xv * xv)), syy = fma(ey, ey, scale * fma(yu, yu, yv * yv));
    const V sxy = fma(ex, ey, scale * fma(xu, yu, xv * yv));
    // Also if the sum overflowed, or if the ellipse is so large that its tests would lose precision.
    o.unbounded = (d > V(S(-0.01)) * zz) | invert(sxx + syy < V(S(1e12)));
    const V hx = sqrt(sxx), hy = sqrt(syy), radius = V(lowpass_px) * sqrt(k2);
    o.x_min = r.cx + min(ex - hx, -radius), o.x_max = r.cx + max(ex + hx, radius);
    o.y_min = r.cy + min(ey - hy, -radius), o.y_max = r.cy + max(ey + hy, radius);
    // Widen by 0.03 px and 0.3 % of the longer side, which exceeds the rounding error of the inverse below.
    const V wide = fma(V(S(1e-5)), sxx + syy, V(S(1e-3)));
    const V wxx = sxx + wide, wyy = syy + wide, det = fnma(sxy, sxy, wxx * wyy);
    const V inv = one / (det * V(S(1.004)));
    o.ex = r.cx + ex, o.ey = r.cy + ey;
    o.a = wyy * inv, o.b = -sxy * inv, o.c = wxx * inv;
    o.slope = sxy / wyy, o.half = one / sqrt(o.a), o.inv_y2 = one / (wyy * V(S(1.004)));
    o.y_right = sxy * sqrt(V(S(1.004)) / wxx);
    o.disc2 = fma(radius, radius * V(S(1.0002)), V(S(1e-3)));
    o.k = sqrt(fma(k2, V(S(1.0002)), V(S(1e-4))));
    return o;
}
#endif

}  // namespace gs2d

#if GS2D_RAYS
#include "core/rays.h"
#endif
