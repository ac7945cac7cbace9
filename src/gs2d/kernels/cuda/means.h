// Means in a fixed order: each block writes partial sums, and a final block adds them (finish_means in losses.cu).
#pragma once

#include "cuda/common.h"

namespace gs2d {

constexpr int MEAN_THREADS = 128;

// Sums N values over the block and writes them to partials[n * blocks + this block]. All threads must call it.
template <int N> __device__ __forceinline__ void leave_sums(float (&values)[N], float* partials) {
    __shared__ float of_warps[N][MEAN_THREADS / 32];
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
#pragma unroll
    for (int n = 0; n < N; ++n) {
#pragma unroll
        for (int step = 16; step > 0; step >>= 1) values[n] = values[n] + __shfl_xor_sync(FULL_MASK, values[n], step);
        if (lane == 0) of_warps[n][warp] = values[n];
    }
    __syncthreads();
    if (threadIdx.x < N) {
        float total = 0.f;
        for (int w = 0; w < MEAN_THREADS / 32; ++w) total = total + of_warps[threadIdx.x][w];
        partials[int64(threadIdx.x) * gridDim.x + blockIdx.x] = total;
    }
}

}  // namespace gs2d
