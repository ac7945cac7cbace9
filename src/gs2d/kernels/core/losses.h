// Losses of one pixel and their vector-Jacobian products (formulas: docs/math.md).
#pragma once

#include "core/base.h"

namespace gs2d {

constexpr double SSIM_C1 = 0.01 * 0.01;
constexpr double SSIM_C2 = 0.03 * 0.03;

// SSIM window: exp(-k^2 / 4.5), k = 0..5, divided by the sum over k = -5..5.
constexpr int SSIM_RADIUS = 5, SSIM_TAPS = 2 * SSIM_RADIUS + 1;
constexpr double SSIM_WINDOW[SSIM_RADIUS + 1] = {0.2660117248617943,  0.21300553771125366,  0.1093606895097,
                                                 0.03600077212843082, 0.007598758135239184, 0.0010283800844791099};

// SSIM of one pixel and channel, and its derivatives with respect to the blurred moments of the rendered image x:
//     a = B(x), s = B(x^2 + y^2), p = B(x y); b = B(y) belongs to the target y.
// The sum of both second moments suffices, because the variances occur only as a sum. The image gradient is
//     dL/dx = B(d_mean) + 2 x B(d_squares) + y B(d_product).
template <class V> struct SsimPoint {
    V value, d_mean, d_squares, d_product;
};

template <class V> GS2D_HD SsimPoint<V> ssim_point(V a, V b, V s, V p) {
    const V two = V(2.0f);
    const V ab = a * b;
    const V means = fma(a, a, b * b);
    const V a1 = fma(two, ab, V(SSIM_C1));
    const V a2 = fma(two, p - ab, V(SSIM_C2));
    const V b1 = means + V(SSIM_C1);
    const V b2 = (s - means) + V(SSIM_C2);
    const V inverse = V(1.0f) / (b1 * b2);
    const V value = (a1 * a2) * inverse;
    const V d_squares = -(value * (b1 * inverse));  // -value / b2
    const V d_product = two * (a1 * inverse);       // 2 a1 / (b1 b2)
    const V same = value * (b1 - b2);               // value (1/b2 - 1/b1) b1 b2
    const V d_mean = (two * inverse) * fma(b, a2 - a1, a * same);
    return {value, d_mean, d_squares, d_product};
}

// d|x - y| / dx, 0 where x = y.
template <class V> GS2D_HD V l1_sign(V x, V y) {
    const V zero = V(0.0f), one = V(1.0f);
    return select(x > y, one, select(x < y, -one, zero));
}

// d(x - y)^2 / dx.
template <class V> GS2D_HD V l2_slope(V x, V y) { return V(2.0f) * (x - y); }

// Computes the surface normal of a pixel from the z-depths of its four neighbours, not normalised, in camera
// coordinates: (P_down - P_up) x (P_right - P_left) is proportional to
//     n = (fx gx, fy gy, -(1 + (px - cx) gx + (py - cy) gy)),  gx = (zr - zl)/(zr + zl),  gy = (zd - zu)/(zd + zu)
// with the positive factor (zr + zl)(zd + zu) / (fx fy). The dot product of n with the pixel ray is -1, so n faces the
// camera and is never 0. The only precondition is that the depths are positive.
template <class V> struct DepthNormal {
    Vec3<V> direction;  // unit, camera frame
    V inverse_length;   // 1 / |n|
    // 2 / (zr + zl)^2, 2 / (zd + zu)^2: d gx/d zr = slope_x zl, d gx/d zl = -slope_x zr
    V slope_x, slope_y;
};

template <class V>
GS2D_HD DepthNormal<V> depth_normal(V left, V right, V up, V down, V offset_x, V offset_y, V fx, V fy) {
    const V one = V(1.0f), two = V(2.0f);
    const V inverse_x = one / (right + left), inverse_y = one / (down + up);
    const V gx = (right - left) * inverse_x, gy = (down - up) * inverse_y;
    const Vec3<V> n = {fx * gx, fy * gy, -fma(offset_x, gx, fma(offset_y, gy, one))};
    const V inverse_length = one / sqrt(dot(n, n));
    return {inverse_length * n, inverse_length, two * inverse_x * inverse_x, two * inverse_y * inverse_y};
}

// True if a neighbour was hit (depth above 0). NaN counts as a hit, so that it propagates to the loss.
template <class V> GS2D_HD auto was_hit(V depth) { return invert(depth <= V(0.0f)); }

// Returns whether four neighbours define a normal. All must be hit; with `at_camera` one hit per pair is enough, and
// missed neighbours are taken to lie at the camera centre. Then gx or gy is 1 or -1, and depth_normal needs no other
// formula. Ignored pixels and pixels outside the image have a negative depth and define no normal.
template <class V> GS2D_HD auto makes_normal(V left, V right, V up, V down, bool at_camera) {
    if (!at_camera) return was_hit(left) & was_hit(right) & was_hit(up) & was_hit(down);
    const V zero = V(0.0f);
    const auto absent = (left < zero) | (right < zero) | (up < zero) | (down < zero);
    return invert(absent) & was_hit(left + right) & was_hit(up + down);
}

// The pullback of a cotangent of the unit normal to gx and gy, times slope_x and slope_y. Depth gradients of the
// neighbours: right x * left, left -x * right, lower y * up, upper -y * down.
template <class V> struct DepthNormalGrad {
    V x, y;
};

template <class V>
GS2D_HD DepthNormalGrad<V> depth_normal_vjp(const DepthNormal<V>& f, Vec3<V> g, V offset_x, V offset_y, V fx, V fy) {
    const Vec3<V> n = f.direction;
    const V along = dot(g, n);
    const Vec3<V> d = f.inverse_length * Vec3<V>{fnma(along, n.x, g.x), fnma(along, n.y, g.y), fnma(along, n.z, g.z)};
    return {f.slope_x * fma(fx, d.x, -(offset_x * d.z)), f.slope_y * fma(fy, d.y, -(offset_y * d.z))};
}

constexpr int SMOOTH_REACH = 2;         // losses.formulas.SMOOTH_REACH
constexpr double SMOOTH_BEND = 0.01;    // losses.formulas.SMOOTH_BEND

// w (sqrt(|n - m|^2 + d^2) - d) of a pixel and a neighbour with normals n and m, and its gradient by n. d: SMOOTH_BEND.
template <class V> struct BendPoint {
    V value;
    Vec3<V> gradient;
};

template <class V> GS2D_HD BendPoint<V> bend_point(Vec3<V> n, Vec3<V> m, V weight) {
    const V bend = V(SMOOTH_BEND);
    const Vec3<V> d = n - m;
    const V length = sqrt(fma(bend, bend, dot(d, d)));
    return {weight * (length - bend), quotient(weight, length) * d};
}

}  // namespace gs2d
