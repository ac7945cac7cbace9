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

// The rows of J.
#if GS2D_RAYS  // per radian, at right angles to the ray of the centre
template <class V> using Row = Vec3<V>;
template <class V> struct Rows {
    Row<V> u, v;
};
template <class V> GS2D_HD Row<V> over(Row<V> a, V s) { return {a.x / s, a.y / s, a.z / s}; }
template <class V, class R> GS2D_HD Rows<V> rows_of(const R& r) { return {r.row0, r.row1}; }
template <class V, class R> GS2D_HD void set_rows(const Rows<V>& j, R& r) { r.row0 = j.u, r.row1 = j.v; }
template <class V> GS2D_HD V determinant(const Rows<V>& j, const Record<V>& r) {
    return dot(cross(j.u, j.v), r.direction);
}
#else
template <class V> struct Row {
    V x, y;
};
template <class V> struct Rows {
    Row<V> u, v;
};
template <class V> GS2D_HD Row<V> over(Row<V> a, V s) { return {a.x / s, a.y / s}; }
template <class V> GS2D_HD Row<V> operator*(V s, Row<V> a) { return {s * a.x, s * a.y}; }
template <class V> GS2D_HD Row<V> axpy(V s, Row<V> b, Row<V> a) { return {fma(s, b.x, a.x), fma(s, b.y, a.y)}; }
template <class V> GS2D_HD V dot(Row<V> a, Row<V> b) { return fma(a.x, b.x, a.y * b.y); }
template <class V, class R> GS2D_HD Rows<V> rows_of(const R& r) { return {{r.au, r.bu}, {r.av, r.bv}}; }
template <class V, class R> GS2D_HD void set_rows(const Rows<V>& j, R& r) {
    r.au = j.u.x, r.bu = j.u.y, r.av = j.v.x, r.bv = j.v.y;
}
template <class V> GS2D_HD V determinant(const Rows<V>& j, const Record<V>&) {
    return j.u.x * j.v.y - j.u.y * j.v.x;
}

// The densification signal (rule 13) per px and per z_c. dL/dp as in `project_vjp`, but from the record: row0 =
// (fx au, fy bu, .) and so on.
template <class V, class S>
GS2D_HD Probe<V> probe_of(const Record<V>& r, const RecordGradient<V>& g, const PinholeCamera<S>&) {
    const V of_u = fma(g.au, r.ai, g.bu * r.bi), of_v = fma(g.av, r.ai, g.bv * r.bi), of_1 = fma(g.ai, r.ai, g.bi * r.bi);
    return {g.cx - fma(of_u, r.au, fma(of_v, r.av, of_1 * r.ai)) / r.iz,
            g.cy - fma(of_u, r.bu, fma(of_v, r.bv, of_1 * r.bi)) / r.iz};
}
#endif

template <class V> GS2D_HD MipFilter<V> mip_filter(const Record<V>& r, V sigma) {
    const V one = V(1.0f), deviation = sigma / r.iz, variance = deviation * deviation;
    const Rows<V> j = rows_of<V>(r);
    const V uu = dot(j.u, j.u), vv = dot(j.v, j.v), area = variance * determinant(j, r);
    const V l11 = sqrt(fma(variance, uu, one));
    const V det = fma(area, area, fma(variance, uu + vv, one));  // of I + variance J J^T, without cancellation
    return {l11, variance * dot(j.u, j.v) / l11, sqrt(det) / l11, variance};
}

// Returns the rows of J of the widened splat.
template <class V> GS2D_HD Rows<V> widened(const MipFilter<V>& m, const Rows<V>& j) {
    const Row<V> u = over(j.u, m.l11);
    return {u, over(axpy(-m.l21, u, j.v), m.l22)};
}

// Replaces the axes P by P L and the opacity o by o / det L.
template <class V> GS2D_HD void widen(const MipFilter<V>& m, Frame3<V>& f, Record<V>& r) {
    set_rows(widened(m, rows_of<V>(r)), r);
    r.log2_opacity = r.log2_opacity - log2(m.l11 * m.l22);
    f.a = m.l11 * f.a + m.l21 * f.b, f.b = m.l22 * f.b;
}

// Vector-Jacobian product of `mip_filter` and `widen`: turns the gradient g of the widened record into that of r.
// Returns the densification signal (rule 13) of the widened splat: L does not depend on Tu and Tv.
template <class V, class S>
GS2D_HD Probe<V> widen_vjp(const Record<V>& r, V sigma, const PinholeCamera<S>& cam, RecordGradient<V>& g) {
    const MipFilter<V> m = mip_filter(r, sigma);
    const V half = V(0.5f), two = V(2.0f);
    const Rows<V> j = rows_of<V>(r), w = widened(m, j);
    Record<V> wide = r;
    set_rows(w, wide);
    const Probe<V> probe = probe_of(wide, g, cam);
    Rows<V> of = rows_of<V>(g);
    of.v = over(of.v, m.l22), of.u = axpy(-m.l21, of.v, of.u);
    // of L, then of the entries uu, uv and vv of I + variance J J^T
    const V g22 = -(dot(of.v, w.v) + g.ln_opacity / m.l22);
    const V g21 = -(dot(of.v, w.u) + m.l21 / m.l22 * g22);
    const V guv = g21 / m.l11;
    const V g11 = -((dot(of.u, w.u) + g.ln_opacity) / m.l11 + m.l21 * guv);
    const V guu = half * g11 / m.l11, gvv = half * g22 / m.l22;
    of.u = axpy(m.variance, axpy(two * guu, j.u, guv * j.v), over(of.u, m.l11));
    of.v = axpy(m.variance, axpy(two * gvv, j.v, guv * j.u), of.v);
    set_rows(of, g);
    const V of_variance = fma(dot(j.u, j.u), guu, fma(dot(j.u, j.v), guv, dot(j.v, j.v) * gvv));
    g.iz = fnma(two * m.variance / r.iz, of_variance, g.iz);  // variance = (sigma / iz)^2
    return probe;
}

}  // namespace gs2d
