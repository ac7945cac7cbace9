// Fusion of depth maps (core/fuse.h), one view per launch and one voxel per thread.
#include "core/fuse.h"

#include "cuda/common.h"

namespace gs2d {

extern "C" __global__ void __launch_bounds__(128) fuse_voxels(FuseArguments<float> a) {
    const int64 i = int64(blockIdx.x) * 128 + threadIdx.x, n = i / FUSE_VOXELS, v = i % FUSE_VOXELS;
    if (n >= a.blocks) return;
    const float z = a.bases[3 * n + 2] + a.offsets[2 * FUSE_VOXELS + v];
    const float xz = a.bases[3 * n] + a.offsets[v], yz = a.bases[3 * n + 1] + a.offsets[FUSE_VOXELS + v];
    const FusePixel<float> p = fuse_pixel(xz, yz, z, float(a.width - 1), float(a.height - 1));
    const int64 pixel = int64(p.row) * a.width + int64(p.column);
    const float distance = fuse_distance(p, a.depth[pixel], a.slope_x[pixel], a.slope_y[pixel], z, a.truncation);
    float weight = fuse_weight(distance);
    if (a.pixel_weight) weight = weight * a.pixel_weight[pixel];
    if (!(weight > 0.f)) return;
    const int64 at = a.rows[n] * FUSE_VOXELS + v;
    if (a.pixel_color && distance < 1.f) {
        const FuseStep<float> color = fuse_step(a.color_weight[at], fuse_color_weight(distance, weight));
        a.color_weight[at] = color.total;
        for (int c = 0; c < 3; ++c) {
            a.color[3 * at + c] = fuse_mean(a.color[3 * at + c], a.pixel_color[3 * pixel + c], color.share);
        }
    }
    const FuseStep<float> step = fuse_step(a.weight[at], weight);
    a.weight[at] = step.total;
    a.tsdf[at] = fuse_mean(a.tsdf[at], fuse_clear(distance), step.share);
}

}  // namespace gs2d
