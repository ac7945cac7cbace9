// Projection of all splats: records, cull records, tile rectangles, radii.
#include "cpu/frame.h"
#if GS2D_RAYS
#include "cpu/ray_bounds.h"
#endif
#include "core/mip_filter.h"
#include "cpu/splat_group.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

// Reads LANES splats; clears `alive` for culled splats (out of range, behind the camera, transparent).
struct Group {
    SplatParameters<V> parameters;
    Frame3<V> frame;
    Record<V> record;
    M alive;
};

// The width of the Mip filter in the units of the records: px, of cameras with rays radians.
inline V mip_sigma(const Frame& f) {
#if GS2D_RAYS
    return V(real(f.view.mip_px / sqrt(f.view.fx * f.view.fy)));
#else
    return V(real(f.view.mip_px));
#endif
}

inline Group project_group(const Frame& f, const Parameters& s, int64_t i, int lanes, bool opacity_counts) {
    Group g;
    g.parameters = load_parameters(s, i, lanes);
    g.frame = frame_of(g.parameters, f.camera);
    g.record = project(g.parameters, g.frame, f.camera);
#if GS2D_RAYS
    g.alive = in_range(g.parameters, g.frame) & (g.record.iz * V(real(f.view.near)) < V(1)) & first(lanes);
#else
    g.alive = in_range(g.parameters, g.frame) & (g.frame.p.z > V(real(f.view.near))) & first(lanes);
#endif
    if (f.view.mip_px > 0) {
        const MipFilter<V> filter = mip_filter(g.record, mip_sigma(f));
        widen(filter, g.frame, g.record);
        g.alive = g.alive & filter.in_range();
    }
    if (opacity_counts) g.alive = g.alive & (g.record.log2_opacity >= V(real(log2(f.view.alpha_min))));
    return g;
}

// Evaluates the colours of alive splats; culls splats whose coefficients are out of range.
inline void color_group(const Frame& f, const Parameters& s, int64_t i, int lanes, Group& g) {
    V sh[3 * SH_MAX], basis[SH_MAX];
    const int degree = f.view.sh_degree;
    load_sh(s, i, lanes, degree, sh);
    sh_basis(g.frame.to_splat, degree, basis);
    V size = V(0);
    for (int k = 0; k < 3 * sh_count(degree); ++k) size = size + abs(sh[k]);
    g.alive = g.alive & color_in_range(size);
    const Vec3<V> c = sh_color(sh, basis, degree);
    g.record.red = clamped_color(c.x, degree), g.record.green = clamped_color(c.y, degree),
    g.record.blue = clamped_color(c.z, degree);
}

#if GS2D_RAYS
// Stores the records, cull records and depths of a group, and finds which of its `alive` splats reach a tile.
void place_group(Frame& f, const Group& g, int64_t i, int lanes, uint32_t alive, V k2, real* radii) {
    const Record<V>& r = g.record;
    const V zero = V(0);
    V fields[RECORD] = {r.row0.x,      r.row0.y,      r.row0.z, r.row1.x, r.row1.y, r.row1.z, r.row2.x,
                        r.row2.y,      r.row2.z,      r.log2_opacity,     r.red,    r.green,  r.blue,
                        r.nx,          r.ny,          r.nz,     r.direction.x,      r.direction.y,
                        r.direction.z, r.iz};
    for (int k = RECORD_FIELDS; k < RECORD; ++k) fields[k] = zero;
    store_rows<RECORD>(&f.records[i * RECORD], RECORD, lanes, fields);
    const RayReach<V> reach = ray_reach(g.frame, r, k2, V(real(f.view.lowpass_px)));
    const V cull[8] = {reach.chord,   reach.disc,    reach.k,       reach.plain_from,
                       r.direction.x, r.direction.y, r.direction.z, zero};
    store_rows<8>(reinterpret_cast<real*>(&f.cull[i]), 8, lanes, cull);
    alignas(64) real depth[LANES], radius[LANES];
    store(depth, V(1) / r.iz);
    const real longer = real(f.view.width > f.view.height ? f.view.width : f.view.height);
    const V focal = V(real(sqrt(f.view.fx * f.view.fy))), disc = V(real(f.view.lowpass_px)) * sqrt(k2);
    const V exact = exact_chord(g.frame, r, k2);
    store(radius, min(max(focal * exact, disc), V(longer / 2)));
    const RayBounds<1>& all = bound_of_view(f);
    const V away2 = distance2(V(all.x[0]), V(all.y[0]), V(all.z[0]), r.direction);
    const V far = V(all.chord[0]) + max(exact, disc * V(all.side[0]));
    const uint32_t near = bits((away2 <= far * far) & (far >= zero));
    for (int l = 0; l < lanes; ++l) {
        memcpy(&f.order[i + l].key, &depth[l], sizeof(real));
        if (!(alive >> l & 1)) continue;
        if (find_ray_tiles(f, i + l)) f.rects[i + l] = {0, 0, 1, 1};  // visible
        if (radii && near >> l & 1) radii[i + l] = radius[l];
    }
}
#else
// Computes the rectangles and radii of the splats in the bit mask `boxed` of a group: rule 19, "box".
void box_group(Frame& f, const Group& g, int64_t i, uint32_t boxed, V k2, real* radii) {
    const Square<V> s = official_square(g.frame, g.record, k2, real(f.view.lowpass_px), f.camera);
    alignas(64) real x[LANES], y[LANES], half[LANES];
    store(x, s.x), store(y, s.y), store(half, s.half);
    for (int l = 0; l < LANES; ++l) {
        if (!(boxed >> l & 1)) continue;
        const TileRect rect = square_tiles(x[l], y[l], half[l], f.tiles_x, f.tiles_y);
        f.rects[i + l] = rect;
        if (radii) radii[i + l] = tiles_radius<real>(rect, f.view.width, f.view.height);
    }
}

