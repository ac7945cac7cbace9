// Fusion of depth maps (core/fuse.h), one view at a time. Blocks are independent and a view updates a voxel once, so
// the result does not depend on the number of threads. Vectors with zero weight are not written.
#include "core/fuse.h"

#include "cpu/export.h"
#include "cpu/simd.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

constexpr int64_t GRAIN = 32;  // blocks per piece

// Reals at LANES positions of an array.
GS2D_HD V gather(const real* from, const int32_t* at) {
    real values[LANES];
    for (int i = 0; i < LANES; ++i) values[i] = from[at[i]];
    return load(values);
}

// Moves the colours [LANES, 3] of LANES voxels towards the colours of their pixels, each by its own share.
void mix_colors(real* colors, const real* image, const int32_t* pixel, V share) {
    real one[LANES], target[3 * LANES], shares[3 * LANES];
    store(one, share);
    for (int i = 0; i < LANES; ++i) {
        for (int c = 0; c < 3; ++c) target[3 * i + c] = image[3 * int64_t(pixel[i]) + c], shares[3 * i + c] = one[i];
    }
    for (int k = 0; k < 3 * LANES; k += LANES) {
        store(colors + k, fuse_mean<V>(load(colors + k), load(target + k), load(shares + k)));
    }
}

void fuse_block(const FuseArguments<real>& a, int64_t n) {
    const V base_x(a.bases[3 * n]), base_y(a.bases[3 * n + 1]), base_z(a.bases[3 * n + 2]);
    const V last_column(real(a.width - 1)), last_row(real(a.height - 1)), truncation(a.truncation), zero(real(0));
    const int32_t width = static_cast<int32_t>(a.width);
    const int64_t first = a.rows[n] * FUSE_VOXELS;
    for (int v = 0; v < FUSE_VOXELS; v += LANES) {
        const V xz = base_x + load(a.offsets + v), yz = base_y + load(a.offsets + FUSE_VOXELS + v);
        const V z = base_z + load(a.offsets + 2 * FUSE_VOXELS + v);
        const FusePixel<V> p = fuse_pixel<V>(xz, yz, z, last_column, last_row);
        real column[LANES], row[LANES];
        int32_t pixel[LANES];
        store(column, p.column), store(row, p.row);
        for (int i = 0; i < LANES; ++i) pixel[i] = int32_t(row[i]) * width + int32_t(column[i]);
        const V depth = gather(a.depth, pixel), slope_x = gather(a.slope_x, pixel), slope_y = gather(a.slope_y, pixel);
        const V distance = fuse_distance<V>(p, depth, slope_x, slope_y, z, truncation);
        V weight = fuse_weight<V>(distance);
        if (a.pixel_weight) weight *= gather(a.pixel_weight, pixel);
        const M changed = weight > zero;
        if (!any(changed)) continue;
        const int64_t at = first + v;
        if (a.pixel_color && any(changed & (distance < V(real(1))))) {
            const V share = keep(changed, fuse_color_weight<V>(distance, weight));
            const FuseStep<V> color = fuse_step<V>(load(a.color_weight + at), share);
            store(a.color_weight + at, color.total);
            mix_colors(a.color + 3 * at, a.pixel_color, pixel, color.share);
        }
        const FuseStep<V> step = fuse_step<V>(load(a.weight + at), weight);
        const V tsdf = load(a.tsdf + at);
        store(a.weight + at, step.total);
        store(a.tsdf + at, select(changed, fuse_mean<V>(tsdf, fuse_clear<V>(distance), step.share), tsdf));
    }
}

constexpr int64_t RAYS = 8192;  // per piece

// Marks the blocks that rays [begin, end) intersect, in double precision and with the order of operations of
// meshing/tsdf_volume.py. Concurrent writes to a mark all store the same value.
void mark_rays(const MarkArguments& a, int64_t begin, int64_t end) {
    const int64_t stride_x = a.padded[1] * a.padded[2], stride_y = a.padded[2];
    for (int64_t step = 0; step < a.steps; ++step) {
        int64_t last = -1;
        for (int64_t i = begin; i < end; ++i) {
            const double depth = a.depth[i] + a.offsets[step];
            const double x = a.start[0] + depth * a.rays[i], y = a.start[1] + depth * a.rays[a.count + i];
            const double z = a.start[2] + depth * a.rays[2 * a.count + i];
            const bool inside = x >= 0 && x < a.end[0] && y >= 0 && y < a.end[1] && z >= 0 && z < a.end[2];
            if (!inside) continue;
            const int64_t block_x = (int64_t(x) + 1) >> 1, block_y = (int64_t(y) + 1) >> 1,
                          block_z = (int64_t(z) + 1) >> 1;
            const int64_t flat = block_x * stride_x + block_y * stride_y + block_z;
            if (flat == last) continue;  // consecutive samples usually share a block
            last = flat;
            __atomic_store_n(&a.marks[flat], 1, __ATOMIC_RELAXED);
        }
    }
}

}  // namespace
}  // namespace gs2d

using namespace gs2d;

// Marks the blocks near the surface of a depth map.
GS2D_EXPORT void gs2d_mark_blocks(const MarkArguments* arguments) {
    parallel_ranges(arguments->count, RAYS, [&](int64_t begin, int64_t end) { mark_rays(*arguments, begin, end); });
}

// Fuses one view into the blocks that it may update.
GS2D_EXPORT void gs2d_fuse(const FuseArguments<real>* arguments) {
    parallel_ranges(arguments->blocks, GRAIN, [&](int64_t begin, int64_t end) {
        for (int64_t n = begin; n < end; ++n) fuse_block(*arguments, n);
    });
}
