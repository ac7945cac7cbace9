// Kernels for the tests of the emulator: correct ones, and ones with faults that it must detect.
struct Ints {
    const int* in;
    int* out;
};
struct Floats {
    const float* in;
    float* out;
};

extern "C" __global__ void add_thread_index(Ints a) {
    const int i = int(blockIdx.x * blockDim.x + threadIdx.x);
    a.out[i] = a.in[i] + int(threadIdx.x);
}

extern "C" __global__ void reverse_block(Ints a) {
    __shared__ int values[64];
    values[threadIdx.x] = a.in[blockIdx.x * 64 + threadIdx.x];
    __syncthreads();
    a.out[blockIdx.x * 64 + threadIdx.x] = values[63 - threadIdx.x];
}

extern "C" __global__ void reverse_block_without_barrier(Ints a) {
    __shared__ int values[64];
    values[threadIdx.x] = a.in[blockIdx.x * 64 + threadIdx.x];
    a.out[blockIdx.x * 64 + threadIdx.x] = values[63 - threadIdx.x];
}

extern "C" __global__ void reverse_block_behind_a_vote(Ints a) {  // a warp barrier where a block barrier is needed
    __shared__ int values[64];
    values[threadIdx.x] = a.in[blockIdx.x * 64 + threadIdx.x];
    __any_sync(0xffffffffu, 1);
    a.out[blockIdx.x * 64 + threadIdx.x] = values[63 - threadIdx.x];
}

extern "C" __global__ void warp_collectives(Ints a) {
    const int v = a.in[threadIdx.x];
    int sum = v;
    for (int step = 16; step > 0; step >>= 1) sum += __shfl_xor_sync(0xffffffffu, sum, step);
    const unsigned odd = __ballot_sync(0xffffffffu, v & 1);
    const int any = __any_sync(0xffffffffu, v < 0);
    int* out = a.out + 3 * threadIdx.x;
    out[0] = sum, out[1] = int(odd), out[2] = any;
}

extern "C" __global__ void count_with_atomics(Ints a) { atomicAdd(a.out + a.in[blockIdx.x * blockDim.x + threadIdx.x], 1); }

extern "C" __global__ void read_unwritten_shared(Floats a) {
    __shared__ float values[32];
    a.out[threadIdx.x] = values[threadIdx.x];
    __syncwarp();
    values[threadIdx.x] = a.in[threadIdx.x];
}

template <int N> __device__ __forceinline__ void leave_unwritten_shared(Floats a) {
    __shared__ float values[N];
    a.out[threadIdx.x] = values[threadIdx.x];
    __syncwarp();
    values[threadIdx.x] = a.in[threadIdx.x];
}
extern "C" __global__ void read_unwritten_shared_of_a_template(Floats a) {
    __shared__ float values[32];  // in addition to that of the template
    values[threadIdx.x] = 0.f;
    leave_unwritten_shared<32>(a);
    a.out[threadIdx.x] += values[threadIdx.x];
}

extern "C" __global__ void collective_in_a_branch(Ints a) {
    if (threadIdx.x % 2) a.out[threadIdx.x] = __any_sync(0xffffffffu, a.in[threadIdx.x]);
}

extern "C" __global__ void different_collectives(Ints a) {
    if (threadIdx.x < 16)
        a.out[threadIdx.x] = __any_sync(0xffffffffu, a.in[threadIdx.x]);
    else
        a.out[threadIdx.x] = int(__ballot_sync(0xffffffffu, a.in[threadIdx.x]));
}

extern "C" __global__ void partial_mask(Ints a) { a.out[threadIdx.x] = __any_sync(0xffffu, a.in[threadIdx.x]); }

extern "C" __global__ void barrier_of_one_warp(Ints a) {
    if (threadIdx.x < 32) __syncthreads();
    a.out[threadIdx.x] = 1;
}

extern "C" __global__ void warps_that_part(Ints a) {  // warps vote different numbers of times, and one exits early
    const int warp = int(threadIdx.x >> 5);
    if (warp == 2) return;
    int votes = 0;
    for (int i = 0; i < a.in[warp]; ++i) {
        votes += __popc(__ballot_sync(0xffffffffu, int(threadIdx.x & 31) <= i));
        if (i == 2) continue;
        __syncwarp();
    }
    int sum = int(threadIdx.x);
    for (int step = 16; step > 0; step >>= 1) sum += __shfl_xor_sync(0xffffffffu, sum, step);
    a.out[2 * threadIdx.x] = votes, a.out[2 * threadIdx.x + 1] = sum;
}