// Finds the tiles that a splat outline reaches, LANES rows of tiles at a time.
TileRect outlined_rectangle(const Frame& f, int64_t splat) {
    const real* const r = &f.records[splat * RECORD];
    const View& v = f.view;
    const Outline<V> outline =
        outline_of(V(r[2]), V(r[3]), V(r[4]), V(r[5]), V(r[6]), V(r[7]), V(r[8]), V(r[0]), V(r[1]), V(f.cull[splat].ex),
                   V(-f.cull[splat].disc2), V(real(v.near)), V(real(v.width)), V(real(v.height)));
    TileRect rect = {0, 0, 0, 0};
    for (int y = 0; y < f.tiles_y; y += LANES) {
        alignas(64) real left[LANES], right[LANES];
        const V top = fma(iota(), V(real(TILE)), V(real(y * TILE) + real(0.5))) - V(r[1]);
        V from, to;
        reach_in_rows(outline, top, top + V(real(TILE - 1)), from, to);
        store(left, from + V(r[0])), store(right, to + V(r[0]));
        for (int i = 0, x0, x1; i < LANES && y + i < f.tiles_y; ++i)
            if (tiles_between(left[i], right[i], v.width, f.tiles_x, x0, x1)) rect = with_row(rect, x0, x1, y + i);
    }
    return rect;
}
#endif

}  // namespace

