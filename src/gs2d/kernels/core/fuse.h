// Update of one voxel of a truncated signed distance field by one depth map (docs/math.md), for meshing/tsdf_volume.py.
// Results in single precision are bit-identical on every processor, so nothing here is a fused multiply-add.
#pragma once

#include "core/base.h"

namespace gs2d {

constexpr int FUSE_VOXELS = 512;           // per block of 8^3, z fastest
constexpr double FUSE_WEIGHT_SLOPE = 4.0;  // 1 / (1 - FULL_WEIGHT_BEHIND) of meshing/tsdf_volume.py
constexpr double FUSE_NO_WEIGHT = 1e-20;   // lower limit for a sum of weights

// One view and the blocks of a volume that it may update, for kernels/tsdf.py. R is the array type.
template <class R> struct FuseArguments {
    long long blocks;       // number of blocks
    const long long* rows;  // [blocks]: rows in the volume
    // [blocks, 3] (x z, y z, z) of the first voxel of each block: x z and y z in world units times px, z in world units
    const R* bases;
    const R* offsets;  // [3, 512] of a voxel relative to the first voxel of its block
    long long width, height;
    // [height, width] world units, and their change per px; the depth is a large negative number if undefined
    const R *depth, *slope_x, *slope_y;
    const R *pixel_weight, *pixel_color;      // [height, width], [height, width, 3]; or null
    R truncation;                             // world units
    R *tsdf, *weight, *color, *color_weight;  // [M, 512], [M, 512, 3]; colours may be null
};

// Rays of one depth map through a grid of blocks, for kernels/tsdf.py. Each ray is sampled before and behind its depth.
// Grid positions are in half blocks from the corner of the grid.
struct MarkArguments {
    long long count, steps;   // rays; samples along each
    const double* rays;       // [3, count], scaled to depth 1
    const double* depth;      // [count] world units
    const double* offsets;    // [steps] world units, sample position relative to the depth
    double start[3], end[3];  // start of the rays; end of the grid, which begins at 0
    long long padded[3];      // blocks, including a border of one block
    unsigned char* marks;     // [padded]: marks the lower of the two nearest blocks along each axis
};

// The pixel that a voxel projects to, and the offset from its centre in px; clamped to the image.
template <class V> struct FusePixel {
    V column, row, x, y;
};

template <class V> GS2D_HD FusePixel<V> fuse_pixel(V xz, V yz, V z, V last_column, V last_row) {
    const V x = min(max(xz / z, V(0.f)), last_column), y = min(max(yz / z, V(0.f)), last_row);
    const V column = whole(x), row = whole(y);
    return {column, row, (x - column) - V(0.5f), (y - row) - V(0.5f)};
}

// Returns the distance of the surface behind the voxel, in truncations, from the plane through the pixel.
template <class V> GS2D_HD V fuse_distance(const FusePixel<V>& p, V depth, V slope_x, V slope_y, V z, V truncation) {
    return (((depth + p.x * slope_x) + p.y * slope_y) - z) / truncation;
}

// Returns 1 up to 3/4 of the truncation behind the surface, decreasing to 0 at the truncation.
template <class V> GS2D_HD V fuse_weight(V distance) {
    return min(max((distance + V(1.f)) * V(float(FUSE_WEIGHT_SLOPE)), V(0.f)), V(1.f));
}

// A running mean: sum of weights, and step of the mean towards the new value.
template <class V> struct FuseStep {
    V total, share;
};

template <class V> GS2D_HD FuseStep<V> fuse_step(V old_weight, V weight) {
    const V total = old_weight + weight;
    return {total, weight / max(total, V(float(FUSE_NO_WEIGHT)))};
}

template <class V> GS2D_HD V fuse_mean(V old, V value, V share) { return old + (value - old) * share; }

template <class V> GS2D_HD V fuse_clear(V distance) { return min(distance, V(1.f)); }  // free space is 1

// Returns the weight of a colour: it increases towards the surface and is 0 in front of the band.
template <class V> GS2D_HD V fuse_color_weight(V distance, V weight) {
    return keep(distance < V(1.f), weight * (V(1.f) - abs(distance)));
}

}  // namespace gs2d
