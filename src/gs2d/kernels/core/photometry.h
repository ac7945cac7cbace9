// Vignetting and response curve of a camera at one pixel (docs/math.md, "Vignetting and response").
#pragma once

#include "core/base.h"

namespace gs2d {

// f(x) = k x / (1 + (k - 1) x) from 0 to 1, linear beyond. `growth` is k = e^s; its inverse is 1 / k.
template <class V> struct Curve {
    V growth, inverse;
};
template <class V> struct Bent {
    V value, slope, by_shift;  // f, df/dx, df/ds
};

template <class V> GS2D_HD Bent<V> bend(V x, const Curve<V>& c) {
    const V inside = min(max(x, V(0.0f)), V(1.0f)), below = min(x, V(0.0f)), above = max(x, V(1.0f)) - V(1.0f);
    const V over = V(1.0f) / fma(c.growth - V(1.0f), inside, V(1.0f)), slope = c.growth * over * over;
    const V outside = fma(c.growth, below, c.inverse * above);
    const V turned = fma(c.growth, below, slope * (inside * (V(1.0f) - inside)));
    return {fma(c.growth * over, inside, outside), slope, fnma(c.inverse, above, turned)};
}

// Returns the relative brightness at a squared radius u: exp(-(a u + b u^2 + c u^3)).
template <class V> GS2D_HD V falloff(V u, const V* a) {
    return exp(V(0.0f) - u * fma(u, fma(u, a[2], a[1]), a[0]));
}

}  // namespace gs2d