bool project_splats(Frame& f, const Parameters& s, Reach reach, real* radii) {
    const int64_t n = s.count;
    f.count = n;
    if (!f.records.reserve(n * RECORD) || !f.scratch.reserve(forward_scratch(n))) return false;
    f.cull = reinterpret_cast<CullRecord*>(f.scratch.data);
    f.rects = reinterpret_cast<TileRect*>(f.cull + n);
    f.order = reinterpret_cast<DepthItem*>(f.rects + n);
#if GS2D_RAYS
    if (!bound_rays(f) || !f.ray_tiles.reserve(n)) return false;
#endif
    const bool blending = reach == Reach::BLEND;
    const V error_k2 = V(real(f.view.error_cutoff * f.view.error_cutoff)),
            log2_alpha_min = V(real(log2(f.view.alpha_min)));
    parallel_ranges(n, 64 * LANES, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; i += LANES) {
            const int lanes = end - i < LANES ? static_cast<int>(end - i) : LANES;
            if (i + 2 * LANES <= n) ask_for(s.shN + (i + LANES) * 3 * s.sh_rest, LANES * 3 * s.sh_rest);
            Group g = project_group(f, s, i, lanes, blending);
#if !GS2D_RAYS
            const M reaches = reaches_camera_plane(g.frame, error_k2);
            if (f.view.near_plane_policy == NEAR_PLANE_CULL) g.alive = g.alive & invert(reaches);
#endif
            if (any(g.alive)) color_group(f, s, i, lanes, g);
            const uint32_t alive = bits(g.alive);
            for (int l = 0; l < lanes; ++l) f.rects[i + l] = {0, 0, 0, 0};
            if (radii)
                for (int l = 0; l < lanes; ++l) radii[i + l] = 0;
            if (!alive) continue;
            const Record<V>& r = g.record;
            const V blend_k2 = V(real(2 * LN2)) * (r.log2_opacity - log2_alpha_min);
            const V k2 = blending ? max(blend_k2, V(0)) : reach == Reach::ERRORS ? error_k2 : max(blend_k2, error_k2);
#if GS2D_RAYS
            place_group(f, g, i, lanes, alive, k2, radii);
#else
            const Footprint<V> o = footprint(g.frame, r, k2, real(f.view.lowpass_px), f.camera);
            const V fields[RECORD] = {r.cx, r.cy,           r.au,  r.bu,    r.av,   r.bv, r.ai, r.bi,
                                      r.iz, r.log2_opacity, r.red, r.green, r.blue, r.nx, r.ny, r.nz};
            store_rows<RECORD>(&f.records[i * RECORD], RECORD, lanes, fields);
            const V cull[8] = {select(o.unbounded, o.k, o.ex),
                               o.ey,
                               o.slope,
                               o.half,
                               o.inv_y2,
                               o.y_right,
                               select(o.unbounded, -o.disc2, o.disc2),
                               plain_from(r, V(real(f.view.lowpass_px)))};
            store_rows<8>(reinterpret_cast<real*>(&f.cull[i]), 8, lanes, cull);
            alignas(64) real box[4][LANES], depth[LANES];
            store(depth, g.frame.p.z);
            for (int l = 0; l < lanes; ++l) memcpy(&f.order[i + l].key, &depth[l], sizeof(real));
            store(box[0], o.x_min), store(box[1], o.y_min), store(box[2], o.x_max), store(box[3], o.y_max);
            const uint32_t unbounded = bits(o.unbounded), crosses = bits(o.crosses);
            const uint32_t boxed = f.view.near_plane_policy == NEAR_PLANE_BOX ? alive & bits(reaches) : 0;
            if (boxed) box_group(f, g, i, boxed, error_k2, radii);
            for (int l = 0; l < lanes; ++l) {
                if (!((alive & ~boxed) >> l & 1)) continue;
                const PixelBox<real> o_l = {box[0][l], box[1][l], box[2][l], box[3][l]};
                const bool outlined = f.view.exact_masks && unbounded >> l & 1;
                f.rects[i + l] = outlined ? outlined_rectangle(f, i + l)
                                          : tile_rectangle(o_l, unbounded >> l & 1, f.view.width, f.view.height,
                                                           f.tiles_x, f.tiles_y);
                if (radii) radii[i + l] = clipped_radius(o_l, crosses >> l & 1, f.view.width, f.view.height);
            }
#endif
        }
    });
    return true;
}

