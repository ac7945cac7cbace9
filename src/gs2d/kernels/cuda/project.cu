// Projection of all splats: activations, SH colour, record, cull record, tile rectangle, depth key, radius.
#include "core/mip_filter.h"
#include "cuda/colors.h"

namespace gs2d {

struct ProjectArguments {
    View view;
    int64 count, sh_rest;  // N; coefficients stored in shN per splat
    const float *means, *quats, *log_scales, *opacity_logits, *sh0, *shN;
    float* records;    // [N, 16]
    float* cull;       // [N, 8], see common.h
    int* depth_keys;   // [N]: bits of z_c, which sort as integers; infinity if culled
    ushort* rects;     // [N, 4]: x0, y0, x1, y1 in tiles
    int* tile_counts;  // [N]: tiles in the rectangle
    float* radii;      // [N]
    int errors;        // 1: the footprint is rho <= error_k2, for any opacity
    int exact;         // 0: splats without an ellipse are listed in every tile (tests)
};

// Returns the tiles that an outline reaches.
__device__ TileRectangle outlined_rectangle(const View& v, const Record<float>& r, float k, float disc2) {
    const Outline<float> outline = outline_of(r.au, r.bu, r.av, r.bv, r.ai, r.bi, r.iz, r.cx, r.cy, k, disc2, v.near,
                                              float(v.width), float(v.height));
    TileRectangle rect = {0, 0, 0, 0};
    for (int y = 0; y < v.tiles_y; ++y) {
        const float top = float(y * TILE_PX) + 0.5f - r.cy;
        float left, right;
        int x0, x1;
        reach_in_rows(outline, top, top + float(TILE_PX - 1), left, right);
        if (tiles_between(left + r.cx, right + r.cx, v.width, v.tiles_x, x0, x1)) rect = with_row(rect, x0, x1, y);
    }
    return rect;
}

__device__ __forceinline__ SplatParameters<float> load_parameters(const ProjectArguments& a, int64 i) {
    const float *m = a.means + 3 * i, *q = a.quats + 4 * i, *l = a.log_scales + 2 * i;
    return {{m[0], m[1], m[2]}, q[0], q[1], q[2], q[3], l[0], l[1], a.opacity_logits[i]};
}

extern "C" __global__ void __launch_bounds__(128) project_splats(ProjectArguments a) {
    const int64 i = int64(blockIdx.x) * blockDim.x + threadIdx.x;
    if (i >= a.count) return;
    const View& v = a.view;
    a.depth_keys[i] = 0x7f800000, a.tile_counts[i] = 0, a.radii[i] = 0.f;

    const SplatParameters<float> p = load_parameters(a, i);
    Frame3<float> frame = frame_of(p, v.camera);
    Record<float> r = project(p, frame, v.camera);
    if (!in_range(p, frame) || !(frame.p.z > v.near)) return;
    if (v.mip_px > 0.f) {
        const MipFilter<float> filter = mip_filter(r, v.mip_px);
        if (!filter.in_range()) return;
        widen(filter, frame, r);
    }
    if (!a.errors && !(r.log2_opacity >= v.log2_alpha_min)) return;
    const bool crossing = v.near_plane_policy != NEAR_PLANE_DRAW && reaches_camera_plane(frame, v.error_k2);
    if (crossing && v.near_plane_policy == NEAR_PLANE_CULL) return;
    float sh_size;
    const Coefficients sh = {a.sh0 + 3 * i, a.shN + 3 * a.sh_rest * i};
    const Vec3<float> c = color_of(v.sh_degree, sh, frame.to_splat, sh_size);
    if (!color_in_range(sh_size)) return;
    r.red = clamped_color(c.x, v.sh_degree), r.green = clamped_color(c.y, v.sh_degree),
    r.blue = clamped_color(c.z, v.sh_degree);

    const float k2 = a.errors ? v.error_k2 : max(float(2 * LN2) * (r.log2_opacity - v.log2_alpha_min), 0.f);
    const Footprint<float> o = footprint(frame, r, k2, v.lowpass_px, v.camera);
    const PixelBox<float> box = {o.x_min, o.y_min, o.x_max, o.y_max};
    TileRectangle rect;
    if (crossing) {
        const Square<float> s = official_square(frame, r, v.error_k2, v.lowpass_px, v.camera);
        rect = square_tiles(s.x, s.y, s.half, v.tiles_x, v.tiles_y);
        a.radii[i] = tiles_radius<float>(rect, v.width, v.height);
    } else {
        rect = o.unbounded && a.exact ? outlined_rectangle(v, r, o.k, o.disc2)
                                      : tile_rectangle(box, o.unbounded, v.width, v.height, v.tiles_x, v.tiles_y);
        a.radii[i] = clipped_radius(box, o.crosses, v.width, v.height);
    }
    const int tiles = (rect.x1 - rect.x0) * (rect.y1 - rect.y0);
    if (tiles == 0) return;
    float4* to = reinterpret_cast<float4*>(a.records + RECORD * i);
    to[0] = {r.cx, r.cy, r.au, r.bu}, to[1] = {r.av, r.bv, r.ai, r.bi};
    to[2] = {r.iz, r.log2_opacity, r.red, r.green}, to[3] = {r.blue, r.nx, r.ny, r.nz};
    float4* cull = reinterpret_cast<float4*>(a.cull + 8 * i);
    cull[0] = {o.unbounded ? o.k : o.ex, o.ey, o.a, o.b}, cull[1] = {o.c, r.cx, r.cy, o.unbounded ? -o.disc2 : o.disc2};
    ushort* rows = a.rects + 4 * i;
    rows[0] = rect.x0, rows[1] = rect.y0, rows[2] = rect.x1, rows[3] = rect.y1;
    a.depth_keys[i] = __float_as_int(frame.p.z), a.tile_counts[i] = tiles;
}

}  // namespace gs2d
