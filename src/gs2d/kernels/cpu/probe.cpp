// Measures the current speed of this machine; benchmarks print it with their times.
#include <string.h>
#include <time.h>

#include "cpu/export.h"
#include "cpu/frame.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

double now() {
    timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return double(t.tv_sec) + 1e-9 * double(t.tv_nsec);
}

}  // namespace
}  // namespace gs2d

using namespace gs2d;

// Returns fused multiply-adds per second on all threads, in GFLOP/s (2 per multiply-add and lane). Takes about 10 ms.
GS2D_EXPORT double gs2d_probe_fma() {
    constexpr int CHAINS = 12, STEPS = 1 << 19;
    const int threads = get_threads();
    const double start = now();
    parallel_for(threads, [&](int64_t i) {
        V x[CHAINS];
        for (int k = 0; k < CHAINS; ++k) x[k] = V(real(1) + real(k + i) * real(1e-3));
        const V a = V(real(0.999)), b = V(real(1e-3));
        for (int s = 0; s < STEPS; ++s)
            for (int k = 0; k < CHAINS; ++k) x[k] = fma(x[k], a, b);
        V total = x[0];
        for (int k = 1; k < CHAINS; ++k) total = total + x[k];
        volatile real sink = sum(total);
        (void)sink;
    });
    return 2.0 * CHAINS * STEPS * LANES * threads / (now() - start) * 1e-9;
}

// Returns bytes read and written per second by a 64 MiB copy on all threads, in GB/s; negative if out of memory.
GS2D_EXPORT double gs2d_probe_copy() {
    constexpr size_t SIZE = size_t(64) << 20;
    Buffer<char> from, to;
    double rate = -1;
    if (from.reserve(SIZE) && to.reserve(SIZE)) {
        memset(from.data, 1, SIZE);
        memset(to.data, 2, SIZE);
        const int threads = get_threads();
        const double start = now();
        parallel_for(threads, [&](int64_t i) {
            const size_t begin = SIZE / threads * i, end = i + 1 == threads ? SIZE : SIZE / threads * (i + 1);
            memcpy(to.data + begin, from.data + begin, end - begin);
        });
        rate = 2.0 * SIZE / (now() - start) * 1e-9;
    }
    from.release(), to.release();
    return rate;
}
