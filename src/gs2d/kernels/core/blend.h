// One splat at one pixel: intersection, compositing, and their vector-Jacobian product (docs/math.md, "Blending").
#pragma once

#include "core/base.h"
#include "core/project.h"
#include "core/transmittance.h"

namespace gs2d {

// Constants of the contract, as values of V.
template <class V> struct BlendLimits {
    V inv_lowpass2;  // 1 / lowpass_px^2
    V near;
    V log2_alpha_min;
    V alpha_max, transmittance_min;
    V inv_depth_width = V(0);  // for rule 22, if that depth has a gradient
};

// A splat plane at a pixel: u / z, v / z and 1 / z, affine in the pixel position.
template <class V> struct PlaneAt {
    V X, Y, I;
};

#if GS2D_RAYS
template <class V> GS2D_HD PlaneAt<V> plane_at(const Record<V>& s, Vec3<V> ray) {
    return {dot(s.row0, ray), dot(s.row1, ray), dot(s.row2, ray)};
}
#else
// dx, dy: pixel centre minus projected splat centre, in px.
template <class V> GS2D_HD PlaneAt<V> plane_at(const Record<V>& s, V dx, V dy) {
    return {fma(s.au, dx, s.bu * dy), fma(s.av, dx, s.bv * dy), fma(s.ai, dx, fma(s.bi, dy, s.iz))};
}
#endif

// A splat at a pixel. If the low-pass filter determines rho, u = v = 0 and the depth is z_c. Skipped pairs have
// alpha = 0.
template <class V> struct Hit {
    V u, v;  // plane coordinates
    V depth, inverse_depth;
    V rho;
    V alpha;        // not yet limited to alpha_max
    mask_t<V> ray;  // the plane determines rho
};

// Intersects a splat whose plane is known to determine rho (see `is_plain`); does not set alpha.
template <class V> GS2D_HD Hit<V> meet_plane(const PlaneAt<V>& p) {
    Hit<V> h;
    h.inverse_depth = p.I, h.depth = reciprocal(p.I);
    h.u = p.X * h.depth, h.v = p.Y * h.depth;
    h.rho = fma(h.u, h.u, h.v * h.v);
    h.ray = p.I > V(0);
    return h;
}

// Intersects any splat; no member is NaN or infinite. zc = 1 / iz.
// offset2: squared distance from the projected centre, px^2.
template <class V> GS2D_HD Hit<V> meet(const PlaneAt<V>& p, V iz, V zc, V offset2, const BlendLimits<V>& k) {
    Hit<V> h = meet_plane(p);
    const V rho2d = offset2 * k.inv_lowpass2;
    h.ray = (p.I > V(0)) & (h.rho <= rho2d);
    h.rho = select(h.ray, h.rho, rho2d);
    h.u = keep(h.ray, h.u), h.v = keep(h.ray, h.v);
    h.inverse_depth = select(h.ray, h.inverse_depth, iz), h.depth = select(h.ray, h.depth, zc);
    return h;
}

#if !GS2D_RAYS
// Returns the least 1 / z for which the plane determines rho at every pixel: rho3d = d^T A d z^2 is at most
// rho2d = d^T d / lowpass_px^2 if the largest eigenvalue of A is at most (1 / z / lowpass_px)^2. Slightly increased to
// allow for rounding.
template <class V> GS2D_HD V plain_from(const Record<V>& s, V lowpass_px) {
    const V xx = fma(s.au, s.au, s.av * s.av), yy = fma(s.bu, s.bu, s.bv * s.bv), xy = fma(s.au, s.bu, s.av * s.bv);
    const V half = V(0.5), d = half * (xx - yy);
    return V(1.001f) * lowpass_px * sqrt(half * (xx + yy) + sqrt(fma(d, d, xy * xy)));
}

// Returns whether neither the low-pass filter nor `near` has an effect at pixels up to `half_side` in x and y from the
// pixel at (dx, dy) from the projected centre. False for NaN.
template <class V> GS2D_HD mask_t<V> is_plain(V dx, V dy, V ai, V bi, V iz, V plain_from, V near, V half_side) {
    const V middle = fma(ai, dx, fma(bi, dy, iz)), range = half_side * (abs(ai) + abs(bi));
    return (middle - range >= plain_from) & ((middle + range) * near < V(0.9999f));
}
#endif

// Alpha of a hit (not yet limited to alpha_max) and its logarithm. Alpha is 0 for skipped pairs. All depths of a plain
// splat are beyond `near`, so the plain variants do not test the depth.
template <class V> GS2D_HD V log2_alpha_of(V log2_opacity, V rho) { return fma(V(-0.5 * LOG2E), rho, log2_opacity); }
template <class V> GS2D_HD V alpha_of(V log2_alpha, const BlendLimits<V>& k) {
    return keep(log2_alpha >= k.log2_alpha_min, exp2_small(log2_alpha));
}
template <class V> GS2D_HD V plain_alpha_of(V log2_opacity, V rho, const BlendLimits<V>& k) {
    return alpha_of(log2_alpha_of(log2_opacity, rho), k);
}
template <class V> GS2D_HD V log2_alpha_of(V log2_opacity, const Hit<V>& h, const BlendLimits<V>& k) {
    return select(h.depth >= k.near, log2_alpha_of(log2_opacity, h.rho), V(-1e30));
}

#if !GS2D_RAYS
// Evaluates the plane and alpha.
template <class V>
GS2D_HD Hit<V> intersect(const Record<V>& s, const PlaneAt<V>& p, V zc, V dx, V dy, const BlendLimits<V>& k) {
    Hit<V> h = meet(p, s.iz, zc, fma(dx, dx, dy * dy), k);
    h.alpha = alpha_of(log2_alpha_of(s.log2_opacity, h, k), k);
    return h;
}
template <class V> GS2D_HD Hit<V> intersect(const Record<V>& s, V zc, V dx, V dy, const BlendLimits<V>& k) {
    return intersect(s, plane_at(s, dx, dy), zc, dx, dy, k);
}
#endif

// State of a pixel during blending. The distortion works with q = 1/z - 1/z of the first pair: the mapped depth is
// affine in 1/z, and differences near 0 keep precision in float32.
template <class V> struct Pixel {
    V T;  // transmittance
    V alpha, red, green, blue, nx, ny, nz;
    V depth;  // sum w z
    V median;
    V inverse_depth0, M1_twice, M2, distortion;  // M1 = sum w q, M2 = sum w q^2
    mask_t<V> live;
};

// Blends one splat with the result of `intersect`: returns its weight and updates all state except the images of
// `accumulate`. Stopped pixels are masked late, so that T does not wait for the mask. `Early`: a live pixel may have
// T > 1/2 or nothing in front; otherwise its first and median pairs are already processed.
template <bool Early, class V>
GS2D_HD V composite_weight(V raw_alpha, V depth, V inverse_depth, const BlendLimits<V>& k, Pixel<V>& p) {
    const V alpha = min(raw_alpha, k.alpha_max);
    const V after = fnma(alpha, p.T, p.T);
    // T of a live pixel is never below this value: only a blended splat can stop it
    p.live = p.live & (after >= k.transmittance_min);
    const V w = keep(p.live, alpha * p.T);
    if constexpr (Early) {
        p.inverse_depth0 = select(p.alpha <= V(0), inverse_depth, p.inverse_depth0);
        p.median = select((w > V(0)) & (p.T > V(0.5)), depth, p.median);
    }
    const V q = p.inverse_depth0 - inverse_depth, wq = w * q;  // -q, so that the value in memory is the subtrahend
    p.distortion = fma(wq, fma(q, p.alpha, p.M1_twice), fma(w, p.M2, p.distortion));
    p.M1_twice = p.M1_twice - (wq + wq);  // exact: additions replace a product
    p.M2 = fma(wq, q, p.M2);
    p.T = select(p.live, after, p.T);
    p.alpha = p.alpha + w;
    return w;
}

// Updates the images that are weighted sums.
template <class V> GS2D_HD void accumulate(const Record<V>& s, V w, V depth, Pixel<V>& p) {
    p.red = fma(w, s.red, p.red), p.green = fma(w, s.green, p.green), p.blue = fma(w, s.blue, p.blue);
    p.nx = fma(w, s.nx, p.nx), p.ny = fma(w, s.ny, p.ny), p.nz = fma(w, s.nz, p.nz);
    p.depth = fma(w, depth, p.depth);
}

// Runs both steps; returns where a live pixel uses the splat (including pixels that stop at it).
template <class V>
GS2D_HD mask_t<V> composite(const Record<V>& s, V raw_alpha, V depth, V inverse_depth, const BlendLimits<V>& k,
                            Pixel<V>& p) {
    const auto seen = (raw_alpha > V(0)) & p.live;
    accumulate(s, composite_weight<true>(raw_alpha, depth, inverse_depth, k, p), depth, p);
    return seen;
}

// Adds the state of the part of the list behind `p`, which began with the transmittance at the end of `p` and with zero
// sums. Associative; T and median keep the values that the splats left, without the rounding of a product.
template <class V> GS2D_HD void append(const Pixel<V>& behind, Pixel<V>& p) {
    p.T = select(behind.alpha > V(0), behind.T, p.T), p.median = select(behind.median > V(0), behind.median, p.median);
    // The moments behind refer to another first pair.
    p.inverse_depth0 = select(p.alpha > V(0), p.inverse_depth0, behind.inverse_depth0);
    const V shift = behind.inverse_depth0 - p.inverse_depth0, twice = fma(V(2) * shift, behind.alpha, behind.M1_twice);
    const V M2 = fma(shift, fma(shift, behind.alpha, behind.M1_twice), behind.M2);
    p.distortion = p.distortion + behind.distortion + fma(p.alpha, M2, fma(behind.alpha, p.M2, V(-0.5f) * p.M1_twice * twice));
    p.M1_twice = p.M1_twice + twice, p.M2 = p.M2 + M2;
    p.alpha = p.alpha + behind.alpha;
    p.red = p.red + behind.red, p.green = p.green + behind.green, p.blue = p.blue + behind.blue;
    p.nx = p.nx + behind.nx, p.ny = p.ny + behind.ny, p.nz = p.nz + behind.nz;
    p.depth = p.depth + behind.depth;
}

// Upstream gradient of one pixel and its totals. With s = g . (outputs of one splat), the remaining sum S = sum over
// later splats of w s gives dL/dalpha = T s - S / (1 - alpha) in a front-to-back pass, without a suffix buffer per
// channel.
template <class V> struct PixelGradient {
    V red, green, blue;
    V alpha;  // of sum w; includes background and the quotient of depth_mean
    V nx, ny, nz;
    V depth;  // of sum w z
    V median;
    V median_below;  // the median pair reduces T from above 1/2 to this value: max(1/2, T_final)
    // Distortion term of s: g (q^2 sum w - 2 q M1 + M2) with g its gradient. Its last summand is included in alpha.
    V distortion2, distortion1;  // g sum w, -2 g M1
    V inverse_depth0;
    V transmittance, z;  // for the depth by transmittance: factor of depth_pair_vjp; depth
};

// Adds the distortion to the gradient of a pixel; total = sum w.
template <class V> GS2D_HD void add_distortion(V g, V total, V M1, V M2, PixelGradient<V>& p) {
    p.distortion2 = g * total, p.distortion1 = V(-2) * g * M1;
    p.alpha = fma(g, M2, p.alpha);
}

// Adds the depth by transmittance; `slope` is the result of slope_of, 0 if nothing was hit.
template <class V> GS2D_HD void add_transmittance(V g, V z, V slope, V total, PixelGradient<V>& p) {
    const V upstream = keep(total > V(0), g / slope), half = V(0.5f);
    p.transmittance = upstream * fnma(half, total, V(1)), p.z = z;
    p.alpha = fma(half, upstream, p.alpha);
}

// Sums of one splat over its pixels; `finish` converts them to a RecordGradient.
template <class V> struct PairSums {
    V X, Xx, Xy, Y, Yx, Yy, I, Ix, Iy, iz, ln_alpha;  // I: the plane determines rho; iz: the filter does
    V red, green, blue, nx, ny, nz;
    V lowpass_x, lowpass_y;
    V abs_x, abs_y;
#if GS2D_RAYS  // X, Xx, Xy: times x, y and z of the ray; Y and I likewise
    V lowpass_z;
#endif
};

// Inputs of the sums of a splat at one pixel, in addition to the hit and the upstream gradient.
template <class V> struct PairGradient {
    V w;         // weight of the splat
    V ln_alpha;  // dL/d ln(alpha)
    V I;         // dL/d(1 / depth) at constant alpha
};

// Processes one splat at one pixel, front to back. T is 0 if the pixel has stopped (or does not exist).
// Template flags say which outputs have gradients. Geo: normal or depth images; Dist: distortion; Trans: depth by
// transmittance; Feat: further channels, and `features` is their part of dL/dw.
template <bool Geo, bool Dist, bool Trans, bool Feat = false, class V>
GS2D_HD PairGradient<V> weigh_vjp(const Record<V>& s, V depth, V inverse_depth, V raw_alpha, const BlendLimits<V>& k,
                                  const PixelGradient<V>& g, V& T, V& S, V features = V(0)) {
    const V alpha = min(raw_alpha, k.alpha_max);
    const V after = fnma(alpha, T, T);
    const auto goes_on = after >= k.transmittance_min;
    const V w = keep(goes_on, alpha * T);
    // s = dL/dw at constant transmittance
    V along = fma(s.red, g.red, fma(s.green, g.green, fma(s.blue, g.blue, g.alpha)));
    if constexpr (Feat) along = along + features;
    V gI = V(0);
    if constexpr (Geo) {
        along = along + fma(s.nx, g.nx, fma(s.ny, g.ny, fma(s.nz, g.nz, depth * g.depth)));
        // T exceeds median_below exactly before the median pair, and w > 0 where T falls
        const V gz = fma(w, g.depth, keep(goes_on & (T > g.median_below) & (after <= g.median_below), g.median));
        gI = -(gz * (depth * depth));
    }
    if constexpr (Dist) {
        const V q = inverse_depth - g.inverse_depth0, slope = fma(q, g.distortion2, g.distortion1);
        along = fma(q, slope, along);
        gI = fma(w, fma(q, g.distortion2, slope), gI);
    }
    S = fnma(w, along, S);
    V of_alpha = fnma(S, reciprocal(V(1) - alpha), T * along);
    if constexpr (Trans) {
        const DepthPairGradient<V> d = depth_pair_vjp(alpha, inverse_depth, g.z, k.inv_depth_width, g.transmittance);
        of_alpha = of_alpha + d.alpha, gI = gI + keep(goes_on, d.inverse_depth);
    }
    // d alpha / d ln(alpha) = the unclamped alpha: gradients pass through the upper limit
    const V gl = keep(goes_on, of_alpha * raw_alpha);
    T = keep(goes_on, after);
    return {w, gl, gI};
}

// Adds the pair to the sums: first the terms of weight and alpha, then the geometry.
template <bool Geo, class V>
GS2D_HD void add_colors(const PixelGradient<V>& g, const PairGradient<V>& p, PairSums<V>& sums) {
    sums.ln_alpha = sums.ln_alpha + p.ln_alpha;
    sums.red = fma(p.w, g.red, sums.red), sums.green = fma(p.w, g.green, sums.green),
    sums.blue = fma(p.w, g.blue, sums.blue);
    if constexpr (Geo)
        sums.nx = fma(p.w, g.nx, sums.nx), sums.ny = fma(p.w, g.ny, sums.ny), sums.nz = fma(p.w, g.nz, sums.nz);
}

#if GS2D_RAYS
// What the geometry sums of a splat need of a pixel.
template <class V> struct RayFrom {
    Vec3<V> ray, away;  // away: direction of the splat's centre minus the ray
    V density;
};

// As below. `unit_x` and `unit_y`: row0, row1 and row2 times each of the two axes at right angles to p.
template <bool Geo, bool Abs, bool Filtered, class V>
GS2D_HD void add_geometry(const RayFrom<V>& at, Vec3<V> unit_x, Vec3<V> unit_y, V t, V tu, V tv, V rho, V inverse_depth,
                          mask_t<V> ray, const PairGradient<V>& p, PairSums<V>& sums) {
    V gI = t * rho;
    if constexpr (Geo) {
        gI = fma(t, rho, p.I);
        if constexpr (Filtered) sums.iz = sums.iz + select(ray, V(0), p.I);
    }
    if constexpr (Filtered) gI = keep(ray, gI);
    const Vec3<V> r = at.ray;
    sums.X = fma(tu, r.x, sums.X), sums.Xx = fma(tu, r.y, sums.Xx), sums.Xy = fma(tu, r.z, sums.Xy);
    sums.Y = fma(tv, r.x, sums.Y), sums.Yx = fma(tv, r.y, sums.Yx), sums.Yy = fma(tv, r.z, sums.Yy);
    sums.I = fma(gI, r.x, sums.I), sums.Ix = fma(gI, r.y, sums.Ix), sums.Iy = fma(gI, r.z, sums.Iy);
    if constexpr (Abs) {
        const Vec3<V> of_plane = {tu, tv, -gI};
        sums.abs_x = sums.abs_x + abs(inverse_depth * dot(unit_x, of_plane));
        sums.abs_y = sums.abs_y + abs(inverse_depth * dot(unit_y, of_plane));
    }
    if constexpr (Filtered) {
        const V filtered = select(ray, V(0), p.ln_alpha) * at.density;
        sums.lowpass_x = fma(filtered, at.away.x, sums.lowpass_x);
        sums.lowpass_y = fma(filtered, at.away.y, sums.lowpass_y);
        sums.lowpass_z = fma(filtered, at.away.z, sums.lowpass_z);
    }
}

// Returns dL/d(record) from the sums, per lane; the caller sums over lanes. zc = |p|; needed only if abs_x and abs_y
// are computed.
template <class V>
GS2D_HD RecordGradient<V> finish(const Record<V>&, V zc, const PairSums<V>& a, const BlendLimits<V>& k) {
    RecordGradient<V> g;
    g.row0 = {-a.X, -a.Xx, -a.Xy}, g.row1 = {-a.Y, -a.Yx, -a.Yy}, g.row2 = {a.I, a.Ix, a.Iy};
    g.ln_opacity = a.ln_alpha;
    g.red = a.red, g.green = a.green, g.blue = a.blue, g.nx = a.nx, g.ny = a.ny, g.nz = a.nz;
    g.direction = -k.inv_lowpass2 * Vec3<V>{a.lowpass_x, a.lowpass_y, a.lowpass_z};
    g.iz = a.iz;
    g.abs_x = zc * a.abs_x, g.abs_y = zc * a.abs_y;
    return g;
}
#else
// Abs: compute the AbsGS signal. Filtered: the low-pass filter may apply to a pair (otherwise the sums are the same).
// Column: dx is the same in all calls of these sums; finish_column multiplies by it once instead.
// tu, tv are -dL/dX, -dL/dY, 0 if the filter applies: rho = (X^2 + Y^2) z^2, z = 1 / I.
template <bool Geo, bool Abs, bool Filtered, bool Column, class V>
GS2D_HD void add_geometry(const Record<V>& s, V dx, V dy, V t, V tu, V tv, V rho, V inverse_depth, mask_t<V> ray,
                          const PairGradient<V>& p, PairSums<V>& sums) {
    V gI = t * rho;
    if constexpr (Geo) {
        gI = fma(t, rho, p.I);
        if constexpr (Filtered) sums.iz = sums.iz + select(ray, V(0), p.I);
    }
    if constexpr (Filtered) gI = keep(ray, gI);
    const auto along_x = [&](V g, V& sum) {
        if constexpr (!Column) sum = fma(g, dx, sum);
    };
    sums.X = sums.X + tu, along_x(tu, sums.Xx), sums.Xy = fma(tu, dy, sums.Xy);
    sums.Y = sums.Y + tv, along_x(tv, sums.Yx), sums.Yy = fma(tv, dy, sums.Yy);
    sums.I = sums.I + gI, along_x(gI, sums.Ix), sums.Iy = fma(gI, dy, sums.Iy);
    if constexpr (Abs) {
        const V px = fma(s.au, tu, fma(s.av, tv, -(s.ai * gI))), py = fma(s.bu, tu, fma(s.bv, tv, -(s.bi * gI)));
        sums.abs_x = sums.abs_x + abs(inverse_depth * px), sums.abs_y = sums.abs_y + abs(inverse_depth * py);
    }
    if constexpr (Filtered) {
        const V filtered = select(ray, V(0), p.ln_alpha);
        sums.lowpass_x = Column ? sums.lowpass_x + filtered : fma(filtered, dx, sums.lowpass_x);
        sums.lowpass_y = fma(filtered, dy, sums.lowpass_y);
    }
}

// Runs all steps; returns the weight.
template <bool Geo, bool Dist, bool Abs, bool Trans, bool Filtered, bool Column, bool Feat, class V>
GS2D_HD V composite_vjp(const Record<V>& s, V dx, V dy, const Hit<V>& h, const BlendLimits<V>& k,
                        const PixelGradient<V>& g, V& T, V& S, PairSums<V>& sums, V features) {
    const PairGradient<V> p =
        weigh_vjp<Geo, Dist, Trans, Feat>(s, h.depth, h.inverse_depth, h.alpha, k, g, T, S, features);
    add_colors<Geo>(g, p, sums);
    const V t = p.ln_alpha * h.depth;
    add_geometry<Geo, Abs, Filtered, Column>(s, dx, dy, t, t * h.u, t * h.v, h.rho, h.inverse_depth, h.ray, p, sums);
    return p.w;
}

#endif

// Returns the weight of one splat at one pixel, front to back, as in `composite_weight`. T is 0 for stopped pixels.
template <class V> GS2D_HD V pass_weight(const Hit<V>& h, const BlendLimits<V>& k, V& T) {
    const V alpha = min(h.alpha, k.alpha_max), after = fnma(alpha, T, T);
    const auto goes_on = after >= k.transmittance_min;
    const V w = keep(goes_on, alpha * T);
    T = keep(goes_on, after);
    return w;
}

// Returns the gradient of the splat colour, sufficient if everything else is frozen.
template <class V>
GS2D_HD void composite_color_vjp(const Hit<V>& h, const BlendLimits<V>& k, Vec3<V> g_color, V& T, Vec3<V>& sum) {
    sum = axpy(pass_weight(h, k, T), g_color, sum);
}

#if !GS2D_RAYS
// Completes the sums of `Column` calls.
template <class V> GS2D_HD void finish_column(V dx, PairSums<V>& a) {
    a.Xx = dx * a.X, a.Yx = dx * a.Y, a.Ix = dx * a.I, a.lowpass_x = dx * a.lowpass_x;
}

// Returns dL/d(record) from the sums, per lane; the caller sums over lanes. zc = 1 / iz; needed only if abs_x and abs_y
// are computed.
template <class V>
GS2D_HD RecordGradient<V> finish(const Record<V>& s, V zc, const PairSums<V>& a, const BlendLimits<V>& k) {
    RecordGradient<V> g;
    g.cx = fma(s.au, a.X, fma(s.av, a.Y, -(s.ai * a.I)));
    g.cy = fma(s.bu, a.X, fma(s.bv, a.Y, -(s.bi * a.I)));
    g.au = -a.Xx, g.bu = -a.Xy, g.av = -a.Yx, g.bv = -a.Yy, g.ai = a.Ix, g.bi = a.Iy;
    g.iz = a.I + a.iz, g.ln_opacity = a.ln_alpha;
    g.red = a.red, g.green = a.green, g.blue = a.blue, g.nx = a.nx, g.ny = a.ny, g.nz = a.nz;
    g.lowpass_cx = k.inv_lowpass2 * a.lowpass_x, g.lowpass_cy = k.inv_lowpass2 * a.lowpass_y;
    g.abs_x = zc * a.abs_x, g.abs_y = zc * a.abs_y;
    return g;
}
#endif

}  // namespace gs2d
