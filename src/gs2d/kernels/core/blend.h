// One splat at one pixel: intersection, compositing, and their vector-Jacobian product (docs/math.md, "Blending").
#pragma once

#include "core/base.h"
#include "core/project.h"

namespace gs2d {

// Constants of the contract, as values of V.
template <class V> struct BlendLimits {
    V inv_lowpass2;      // 1 / lowpass_px^2
    V near;
    V log2_alpha_min;
    V alpha_max, transmittance_min;
};

template <class V> struct Hit {
    V dx, dy;       // px, from the projected centre
    V Q, rq, u, v;  // plane coordinates; rq = 1 / Q
    V rho, depth;
    V log2_alpha;
    mask_t<V> ray;  // the plane decides; elsewhere the low-pass filter
    mask_t<V> visible;
};

// x, y: pixel centre. NaN and infinity in u, v, rq are possible where `ray` is false.
template <class V> GS2D_HD Hit<V> intersect(const Record<V>& s, V x, V y, const BlendLimits<V>& k) {
    Hit<V> h;
    h.dx = x - s.cx, h.dy = y - s.cy;
    h.Q = fma(s.az, h.dx, fma(s.bz, h.dy, V(1)));
    h.rq = V(1) / h.Q;
    h.u = fma(s.au, h.dx, s.bu * h.dy) * h.rq;
    h.v = fma(s.av, h.dx, s.bv * h.dy) * h.rq;
    const V rho3d = fma(h.u, h.u, h.v * h.v), rho2d = fma(h.dx, h.dx, h.dy * h.dy) * k.inv_lowpass2;
    h.ray = (h.Q > V(0)) & (rho3d <= rho2d);
    h.rho = select(h.ray, rho3d, rho2d);
    h.depth = select(h.ray, s.zc * h.rq, s.zc);
    h.log2_alpha = fma(V(-0.5 * LOG2E), h.rho, s.log2_opacity);
    h.visible = (h.log2_alpha >= k.log2_alpha_min) & (h.depth >= k.near);
    return h;
}

// A pixel on its way from front to back. The distortion works with q = 1/z - 1/z of the first pair: the mapped depth is
// affine in 1/z, and differences near 0 keep their digits in float32.
template <class V> struct Pixel {
    V T;  // transmittance
    V alpha, red, green, blue, nx, ny, nz;
    V depth;  // sum w z
    V median;
    V inverse_depth0, M1, M2, distortion;  // sum w q, sum w q^2
    mask_t<V> live;
};

// Composites one splat; returns where it was visible to a live pixel (also where that pixel stops).
template <class V>
GS2D_HD mask_t<V> composite(const Record<V>& s, V inverse_zc, const Hit<V>& h, const BlendLimits<V>& k, Pixel<V>& p) {
    const auto seen = h.visible & p.live;
    const V alpha = min(exp2(h.log2_alpha), k.alpha_max);
    const V after = fnma(alpha, p.T, p.T);
    const auto stays = after >= k.transmittance_min;
    const auto blends = seen & stays;
    p.live = and_not(p.live, and_not(seen, stays));
    const V w = keep(blends, alpha * p.T);
    const V inverse_depth = select(h.ray, h.Q * inverse_zc, inverse_zc);
    p.inverse_depth0 = select(p.alpha <= V(0), inverse_depth, p.inverse_depth0);
    const V q = inverse_depth - p.inverse_depth0, wq = w * q;
    p.distortion = fma(wq, fma(q, p.alpha, V(-2) * p.M1), fma(w, p.M2, p.distortion));
    p.M1 = p.M1 + wq;
    p.M2 = fma(wq, q, p.M2);
    p.median = select(blends & (p.T > V(0.5)), h.depth, p.median);
    p.T = select(blends, after, p.T);
    p.alpha = p.alpha + w;
    p.red = fma(w, s.red, p.red), p.green = fma(w, s.green, p.green), p.blue = fma(w, s.blue, p.blue);
    p.nx = fma(w, s.nx, p.nx), p.ny = fma(w, s.ny, p.ny), p.nz = fma(w, s.nz, p.nz);
    p.depth = fma(w, h.depth, p.depth);
    return seen;
}

// Upstream gradient of one pixel and the totals it needs. With s = g . (outputs of one splat), the remaining sum
// S = sum over later splats of w s gives dL/dalpha = T s - S / (1 - alpha) in a front-to-back pass, without a suffix
// buffer per channel.
template <class V> struct PixelGradient {
    V red, green, blue;
    V alpha;   // of sum w; background and the quotient of depth_mean are folded in
    V nx, ny, nz;
    V depth;   // of sum w z
    V median;
    V median_below;  // the median pair is the one that brings T from above 1/2 to this: max(1/2, T_final)
    V distortion, total, M1, M2, inverse_depth0;  // total = sum w
};

// What one splat gathers over its pixels; `finish` turns it into a RecordGradient.
template <class V> struct PairSums {
    V X, Xx, Xy, Y, Yx, Yy, Q, Qx, Qy, zc, ln_alpha;
    V red, green, blue, nx, ny, nz;
    V lowpass_x, lowpass_y;
    V abs_x, abs_y;
};

// One splat at one pixel, front to back. T is 0 where the pixel has stopped (or does not exist).
// Geo: normal or depth images have gradients. Dist: the distortion has. Abs: the AbsGS signal is wanted.
template <bool Geo, bool Dist, bool Abs, class V>
GS2D_HD void composite_vjp(const Record<V>& s, V inverse_zc, const Hit<V>& h, const BlendLimits<V>& k,
                           const PixelGradient<V>& g, V& T, V& S, PairSums<V>& sums) {
    const V raw = exp2(h.log2_alpha), alpha = min(raw, k.alpha_max);
    const V after = fnma(alpha, T, T);
    const auto blends = h.visible & (after >= k.transmittance_min);
    const V w = keep(blends, alpha * T);
    V along = fma(s.red, g.red, fma(s.green, g.green, fma(s.blue, g.blue, g.alpha)));  // s = dL/dw, transmittance held
    V gz = V(0);
    if constexpr (Geo) {
        along = fma(s.nx, g.nx, fma(s.ny, g.ny, fma(s.nz, g.nz, along)));
        along = fma(h.depth, g.depth, along);
        gz = fma(w, g.depth, keep(blends & (T > V(0.5)) & (after <= g.median_below), g.median));
    }
    if constexpr (Dist) {
        const V inverse_depth = select(h.ray, h.Q * inverse_zc, inverse_zc);
        const V q = inverse_depth - g.inverse_depth0, lever = fma(q, g.total, -g.M1);
        along = fma(g.distortion, fma(q, lever - g.M1, g.M2), along);
        gz = fnma(V(2) * w * g.distortion * lever, inverse_depth * inverse_depth, gz);
    }
    S = fnma(w, along, S);
    // d alpha / d ln(alpha) = the unclamped alpha: the ceiling passes gradients
    const V gl = keep(blends, fma(T, along, -(S / (V(1) - alpha))) * raw);
    T = select(h.visible, keep(blends, after), T);

    sums.ln_alpha = sums.ln_alpha + gl;
    sums.red = fma(w, g.red, sums.red), sums.green = fma(w, g.green, sums.green), sums.blue = fma(w, g.blue, sums.blue);
    // Plane branch: rho = (X^2 + Y^2) / Q^2, z = z_c / Q.
    const V rq = keep(h.ray, h.rq), u = keep(h.ray, h.u), v = keep(h.ray, h.v);
    const V t = gl * rq, tu = t * u, tv = t * v;  // -dL/dX, -dL/dY
    V gQ = t * h.rho;
    if constexpr (Geo) {
        sums.nx = fma(w, g.nx, sums.nx), sums.ny = fma(w, g.ny, sums.ny), sums.nz = fma(w, g.nz, sums.nz);
        gQ = fnma(gz * rq, h.depth, gQ);
        sums.zc = sums.zc + select(h.ray, gz * rq, gz);
    }
    sums.X = sums.X + tu, sums.Xx = fma(tu, h.dx, sums.Xx), sums.Xy = fma(tu, h.dy, sums.Xy);
    sums.Y = sums.Y + tv, sums.Yx = fma(tv, h.dx, sums.Yx), sums.Yy = fma(tv, h.dy, sums.Yy);
    sums.Q = sums.Q + gQ, sums.Qx = fma(gQ, h.dx, sums.Qx), sums.Qy = fma(gQ, h.dy, sums.Qy);
    if constexpr (Abs) {
        const V px = fma(s.au, tu, fma(s.av, tv, -(s.az * gQ))), py = fma(s.bu, tu, fma(s.bv, tv, -(s.bz * gQ)));
        sums.abs_x = sums.abs_x + abs(keep(h.ray, h.Q * px)), sums.abs_y = sums.abs_y + abs(keep(h.ray, h.Q * py));
    }
    const V filtered = select(h.ray, V(0), gl);
    sums.lowpass_x = fma(filtered, h.dx, sums.lowpass_x), sums.lowpass_y = fma(filtered, h.dy, sums.lowpass_y);
}

// dL/d(record) from the sums, per lane (the sum over lanes is left to the caller).
template <class V>
GS2D_HD RecordGradient<V> finish(const Record<V>& s, const PairSums<V>& a, const BlendLimits<V>& k) {
    RecordGradient<V> g;
    g.cx = fma(s.au, a.X, fma(s.av, a.Y, -(s.az * a.Q)));
    g.cy = fma(s.bu, a.X, fma(s.bv, a.Y, -(s.bz * a.Q)));
    g.au = -a.Xx, g.bu = -a.Xy, g.av = -a.Yx, g.bv = -a.Yy, g.az = a.Qx, g.bz = a.Qy;
    g.zc = a.zc, g.ln_opacity = a.ln_alpha;
    g.red = a.red, g.green = a.green, g.blue = a.blue, g.nx = a.nx, g.ny = a.ny, g.nz = a.nz;
    g.lowpass_cx = k.inv_lowpass2 * a.lowpass_x, g.lowpass_cy = k.inv_lowpass2 * a.lowpass_y;
    g.abs_x = a.abs_x, g.abs_y = a.abs_y;
    return g;
}

}  // namespace gs2d
