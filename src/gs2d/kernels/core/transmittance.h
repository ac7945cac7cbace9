// Depth by transmittance (rule 22; docs/math.md, "Depth by transmittance"): the profile, the search along a pixel ray,
// and the contribution of a pair to the gradient.
#pragma once

#include "core/base.h"

namespace gs2d {

// The fraction of a splat's opacity in front of depth z, and its slope over x = (z / z_i - 1) / width. The fraction is
// the integral of the Epanechnikov kernel: 0 up to x = -1, and 1 from x = 1.
template <class V> struct Fraction {
    V before, slope;
};
template <class V> GS2D_HD Fraction<V> fraction_at(V z, V inverse_depth, V inv_width) {
    const V x = max(min(fma(z, inverse_depth, V(-1)) * inv_width, V(1)), V(-1)), square = x * x;
    return {fma(V(0.25f) * x, V(3) - square, V(0.5f)), fnma(V(0.75f), square, V(0.75f))};
}

// T(z) and its decrease, accumulated over pairs in any order. fall: -width dT/dz.
template <class V> struct Transmittance {
    V T, fall;
};
template <class V> GS2D_HD void pass_pair(V alpha, V inverse_depth, V z, V inv_width, Transmittance<V>& t) {
    const Fraction<V> f = fraction_at(z, inverse_depth, inv_width);
    const V left = fnma(alpha, f.before, V(1));
    t.fall = fma(t.fall, left, t.T * alpha * f.slope * inverse_depth);
    t.T = t.T * left;
}

// Newton's method within a bracket. A step that leaves it or does not halve the previous step becomes a bisection.
template <class V> struct DepthSearch {
    V z, near, far;  // near < depth <= far
    V step;          // length of the last step
    V fall;          // decrease of T where the last step began
    mask_t<V> open;  // not converged
};

constexpr int MAX_SEARCH_STEPS = 64;  // twice the number of bisection steps in float
// Relative to the width. The search ends with a shorter step; the remaining error of Newton's method is then the square
// of that step, and the decrease of T is practically unchanged.
template <class real> constexpr real SEARCH_TOLERANCE = real(sizeof(real) == sizeof(double) ? 1e-8 : 1e-4);

// Starts at the depth of a pair of the pixel; least, most: bounds of 1 / z of its pairs.
template <class V>
GS2D_HD DepthSearch<V> begin_search(V z, V least, V most, V inv_width, mask_t<V> hit) {
    const V width = reciprocal(inv_width);
    const V near = (V(1) - width) * reciprocal(select(hit, most, V(1)));
    const V far = (V(1) + width) * reciprocal(select(hit, least, V(1)));
    return {z, near, far, far - near, V(0), hit};
}

// Takes one step, given T at z.
template <class V>
GS2D_HD void advance(const Transmittance<V>& t, V level, V inv_width, V tolerance, DepthSearch<V>& s) {
    const V excess = t.T - level;
    const auto before = excess > V(0);
    s.near = select(before, s.z, s.near), s.far = select(before, s.far, s.z);
    const V newton = quotient(excess, t.fall * inv_width), half = V(0.5f) * (s.far - s.near), next = s.z + newton;
    // false for NaN and infinities, which select bisection
    const auto good = (next >= s.near) & (next <= s.far) & (abs(newton) <= V(0.5f) * s.step);
    const V z = select(good, next, s.near + half), step = select(good, abs(newton), half);
    const auto moves = s.open;
    s.open = moves & (step * inv_width > tolerance * s.z);
    s.z = select(moves, z, s.z), s.fall = select(moves, t.fall, s.fall), s.step = step;
}

// Returns -dT/dz for the gradient, bounded below because it is nearly 0 for a pixel between two surfaces.
template <class V> GS2D_HD V slope_of(V fall, V alpha, V z, V inv_width) {
    return max(fall, V(0.05f) * alpha * reciprocal(z)) * inv_width;
}

// Contribution of a pair to the gradients of ln(alpha) and 1 / z_i. factor = g T(z) / slope_of(...), with g the
// upstream gradient. The dependence of the level 1 - alpha / 2 is handled by the alpha image.
template <class V> struct DepthPairGradient {
    V alpha, inverse_depth;
};
template <class V>
GS2D_HD DepthPairGradient<V> depth_pair_vjp(V alpha, V inverse_depth, V z, V inv_width, V factor) {
    const Fraction<V> f = fraction_at(z, inverse_depth, inv_width);
    const V g = factor * reciprocal(fnma(alpha, f.before, V(1)));
    return {-(g * f.before), -(g * alpha * f.slope * z * inv_width)};
}

}  // namespace gs2d
