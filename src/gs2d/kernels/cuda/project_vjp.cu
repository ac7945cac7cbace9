// From gradients of records to gradients of parameters, SH and the densification signal: one thread per splat.
#include "cuda/colors.h"

namespace gs2d {

struct ProjectVjpArguments {
    View view;
    int64 count, sh_rest;
    const float *means, *quats, *log_scales, *opacity_logits, *sh0, *shN;
    const int* tile_counts;  // 0: not drawn, all gradients are 0
    const uchar* learns;     // [N], 0: all gradients are 0; or null
    const float* gradients;  // [N, 16]
    const float* extras;     // [N, 4]
    float *g_means, *g_quats, *g_log_scales, *g_opacity_logits, *g_sh0, *g_shN, *g_probe;  // null where not wanted
    int64 probe_columns;                                                                   // 2 or 4
    float* g_intrinsics;  // [N, 4]: what each splat says of fx, fy, cx, cy; or null
};

__device__ __forceinline__ void write_row(float* to, int64 i, int columns, float a, float b = 0.f, float c = 0.f,
                                          float d = 0.f) {
    if (!to) return;
    to += i * columns;
    to[0] = a;
    if (columns > 1) to[1] = b;
    if (columns > 2) to[2] = c;
    if (columns > 3) to[3] = d;
}

__device__ __forceinline__ void write_zeros(const ProjectVjpArguments& a, int64 i) {
    write_row(a.g_means, i, 3, 0.f), write_row(a.g_quats, i, 4, 0.f), write_row(a.g_log_scales, i, 2, 0.f);
    write_row(a.g_opacity_logits, i, 1, 0.f), write_row(a.g_sh0, i, 3, 0.f),
        write_row(a.g_probe, i, int(a.probe_columns), 0.f);
    write_row(a.g_intrinsics, i, 4, 0.f);
    if (a.g_shN)
        for (int64 k = 0; k < 3 * a.sh_rest; ++k) a.g_shN[3 * a.sh_rest * i + k] = 0.f;
}

extern "C" __global__ void __launch_bounds__(128, 5) project_splats_vjp(ProjectVjpArguments a) {
    const int64 i = int64(blockIdx.x) * blockDim.x + threadIdx.x;
    if (i >= a.count) return;
    if (a.tile_counts[i] == 0 || (a.learns && !a.learns[i])) return write_zeros(a, i);
    const float *g = a.gradients + 16 * i, *e = a.extras + 4 * i, *m = a.means + 3 * i;
    // Colours first, so that coefficients and geometry are not in registers at the same time.
    const Coefficients sh = {a.sh0 + 3 * i, a.shN + 3 * a.sh_rest * i};
    const CoefficientGradients g_sh = {a.g_sh0 ? a.g_sh0 + 3 * i : nullptr,
                                       a.g_shN ? a.g_shN + 3 * a.sh_rest * i : nullptr};
    float inverse_distance;
    const Vec3<float> direction =
        direction_of(Vec3<float>{m[0], m[1], m[2]} - center_of<float>(a.view.camera), inverse_distance);
    const Vec3<float> g_direction =
        color_vjp(a.view.sh_degree, sh, int(a.sh_rest), g_sh, direction, {g[10], g[11], g[12]});

    const float *q = a.quats + 4 * i, *l = a.log_scales + 2 * i;
    const SplatParameters<float> p = {{m[0], m[1], m[2]}, q[0], q[1], q[2], q[3], l[0], l[1], a.opacity_logits[i]};
    const Frame3<float> frame = frame_of(p, a.view.camera);
    const Record<float> r = project(p, frame, a.view.camera);
    const RecordGradient<float> gr = {g[0],  g[1],  g[2],  g[3],  g[4],  g[5],  g[6], g[7], g[8], g[9],
                                      g[10], g[11], g[12], g[13], g[14], g[15], e[0], e[1], e[2], e[3]};
    const ParameterGradient<float> d = project_vjp(p, frame, r, gr, g_direction, a.view.camera);
    write_row(a.g_means, i, 3, d.mean.x, d.mean.y, d.mean.z);
    write_row(a.g_quats, i, 4, d.qw, d.qx, d.qy, d.qz);
    write_row(a.g_log_scales, i, 2, d.log_su, d.log_sv);
    write_row(a.g_opacity_logits, i, 1, d.logit);
    const float half_w = 0.5f * float(a.view.width), half_h = 0.5f * float(a.view.height);
    write_row(a.g_probe, i, int(a.probe_columns), d.probe_x * half_w, d.probe_y * half_h, gr.abs_x * half_w,
              gr.abs_y * half_h);
    if (!a.g_intrinsics) return;
    const IntrinsicsGradient<float> intrinsics = intrinsics_vjp(frame, r, gr, a.view.camera);
    write_row(a.g_intrinsics, i, 4, intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy);
}

}  // namespace gs2d
