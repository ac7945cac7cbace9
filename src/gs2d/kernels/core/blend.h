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

// A splat at a pixel. Filtered pairs (the low-pass filter decides) have u = v = 0 and Q = 1 / Q = 1, so that their depth is
// z_c; skipped pairs have alpha = 0. Nothing in here is NaN or infinite.
template <class V> struct Hit {
    V u, v;      // plane coordinates
    V Q, rq;     // z_c / depth, and its inverse
    V depth;
    V rho;
    V alpha;     // not yet limited to alpha_max
    mask_t<V> ray;  // the plane decides
};

// All of a hit but its alpha. dx, dy: pixel centre - projected splat centre, px.
template <class V> GS2D_HD Hit<V> meet(const Record<V>& s, V dx, V dy, const BlendLimits<V>& k) {
    Hit<V> h;
    const V Q = fma(s.az, dx, fma(s.bz, dy, V(1))), rq = reciprocal(Q);
    const V u = fma(s.au, dx, s.bu * dy) * rq, v = fma(s.av, dx, s.bv * dy) * rq;
    const V rho3d = fma(u, u, v * v), rho2d = fma(dx, dx, dy * dy) * k.inv_lowpass2;
    h.ray = (Q > V(0)) & (rho3d <= rho2d);
    h.rho = select(h.ray, rho3d, rho2d);
    h.u = keep(h.ray, u), h.v = keep(h.ray, v);
    h.Q = select(h.ray, Q, V(1)), h.rq = select(h.ray, rq, V(1));
    h.depth = s.zc * h.rq;
    return h;
}

// The alpha of a hit (not yet limited to alpha_max), 0 where it is skipped.
template <class V> GS2D_HD V alpha_of(V log2_opacity, V rho, V depth, const BlendLimits<V>& k) {
    const V log2_alpha = fma(V(-0.5 * LOG2E), rho, log2_opacity);
    return keep((log2_alpha >= k.log2_alpha_min) & (depth >= k.near), exp2_small(log2_alpha));
}

