// Converts record gradients to gradients of parameters, SH and the densification signal: one thread per splat.
//
// Rows of SH and of three floats pass through shared memory (rows.h): they are three quarters of the 464 bytes per
// splat that this kernel reads and writes. Therefore no lane of a warp may exit early.
#include "core/mip_filter.h"
#include "cuda/colors.h"
#include "cuda/rows.h"

namespace gs2d {

// Sums of the densification signal; splats of radius 0 are skipped. If all are null, nothing is accumulated here.
struct Gathered {
    float *signed_norms, *absolute_norms, *counts;  // [N]; absolute_norms may be the only null
    const float* radii;                             // [N] px
    const int* skip;                                // if nonzero, nothing is added; may be null
};

struct ProjectVjpArguments {
    View view;
    int64 count, sh_rest;
    const float *means, *quats, *log_scales, *opacity_logits, *sh0, *shN;
    const int* tile_counts;  // 0: not drawn, all gradients are 0
    const uchar* learns;     // [N], 0: all gradients are 0; or null
    float* gradients;        // [N, 16]
    float* extras;           // [N, 4]
    float *g_means, *g_quats, *g_log_scales, *g_opacity_logits, *g_sh0, *g_shN, *g_probe;  // null: not computed
    int64 probe_columns;                                                                   // 2 or 4
    float* g_intrinsics;  // [N, 4]: per-splat gradients of fx, fy, cx, cy; or null
    Gathered gathered;
    int clears;  // 1: reset the rows of gradients and extras to zero
};

// Rows of tensors that are allocated for this kernel and therefore aligned.
__device__ __forceinline__ void write_2(float* to, int64 i, float a, float b) {
    reinterpret_cast<float2*>(to)[i] = {a, b};
}
__device__ __forceinline__ void write_4(float* to, int64 i, float a, float b, float c, float d) {
    reinterpret_cast<float4*>(to)[i] = {a, b, c, d};
}

__device__ __forceinline__ float norm_of(float x, float y) { return sqrt(x * x + y * y); }

// Loads a row of three floats per lane.
__device__ __forceinline__ void write_3(float* to, int64 begin, int count, int lane, float a, float b, float c,
                                        float* rows) {
    rows[3 * lane] = a, rows[3 * lane + 1] = b, rows[3 * lane + 2] = c;
    store_rows(to, begin, count, 3, lane, rows);
}

__device__ __forceinline__ Vec3<float> mean_of(const ProjectVjpArguments& a, int64 i) {
    const float* m = a.means + 3 * i;
    return {m[0], m[1], m[2]};
}

// Writes the gradient of the first coefficient to `first`, and overwrites the row with the gradients of the others.
// Returns the gradient of the direction.
__device__ __forceinline__ Vec3<float> learn_colors(const ProjectVjpArguments& a, int64 i, Vec3<float> g_color,
                                                    float* row, float* first) {
    const Coefficients sh = {a.sh0 + 3 * i, row};
    const CoefficientGradients g_sh = {first, a.g_shN ? row : nullptr};
    float inverse_distance;
    const Vec3<float> direction = direction_of(mean_of(a, i) - center_of<float>(a.view.camera), inverse_distance);
    return color_vjp(a.view.sh_degree, sh, int(a.sh_rest), g_sh, direction, g_color);
}

// Minimum blocks per multiprocessor: five would leave 96 registers, too few for sm_120 (8 bytes spilled).
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 1200
#define PROJECT_VJP_BLOCKS 4
#else
#define PROJECT_VJP_BLOCKS 5
#endif

extern "C" __global__ void __launch_bounds__(128, PROJECT_VJP_BLOCKS) project_splats_vjp(ProjectVjpArguments a) {
    __shared__ float4 staged[4][WARP_ROWS * MAX_ROW / 4];
    const int lane = threadIdx.x & 31, length = int(3 * a.sh_rest);
    const int64 begin = int64(blockIdx.x) * blockDim.x + (threadIdx.x & ~31u), i = begin + lane;
    if (begin >= a.count) return;  // uniform over the warp
    const int count = a.count - begin < WARP_ROWS ? int(a.count - begin) : WARP_ROWS;
    float* rows = reinterpret_cast<float*>(staged[threadIdx.x >> 5]);
    const bool drawn = lane < count && a.tile_counts[i] != 0 && (!a.learns || a.learns[i]);
    const uint wanted = __ballot_sync(FULL_MASK, drawn);
    if (length > 0 && a.view.sh_degree > 0) load_rows(a.shN, begin, count, length, wanted, lane, rows);

    // Process colours first, so that coefficients and geometry are not in registers at the same time.
    const float4* g = reinterpret_cast<const float4*>(a.gradients) + 4 * i;
    Vec3<float> g_direction = {0.f, 0.f, 0.f};
    float first[3] = {0.f, 0.f, 0.f};
    float* row = rows + lane * length;
    if (drawn) {
        const float4 g2 = g[2], g3 = g[3];
        g_direction = learn_colors(a, i, {g2.z, g2.w, g3.x}, row, first);
    } else if (a.g_shN)
#pragma unroll 1
        for (int k = 0; k < length; ++k) row[k] = 0.f;
    if (a.g_shN && length > 0) store_rows(a.g_shN, begin, count, length, lane, rows);
    __syncwarp();
    if (a.g_sh0) write_3(a.g_sh0, begin, count, lane, first[0], first[1], first[2], rows);

    ParameterGradient<float> d = {};
    IntrinsicsGradient<float> intrinsics = {};
    float abs_x = 0.f, abs_y = 0.f;
    if (drawn) {
        const float4 q = row_of_4(a.quats, i);
        const float2 l = row_of_2(a.log_scales, i);
        const SplatParameters<float> p = {mean_of(a, i), q.x, q.y, q.z, q.w, l.x, l.y, a.opacity_logits[i]};
        const Frame3<float> frame = frame_of(p, a.view.camera);
        const Record<float> r = project(p, frame, a.view.camera);
        const float4 g0 = g[0], g1 = g[1], g2 = g[2], g3 = g[3], e = row_of_4(a.extras, i);
        RecordGradient<float> gr = {g0.x, g0.y, g0.z, g0.w, g1.x, g1.y, g1.z, g1.w, g2.x, g2.y,
                                    g2.z, g2.w, g3.x, g3.y, g3.z, g3.w, e.x,  e.y,  e.z,  e.w};
        const bool filters = a.view.mip_px > 0.f;
        const Probe<float> filtered = filters ? widen_vjp(r, a.view.mip_px, a.view.camera, gr) : Probe<float>{};
        d = project_vjp(p, frame, r, gr, g_direction, a.view.camera);
        if (filters) d.probe_x = filtered.x, d.probe_y = filtered.y;
        if (a.g_intrinsics) intrinsics = intrinsics_vjp(frame, r, gr, a.view.camera);
        abs_x = gr.abs_x, abs_y = gr.abs_y;
        if (a.clears) {
            const float4 none = {0.f, 0.f, 0.f, 0.f};
            float4 *row = reinterpret_cast<float4*>(a.gradients) + 4 * i, *extra = reinterpret_cast<float4*>(a.extras) + i;
            row[0] = none, row[1] = none, row[2] = none, row[3] = none, *extra = none;
        }
    }
    if (a.g_means) write_3(a.g_means, begin, count, lane, d.mean.x, d.mean.y, d.mean.z, rows);
    if (lane >= count) return;
    if (a.g_quats) write_4(a.g_quats, i, d.qw, d.qx, d.qy, d.qz);
    if (a.g_log_scales) write_2(a.g_log_scales, i, d.log_su, d.log_sv);
    if (a.g_opacity_logits) a.g_opacity_logits[i] = d.logit;
    const float half_w = 0.5f * float(a.view.width), half_h = 0.5f * float(a.view.height);
    if (a.g_probe && a.probe_columns == 2) write_2(a.g_probe, i, d.probe_x * half_w, d.probe_y * half_h);
    if (a.g_probe && a.probe_columns == 4)
        write_4(a.g_probe, i, d.probe_x * half_w, d.probe_y * half_h, abs_x * half_w, abs_y * half_h);
    const Gathered& to = a.gathered;
    if (to.counts && to.radii[i] > 0.f && !(to.skip && *to.skip)) {
        to.signed_norms[i] = to.signed_norms[i] + norm_of(d.probe_x * half_w, d.probe_y * half_h);
        if (to.absolute_norms) to.absolute_norms[i] = to.absolute_norms[i] + norm_of(abs_x * half_w, abs_y * half_h);
        to.counts[i] = to.counts[i] + 1.f;
    }
    if (a.g_intrinsics) write_4(a.g_intrinsics, i, intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy);
}

}  // namespace gs2d
