// The object-space Mip filter of a splat (rule 24; docs/math.md, "Mip filter"): a Gaussian of sigma px on the screen,
// mapped to the plane of the splat at its centre, is added to the splat's own Gaussian.
#pragma once

#include "core/project.h"

namespace gs2d {

constexpr double MAX_WIDENING = 1e4;  // same limit: render/types.py

// The Cholesky factor L = [l11 0; l21 l22] of I + variance J J^T, J = [au bu; av bv].
template <class V> struct MipFilter {
    V l11, l21, l22;
    V variance;  // (sigma z_c)^2

    // Whether the filter enlarges the splat by less than the limit; false for NaN.
    GS2D_HD mask_t<V> in_range() const { return l11 * l22 <= V(float(MAX_WIDENING)); }
};

template <class V> GS2D_HD MipFilter<V> mip_filter(const Record<V>& r, V sigma) {
    const V one = V(1.0f), deviation = sigma / r.iz, variance = deviation * deviation;
    const V uu = fma(r.au, r.au, r.bu * r.bu), vv = fma(r.av, r.av, r.bv * r.bv), uv = fma(r.au, r.av, r.bu * r.bv);
    const V area = variance * (r.au * r.bv - r.bu * r.av);
    const V l11 = sqrt(fma(variance, uu, one));
    const V det = fma(area, area, fma(variance, uu + vv, one));  // of I + variance J J^T, without cancellation
    return {l11, variance * uv / l11, sqrt(det) / l11, variance};
}

// Replaces the axes P by P L and the opacity o by o / det L.
template <class V> GS2D_HD void widen(const MipFilter<V>& m, Frame3<V>& f, Record<V>& r) {
    r.au = r.au / m.l11, r.bu = r.bu / m.l11;
    r.av = fnma(m.l21, r.au, r.av) / m.l22, r.bv = fnma(m.l21, r.bu, r.bv) / m.l22;
    r.log2_opacity = r.log2_opacity - log2(m.l11 * m.l22);
    f.a = m.l11 * f.a + m.l21 * f.b, f.b = m.l22 * f.b;
}

// The densification signal (rule 13) per px and per z_c, of the widened splat: L does not depend on Tu and Tv.
template <class V> struct Probe {
    V x, y;
};

// Vector-Jacobian product of `mip_filter` and `widen`: turns the gradient g of the widened record into that of r.
template <class V> GS2D_HD Probe<V> widen_vjp(const Record<V>& r, V sigma, RecordGradient<V>& g) {
    const MipFilter<V> m = mip_filter(r, sigma);
    const V half = V(0.5f), two = V(2.0f);
    const V au = r.au / m.l11, bu = r.bu / m.l11;
    const V av = fnma(m.l21, au, r.av) / m.l22, bv = fnma(m.l21, bu, r.bv) / m.l22;
    // dL/dp of the widened splat, as in `project_vjp`, but from the record: row0 = (fx au, fy bu, .) and so on
    const V of_u = fma(g.au, r.ai, g.bu * r.bi), of_v = fma(g.av, r.ai, g.bv * r.bi), of_1 = fma(g.ai, r.ai, g.bi * r.bi);
    const Probe<V> probe = {g.cx - fma(of_u, au, fma(of_v, av, of_1 * r.ai)) / r.iz,
                            g.cy - fma(of_u, bu, fma(of_v, bv, of_1 * r.bi)) / r.iz};
    const V gav = g.av / m.l22, gbv = g.bv / m.l22;
    const V gau = fnma(m.l21, gav, g.au), gbu = fnma(m.l21, gbv, g.bu);
    // of L, then of the entries uu, uv and vv of I + variance J J^T
    const V g22 = -(fma(gav, av, gbv * bv) + g.ln_opacity / m.l22);
    const V g21 = -(fma(gav, au, gbv * bu) + m.l21 / m.l22 * g22);
    const V guv = g21 / m.l11;
    const V g11 = -(fma(gau, au, fma(gbu, bu, g.ln_opacity)) / m.l11 + m.l21 * guv);
    const V guu = half * g11 / m.l11, gvv = half * g22 / m.l22;
    g.au = fma(m.variance, fma(two * r.au, guu, r.av * guv), gau / m.l11);
    g.bu = fma(m.variance, fma(two * r.bu, guu, r.bv * guv), gbu / m.l11);
    g.av = fma(m.variance, fma(two * r.av, gvv, r.au * guv), gav);
    g.bv = fma(m.variance, fma(two * r.bv, gvv, r.bu * guv), gbv);
    const V uu = fma(r.au, r.au, r.bu * r.bu), vv = fma(r.av, r.av, r.bv * r.bv), uv = fma(r.au, r.av, r.bu * r.bv);
    const V of_variance = fma(uu, guu, fma(uv, guv, vv * gvv));
    g.iz = fnma(two * m.variance / r.iz, of_variance, g.iz);  // variance = (sigma / iz)^2
    return probe;
}

}  // namespace gs2d
