// A pool of sleeping threads. OpenMP is not used: its threads spin, and torch has its own pool in the process.
//
// parallel_for(n, f) calls f(i) once for each i in [0, n), on the calling thread and the pool, in no fixed order. For
// results that do not depend on the number of threads, use a fixed number of pieces, let piece i write only its own
// output, and reduce in order afterwards.
#pragma once

#include <atomic>
#include <cstdint>

namespace gs2d_shared {  // by the rasterizers of both kinds of cameras

void set_threads(int n);  // at least 1; the calling thread is one of them
int get_threads();
int thread_number();  // of the calling thread, constant while it lives: 1, 2, ... in the pool, 0 for all other threads

using Task = void (*)(void* context, int64_t i);
void run_tasks(int64_t n, Task task, void* context);

template <class F> void parallel_for(int64_t n, F&& f) {
    run_tasks(n, [](void* context, int64_t i) { (*static_cast<F*>(context))(i); }, &f);
}

// Splits [0, n) into pieces of at most `grain` and calls f(begin, end) for each.
template <class F> void parallel_ranges(int64_t n, int64_t grain, F&& f) {
    parallel_for((n + grain - 1) / grain, [&](int64_t i) {
        const int64_t begin = i * grain, end = begin + grain < n ? begin + grain : n;
        f(begin, end);
    });
}

// Called on every thread of a parallel_for: distributes the pieces [first, end), whose flags are 0. Piece i goes to
// thread i % get_threads() as long as that thread keeps up. On CPUs whose cores do not share a cache, data that a
// thread wrote for a piece in one pass is then in its cache in the next pass. Threads that have finished help the
// others, starting with the last piece.
template <class F> void share_out(int64_t first, int64_t end, std::atomic<uint8_t>* taken, F&& f) {
    const int64_t threads = get_threads(), me = thread_number() % threads;
    const auto take = [&](int64_t i) {
        if (!taken[i].load(std::memory_order_relaxed) && !taken[i].exchange(1, std::memory_order_relaxed)) f(i);
    };
    const auto first_of = [&](int64_t thread) { return first + (thread + threads - first % threads) % threads; };
    for (int64_t i = first_of(me); i < end; i += threads) take(i);
    for (int64_t k = 1; k < threads; ++k) {
        const int64_t begin = first_of((me + k) % threads);
        if (begin >= end) continue;
        for (int64_t i = begin + (end - 1 - begin) / threads * threads; i >= begin; i -= threads) take(i);
    }
}

}  // namespace gs2d_shared
namespace gs2d {
using namespace gs2d_shared;
}
