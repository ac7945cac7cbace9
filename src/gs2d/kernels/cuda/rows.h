// Transfers the rows of a warp's splats through shared memory: adjacent lanes move 16 bytes each. A lane that read its
// own row would touch a cache line for every 4 bytes.
#pragma once

#include "cuda/common.h"

namespace gs2d {

constexpr int WARP_ROWS = 32;
constexpr int MAX_ROW = 45;  // floats: SH of degree 3 without the first coefficient

template <class T> __device__ __forceinline__ bool is_aligned(const void* at) {
    return reinterpret_cast<unsigned long long>(at) % sizeof(T) == 0;
}

// Returns whether four floats are part of a selected row. They belong to at most two rows, since a row has at least
// three floats.
__device__ __forceinline__ bool any_wanted(uint wanted, int first_float, int length) {
    const int first = first_float / length, last = (first_float + 3) / length;
    return (wanted >> first | wanted >> (last < WARP_ROWS ? last : first)) & 1u;
}

// Loads the rows from `begin` whose bit is set into `rows` [32 * length]; others may be skipped. All lanes must call
// it.
__device__ __forceinline__ void load_rows(const float* from, int64 begin, int count, int length, uint wanted, int lane,
                                          float* rows) {
    const float* source = from + begin * length;
    const int floats = count * length, quads = is_aligned<float4>(source) ? floats / 4 : 0;
#pragma unroll 4
    for (int q = lane; q < quads; q += WARP_ROWS)
        if (any_wanted(wanted, 4 * q, length))
            reinterpret_cast<float4*>(rows)[q] = reinterpret_cast<const float4*>(source)[q];
#pragma unroll 1
    for (int k = 4 * quads + lane; k < floats; k += WARP_ROWS) rows[k] = source[k];
    __syncwarp();
}

// Stores all rows. All lanes must call it.
__device__ __forceinline__ void store_rows(float* to, int64 begin, int count, int length, int lane,
                                           const float* rows) {
    float* target = to + begin * length;
    const int floats = count * length, quads = is_aligned<float4>(target) ? floats / 4 : 0;
    __syncwarp();
#pragma unroll 4
    for (int q = lane; q < quads; q += WARP_ROWS)
        reinterpret_cast<float4*>(target)[q] = reinterpret_cast<const float4*>(rows)[q];
#pragma unroll 1
    for (int k = 4 * quads + lane; k < floats; k += WARP_ROWS) target[k] = rows[k];
    __syncwarp();
}

// Loads or stores one row of two or four floats.
__device__ __forceinline__ float2 row_of_2(const float* from, int64 i) {
    if (is_aligned<float2>(from)) return reinterpret_cast<const float2*>(from)[i];
    return {from[2 * i], from[2 * i + 1]};
}
__device__ __forceinline__ float4 row_of_4(const float* from, int64 i) {
    if (is_aligned<float4>(from)) return reinterpret_cast<const float4*>(from)[i];
    return {from[4 * i], from[4 * i + 1], from[4 * i + 2], from[4 * i + 3]};
}

}  // namespace gs2d
