// Sums over a warp.
#pragma once

#include "cuda/common.h"

namespace gs2d {

// Sums N = 16, 4 or 2 values over the warp by exchange: in each step a lane keeps half of the values. Lane l returns
// the sum of value l / (32 / N).
template <int N, int STEP = 16> __device__ __forceinline__ float transpose_reduce(float* v, int lane) {
    if constexpr (N == 1) {
#pragma unroll
        for (int step = STEP; step > 0; step >>= 1) v[0] = v[0] + __shfl_xor_sync(FULL_MASK, v[0], step);
        return v[0];
    } else {
        const bool upper = lane & STEP;
#pragma unroll
        for (int k = 0; k < N / 2; ++k) {
            const float kept = upper ? v[k + N / 2] : v[k], given = upper ? v[k] : v[k + N / 2];
            v[k] = kept + __shfl_xor_sync(FULL_MASK, given, STEP);
        }
        return transpose_reduce<N / 2, STEP / 2>(v, lane);
    }
}

__device__ __forceinline__ float sum_over_warp(float v) { return transpose_reduce<1>(&v, 0); }

}  // namespace gs2d