namespace {

// Loads the sums of LANES splats; without a densification signal the extras are 0.
inline void load_sums(const Sums& sums, int64_t first, int lanes, V* fields, V* extras) {
    load_rows<GRADIENT>(sums.row(first), GRADIENT, lanes, fields);
    for (int k = 0; k < GRADIENT_EXTRA; ++k) extras[k] = V(0);
    if (sums.columns == 2) load_rows<2>(sums.extra(first), 2, lanes, extras);
    if (sums.columns == 4) load_rows<4>(sums.extra(first), 4, lanes, extras);
}

// Returns where a sum is nonzero or NaN. Elsewhere no pixel uses the splat, or all its gradients are 0.
inline M not_all_zero(const V* fields, const V* extras) {
    V size = V(0);
    for (int k = 0; k < GRADIENT; ++k) size = size + abs(fields[k]);
    for (int k = 0; k < GRADIENT_EXTRA; ++k) size = size + abs(extras[k]);
    return ~(size <= V(0));
}

void project_range_vjp(const Frame& f, const Parameters& s, const ParameterGradients& out, real* intrinsics,
                       int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += LANES) {
        const int lanes = end - i < LANES ? static_cast<int>(end - i) : LANES;
        if (i + 2 * LANES <= s.count) {
            ask_for(s.shN + (i + LANES) * 3 * s.sh_rest, LANES * 3 * s.sh_rest);
            if (out.shN) ask_for(out.shN + (i + LANES) * 3 * s.sh_rest, LANES * 3 * s.sh_rest);
        }
        V g[GRADIENT], e[GRADIENT_EXTRA];
        load_sums(f.sums, i, lanes, g, e);  // before any write: the sums may share memory with rows of out.shN
        const M seen = not_all_zero(g, e) & first(lanes);
        if (!any(seen)) {
            zero_rows(out.means, i, 3, lanes), zero_rows(out.quats, i, 4, lanes),
                zero_rows(out.log_scales, i, 2, lanes);
            zero_rows(out.opacity_logits, i, 1, lanes), zero_rows(out.sh0, i, 3, lanes);
            zero_rows(out.shN, i, 3 * s.sh_rest, lanes), zero_rows(out.probe, i, out.probe_columns, lanes),
                zero_rows(intrinsics, i, 4, lanes);
            continue;
        }
#if GS2D_RAYS
        RecordGradient<V> gr = {{g[0], g[1], g[2]}, {g[3], g[4], g[5]}, {g[6], g[7], g[8]},    g[9],  g[10], g[11], g[12],
                                g[13],              g[14],              g[15], {g[16], g[17], g[18]}, g[19], e[2],  e[3]};
        gr.abs_x = gr.abs_x * V(real(1 / f.view.fx)), gr.abs_y = gr.abs_y * V(real(1 / f.view.fy));
#else
        RecordGradient<V> gr = {g[0],  g[1],  g[2],  g[3],  g[4],  g[5],  g[6], g[7], g[8], g[9],
                                g[10], g[11], g[12], g[13], g[14], g[15], e[0], e[1], e[2], e[3]};
#endif
        const SplatParameters<V> p = load_parameters(s, i, lanes);
        const Frame3<V> frame = frame_of(p, f.camera);
        const Record<V> r = project(p, frame, f.camera);
        const bool filters = f.view.mip_px > 0;
        const Probe<V> filtered = filters ? widen_vjp(r, mip_sigma(f), f.camera, gr) : Probe<V>{};

        V sh[3 * SH_MAX], basis[SH_MAX], along[SH_MAX];
        const int degree = f.view.sh_degree;
        load_sh(s, i, lanes, degree, sh);
        sh_basis(frame.to_splat, degree, basis);
        const Vec3<V> c = sh_color(sh, basis, degree);
        const Vec3<V> g_color = {keep(seen, clamped_color_vjp(c.x, degree, gr.red)),
                                 keep(seen, clamped_color_vjp(c.y, degree, gr.green)),
                                 keep(seen, clamped_color_vjp(c.z, degree, gr.blue))};
        for (int k = 0; k < sh_count(degree); ++k) {
            basis[k] = keep(seen, basis[k]);
            along[k] = fma(g_color.x, sh[3 * k], fma(g_color.y, sh[3 * k + 1], g_color.z * sh[3 * k + 2]));
        }
        write_sh(degree, s.sh_rest, out, i, lanes, g_color, basis);
        if (!wants_geometry(out) && !intrinsics) continue;

        ParameterGradient<V> d =
            project_vjp(p, frame, r, gr, sh_basis_vjp(frame.to_splat, degree, along), f.camera);
        if (filters) d.probe_x = filtered.x, d.probe_y = filtered.y;
        const auto write = [&]<int K>(real* to, V(&values)[K]) {
            if (!to) return;
            for (V& v : values) v = keep(seen, v);
            store_rows<K>(to + K * i, K, lanes, values);
        };
        V means[] = {d.mean.x, d.mean.y, d.mean.z}, quats[] = {d.qw, d.qx, d.qy, d.qz};
        V scales[] = {d.log_su, d.log_sv}, logit[] = {d.logit};
        write(out.means, means), write(out.quats, quats), write(out.log_scales, scales),
            write(out.opacity_logits, logit);
        const V half_w = V(real(f.view.width / 2.0)), half_h = V(real(f.view.height / 2.0));
        V probe[] = {d.probe_x * half_w, d.probe_y * half_h, gr.abs_x * half_w, gr.abs_y * half_h};
        V probe2[] = {probe[0], probe[1]};
        if (out.probe_columns == 4)
            write(out.probe, probe);
        else
            write(out.probe, probe2);
#if !GS2D_RAYS
        if (!intrinsics) continue;
        const IntrinsicsGradient<V> of_intrinsics = intrinsics_vjp(frame, r, gr, f.camera);
        V values_of_intrinsics[] = {of_intrinsics.fx, of_intrinsics.fy, of_intrinsics.cx, of_intrinsics.cy};
        write(intrinsics, values_of_intrinsics);
#endif
    }
}

}  // namespace

// If the sums share memory with the gradient of shN, row i overwrites the sums of later splats. Splats are therefore
// processed from last to first, in groups that overwrite only sums already read. Groups of up to LANES splats are read
// before they are written.
void project_splats_vjp(Frame& f, const Parameters& s, const ParameterGradients& out, real* intrinsics) {
    for (int64_t end = s.count, first = 0; end > 0; end = first) {
        first = 0;
        if (f.sums.coefficient_row) {
            const int64_t free = (GRADIENT * end + f.sums.coefficient_row - 1) / f.sums.coefficient_row,
                          last_group = (end - 1) / LANES * LANES;
            first = (free + LANES - 1) / LANES * LANES;
            if (first > last_group) first = last_group;
        }
        parallel_ranges(end - first, 16 * LANES,
                        [&](int64_t a, int64_t b) { project_range_vjp(f, s, out, intrinsics, first + a, first + b); });
    }
}

}  // namespace gs2d
