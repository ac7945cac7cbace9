// Update of one voxel of a truncated signed distance field by one depth map (docs/math.md; meshing/tsdf_volume.py
// and meshing/sampling.py have the same in numpy, operation for operation: single precision gives the same bits, so
// nothing here is a fused multiply-add).
#pragma once

#include "core/base.h"

namespace gs2d {

constexpr int FUSE_VOXELS = 512;           // per block of 8^3, z fastest
constexpr double FUSE_WEIGHT_SLOPE = 4.0;  // 1 / (1 - FULL_WEIGHT_BEHIND) of meshing/tsdf_volume.py
constexpr double FUSE_NO_WEIGHT = 1e-20;   // lower limit of a sum of weights

// One view and the blocks of a volume that it may change, for kernels/tsdf.py. R is the type of the arrays.
template <class R> struct FuseArguments {
    long long blocks;       // number of blocks
    const long long* rows;  // [blocks] of the volume
    // [blocks, 3] (x z, y z, z) of each block's first voxel: world units times px, and world units
    const R* bases;
    const R* offsets;  // [3, 512] of a voxel from its block's first
    long long width, height;
    // [height, width] world units, and their change per px; the depth is hugely negative where unseen
    const R *depth, *slope_x, *slope_y;
    const R *pixel_weight, *pixel_color;      // [height, width], [height, width, 3]; or null
    R truncation;                             // world units
    R *tsdf, *weight, *color, *color_weight;  // [M, 512], [M, 512, 3]; colours may be null
};

// Rays of one depth map through a grid of blocks, for kernels/tsdf.py: where a depth lies on each, sampled before and
// behind it, in halves of a block from the grid's corner.
struct MarkArguments {
    long long count, steps;   // rays; samples along each
    const double* rays;       // [3, count], to depth 1
    const double* depth;      // [count] world units
    const double* offsets;    // [steps] world units, of a sample from the depth
    double start[3], end[3];  // of the rays; of the grid, which begins at 0
    long long padded[3];      // blocks, with a border of one
    unsigned char* marks;     // [padded]: of the lower of the two nearest blocks along each axis
};

// The pixel that shows a voxel, and the offset from its centre, px; clamped to the image.
template <class V> struct FusePixel {
    V column, row, x, y;
};

template <class V> GS2D_HD FusePixel<V> fuse_pixel(V xz, V yz, V z, V last_column, V last_row) {
    const V x = min(max(xz / z, V(0.f)), last_column), y = min(max(yz / z, V(0.f)), last_row);
    const V column = whole(x), row = whole(y);
    return {column, row, (x - column) - V(0.5f), (y - row) - V(0.5f)};
}

// Distance of the surface behind the voxel, in truncations, by the plane through the pixel.
template <class V> GS2D_HD V fuse_distance(const FusePixel<V>& p, V depth, V slope_x, V slope_y, V z, V truncation) {
    return (((depth + p.x * slope_x) + p.y * slope_y) - z) / truncation;
}

// 1 up to 3/4 of the truncation behind the surface, then decreasing to 0 at the truncation.
template <class V> GS2D_HD V fuse_weight(V distance) {
    return min(max((distance + V(1.f)) * V(float(FUSE_WEIGHT_SLOPE)), V(0.f)), V(1.f));
}

// A running mean: the sum of weights, and the step of the mean towards the new value.
template <class V> struct FuseStep {
    V total, share;
};

template <class V> GS2D_HD FuseStep<V> fuse_step(V old_weight, V weight) {
    const V total = old_weight + weight;
    return {total, weight / max(total, V(float(FUSE_NO_WEIGHT)))};
}

template <class V> GS2D_HD V fuse_mean(V old, V value, V share) { return old + (value - old) * share; }

template <class V> GS2D_HD V fuse_clear(V distance) { return min(distance, V(1.f)); }  // free space is 1

// Weight of a colour: increases towards the surface; 0 before the band.
template <class V> GS2D_HD V fuse_color_weight(V distance, V weight) {
    return keep(distance < V(1.f), weight * (V(1.f) - abs(distance)));
}

}  // namespace gs2d
