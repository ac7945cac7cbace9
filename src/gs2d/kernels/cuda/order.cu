// Order in which blocks process tiles: long lists first, so that no long list starts when the others are done. One
// block counts tiles by list length and assigns positions; the order within a bucket does not affect results.
#include "cuda/common.h"

namespace gs2d {

constexpr int ORDER_THREADS = 512, BUCKETS = 512, PER_BUCKET = 32;  // entries: a chunk of the blending

struct OrderArguments {
    int64 tiles;
    const int64* ranges;  // [tiles + 1, 2]
    int* order;           // [tiles]
};

// Returns the bucket of a list, longest first; lists of BUCKETS * PER_BUCKET entries or more share a bucket.
__device__ __forceinline__ int bucket_of(const OrderArguments& a, int64 tile) {
    const int64 chunks = (a.ranges[2 * tile + 1] - a.ranges[2 * tile] + PER_BUCKET - 1) / PER_BUCKET;
    return BUCKETS - 1 - int(chunks < BUCKETS ? chunks : BUCKETS - 1);
}

extern "C" __global__ void __launch_bounds__(512) order_tiles(OrderArguments a) {
    __shared__ int sums[BUCKETS];
    const int own = threadIdx.x;  // one bucket per thread
    sums[own] = 0;
    __syncthreads();
    for (int64 tile = own; tile < a.tiles; tile += ORDER_THREADS) atomicAdd(&sums[bucket_of(a, tile)], 1);
    __syncthreads();
    const int count = sums[own];
    for (int step = 1; step < BUCKETS; step <<= 1) {  // running sums
        const int before = own >= step ? sums[own - step] : 0;
        __syncthreads();
        sums[own] += before;
        __syncthreads();
    }
    const int place = sums[own] - count;
    __syncthreads();
    sums[own] = place;
    __syncthreads();
    for (int64 tile = own; tile < a.tiles; tile += ORDER_THREADS)
        a.order[atomicAdd(&sums[bucket_of(a, tile)], 1)] = int(tile);
}

}  // namespace gs2d
