// Runs CUDA kernels on the CPU, for tests: blocks one after another, one fiber per thread, switched only at collectives.
//
// Stricter than a GPU: a warp collective needs all 32 lanes of the warp at the same call with the full mask, and a block
// barrier needs every thread. A mismatch is an error that names the lines, never a hang. Shared memory is filled with NaN
// before each block. Between collectives, threads run in ascending, descending or shuffled order. Shuffled, blocks run in
// any order too, and some warps are held back, so that others run ahead as far as barriers allow. A missing barrier changes
// the result of one of these orders. Races between collectives are not found.
#pragma once

#include <link.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <ucontext.h>

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline __attribute__((always_inline))
#define __launch_bounds__(...)
#define __shared__ static thread_local  // not a section: g++ < 14 ignores it in templates, later versions reject it

struct dim3 {
    unsigned x, y, z;
};
struct alignas(8) float2 {
    float x, y;
};
struct alignas(16) float4 {
    float x, y, z, w;
};
inline dim3 threadIdx, blockIdx, blockDim, gridDim;

namespace emulator {

constexpr unsigned WARP = 32, MOST_THREADS = 1024;
constexpr size_t STACK = 128 << 10;
constexpr unsigned FULL = 0xffffffffu;

enum class Op { NONE, BARRIER, SYNC_WARP, BALLOT, ANY, SHUFFLE_XOR };
inline const char* name_of(Op op) {
    static const char* const names[] = {"-", "__syncthreads", "__syncwarp", "__ballot_sync", "__any_sync", "__shfl_xor_sync"};
    return names[static_cast<int>(op)];
}

struct Fiber {
    ucontext_t context;
    void* stack;
    bool runnable, done;
    Op op;  // the collective at which it waits
    int line, operand;
    uint32_t value;
};

inline Fiber fibers[MOST_THREADS];
inline ucontext_t scheduler;
inline unsigned current, threads;
inline char message[512];
inline bool failed;
inline void (*body)(const void*);
inline const void* body_argument;

inline void fail(const char* what, const Fiber& a, unsigned thread_a, const Fiber& b, unsigned thread_b) {
    if (failed) return;
    failed = true;
    const auto where = [](const Fiber& f) { return f.done ? "has returned" : f.op == Op::NONE ? "runs" : name_of(f.op); };
    snprintf(message, sizeof message, "%s in block (%u, %u, %u): thread %u %s (line %d), thread %u %s (line %d)", what, blockIdx.x,
             blockIdx.y, blockIdx.z, thread_a, where(a), a.line, thread_b, where(b), b.line);
}

// Suspends the running thread until the scheduler has completed the collective; returns the thread's `value`.
inline uint32_t wait(Op op, int line, unsigned mask, uint32_t value, int operand) {
    Fiber& f = fibers[current];
    f.op = op, f.line = line, f.value = value, f.operand = operand, f.runnable = false;
    if (mask != FULL) fail("a collective without the full mask", f, current, f, current);
    swapcontext(&f.context, &scheduler);
    return f.value;
}

inline void enter() {
    body(body_argument);
    fibers[current].done = true, fibers[current].runnable = false;
    swapcontext(&fibers[current].context, &scheduler);
}

inline bool together(unsigned first, unsigned count, const char* what) {
    for (unsigned i = first + 1; i < first + count; ++i) {
        const Fiber &a = fibers[first], &b = fibers[i];
        if (a.done != b.done || a.op != b.op || a.line != b.line) {
            fail(what, a, first, b, i);
            return false;
        }
    }
    return true;
}

inline void release(unsigned first, unsigned count) {
    for (unsigned i = first; i < first + count; ++i) fibers[i].op = Op::NONE, fibers[i].runnable = true;
}

enum Order : int { ASCENDING, DESCENDING };  // any other number is the seed of a shuffle

inline int order_of_threads;
inline uint32_t random_state;
inline unsigned random_below(unsigned n) {  // xorshift
    random_state ^= random_state << 13, random_state ^= random_state >> 17, random_state ^= random_state << 5;
    return random_state % n;
}

inline void complete_warp(unsigned first) {
    uint32_t given[WARP], ballot = 0;
    for (unsigned i = 0; i < WARP; ++i) given[i] = fibers[first + i].value, ballot |= uint32_t(given[i] != 0) << i;
    for (unsigned i = 0; i < WARP; ++i) {
        Fiber& f = fibers[first + i];
        if (f.op == Op::BALLOT) f.value = ballot;
        if (f.op == Op::ANY) f.value = ballot != 0;
        if (f.op == Op::SHUFFLE_XOR) f.value = given[(i ^ unsigned(f.operand)) % WARP];
    }
    release(first, WARP);
}

// Called when no thread can continue: completes the collectives that all threads reached. True: the block is finished.
inline bool complete_collectives() {
    bool all_done = true, barrier = true, progress = false;
    for (unsigned i = 0; i < threads; ++i) all_done &= fibers[i].done, barrier &= fibers[i].op == Op::BARRIER;
    if (all_done) return true;
    if (barrier) {
        if (together(0, threads, "different barriers")) release(0, threads);
        return false;
    }
    for (unsigned w = 0; w < threads; w += WARP) {
        if (!together(w, WARP, "a divergent collective")) return false;
        if (fibers[w].done || fibers[w].op == Op::BARRIER) continue;
        progress = true;
        if (fibers[w].op == Op::NONE) continue;  // it has not run yet
        complete_warp(w);
    }
    if (!progress) together(0, threads, "a barrier that not all threads reach");
    return false;
}

inline void shuffle(unsigned* items, unsigned n) {
    for (unsigned i = n; i > 1; --i) {
        const unsigned j = random_below(i), last = items[i - 1];
        items[i - 1] = items[j], items[j] = last;
    }
}

// All shared memory: the thread-local memory of this library in the one thread that runs all fibers.
struct Shared {
    char* begin;
    size_t bytes;
};
inline Shared find_shared() {
    __shared__ char one;  // memory of a thread is made when it is first asked for
    struct Search {
        const char* one;
        Shared found;
    } search = {&one, {nullptr, 0}};
    dl_iterate_phdr(
        [](dl_phdr_info* library, size_t, void* data) {
            Search& s = *static_cast<Search*>(data);
            for (int i = 0; i < library->dlpi_phnum; ++i) {
                const auto& segment = library->dlpi_phdr[i];
                char* const begin = static_cast<char*>(library->dlpi_tls_data);
                if (segment.p_type == PT_TLS && begin && begin <= s.one && s.one < begin + segment.p_memsz)
                    return s.found = {begin, segment.p_memsz}, 1;
            }
            return 0;
        },
        &search);
    return search.found;
}

// Lists the threads in the order in which they run until their next collective; returns their number.
inline unsigned choose_threads(int order, unsigned* chosen) {
    if (order == ASCENDING || order == DESCENDING) {
        for (unsigned k = 0; k < threads; ++k) chosen[k] = order == DESCENDING ? threads - 1 - k : k;
        return threads;
    }
    unsigned n = 0;
    for (unsigned w = 0; w < threads; w += WARP)
        if (random_below(2))
            for (unsigned i = w; i < w + WARP; ++i) chosen[n++] = i;
    shuffle(chosen, n);
    return n;
}

inline void run_block(int order, Shared shared) {
    unsigned chosen[MOST_THREADS];
    memset(shared.begin, 0xff, shared.bytes);
    for (unsigned i = 0; i < threads; ++i) {
        Fiber& f = fibers[i];
        if (!f.stack) f.stack = malloc(STACK);
        getcontext(&f.context);
        f.context.uc_stack.ss_sp = f.stack, f.context.uc_stack.ss_size = STACK, f.context.uc_link = nullptr;
        makecontext(&f.context, enter, 0);
        f.runnable = true, f.done = false, f.op = Op::NONE, f.line = 0;
    }
    do {
        const unsigned n = choose_threads(order, chosen);
        for (unsigned k = 0; k < n; ++k) {
            current = chosen[k];
            if (!fibers[current].runnable) continue;
            threadIdx = {current % blockDim.x, current / blockDim.x, 0};
            swapcontext(&scheduler, &fibers[current].context);
        }
    } while (!failed && !complete_collectives());
}

// Null, or the error, after which the rest of the grid is not run.
template <class A>
const char* launch(void (*kernel)(A), unsigned grid_x, unsigned grid_y, unsigned block_x, int order, const void* arguments) {
    static void (*the_kernel)(A);
    the_kernel = kernel;
    body = [](const void* a) { the_kernel(*static_cast<const A*>(a)); };
    body_argument = arguments;
    threads = block_x, failed = false;
    const Shared shared = find_shared();
    if (!shared.begin) return "the emulator does not find its shared memory";
    if (block_x % WARP || block_x > MOST_THREADS) return "the block must be whole warps, at most 1024 threads";
    gridDim = {grid_x, grid_y, 1}, blockDim = {block_x, 1, 1};
    const unsigned blocks = grid_x * grid_y;
    unsigned* const turns = static_cast<unsigned*>(malloc(blocks * sizeof(unsigned)));
    for (unsigned i = 0; i < blocks; ++i) turns[i] = i;
    order_of_threads = order;
    if (order != ASCENDING && order != DESCENDING) random_state = uint32_t(order), shuffle(turns, blocks);
    for (unsigned i = 0; i < blocks && !failed; ++i) {
        blockIdx = {turns[i] % grid_x, turns[i] / grid_x, 0};
        run_block(order, shared);
    }
    free(turns);
    return failed ? message : nullptr;
}

template <class T> inline uint32_t to_bits(T v) {
    static_assert(sizeof(T) == 4);
    uint32_t b;
    memcpy(&b, &v, 4);
    return b;
}
template <class T> inline T from_bits(uint32_t b) {
    T v;
    memcpy(&v, &b, 4);
    return v;
}

}  // namespace emulator

