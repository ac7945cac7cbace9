// Normal consistency, silhouettes, means over valid pixels, and the last step of every mean.
//
// Two forms of normal consistency: the official mean(1 - alpha <n, N>) with alpha detached, and the paper's per-splat
// mean(alpha - <n, N>) with nothing detached. N depends on the depths of the four neighbours, so the depth gradient is
// gathered from the four adjacent pixels, without atomics.
#include "core/losses.h"
#include "cuda/means.h"

namespace gs2d {

constexpr int MEAN_PIXELS = 1024;           // per block; same value in cuda_losses.py
constexpr int NORMAL_W = 32, NORMAL_H = 8;  // tile of a block in the backward pass; same values in cuda_losses.py
constexpr int HALO = 2;                     // number of depths on each side that affect a depth gradient

struct NormalArguments {
    int64 height, width;
    float fx, fy, cx, cy;
    float rotation[9];  // world to camera
    int per_splat, at_camera;             // at_camera: see makes_normal
    const float *normal, *depth, *alpha;  // [H, W, 3] world frame, [H, W], [H, W]
    const uchar* mask;                    // or null
    const float* weights;                 // [H, W] per pixel, or null
    float* partials;                      // [2, blocks]: valid pixels; sum, depending on `per_splat` and `weights`
    const float *means, *cotangent;       // backward: means[0] = 1 / valid pixels; null if `scale` is set
    float *g_normal, *g_depth, *g_alpha;  // null: not computed
    float scale;                          // cotangent / valid pixels
    const uchar* object;                  // instead of weights: photo bytes [H, W, 4]; 1 where alpha > 1/2
    const uchar* flatness;                // [H, W], or null: weights times 1 + flat_more flatness / 255
    float flat_more;
};

struct SmoothArguments {
    int64 height, width;
    const float *normal, *alpha;  // [H, W, 3], [H, W]
    const uchar *flatness, *mask;  // the mask may be null
    float* partials;               // [2, blocks]: valid pixels, sum; or null
    const float *means, *cotangent;  // of the gradient: means[0] = 1 / valid pixels; null if `scale` is set
    float* g_normal;                 // or null
    float scale;                     // cotangent / valid pixels
    int adds;                        // whether to add to g_normal
};

struct SilhouetteArguments {
    int64 pixels;
    const float* alpha;   // [H, W], rendered
    const uchar* object;  // photo bytes [H, W, 4]
    const uchar* mask;    // or null
    float* g_alpha;       // [H, W]
    float scale;          // cotangent / valid pixels
};

struct MeanArguments {
    int64 height, width;
    const float* values;  // [H, W]
    const uchar* mask;
    float* partials;  // [2, blocks]: valid pixels, sum
};

struct FinishArguments {
    const float* partials;  // [1 + values, blocks]; the first row is the count
    int64 blocks;
    int values, complement;  // complement: the mean of 1 - value
    float* means;            // [1 + values]: 1 / count, then the means; a count of 0 is replaced by 1
};

// Returns the depth of a pixel, 0 in the background, negative outside the image and at ignored pixels (makes_normal).
__device__ __forceinline__ float depth_at(const NormalArguments& a, int64 x, int64 y) {
    const float absent = a.at_camera ? -1.f : 0.f;
    if (x < 0 || y < 0 || x >= a.width || y >= a.height) return absent;
    const int64 at = y * a.width + x;
    if (a.mask && !a.mask[at]) return absent;
    const float z = a.depth[at];
    return keep(was_hit(z), z);
}

__device__ __forceinline__ float weight_at(const NormalArguments& a, int64 at) {
    const float weight = a.object ? (a.object[4 * at + 3] > 127 ? 1.f : 0.f) : a.weights ? a.weights[at] : 1.f;
    return a.flatness ? weight * (1.f + a.flat_more * part_of_255(a.flatness[at])) : weight;
}

// Computes the depth normal of a pixel and its rendered normal in the camera frame.
struct Centre {
    bool defined;
    DepthNormal<float> from_depth;
    Vec3<float> rendered;
    float offset_x, offset_y, alpha, cosine;
};

__device__ __forceinline__ Centre centre_of(const NormalArguments& a, int64 x, int64 y, float left, float right,
                                            float up, float down) {
    Centre c;
    const int64 at = y * a.width + x;
    c.defined = makes_normal(left, right, up, down, a.at_camera != 0) && (!a.mask || a.mask[at]);
    c.offset_x = float(x) + 0.5f - a.cx, c.offset_y = float(y) + 0.5f - a.cy;
    c.from_depth = depth_normal(left, right, up, down, c.offset_x, c.offset_y, a.fx, a.fy);
    c.rendered = rotate(a.rotation, Vec3<float>{a.normal[3 * at], a.normal[3 * at + 1], a.normal[3 * at + 2]});
    c.alpha = a.alpha[at], c.cosine = dot(c.rendered, c.from_depth.direction);
    return c;
}

extern "C" __global__ void __launch_bounds__(128) normal_consistency(NormalArguments a) {
    float sums[2] = {0.f, 0.f};
    for (int i = 0; i < MEAN_PIXELS; i += MEAN_THREADS) {
        const int64 at = int64(blockIdx.x) * MEAN_PIXELS + i + threadIdx.x;
        if (at >= a.height * a.width || (a.mask && !a.mask[at])) continue;
        const int64 x = at % a.width, y = at / a.width;
        const Centre c = centre_of(a, x, y, depth_at(a, x - 1, y), depth_at(a, x + 1, y), depth_at(a, x, y - 1),
                                   depth_at(a, x, y + 1));
        sums[0] = sums[0] + 1.f;
        const float part = keep(c.defined, a.per_splat ? c.alpha - c.cosine : c.alpha * c.cosine);
        sums[1] = sums[1] + (a.weights ? a.weights[at] * (a.per_splat ? part : 1.f - part) : part);
    }
    leave_sums(sums, a.partials);
}

extern "C" __global__ void __launch_bounds__(128) normal_consistency_vjp(NormalArguments a) {
    constexpr int DW = NORMAL_W + 2 * HALO, DH = NORMAL_H + 2 * HALO, CW = NORMAL_W + 2, CH = NORMAL_H + 2;
    __shared__ float depth[DH][DW], pull_x[CH][CW], pull_y[CH][CW];  // pull_*: see depth_normal_vjp
    const int64 across = (a.width + NORMAL_W - 1) / NORMAL_W;
    const int64 left = blockIdx.x % across * NORMAL_W, top = blockIdx.x / across * NORMAL_H;
    const float of_all = a.means ? *a.cotangent * a.means[0] : a.scale;
    for (int i = threadIdx.x; i < DH * DW; i += MEAN_THREADS)
        depth[i / DW][i % DW] = depth_at(a, left + i % DW - HALO, top + i / DW - HALO);
    __syncthreads();
    for (int i = threadIdx.x; i < CH * CW; i += MEAN_THREADS) {
        const int cx = i % CW, cy = i / CW;  // depth of this pixel: depth[cy + 1][cx + 1]
        const int64 x = left + cx - 1, y = top + cy - 1, at = y * a.width + x;
        DepthNormalGrad<float> pull = {0.f, 0.f};
        if (x >= 0 && y >= 0 && x < a.width && y < a.height) {
            const Centre c =
                centre_of(a, x, y, depth[cy + 1][cx], depth[cy + 1][cx + 2], depth[cy][cx + 1], depth[cy + 2][cx + 1]);
            const float scale = of_all * weight_at(a, at);
            const float weight = a.per_splat ? -scale : -(scale * c.alpha);
            if (c.defined)
                pull = depth_normal_vjp(c.from_depth, weight * c.rendered, c.offset_x, c.offset_y, a.fx, a.fy);
            if (cx > 0 && cx <= NORMAL_W && cy > 0 && cy <= NORMAL_H) {
                const Vec3<float> n = rotate_back(a.rotation, weight * c.from_depth.direction);
                if (a.g_normal) {
                    a.g_normal[3 * at] = keep(c.defined, n.x), a.g_normal[3 * at + 1] = keep(c.defined, n.y);
                    a.g_normal[3 * at + 2] = keep(c.defined, n.z);
                }
                if (a.g_alpha) a.g_alpha[at] = keep(c.defined && a.per_splat, scale);
            }
        }
        pull_x[cy][cx] = pull.x, pull_y[cy][cx] = pull.y;
    }
    __syncthreads();
    if (!a.g_depth) return;
    for (int i = threadIdx.x; i < NORMAL_H * NORMAL_W; i += MEAN_THREADS) {
        // depth of this pixel: depth[dy + 2][dx + 2]; its pullbacks: pull_*[dy + 1][dx + 1]
        const int dx = i % NORMAL_W, dy = i / NORMAL_W;
        if (left + dx >= a.width || top + dy >= a.height) continue;
        const float from_left = pull_x[dy + 1][dx] * depth[dy + 2][dx],
                    from_right = pull_x[dy + 1][dx + 2] * depth[dy + 2][dx + 4];
        const float from_above = pull_y[dy][dx + 1] * depth[dy][dx + 2],
                    from_below = pull_y[dy + 2][dx + 1] * depth[dy + 4][dx + 2];
        const float gradient = (from_left - from_right) + (from_above - from_below);
        a.g_depth[(top + dy) * a.width + left + dx] = keep(was_hit(depth[dy + 2][dx + 2]), gradient);
    }
}

// A normal and its weight; both are 0 outside the image and at ignored pixels.
struct Smoothed {
    Vec3<float> normal;
    float weight;
};

__device__ __forceinline__ Smoothed smoothed_at(const SmoothArguments& a, int64 x, int64 y) {
    if (x < 0 || y < 0 || x >= a.width || y >= a.height) return {{0.f, 0.f, 0.f}, 0.f};
    const int64 at = y * a.width + x;
    if (a.mask && !a.mask[at]) return {{0.f, 0.f, 0.f}, 0.f};
    return {{a.normal[3 * at], a.normal[3 * at + 1], a.normal[3 * at + 2]},
            a.alpha[at] > 0.5f ? part_of_255(a.flatness[at]) : 0.f};
}

// Computes the smoothness of normals, its gradient, or both.
extern "C" __global__ void __launch_bounds__(128) normal_smoothness(SmoothArguments a) {
    float sums[2] = {0.f, 0.f};
    const float scale = a.means ? *a.cotangent * a.means[0] : a.scale;
    for (int i = 0; i < MEAN_PIXELS; i += MEAN_THREADS) {
        const int64 at = int64(blockIdx.x) * MEAN_PIXELS + i + threadIdx.x;
        if (at >= a.height * a.width) continue;
        const int64 x = at % a.width, y = at / a.width;
        const Smoothed here = smoothed_at(a, x, y);
        const auto pair = [&](int64 x2, int64 y2) {
            const Smoothed there = smoothed_at(a, x2, y2);
            return bend_point(here.normal, there.normal, min(here.weight, there.weight));
        };
        const BendPoint<float> right = pair(x + SMOOTH_REACH, y), below = pair(x, y + SMOOTH_REACH);
        sums[0] = sums[0] + (a.mask && !a.mask[at] ? 0.f : 1.f), sums[1] = sums[1] + (right.value + below.value);
        if (!a.g_normal) continue;
        const BendPoint<float> left = pair(x - SMOOTH_REACH, y), above = pair(x, y - SMOOTH_REACH);
        const Vec3<float> g = scale * ((right.gradient + left.gradient) + (below.gradient + above.gradient));
        float* to = a.g_normal + 3 * at;
        to[0] = (a.adds ? to[0] : 0.f) + g.x, to[1] = (a.adds ? to[1] : 0.f) + g.y;
        to[2] = (a.adds ? to[2] : 0.f) + g.z;
    }
    if (a.partials) leave_sums(sums, a.partials);
}

// Computes the gradient of the mean |alpha - target alpha| over valid pixels; 0 where both are equal.
extern "C" __global__ void __launch_bounds__(128) silhouette_vjp(SilhouetteArguments a) {
    const int64 at = int64(blockIdx.x) * MEAN_THREADS + threadIdx.x;
    if (at >= a.pixels) return;
    const float over = a.alpha[at] - float(a.object[4 * at + 3]) / 255.f;
    const float sign = over > 0.f ? 1.f : over < 0.f ? -1.f : 0.f;
    a.g_alpha[at] = a.mask && !a.mask[at] ? 0.f : a.scale * sign;
}

extern "C" __global__ void __launch_bounds__(128) masked_mean(MeanArguments a) {
    float sums[2] = {0.f, 0.f};
    for (int i = 0; i < MEAN_PIXELS; i += MEAN_THREADS) {
        const int64 at = int64(blockIdx.x) * MEAN_PIXELS + i + threadIdx.x;
        if (at >= a.height * a.width || (a.mask && !a.mask[at])) continue;
        sums[0] = sums[0] + 1.f, sums[1] = sums[1] + a.values[at];
    }
    leave_sums(sums, a.partials);
}

// Runs in a single block.
extern "C" __global__ void __launch_bounds__(128) finish_means(FinishArguments a) {
    __shared__ double sums[MEAN_THREADS];
    double count = 1., raw_count = 0.;
    for (int row = 0; row <= a.values; ++row) {
        double mine = 0.;
        for (int64 i = threadIdx.x; i < a.blocks; i += MEAN_THREADS) mine += double(a.partials[row * a.blocks + i]);
        sums[threadIdx.x] = mine;
        __syncthreads();
        for (int half = MEAN_THREADS / 2; half > 0; half >>= 1) {
            if (int(threadIdx.x) < half) sums[threadIdx.x] += sums[threadIdx.x + half];
            __syncthreads();
        }
        const double total = sums[0];
        __syncthreads();
        if (row == 0) raw_count = total, count = total > 0. ? total : 1.;
        if (threadIdx.x == 0)
            a.means[row] = float(row == 0 ? 1. / count : (a.complement ? raw_count - total : total) / count);
    }
}

}  // namespace gs2d
