// Instruction rate ceilings of a GPU, the reference for the kernels. Each thread runs 16 independent chains to hide
// latency. The result is written under a condition that never holds, so that the compiler cannot remove the work.
typedef unsigned int uint;
typedef unsigned long long uint64;

struct ProbeArguments {
    float* out;
    uint64 rounds;
    int stride;  // for red: floats between the addresses of neighbouring lanes
    int lanes;   // for red: number of lanes of a warp that add
};

constexpr int CHAINS = 16;
constexpr int FMA_ROUNDS = 16;  // unrolled; the number of rounds is a multiple of this

extern "C" __global__ void __launch_bounds__(128) probe_fma(ProbeArguments a) {
    float v[CHAINS];
    for (int k = 0; k < CHAINS; ++k) v[k] = float(threadIdx.x + k);
    // Counting rounds costs seven instructions: a tenth of the total if done every fourth round.
    for (int i = 0; i < int(a.rounds); i += FMA_ROUNDS)
#pragma unroll
        for (int n = 0; n < FMA_ROUNDS; ++n)
#pragma unroll
            for (int k = 0; k < CHAINS; ++k) v[k] = fmaf(v[k], 0.999f, 0.001f);
    float sum = 0.f;
    for (int k = 0; k < CHAINS; ++k) sum += v[k];
    if (sum == -1.f) a.out[threadIdx.x] = sum;
}

extern "C" __global__ void __launch_bounds__(128) probe_shuffle(ProbeArguments a) {
    float v[CHAINS];
    for (int k = 0; k < CHAINS; ++k) v[k] = float(threadIdx.x + k);
    for (uint64 i = 0; i < a.rounds; ++i)
#pragma unroll
        for (int k = 0; k < CHAINS; ++k) v[k] = __shfl_xor_sync(0xffffffffu, v[k], 1 + k);
    float sum = 0.f;
    for (int k = 0; k < CHAINS; ++k) sum += v[k];
    if (sum == -1.f) a.out[threadIdx.x] = sum;
}

extern "C" __global__ void __launch_bounds__(128) probe_exp2(ProbeArguments a) {
    float v[CHAINS];
    for (int k = 0; k < CHAINS; ++k) v[k] = float(threadIdx.x + k) * 1e-3f;
    for (uint64 i = 0; i < a.rounds; ++i)
#pragma unroll
        for (int k = 0; k < CHAINS; ++k) asm volatile("ex2.approx.ftz.f32 %0, %0;" : "+f"(v[k]));
    float sum = 0.f;
    for (int k = 0; k < CHAINS; ++k) sum += v[k];
    if (sum == -1.f) a.out[threadIdx.x] = sum;
}

// Add to global memory once per warp and round, with `lanes` lanes; blocks are spread over the array.
extern "C" __global__ void __launch_bounds__(128) probe_red(ProbeArguments a) {
    const int lane = threadIdx.x & 31;
    const uint64 warp = (uint64(blockIdx.x) * 128 + threadIdx.x) >> 5;
    for (uint64 i = 0; i < a.rounds; ++i) {
        const uint64 line = (warp * 2654435761ull + i * 40503ull) & ((1ull << 20) - 1);
        if (lane < a.lanes) atomicAdd(a.out + line * 32 + uint64(lane) * a.stride, 1.f);
    }
}