#define GS2D_LINE int line = __builtin_LINE()
inline void __syncthreads(GS2D_LINE) { emulator::wait(emulator::Op::BARRIER, line, emulator::FULL, 0, 0); }
inline void __syncwarp(unsigned mask = emulator::FULL, GS2D_LINE) { emulator::wait(emulator::Op::SYNC_WARP, line, mask, 0, 0); }
inline unsigned __ballot_sync(unsigned mask, int p, GS2D_LINE) { return emulator::wait(emulator::Op::BALLOT, line, mask, p != 0, 0); }
inline int __any_sync(unsigned mask, int p, GS2D_LINE) { return int(emulator::wait(emulator::Op::ANY, line, mask, p != 0, 0)); }
template <class T> inline T __shfl_xor_sync(unsigned mask, T v, int lanes, GS2D_LINE) {
    return emulator::from_bits<T>(emulator::wait(emulator::Op::SHUFFLE_XOR, line, mask, emulator::to_bits(v), lanes));
}
#undef GS2D_LINE

template <class T> inline T atomicAdd(T* p, T v) {
    const T old = *p;
    *p = old + v;
    return old;
}
inline void __threadfence() {}  // blocks run one after another
inline int __popc(unsigned v) { return __builtin_popcount(v); }
inline int __ffs(int v) { return __builtin_ffs(v); }
inline int __float_as_int(float v) { return emulator::from_bits<int>(emulator::to_bits(v)); }
inline float __int_as_float(int v) { return emulator::from_bits<float>(emulator::to_bits(v)); }

#ifdef EMULATE_APPROXIMATIONS
// The GPU's approximate instructions err by up to 1 (rcp.approx) and 2 (ex2.approx) units in the last place. Here they err
// by that much always, upwards or downwards by the bits of their argument. Preferred to the exact templates of core/base.h.
namespace gs2d {
inline float off_by(float v, int units, float argument) {
    if (!(fabsf(v) > 1e-30f && fabsf(v) < 1e30f)) return v;
    const int sign = (emulator::to_bits(argument) * 2654435761u >> 31) ? 1 : -1;
    return emulator::from_bits<float>(emulator::to_bits(v) + uint32_t(sign * units));
}
inline float exp2_small(float x) { return off_by(exp2f(x), 2, x); }
inline float reciprocal(float a) { return off_by(1.f / a, 1, a); }
inline float quotient(float a, float b) { return a * reciprocal(b); }
}  // namespace gs2d
#endif
