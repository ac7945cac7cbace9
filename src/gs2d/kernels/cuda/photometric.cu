// L1, SSIM and L2 of an image [H, W, 3], and their gradient: two passes with a map of three derivatives between them.
//
// A row of W interleaved pixels has 3 W reals, and the window taps are 3 reals apart, so channels need no planes. A
// block moves down a strip of 128 reals. Each row passes through shared memory once, is blurred horizontally, and is
// added to 11 running sums in registers, so the vertical blur reads no memory. Output rows are complete 5 rows behind
// the input.
#include "core/losses.h"
#include "cuda/means.h"

namespace gs2d {

constexpr int STRIP = MEAN_THREADS, STRIP_ROWS = 32;              // reals and rows per block; same in cuda_losses.py
constexpr int SIDE = 3 * SSIM_RADIUS, STAGED = STRIP + 2 * SIDE;  // reals of a row that a block reads

// A decoded image [H, W, 3 or 4] instead of `target`, in the variants `rgb` and `rgba`.
struct Photograph {
    const uchar* bytes;
    float background[3];  // composited behind alpha
};

struct PhotometricArguments {
    int64 height, width;
    const float *rendered, *target;  // [H, W, 3]
    const uchar* mask;               // [H, W], 0 = ignore; or null
    float* maps;                     // [3, H, W, 3]: derivatives of SSIM with respect to the blurred moments; or null
    float* partials;                 // [4, blocks]: valid reals, L1, SSIM, L2; or null
    Photograph photograph;
};

struct PhotometricVjpArguments {
    int64 height, width;
    const float *rendered, *target;
    const uchar* mask;
    const float *maps, *means;   // means[0] = 1 / valid reals; null if the scales below are set
    const float *g_l1, *g_ssim, *g_l2;  // cotangents of the values, or null
    float* gradient;                    // [H, W, 3]
    Photograph photograph;
    float l1_scale, ssim_scale, l2_scale;  // cotangents / valid reals
};

// Part of a thread: one column of reals, STRIP_ROWS rows.
struct Strip {
    int64 n, height;  // reals of a row, rows
    int64 first, column, begin, end;
    __device__ __forceinline__ Strip(int64 height, int64 width) : n(3 * width), height(height) {
        const int64 across = (n + STRIP - 1) / STRIP;
        first = blockIdx.x % across * STRIP, column = first + threadIdx.x;
        begin = blockIdx.x / across * STRIP_ROWS, end = begin + STRIP_ROWS < height ? begin + STRIP_ROWS : height;
    }
    __device__ __forceinline__ bool mine() const { return column < n; }
    __device__ __forceinline__ bool has_row(int64 y) const { return y >= 0 && y < height; }
};

// Up to two reals of each of MAPS rows in transit to shared memory: a row is read while the previous row is processed.
template <int MAPS> struct Staging {
    float value[2][MAPS];
    // Calls read(column, value) for reals inside the image; elsewhere the values are 0.
    template <class Read> __device__ __forceinline__ void load(const Strip& s, int64 y, Read read) {
#pragma unroll
        for (int part = 0; part < 2; ++part) {
            const int i = int(threadIdx.x) + part * STRIP;
            const int64 column = s.first - SIDE + i;
#pragma unroll
            for (int m = 0; m < MAPS; ++m) value[part][m] = 0.f;
            if (i < STAGED && s.has_row(y) && column >= 0 && column < s.n) read(column, value[part]);
        }
    }
    __device__ __forceinline__ void store(float (*to)[STAGED]) const {
#pragma unroll
        for (int part = 0; part < 2; ++part) {
            const int i = int(threadIdx.x) + part * STRIP;
            if (i < STAGED)
                for (int m = 0; m < MAPS; ++m) to[m][i] = value[part][m];
        }
    }
};

__device__ __forceinline__ float window_weight(int k) { return float(SSIM_WINDOW[k < 0 ? -k : k]); }  // k = -5..5

// Adds rows one by one; after row y, `done` is the window over rows y - 10 .. y.
struct RunningBlur {
    float sums[SSIM_TAPS] = {};
    __device__ __forceinline__ void add(float row) {
#pragma unroll
        for (int j = 0; j < SSIM_TAPS; ++j) {
            const float before = j + 1 < SSIM_TAPS ? sums[j + 1] : 0.f;
            sums[j] = fma(window_weight(SSIM_RADIUS - j), row, before);
        }
    }
    __device__ __forceinline__ float done() const { return sums[0]; }
};

// Applies the horizontal window to a staged row, at the real of this thread.
__device__ __forceinline__ float blur_row(const float* row) {
    float sum = 0.f;
#pragma unroll
    for (int k = -SSIM_RADIUS; k <= SSIM_RADIUS; ++k)
        sum = fma(window_weight(k), row[int(threadIdx.x) + SIDE + 3 * k], sum);
    return sum;
}

__device__ __forceinline__ bool is_valid(const uchar* mask, int64 y, int64 width, int64 column) {
    return !mask || mask[y * width + column / 3];
}

// Reads a real of the target: a float (CHANNELS = 0), or composited from CHANNELS bytes per pixel.
template <int CHANNELS, class Arguments>
__device__ __forceinline__ float target_of(const Arguments& a, int64 y, int64 column) {
    if constexpr (CHANNELS == 0) return a.target[y * 3 * a.width + column];
    const Photograph& from = a.photograph;
    if constexpr (CHANNELS == 3) return part_of_255(from.bytes[y * 3 * a.width + column]);
    const int64 x = column / 3;
    const int channel = int(column - 3 * x);
    const uchar* pixel = from.bytes + 4 * (y * a.width + x);
    // constant indices, since dynamic indexing would copy the arguments to local memory
    const float behind = channel == 0 ? from.background[0] : channel == 1 ? from.background[1] : from.background[2];
    return (part_of_255(pixel[channel]) - behind) * part_of_255(pixel[3]) + behind;
}

template <int CHANNELS> __device__ __forceinline__ void photometric(const PhotometricArguments& a) {
    __shared__ float rows[2][2][STAGED];
    const Strip s(a.height, a.width);
    const auto read = [&](int64 y) {
        return [&a, &s, y](int64 column, float* value) {
            value[1] = target_of<CHANNELS>(a, y, column);
            value[0] = is_valid(a.mask, y, a.width, column) ? a.rendered[y * s.n + column] : value[1];
        };
    };
    RunningBlur mean, squares, product, target_mean;
    Staging<2> next;
    float sums[4] = {0.f, 0.f, 0.f, 0.f};  // valid reals, L1, SSIM, L2
    next.load(s, s.begin - SSIM_RADIUS, read(s.begin - SSIM_RADIUS));
    for (int64 y = s.begin - SSIM_RADIUS; y < s.end + SSIM_RADIUS; ++y) {
        float (*row)[STAGED] = rows[y & 1];
        next.store(row);
        __syncthreads();  // also ensures that the buffer of the next row is free
        next.load(s, y + 1, read(y + 1));
        float m = 0.f, q = 0.f, p = 0.f;
#pragma unroll
        for (int k = -SSIM_RADIUS; k <= SSIM_RADIUS; ++k) {
            const int i = int(threadIdx.x) + SIDE + 3 * k;
            const float u = row[0][i], v = row[1][i], wu = window_weight(k) * u, wv = window_weight(k) * v;
            m = m + wu, q = fma(wu, u, fma(wv, v, q)), p = fma(wu, v, p);
        }
        mean.add(m), squares.add(q), product.add(p);
        target_mean.add(blur_row(row[1]));
        const float u = row[0][threadIdx.x + SIDE], v = row[1][threadIdx.x + SIDE];
        if (s.mine() && y >= s.begin && y < s.end) {
            sums[1] = sums[1] + abs(u - v);
            if constexpr (CHANNELS == 0) sums[3] = fma(u - v, u - v, sums[3]);  // not used for bytes
        }
        const int64 out = y - SSIM_RADIUS, at = out * s.n + s.column;
        if (out < s.begin || !s.mine()) continue;
        const SsimPoint<float> point = ssim_point(mean.done(), target_mean.done(), squares.done(), product.done());
        const bool valid = is_valid(a.mask, out, a.width, s.column);
        sums[0] = sums[0] + float(valid), sums[2] = sums[2] + keep(valid, point.value);
        if (!a.maps) continue;
        const int64 plane = s.height * s.n;
        a.maps[at] = keep(valid, point.d_mean);
        a.maps[plane + at] = keep(valid, point.d_squares);
        a.maps[2 * plane + at] = keep(valid, point.d_product);
    }
    if (a.partials) leave_sums(sums, a.partials);  // uniform over the grid
}

extern "C" __global__ void __launch_bounds__(128) photometric_forward(PhotometricArguments a) { photometric<0>(a); }
extern "C" __global__ void __launch_bounds__(128) photometric_forward_rgb(PhotometricArguments a) { photometric<3>(a); }
extern "C" __global__ void __launch_bounds__(128) photometric_forward_rgba(PhotometricArguments a) {
    photometric<4>(a);
}

// dL/dx = B(d_mean) + 2 x B(d_squares) + y B(d_product) for SSIM, the sign of x - y for L1, 2 (x - y) for L2.
template <int CHANNELS> __device__ __forceinline__ void gradient_of(const PhotometricVjpArguments& a) {
    __shared__ float rows[2][3][STAGED];
    const Strip s(a.height, a.width);
    const int64 plane = s.height * s.n;
    float l1_scale = a.l1_scale, ssim_scale = a.ssim_scale, l2_scale = a.l2_scale;
    if (a.means) {
        const auto scale = [&a](const float* cotangent) { return cotangent ? *cotangent * a.means[0] : 0.f; };
        l1_scale = scale(a.g_l1), ssim_scale = scale(a.g_ssim), l2_scale = scale(a.g_l2);
    }
    const auto read = [&](int64 y) {
        return [&a, &s, plane, y](int64 column, float* value) {
            for (int m = 0; m < 3; ++m) value[m] = a.maps[m * plane + y * s.n + column];
        };
    };
    RunningBlur blurred[3];
    Staging<3> next;
    next.load(s, s.begin - SSIM_RADIUS, read(s.begin - SSIM_RADIUS));
    for (int64 y = s.begin - SSIM_RADIUS; y < s.end + SSIM_RADIUS; ++y) {
        float (*row)[STAGED] = rows[y & 1];
        next.store(row);
        __syncthreads();
        next.load(s, y + 1, read(y + 1));
#pragma unroll
        for (int m = 0; m < 3; ++m) blurred[m].add(blur_row(row[m]));
        const int64 out = y - SSIM_RADIUS, at = out * s.n + s.column;
        if (out < s.begin || !s.mine()) continue;
        float g = 0.f;
        if (is_valid(a.mask, out, a.width, s.column)) {
            const float u = a.rendered[at], v = target_of<CHANNELS>(a, out, s.column);
            const float ssim = fma(2.f * u, blurred[1].done(), fma(v, blurred[2].done(), blurred[0].done()));
            g = fma(ssim_scale, ssim, fma(l2_scale, l2_slope(u, v), l1_scale * l1_sign(u, v)));
        }
        a.gradient[at] = g;
    }
}

extern "C" __global__ void __launch_bounds__(128) photometric_vjp(PhotometricVjpArguments a) { gradient_of<0>(a); }
extern "C" __global__ void __launch_bounds__(128) photometric_vjp_rgb(PhotometricVjpArguments a) { gradient_of<3>(a); }
extern "C" __global__ void __launch_bounds__(128) photometric_vjp_rgba(PhotometricVjpArguments a) { gradient_of<4>(a); }

}  // namespace gs2d
