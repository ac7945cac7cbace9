// Comparison of patches of two views: one warp per pixel, one lane per patch pixel. Every lane computes the plane and
// the round trip, which is a small part of the work. The patch is sampled twice, for the sums and for the gradient.
// Each pixel writes its own results, which are summed in a separate step.
#include "core/multiview.h"
#include "cuda/common.h"

namespace gs2d {

constexpr int PATCHES = 4;  // per block; same value in cuda_multiview.py

// An image interpolated between pixel centres; border values extend beyond the border.
struct ImageBetween {
    const float* pixels;
    int64 width, height;
    __device__ __forceinline__ Sampled<float> operator()(float x, float y) const {
        x = min(max(x, 0.f), float(width - 1)), y = min(max(y, 0.f), float(height - 1));
        const float i = min(whole(x), float(width > 1 ? width - 2 : 0));
        const float j = min(whole(y), float(height > 1 ? height - 2 : 0));
        const int64 right = width > 1, below = height > 1 ? width : 0;
        const float* at = pixels + int64(j) * width + int64(i);
        return between(at[0], at[right], at[below], at[below + right], x - i, y - j);
    }
    __device__ __forceinline__ bool contains(float x, float y) const {
        return x >= 0.f && x <= float(width - 1) && y >= 0.f && y <= float(height - 1);
    }
};

struct ClearAt {
    const uchar* flags;
    int64 width, height;
    Lens<float> lens;
    __device__ __forceinline__ bool operator()(float u, float v) const {
        const float x = fma(lens.fx, u, lens.cx), y = fma(lens.fy, v, lens.cy);
        const float i = min(max(x + 0.5f, 0.f), float(width - 1)), j = min(max(y + 0.5f, 0.f), float(height - 1));
        return flags[int64(j) * width + int64(i)] != 0;
    }
};

// Rows starting at `row` of an array [., P], for one pixel.
struct LeaveRows {
    float* rows;
    int64 patch, count;
    int row;
    __device__ __forceinline__ void operator()(int k, float value) const { rows[(row + k) * count + patch] = value; }
};

// Sums over the lanes; all lanes get the results.
template <int N> __device__ __forceinline__ void sum_lanes(float (&values)[N]) {
#pragma unroll
    for (int n = 0; n < N; ++n) {
#pragma unroll
        for (int step = 16; step > 0; step >>= 1) values[n] = values[n] + __shfl_xor_sync(FULL_MASK, values[n], step);
    }
}

struct PatchPixel {
    float a, b;
    Vec3<float> pull;
};

__device__ __forceinline__ PatchPixel patch_pixel(const CompareArguments<float>& a, const ImageBetween& source,
                                                  const PatchPlane<float>& plane, const Lens<float>& there, int64 pixel,
                                                  int i, int j) {
    const Vec3<float> h = axpy(float(i), plane.right, axpy(float(j), plane.down, plane.middle));
    const PatchPlace<float> at = patch_place(h);
    const Sampled<float> s = source(fma(there.fx, at.x, there.cx), fma(there.fy, at.y, there.cy));
    return {a.reference[pixel + j * a.width + i], s.value, patch_pull(at, s, there)};
}

// The warped square is convex, so its corners bound the patch.
__device__ __forceinline__ bool patch_is_inside(const ImageBetween& source, const PatchPlane<float>& plane,
                                                const Lens<float>& there, int radius) {
    bool inside = true;
    for (int corner = 0; corner < 4; ++corner) {
        const float i = float(corner & 1 ? radius : -radius), j = float(corner & 2 ? radius : -radius);
        const Vec3<float> h = axpy(i, plane.right, axpy(j, plane.down, plane.middle));
        const PatchPlace<float> at = patch_place(h);
        inside = inside && h.z > float(MIN_SCALE) &&
                 source.contains(fma(there.fx, at.x, there.cx), fma(there.fy, at.y, there.cy));
    }
    return inside;
}

extern "C" __global__ void __launch_bounds__(128) compare_views(CompareArguments<float> a) {
    const int lane = threadIdx.x & 31;
    const int64 patch = int64(blockIdx.x) * PATCHES + (threadIdx.x >> 5);
    if (patch >= a.count) return;  // uniform over the warp
    const auto rows = [&](float* all, int row) { return LeaveRows{all, patch, a.count, row}; };
    const LeaveRows values = rows(a.values, 0), gradients = rows(a.gradients, 0), moves = rows(a.motion_gradients, 0);
    const bool first = lane == 0;
    if (first) {
        for (int k = 0; k < VALUE_ROWS; ++k) values(k, 0.f);
        for (int k = 0; a.gradients && k < GRADIENT_ROWS; ++k) gradients(k, 0.f);
        for (int k = 0; a.motion_gradients && k < MOTION_ROWS; ++k) moves(k, 0.f);
    }
    if (!a.chosen[patch]) return;
    const int64 pixel = a.index[patch];
    const Lens<float> here = lens_of<float, float>(a.lens), there = lens_of<float, float>(a.source_lens);
    const Motion<float> motion = motion_of<float>(a.motion);
    const float x = float(pixel % a.width), y = float(pixel / a.width), depth = a.depth[pixel];
    const Vec3<float> ray = {(x - here.cx) / here.fx, (y - here.cy) / here.fy, 1.f};
    const Vec3<float> q = {a.normal[3 * pixel], a.normal[3 * pixel + 1], a.normal[3 * pixel + 2]};
    const ImageBetween surface = {a.source_depth, a.depth_width, a.depth_height};
    const double by_x = double(a.depth_width) / double(a.source_width);
    const double by_y = double(a.depth_height) / double(a.source_height);
    const Lens<float> surface_lens = lens_of<float, float>(a.source_lens, by_x, by_y);
    const ImageBetween source = {a.source, a.source_width, a.source_height};
    const ClearAt clear = {a.clear, a.source_width, a.source_height, there};
    const RoundTrip<float> trip = round_trip(depth, ray, motion, here, surface_lens, float(a.depth_width - 1),
                                             float(a.depth_height - 1), surface, clear);
    if (!(trip.back && trip.error < float(a.occluded))) return;
    const float weight = exp(-trip.error);
    if (first) {
        values(1, weight * trip.error);
        if (a.gradients) gradients(4, weight * trip.by_depth);
        if (a.motion_gradients) {
            const MotionGrad<float> g = motion_grad(trip, depth, ray);
            each_of(g.turn, weight, rows(a.motion_gradients, TRIP_TURN_ROW));
            each_of(g.shift, weight, rows(a.motion_gradients, TRIP_SHIFT_ROW));
        }
    }
    const int radius = int(a.radius), side = 2 * radius + 1;
    const PatchPlane<float> plane = patch_plane(depth, q, ray, motion, here);
    if (!(plane.planar && weight > 0.f && patch_is_inside(source, plane, there, radius))) return;
    const PatchPixel middle = patch_pixel(a, source, plane, there, pixel, 0, 0);
    PatchSums<float> mine = {0.f, 0.f, 0.f, 0.f, 0.f};
    for (int k = lane; k < side * side; k += 32) {
        const PatchPixel p = patch_pixel(a, source, plane, there, pixel, k % side - radius, k / side - radius);
        mine.add(p.a - middle.a, p.b - middle.b);
    }
    float sums[5] = {mine.a, mine.b, mine.aa, mine.bb, mine.ab};
    sum_lanes(sums);
    const PatchSums<float> all = {sums[0], sums[1], sums[2], sums[3], sums[4]};
    const PatchNcc<float> ncc = patch_ncc(all, float(side * side), float(a.texture));
    if (!ncc.valid) return;
    if (first) values(0, weight * (1.f - ncc.value));
    if (!a.gradients) return;
    float g[9] = {0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f};  // gradients of right, down, middle
    for (int k = lane; k < side * side; k += 32) {
        const int i = k % side - radius, j = k / side - radius;
        const PatchPixel p = patch_pixel(a, source, plane, there, pixel, i, j);
        const float by_a = ncc.by_a * (p.a - middle.a - ncc.mean_a), by_b = ncc.by_b * (p.b - middle.b - ncc.mean_b);
        const float by[3] = {(by_a - by_b) * p.pull.x, (by_a - by_b) * p.pull.y, (by_a - by_b) * p.pull.z};
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            g[c] = fma(float(i), by[c], g[c]), g[3 + c] = fma(float(j), by[c], g[3 + c]), g[6 + c] = g[6 + c] + by[c];
        }
    }
    sum_lanes(g);
    if (!first) return;
    const Vec3<float> by_middle = {g[6], g[7], g[8]};
    const PatchPlaneGrad<float> back =
        patch_plane_vjp(plane, {g[0], g[1], g[2]}, {g[3], g[4], g[5]}, by_middle, depth, ray, motion, here);
    gradients(0, -weight * back.depth);
    each_of(transposed_times(motion.world, back.normal), -weight, rows(a.gradients, 1));
    if (!a.motion_gradients) return;
    const MotionGrad<float> m = motion_grad(plane, back, by_middle, ray);
    each_of(m.turn, -weight, rows(a.motion_gradients, TURN_ROW));
    each_of(m.shift, -weight, rows(a.motion_gradients, SHIFT_ROW));
    each_of(outer(back.normal, q), -weight, rows(a.motion_gradients, WORLD_ROW));
}

}  // namespace gs2d
