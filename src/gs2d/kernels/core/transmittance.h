// Depth by continuous transmittance (rule 22; docs/math.md, "Depth by transmittance"): the profile, the search along the
// ray of a pixel, and what a pair adds to its gradient.
#pragma once

#include "core/base.h"

namespace gs2d {

// How much of a splat's opacity lies before depth z, and the slope of that over x = (z / z_i - 1) / width: the integral of
// the Epanechnikov kernel, 0 up to x = -1, 1 from x = 1 on.
template <class V> struct Fraction {
    V before, slope;
};
template <class V> GS2D_HD Fraction<V> fraction_at(V z, V inverse_depth, V inv_width) {
    const V x = max(min(fma(z, inverse_depth, V(-1)) * inv_width, V(1)), V(-1)), square = x * x;
    return {fma(V(0.25f) * x, V(3) - square, V(0.5f)), fnma(V(0.75f), square, V(0.75f))};
}

// T(z) and its fall there, pair by pair, in any order. fall: -width dT/dz.
template <class V> struct Transmittance {
    V T, fall;
};
template <class V> GS2D_HD void pass_pair(V alpha, V inverse_depth, V z, V inv_width, Transmittance<V>& t) {
    const Fraction<V> f = fraction_at(z, inverse_depth, inv_width);
    const V left = fnma(alpha, f.before, V(1));
    t.fall = fma(t.fall, left, t.T * alpha * f.slope * inverse_depth);
    t.T = t.T * left;
}

// Newton's method within a bracket: a step that would leave it, or does not halve the step before, becomes a bisection.
template <class V> struct DepthSearch {
    V z, near, far;  // near < depth <= far
    V step;          // the last one's length
    mask_t<V> open;  // still moving
};

constexpr int MAX_SEARCH_STEPS = 64;  // twice what bisection needs in float

// `first` is a guess; nearest, farthest: depths of the pixel's pairs.
template <class V>
GS2D_HD void begin_search(V first, V nearest, V farthest, V inv_width, mask_t<V> hit, DepthSearch<V>& s) {
    const V width = reciprocal(inv_width);
    s.near = nearest * (V(1) - width), s.far = farthest * (V(1) + width);
    s.z = min(max(first, s.near), s.far), s.step = s.far - s.near, s.open = hit;
}

// One step, given T at z. Where it has become smaller than `tolerance` z the pixel stays where T was evaluated.
template <class V>
GS2D_HD void advance(const Transmittance<V>& t, V level, V inv_width, V tolerance, DepthSearch<V>& s) {
    const V excess = t.T - level;
    const auto before = excess > V(0);
    s.near = select(before, s.z, s.near), s.far = select(before, s.far, s.z);
    const V newton = quotient(excess, t.fall * inv_width), half = V(0.5f) * (s.far - s.near), next = s.z + newton;
    // false for NaN and infinities: bisection
    const auto good = (next > s.near) & (next < s.far) & (abs(newton) <= V(0.5f) * s.step);
    const V z = select(good, next, s.near + half), step = select(good, abs(newton), half);
    s.open = s.open & (step > tolerance * s.z);
    s.z = select(s.open, z, s.z), s.step = step;
}

// -dT/dz as the gradient takes it: a pixel between two surfaces has nearly none, and would have any gradient.
template <class V> GS2D_HD V slope_of(V fall, V alpha, V z, V inv_width) {
    return max(fall, V(0.05f) * alpha * reciprocal(z)) * inv_width;
}

// What a pair adds to the gradients by ln(alpha) and 1 / z_i: factor = g T(z) / slope_of(...), g the upstream gradient. The part
// of the level 1 - alpha / 2 goes through the alpha image.
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
