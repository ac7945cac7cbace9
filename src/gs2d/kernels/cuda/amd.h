// The vocabulary of CUDA for AMD's compilers (hiprtc, or clang alone), which reads this before every source. All of it lies in
// our namespace, where it hides what the compiler brings of the same name: versions of ROCm differ in masks and types.
//
// A warp of ours is 32 lanes on every GPU. GS2D_WAVE is how many the hardware runs together: 32 (RDNA), or 64 (CDNA, GCN),
// which are two warps. Where these part, one is silent in the other's ballots; each looks at its own half alone. Exchanges
// never leave a half. The tests run this in waves of 64, divergent ones too (tests/helpers/emulator.h, GS2D_EMULATED).
#pragma once

#define GS2D_AMD 1

#if !defined(GS2D_EMULATED)
#undef __global__
#undef __device__
#undef __host__
#undef __shared__
#undef __forceinline__
#undef __launch_bounds__
#define __global__ __attribute__((global))
#define __device__ __attribute__((device))
#define __host__ __attribute__((host))
#define __shared__ __attribute__((shared))
#define __forceinline__ inline __attribute__((always_inline))
// Here a second number would be waves for each SIMD, not blocks for each multiprocessor; registers are no scarcer for it.
#define __launch_bounds__(threads, ...) __attribute__((amdgpu_flat_work_group_size(1, threads)))
#endif

namespace gs2d {

#if !defined(GS2D_EMULATED)
struct alignas(8) float2 {
    float x, y;
};
struct alignas(16) float4 {
    float x, y, z, w;
};

#define GS2D_INDEX(name, value)                                                                 \
    struct name##_type {                                                                        \
        struct {                                                                                \
            __device__ __forceinline__ operator unsigned int() const { return value; }          \
        } x;                                                                                    \
    };                                                                                          \
    extern const __device__ __attribute__((weak)) name##_type name;
GS2D_INDEX(threadIdx, __builtin_amdgcn_workitem_id_x())
GS2D_INDEX(blockIdx, __builtin_amdgcn_workgroup_id_x())
GS2D_INDEX(blockDim, __builtin_amdgcn_workgroup_size_x())
GS2D_INDEX(gridDim, __builtin_amdgcn_grid_size_x() / __builtin_amdgcn_workgroup_size_x())
#undef GS2D_INDEX

// What the lanes of a wave do together; `line` is that of the call, for the tests.
__device__ __forceinline__ unsigned long long wave_ballot(bool mine, int) {
#if !__has_builtin(__builtin_amdgcn_ballot_w64)  // ROCm 5
    return __builtin_amdgcn_uicmp(mine, 0u, 33);   // 33: not equal
#elif GS2D_WAVE == 64
    return __builtin_amdgcn_ballot_w64(mine);
#else
    return __builtin_amdgcn_ballot_w32(mine);
#endif
}
// The value of another lane of the same 32; the pattern is a constant of the instruction.
template <int PATTERN> __device__ __forceinline__ int wave_swizzle(int value, int) {
    return __builtin_amdgcn_ds_swizzle(value, PATTERN);
}
// Lanes of a wave go in step; only the compiler must not carry memory across.
__device__ __forceinline__ void wave_sync(int) {
    __builtin_amdgcn_fence(__ATOMIC_RELEASE, "wavefront");
    __builtin_amdgcn_wave_barrier();
    __builtin_amdgcn_fence(__ATOMIC_ACQUIRE, "wavefront");
}
__device__ __forceinline__ void __syncthreads() {
    __builtin_amdgcn_fence(__ATOMIC_RELEASE, "workgroup");
    __builtin_amdgcn_s_barrier();
    __builtin_amdgcn_fence(__ATOMIC_ACQUIRE, "workgroup");
}

// With -munsafe-fp-atomics an instruction where there is one: torch's memory lies on the device.
template <class T> __device__ __forceinline__ T atomicAdd(T* at, T value) {
    return __hip_atomic_fetch_add(at, value, __ATOMIC_RELAXED, __HIP_MEMORY_SCOPE_AGENT);
}
__device__ __forceinline__ int __popc(unsigned int bits) { return __builtin_popcount(bits); }
__device__ __forceinline__ int __ffs(int bits) { return __builtin_ffs(bits); }
__device__ __forceinline__ int __float_as_int(float value) { return __builtin_bit_cast(int, value); }
#else
using emulator::wave_ballot;
using emulator::wave_swizzle;
using emulator::wave_sync;
#endif

// CUDA's collectives of a warp, always with the full mask.
#define GS2D_LINE int line = __builtin_LINE()
__device__ __forceinline__ unsigned int __ballot_sync(unsigned int, int mine, GS2D_LINE) {
    const unsigned long long wave = wave_ballot(mine != 0, line);
#if GS2D_WAVE == 64
    return static_cast<unsigned int>(wave >> (threadIdx.x & 32u));
#else
    return static_cast<unsigned int>(wave);
#endif
}
__device__ __forceinline__ int __any_sync(unsigned int mask, int mine, GS2D_LINE) {
    return __ballot_sync(mask, mine, line) != 0u;
}
// lanes: 1, 2, 4, 8 or 16, a constant once loops are unrolled. Pattern: xor << 10 | and, of the five bits of a lane.
template <class T> __device__ __forceinline__ T __shfl_xor_sync(unsigned int, T value, int lanes, GS2D_LINE) {
    static_assert(sizeof(T) == 4, "an exchange is of 32 bits");
    int bits, found;
    __builtin_memcpy(&bits, &value, 4);
    switch (lanes) {
        case 1: found = wave_swizzle<1 << 10 | 31>(bits, line); break;
        case 2: found = wave_swizzle<2 << 10 | 31>(bits, line); break;
        case 4: found = wave_swizzle<4 << 10 | 31>(bits, line); break;
        case 8: found = wave_swizzle<8 << 10 | 31>(bits, line); break;
        default: found = wave_swizzle<16 << 10 | 31>(bits, line);
    }
    T out;
    __builtin_memcpy(&out, &found, 4);
    return out;
}
__device__ __forceinline__ void __syncwarp(unsigned int = 0xffffffffu, GS2D_LINE) { wave_sync(line); }
#undef GS2D_LINE

}  // namespace gs2d
