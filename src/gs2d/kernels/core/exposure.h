// Exposure and white balance of a photo at one pixel (docs/math.md, "Exposure").
#pragma once

#include "core/base.h"

namespace gs2d {

// Applies c -> A c + b to the object colour; the background is composited behind the object afterwards.
template <class V> struct Exposure {
    V A[3][3], b[3], background[3];
};

// Removes the background from a colour with this `coverage`.
template <class V> GS2D_HD void remove_background(const V* color, V coverage, const Exposure<V>& e, V* light) {
    for (int i = 0; i < 3; ++i) light[i] = color[i] - (V(1.0f) - coverage) * e.background[i];
}

template <class V> GS2D_HD void expose(const V* color, V coverage, const Exposure<V>& e, V* out) {
    V light[3];
    remove_background(color, coverage, e, light);
    for (int i = 0; i < 3; ++i) {
        const V seen = fma(e.A[i][0], light[0], fma(e.A[i][1], light[1], e.A[i][2] * light[2]));
        out[i] = fma(coverage, e.b[i], seen) + (V(1.0f) - coverage) * e.background[i];
    }
}

// Returns the gradient of the colour; adds the gradients of A and b to `sums`, row by row.
template <class V>
GS2D_HD void expose_vjp(const V* upstream, const V* color, V coverage, const Exposure<V>& e, V* to_color,
                        V (*sums)[4]) {
    V light[3];
    remove_background(color, coverage, e, light);
    for (int j = 0; j < 3; ++j)
        to_color[j] = fma(e.A[0][j], upstream[0], fma(e.A[1][j], upstream[1], e.A[2][j] * upstream[2]));
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) sums[i][j] = fma(upstream[i], light[j], sums[i][j]);
        sums[i][3] = fma(upstream[i], coverage, sums[i][3]);
    }
}

}  // namespace gs2d
