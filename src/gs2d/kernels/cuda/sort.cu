// Stable radix sort of keys with payloads, and prefix sums, for training iterations without torch operations.
//
// Each pass sorts by eight bits and reads each key once ("onesweep": Adinets and Merrill, 2022). One launch counts the
// digits of all passes. In a pass, a block takes the next piece of the keys by a ticket, ranks the keys and publishes
// its count of each digit. Then it sums the counts of earlier pieces, going back until one has published its inclusive
// prefix sum ("decoupled look-back": Merrill and Garland, 2016). A number and its kind share one word, so no memory
// ordering is required. A piece waits only for earlier tickets, whose blocks are already running.
#include "cuda/common.h"

namespace gs2d {

constexpr int SORT_THREADS = 256, SORT_ITEMS = 8, DIGITS = 256, MOST_PASSES = 4;  // same in sort.py
constexpr int PIECE = SORT_THREADS * SORT_ITEMS, SORT_WARPS = SORT_THREADS / 32, WARP_ITEMS = 32 * SORT_ITEMS;
// Kinds of a word: empty; the piece's own number; sum of the numbers up to and including the piece.
constexpr uint OWN = 1u << 30, SUM = 2u << 30, NUMBER = OWN - 1u;

struct ClearArguments {
    float4* words;  // aligned to 16 bytes
    int64 count;    // number of float4
};

struct DigitArguments {
    const void* keys;  // [count] uint16 or uint32
    int64 count;
    int passes;
    uint* digits;  // [MOST_PASSES, DIGITS]; zeros on entry
};

struct SortArguments {
    const void* keys;
    const uint* payloads;  // null: the payload is the index of the key
    void* sorted_keys;     // null: not written
    uint* sorted_payloads;
    int64 count;
    int shift, bits;       // position and width of the digit
    const uint* digits;    // [DIGITS]: number of keys with each digit
    uint *ticket, *words;  // [pieces, DIGITS]; both are zeros on entry
};

struct RunningArguments {
    const uint* order;        // [count]: splats in depth order
    const int* tile_counts;   // [splats]
    int64 count, room;        // room: capacity for pairs
    uint* ends;               // [count]: prefix sum in depth order
    uint *ticket, *words;     // [pieces]; both are zeros on entry
    int64* pairs;             // [1]: total number of pairs, in host memory
    int* overflow;            // [1]: 1 if the total exceeds the capacity
};

extern "C" __global__ void __launch_bounds__(256) clear_words(ClearArguments a) {
    const int64 step = int64(gridDim.x) * blockDim.x;
    for (int64 i = int64(blockIdx.x) * blockDim.x + threadIdx.x; i < a.count; i += step)
        a.words[i] = {0.f, 0.f, 0.f, 0.f};
}

__device__ __forceinline__ void publish(uint* word, uint value) { *static_cast<volatile uint*>(word) = value; }

// Waits until the word of a piece is published and returns it.
__device__ __forceinline__ uint said(const uint* word) {
    uint value;
    do value = *static_cast<const volatile uint*>(word);
    while (value < OWN);
    return value;
}

// Adds with saturation: any number above the largest capacity is equivalent.
__device__ __forceinline__ uint saturated(uint a, uint b) {
    const uint sum = a + b;  // both below 2^30, so no overflow
    return sum < NUMBER ? sum : NUMBER;
}

// Returns the next piece; all threads get the same value.
__device__ __forceinline__ int64 next_piece(uint* ticket) {
    __shared__ uint piece;
    if (threadIdx.x == 0) piece = atomicAdd(ticket, 1u);
    __syncthreads();
    return int64(piece);
}

// Replaces each thread's numbers (below 2^30) by their exclusive prefix sums over the block. All threads call it.
template <int N> __device__ __forceinline__ void sums_before(uint (&numbers)[N], uint (*shared)[SORT_THREADS]) {
    const int own = threadIdx.x;
    for (int n = 0; n < N; ++n) shared[n][own] = numbers[n];
    __syncthreads();
    for (int step = 1; step < SORT_THREADS; step <<= 1) {
        uint before[N];
        for (int n = 0; n < N; ++n) before[n] = own >= step ? shared[n][own - step] : 0u;
        __syncthreads();
        for (int n = 0; n < N; ++n) shared[n][own] = saturated(shared[n][own], before[n]);
        __syncthreads();
    }
    for (int n = 0; n < N; ++n) numbers[n] = own > 0 ? shared[n][own - 1] : 0u;
}

template <class Key> __device__ __forceinline__ void count_digits(const DigitArguments& a) {
    __shared__ uint counts[MOST_PASSES][DIGITS];
    for (int p = 0; p < MOST_PASSES; ++p) counts[p][threadIdx.x] = 0u;
    __syncthreads();
    const Key* keys = static_cast<const Key*>(a.keys);
    const int64 step = int64(gridDim.x) * SORT_THREADS;
    for (int64 i = int64(blockIdx.x) * SORT_THREADS + threadIdx.x; i < a.count; i += step) {
        const uint key = keys[i];
        for (int p = 0; p < a.passes; ++p) atomicAdd(&counts[p][key >> 8 * p & 255u], 1u);
    }
    __syncthreads();
    for (int p = 0; p < a.passes; ++p) {
        const uint count = counts[p][threadIdx.x];
        if (count) atomicAdd(&a.digits[DIGITS * p + threadIdx.x], count);
    }
}

// Returns the lanes that have the same digit.
__device__ __forceinline__ uint peers_of(uint digit, int bits) {
    uint peers = FULL_MASK;
#pragma unroll
    for (int b = 0; b < 8; ++b) {
        if (b >= bits) break;  // uniform over the grid
        const uint set = __ballot_sync(FULL_MASK, digit >> b & 1u);
        peers &= digit >> b & 1u ? set : ~set;
    }
    return peers;
}

template <class Key> struct SortShared {
    uint counts[SORT_WARPS][DIGITS];  // per warp; later the number of keys with the digit in earlier warps
    uint sums[2][SORT_THREADS];
    uint starts[DIGITS];    // first position of each digit in the piece
    uint targets[DIGITS];   // global position of the digit's first key, minus starts; modulo 2^32
    Key keys[PIECE];
    uint payloads[PIECE];
};

template <class Key> __device__ __forceinline__ void sort_pass(const SortArguments& a, SortShared<Key>& s) {
    const int lane = threadIdx.x & 31, warp = threadIdx.x >> 5;
    for (int w = 0; w < SORT_WARPS; ++w) s.counts[w][threadIdx.x] = 0u;
    const int64 piece = next_piece(a.ticket), begin = piece * PIECE;
    const int count = a.count - begin < PIECE ? int(a.count - begin) : PIECE;
    const uint mask = (1u << a.bits) - 1u;
    Key keys[SORT_ITEMS];
    uint payloads[SORT_ITEMS], ranks[SORT_ITEMS];
    uint* counts = s.counts[warp];
#pragma unroll
    for (int j = 0; j < SORT_ITEMS; ++j) {
        const int at = WARP_ITEMS * warp + 32 * j + lane;
        const int64 i = begin + at;
        keys[j] = Key(~Key(0)), payloads[j] = uint(i);  // beyond the end: the largest key sorts last
        if (at < count) {
            keys[j] = static_cast<const Key*>(a.keys)[i];
            if (a.payloads) payloads[j] = a.payloads[i];
        }
    }
#pragma unroll
    for (int j = 0; j < SORT_ITEMS; ++j) {
        const uint digit = uint(keys[j]) >> a.shift & mask;
        const uint peers = peers_of(digit, a.bits);
        const int before = __popc(peers & ((1u << lane) - 1u));
        const uint first = counts[digit];
        ranks[j] = first + uint(before);
        __syncwarp();
        if (before == 0) counts[digit] = first + uint(__popc(peers));
        __syncwarp();
    }
    __syncthreads();

    const int own = threadIdx.x;  // one digit per thread
    uint total = 0u;
    for (int w = 0; w < SORT_WARPS; ++w) {
        const uint of_warp = s.counts[w][own];
        s.counts[w][own] = total, total += of_warp;
    }
    uint* words = a.words + DIGITS * piece + own;
    publish(words, piece == 0 ? SUM | total : OWN | total);
    uint before = 0u;
    for (int64 p = piece - 1; p >= 0; --p) {
        const uint word = said(a.words + DIGITS * p + own);
        before += word & NUMBER;
        if (word >= SUM) break;
    }
    if (piece > 0) publish(words, SUM | (before + total));
    uint starts[2] = {total, a.digits[own]};  // counts in the piece, and in total
    sums_before<2>(starts, s.sums);
    s.starts[own] = starts[0], s.targets[own] = starts[1] + before - starts[0];
    __syncthreads();

#pragma unroll
    for (int j = 0; j < SORT_ITEMS; ++j) {
        const uint digit = uint(keys[j]) >> a.shift & mask;
        const uint at = s.starts[digit] + counts[digit] + ranks[j];
        s.keys[at] = keys[j], s.payloads[at] = payloads[j];
    }
    __syncthreads();
    for (int at = threadIdx.x; at < count; at += SORT_THREADS) {
        const Key key = s.keys[at];
        const uint to = s.targets[uint(key) >> a.shift & mask] + uint(at);
        if (a.sorted_keys) static_cast<Key*>(a.sorted_keys)[to] = key;
        a.sorted_payloads[to] = s.payloads[at];
    }
}

// Returns the sum of all earlier pieces, computed by the first warp, 32 pieces at a time.
__device__ __forceinline__ uint sum_before(const uint* words, int64 piece, int lane) {
    uint sum = 0u;
    for (int64 last = piece - 1; last >= 0; last -= 32) {
        const int64 p = last - lane;
        const uint word = p >= 0 ? said(words + p) : SUM;
        const uint ends = __ballot_sync(FULL_MASK, word >= SUM);  // the search ends at the nearest of these
        const int furthest = ends ? __ffs(int(ends)) - 1 : 31;
        uint number = lane <= furthest ? word & NUMBER : 0u;
        const auto exchange = [&](int step) {
            number = saturated(number, __shfl_xor_sync(FULL_MASK, number, step));
        };
        exchange(16), exchange(8), exchange(4), exchange(2), exchange(1);
        sum = saturated(sum, number);
        if (ends) break;
    }
    return sum;
}

// Computes the end of each splat's pairs in depth order; the last piece writes their total number.
extern "C" __global__ void __launch_bounds__(256) running_counts(RunningArguments a) {
    __shared__ uint sums[1][SORT_THREADS];
    __shared__ uint of_piece, before_piece;
    const int64 piece = next_piece(a.ticket), begin = piece * PIECE + SORT_ITEMS * int64(threadIdx.x);
    uint counts[SORT_ITEMS], total[1] = {0u};
#pragma unroll
    for (int j = 0; j < SORT_ITEMS; ++j) {
        counts[j] = begin + j < a.count ? uint(a.tile_counts[a.order[begin + j]]) : 0u;
        total[0] = saturated(total[0], counts[j]);
    }
    const uint mine = total[0];
    sums_before<1>(total, sums);
    if (threadIdx.x == SORT_THREADS - 1) of_piece = saturated(total[0], mine);
    __syncthreads();
    if (threadIdx.x < 32) {
        const int lane = threadIdx.x;
        if (lane == 0) publish(a.words + piece, piece == 0 ? SUM | of_piece : OWN | of_piece);
        const uint before = sum_before(a.words, piece, lane);
        if (lane == 0) {
            before_piece = before;
            if (piece > 0) publish(a.words + piece, SUM | saturated(before, of_piece));
        }
    }
    __syncthreads();
    uint sum = saturated(before_piece, total[0]);
#pragma unroll
    for (int j = 0; j < SORT_ITEMS; ++j) {
        sum = saturated(sum, counts[j]);
        if (begin + j < a.count) a.ends[begin + j] = sum;
    }
    if (begin < a.count && a.count <= begin + SORT_ITEMS) *a.pairs = int64(sum), *a.overflow = int64(sum) > a.room;
}

extern "C" __global__ void __launch_bounds__(256) count_digits_16(DigitArguments a) { count_digits<ushort>(a); }
extern "C" __global__ void __launch_bounds__(256) count_digits_32(DigitArguments a) { count_digits<uint>(a); }
extern "C" __global__ void __launch_bounds__(256) sort_pass_16(SortArguments a) {
    __shared__ SortShared<ushort> shared;
    sort_pass<ushort>(a, shared);
}
extern "C" __global__ void __launch_bounds__(256) sort_pass_32(SortArguments a) {
    __shared__ SortShared<uint> shared;
    sort_pass<uint>(a, shared);
}

}  // namespace gs2d