// Both.
template <class V> GS2D_HD Hit<V> intersect(const Record<V>& s, V dx, V dy, const BlendLimits<V>& k) {
    Hit<V> h = meet(s, dx, dy, k);
    h.alpha = alpha_of(s.log2_opacity, h.rho, h.depth, k);
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

// One splat at the pixel, given what `intersect` found: its weight, and all of the state that it changes but the images
// of `accumulate`. Early: a live pixel may have T > 1/2 or nothing in front; otherwise its first and median pairs are past.
template <bool Early, class V>
GS2D_HD V composite_weight(V raw_alpha, V depth, V inverse_depth, const BlendLimits<V>& k, Pixel<V>& p) {
    const V alpha = keep(p.live, min(raw_alpha, k.alpha_max));
    const V after = fnma(alpha, p.T, p.T);
    p.live = p.live & (after >= k.transmittance_min);  // T of a live pixel never is below: only a seen splat can stop it
    const V w = keep(p.live, alpha * p.T);
    if constexpr (Early) {
        p.inverse_depth0 = select(p.alpha <= V(0), inverse_depth, p.inverse_depth0);
        p.median = select((w > V(0)) & (p.T > V(0.5)), depth, p.median);
    }
    const V q = inverse_depth - p.inverse_depth0, wq = w * q;
    p.distortion = fma(wq, fma(q, p.alpha, V(-2) * p.M1), fma(w, p.M2, p.distortion));
    p.M1 = p.M1 + wq;
    p.M2 = fma(wq, q, p.M2);
    p.T = select(p.live, after, p.T);
    p.alpha = p.alpha + w;
    return w;
}

// The images that only sum up weights.
template <class V> GS2D_HD void accumulate(const Record<V>& s, V w, V depth, Pixel<V>& p) {
    p.red = fma(w, s.red, p.red), p.green = fma(w, s.green, p.green), p.blue = fma(w, s.blue, p.blue);
    p.nx = fma(w, s.nx, p.nx), p.ny = fma(w, s.ny, p.ny), p.nz = fma(w, s.nz, p.nz);
    p.depth = fma(w, depth, p.depth);
}

// Both; returns where a live pixel saw the splat (also where that pixel stops).
template <class V>
GS2D_HD mask_t<V> composite(const Record<V>& s, V raw_alpha, V depth, V inverse_depth, const BlendLimits<V>& k, Pixel<V>& p) {
    const auto seen = (raw_alpha > V(0)) & p.live;
    accumulate(s, composite_weight<true>(raw_alpha, depth, inverse_depth, k, p), depth, p);
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

// What the sums of a splat need of one pixel, besides the hit and the upstream gradient.
template <class V> struct PairGradient {
    V w;         // weight of the splat
    V ln_alpha;  // dL/d ln(alpha)
    V z;         // dL/d depth
};

// One splat at one pixel, front to back. T is 0 where the pixel has stopped (or does not exist).
// Geo: normal or depth images have gradients. Dist: the distortion has.
template <bool Geo, bool Dist, class V>
GS2D_HD PairGradient<V> weigh_vjp(const Record<V>& s, V inverse_zc, V depth, V Q, V raw_alpha, const BlendLimits<V>& k,
                                  const PixelGradient<V>& g, V& T, V& S) {
    const V alpha = min(raw_alpha, k.alpha_max);
    const V after = fnma(alpha, T, T);
    const auto goes_on = after >= k.transmittance_min;
    const V w = keep(goes_on, alpha * T);
    V along = fma(s.red, g.red, fma(s.green, g.green, fma(s.blue, g.blue, g.alpha)));  // s = dL/dw, transmittance held
    V gz = V(0);
    if constexpr (Geo) {
        along = fma(s.nx, g.nx, fma(s.ny, g.ny, fma(s.nz, g.nz, along)));
        along = fma(depth, g.depth, along);
        // T is above median_below exactly before the median pair, and w > 0 where it falls
        gz = fma(w, g.depth, keep(goes_on & (T > g.median_below) & (after <= g.median_below), g.median));
    }
    if constexpr (Dist) {
        const V inverse_depth = inverse_zc * Q;
        const V q = inverse_depth - g.inverse_depth0, lever = fma(q, g.total, -g.M1);
        along = fma(g.distortion, fma(q, lever - g.M1, g.M2), along);
        gz = fnma(V(2) * w * g.distortion * lever, inverse_depth * inverse_depth, gz);
    }
    S = fnma(w, along, S);
    // d alpha / d ln(alpha) = the unclamped alpha: the ceiling passes gradients
    const V gl = keep(goes_on, fma(T, along, -quotient(S, V(1) - alpha)) * raw_alpha);
    T = keep(goes_on, after);
    return {w, gl, gz};
}

// Adds that pair to the sums: first what follows from the weight and from alpha alone, then the geometry.
template <bool Geo, class V> GS2D_HD void add_colors(const PixelGradient<V>& g, const PairGradient<V>& p, PairSums<V>& sums) {
    sums.ln_alpha = sums.ln_alpha + p.ln_alpha;
    sums.red = fma(p.w, g.red, sums.red), sums.green = fma(p.w, g.green, sums.green), sums.blue = fma(p.w, g.blue, sums.blue);
    if constexpr (Geo) sums.nx = fma(p.w, g.nx, sums.nx), sums.ny = fma(p.w, g.ny, sums.ny), sums.nz = fma(p.w, g.nz, sums.nz);
}

// Abs: the AbsGS signal is wanted. Filtered: the low-pass filter may have decided one of the pairs (if not: the same sums).
// Column: dx is the same in all calls of these sums; finish_column multiplies by it once instead.
template <bool Geo, bool Abs, bool Filtered, bool Column, class V>
GS2D_HD void add_geometry(const Record<V>& s, V dx, V dy, const Hit<V>& h, const PairGradient<V>& p, PairSums<V>& sums) {
    // Plane branch: rho = (X^2 + Y^2) / Q^2, z = z_c / Q. Filtered pairs: only zc and the filter's centre.
    const V t = p.ln_alpha * h.rq, tu = t * h.u, tv = t * h.v;  // -dL/dX, -dL/dY
    V gQ = t * h.rho;
    if constexpr (Geo) {
        const V gzc = p.z * h.rq;
        sums.zc = sums.zc + gzc;
        gQ = fnma(gzc, h.depth, gQ);
    }
    if constexpr (Filtered) gQ = keep(h.ray, gQ);
    const auto along_x = [&](V g, V& sum) {
        if constexpr (!Column) sum = fma(g, dx, sum);
    };
    sums.X = sums.X + tu, along_x(tu, sums.Xx), sums.Xy = fma(tu, dy, sums.Xy);
    sums.Y = sums.Y + tv, along_x(tv, sums.Yx), sums.Yy = fma(tv, dy, sums.Yy);
    sums.Q = sums.Q + gQ, along_x(gQ, sums.Qx), sums.Qy = fma(gQ, dy, sums.Qy);
    if constexpr (Abs) {
        const V px = fma(s.au, tu, fma(s.av, tv, -(s.az * gQ))), py = fma(s.bu, tu, fma(s.bv, tv, -(s.bz * gQ)));
        sums.abs_x = sums.abs_x + abs(h.Q * px), sums.abs_y = sums.abs_y + abs(h.Q * py);
    }
    if constexpr (Filtered) {
        const V filtered = select(h.ray, V(0), p.ln_alpha);
        sums.lowpass_x = Column ? sums.lowpass_x + filtered : fma(filtered, dx, sums.lowpass_x);
        sums.lowpass_y = fma(filtered, dy, sums.lowpass_y);
    }
}

// All of it.
template <bool Geo, bool Dist, bool Abs, bool Column = false, class V>
GS2D_HD void composite_vjp(const Record<V>& s, V inverse_zc, V dx, V dy, const Hit<V>& h, const BlendLimits<V>& k,
                           const PixelGradient<V>& g, V& T, V& S, PairSums<V>& sums) {
    const PairGradient<V> p = weigh_vjp<Geo, Dist>(s, inverse_zc, h.depth, h.Q, h.alpha, k, g, T, S);
    add_colors<Geo>(g, p, sums);
    add_geometry<Geo, Abs, true, Column>(s, dx, dy, h, p, sums);
}

// The part of it that reaches the splat's colour: all that is needed while everything else is frozen.
template <class V>
GS2D_HD void composite_color_vjp(const Hit<V>& h, const BlendLimits<V>& k, Vec3<V> g_color, V& T, Vec3<V>& sum) {
    const V alpha = min(h.alpha, k.alpha_max), after = fnma(alpha, T, T);
    const auto goes_on = after >= k.transmittance_min;
    sum = axpy(keep(goes_on, alpha * T), g_color, sum);
    T = keep(goes_on, after);
}

// For sums of `Column` calls: what they have left out.
template <class V> GS2D_HD void finish_column(V dx, PairSums<V>& a) {
    a.Xx = dx * a.X, a.Yx = dx * a.Y, a.Qx = dx * a.Q, a.lowpass_x = dx * a.lowpass_x;
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
