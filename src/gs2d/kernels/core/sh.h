// Real spherical harmonics up to degree 3 and their derivatives by direction (docs/math.md, "Colour").
#pragma once

#include "core/base.h"

namespace gs2d {

constexpr int SH_MAX = 16;  // coefficients of degree 3
// In degree -1, the first coefficient is the colour, neither shifted nor clamped (rule 11).
GS2D_HD int sh_count(int degree) { return degree < 0 ? 1 : (degree + 1) * (degree + 1); }

// Evaluates the first sh_count(degree) basis functions at the unit vector d.
template <class V> GS2D_HD void sh_basis(Vec3<V> d, int degree, V* basis) {
    const V x = d.x, y = d.y, z = d.z;
    basis[0] = degree < 0 ? V(1.0) : V(0.28209479177387814);
    if (degree < 1) return;
    const V c1 = V(0.4886025119029199);
    basis[1] = -(c1 * y);
    basis[2] = c1 * z;
    basis[3] = -(c1 * x);
    if (degree < 2) return;
    const V xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
    const V a2 = V(1.0925484305920792);
    basis[4] = a2 * xy;
    basis[5] = -(a2 * yz);
    basis[6] = V(0.31539156525252005) * (zz + zz - xx - yy);
    basis[7] = -(a2 * xz);
    basis[8] = V(0.5462742152960396) * (xx - yy);
    if (degree < 3) return;
    const V three = V(3.0), four_zz = V(4.0) * zz - xx - yy;
    const V a3 = V(0.5900435899266435), c3 = V(0.4570457994644658);
    basis[9] = -(a3 * y * (three * xx - yy));
    basis[10] = V(2.890611442640554) * xy * z;
    basis[11] = -(c3 * y * four_zz);
    basis[12] = V(0.3731763325901154) * z * (zz + zz - three * (xx + yy));
    basis[13] = -(c3 * x * four_zz);
    basis[14] = V(1.445305721320277) * z * (xx - yy);
    basis[15] = -(a3 * x * (xx - three * yy));
}

// Computes colour + 1/2, not clamped, from the coefficients sh[3 * k + channel].
template <class V> GS2D_HD Vec3<V> sh_color(const V* sh, const V* basis, int degree) {
    const V half = degree < 0 ? V(0.f) : V(0.5f);
    Vec3<V> c = {half, half, half};
    for (int k = 0; k < sh_count(degree); ++k) c = axpy(basis[k], Vec3<V>{sh[3 * k], sh[3 * k + 1], sh[3 * k + 2]}, c);
    return c;
}

// Returns the displayed value of a colour channel.
template <class V> GS2D_HD V clamped_color(V c, int degree) { return degree < 0 ? c : max(c, V(0.f)); }
// Returns the gradient of a colour channel from the gradient g of its displayed value.
template <class V> GS2D_HD V clamped_color_vjp(V c, int degree, V g) { return degree < 0 ? g : keep(c > V(0.f), g); }

// Computes the gradient of sum_k g[k] basis[k] with respect to d, as a free vector (the caller handles normalisation).
template <class V> GS2D_HD Vec3<V> sh_basis_vjp(Vec3<V> d, int degree, const V* g) {
    Vec3<V> r = {V(0.0), V(0.0), V(0.0)};
    if (degree < 1) return r;
    const V x = d.x, y = d.y, z = d.z;
    const V c1 = V(0.4886025119029199);
    r = {-(c1 * g[3]), -(c1 * g[1]), c1 * g[2]};
    if (degree < 2) return r;
    const V a2 = V(1.0925484305920792), b2 = V(2 * 0.31539156525252005), c2 = V(2 * 0.5462742152960396);
    r.x += a2 * (y * g[4] - z * g[7]) - b2 * x * g[6] + c2 * x * g[8];
    r.y += a2 * (x * g[4] - z * g[5]) - b2 * y * g[6] - c2 * y * g[8];
    r.z += b2 * (z + z) * g[6] - a2 * (y * g[5] + x * g[7]);
    if (degree < 3) return r;
    const V xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
    const V a3 = V(0.5900435899266435), b3 = V(2.890611442640554), c3 = V(0.4570457994644658);
    const V d3 = V(0.3731763325901154), e3 = V(1.445305721320277);
    const V two = V(2.0), three = V(3.0), four = V(4.0), six = V(6.0), eight = V(8.0);
    r.x += b3 * yz * g[10] + two * c3 * xy * g[11] - six * d3 * xz * g[12] -
           c3 * (four * zz - three * xx - yy) * g[13] + two * e3 * xz * g[14] - six * a3 * xy * g[9] -
           three * a3 * (xx - yy) * g[15];
    r.y += b3 * xz * g[10] - three * a3 * (xx - yy) * g[9] - c3 * (four * zz - xx - three * yy) * g[11] -
           six * d3 * yz * g[12] + two * c3 * xy * g[13] - two * e3 * yz * g[14] + six * a3 * xy * g[15];
    r.z += b3 * xy * g[10] - eight * c3 * yz * g[11] + three * d3 * (two * zz - xx - yy) * g[12] -
           eight * c3 * xz * g[13] + e3 * (xx - yy) * g[14];
    return r;
}

}  // namespace gs2d
