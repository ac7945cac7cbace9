// Order in which blocks process tiles: long lists first, so that no long list starts when the others are done. One
// block counts tiles by list length and assigns positions; the order within a bucket does not affect results.
//
// It also cuts lists into pieces (pixels.h) that have at least `shortest` entries, and at least 1 / `most` of all
// entries: lists are long in comparison with the work of a multiprocessor. The lengths do not depend on the capacity,
// which is large enough.
#include "cuda/pixels.h"

namespace gs2d {

constexpr int ORDER_THREADS = 512, BUCKETS = 512, PER_BUCKET = 32;  // entries: a chunk of the blending

struct OrderArguments {
    int64 tiles;
    const int64* ranges;  // [tiles + 1, 2]
    int* order;           // [tiles]
    int64 capacity, shortest, most;  // of the pieces
    int* pieces;                     // as in pixels.h
};

// Returns the bucket of a list, longest first; lists of BUCKETS * PER_BUCKET entries or more share a bucket.
__device__ __forceinline__ int bucket_of(const OrderArguments& a, int64 tile) {
    const int64 chunks = (a.ranges[2 * tile + 1] - a.ranges[2 * tile] + PER_BUCKET - 1) / PER_BUCKET;
    return BUCKETS - 1 - int(chunks < BUCKETS ? chunks : BUCKETS - 1);
}

// Writes the table of the pieces. All threads call it.
__device__ __forceinline__ void cut_lists(const OrderArguments& a) {
    __shared__ int entries, used;
    const int own = threadIdx.x;
    if (own == 0) entries = used = 0;
    __syncthreads();
    int64 mine = 0;
    for (int64 tile = own; tile < a.tiles; tile += ORDER_THREADS) mine += a.ranges[2 * tile + 1] - a.ranges[2 * tile];
    atomicAdd(&entries, int(mine));
    __syncthreads();
    const int64 average = (entries + a.most - 1) / a.most, length = average < a.shortest ? a.shortest : average;
    for (int64 i = own; i < PIECE_ROW * a.capacity; i += ORDER_THREADS) a.pieces[i] = i % PIECE_ROW == 0 ? -1 : 0;
    if (own == 0) a.pieces[PIECE_ROW * a.capacity] = int(length);
    __syncthreads();
    for (int64 tile = own; tile < a.tiles; tile += ORDER_THREADS) {
        const int pieces = pieces_in(a.ranges[2 * tile + 1] - a.ranges[2 * tile], length);
        if (pieces == 1) continue;
        const int first = atomicAdd(&used, pieces);
        for (int i = first; i < first + pieces; ++i)
            a.pieces[PIECE_ROW * i] = int(tile), a.pieces[PIECE_ROW * i + 1] = first;
    }
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
    if (a.capacity > 0) cut_lists(a);
}

}  // namespace gs2d
