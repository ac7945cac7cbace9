// A pool of sleeping threads. No OpenMP: its threads spin, and torch has a pool of its own in the same process.
//
// parallel_for(n, f) calls f(i) once for each i in [0, n), on the calling thread and the pool, in no fixed order. For
// results that do not depend on the number of threads, cut the work into a number of pieces that does not depend on it
// either, let piece i write only what belongs to i, and reduce in order afterwards.
#pragma once

#include <cstdint>

namespace gs2d {

void set_threads(int n);  // at least 1; the calling thread is one of them
int get_threads();

using Task = void (*)(void* context, int64_t i);
void run_tasks(int64_t n, Task task, void* context);

template <class F> void parallel_for(int64_t n, F&& f) {
    run_tasks(n, [](void* context, int64_t i) { (*static_cast<F*>(context))(i); }, &f);
}

// Cuts [0, n) into pieces of at most `grain` and calls f(begin, end) for each.
template <class F> void parallel_ranges(int64_t n, int64_t grain, F&& f) {
    parallel_for((n + grain - 1) / grain, [&](int64_t i) {
        const int64_t begin = i * grain, end = begin + grain < n ? begin + grain : n;
        f(begin, end);
    });
}

}  // namespace gs2d
