#include "cpu/threads.h"

#include <pthread.h>
#include <time.h>

#include <atomic>

#include "cpu/export.h"

namespace gs2d_shared {
namespace {

constexpr int MAX_THREADS = 256;
constexpr int64_t LOOK_NS = 50000;

struct Pool {
    pthread_mutex_t run_lock = PTHREAD_MUTEX_INITIALIZER;  // one parallel_for at a time
    // guards everything below; busy and job are also read without it
    pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
    pthread_cond_t wake = PTHREAD_COND_INITIALIZER, done = PTHREAD_COND_INITIALIZER;
    int wanted = 1;            // requested threads, including the caller
    int started = 0;           // pool threads alive
    int seats = 0;             // pool threads that may still join the current job
    std::atomic<int> busy{0};  // pool threads inside the job
    std::atomic<uint64_t> job{0};
    Task task = nullptr;
    void* context = nullptr;
    int64_t count = 0;
    std::atomic<int64_t> next{0};
};

Pool pool;
thread_local bool inside = false;
thread_local int number = 0;

// How long a thread spins before it sleeps. Jobs follow within microseconds, and waking a thread takes tens of
// microseconds. Longer spinning would take cores from torch's threads.
template <class F> void look_for(F&& ready) {
    timespec start, now;
    clock_gettime(CLOCK_MONOTONIC, &start);
    do {
        for (int n = 0; n < 64; ++n) {
            if (ready()) return;
#if defined(__x86_64__)
            __builtin_ia32_pause();
#endif
        }
        clock_gettime(CLOCK_MONOTONIC, &now);
    } while ((now.tv_sec - start.tv_sec) * 1000000000 + now.tv_nsec - start.tv_nsec < LOOK_NS);
}

void work(Task task, void* context, int64_t count) {
    for (int64_t i; (i = pool.next.fetch_add(1, std::memory_order_relaxed)) < count;) task(context, i);
}

void* thread_main(void* started) {
    inside = true;
    number = static_cast<int>(reinterpret_cast<intptr_t>(started));
    uint64_t seen = 0;
    pthread_mutex_lock(&pool.lock);
    for (;;) {
        while (pool.seats == 0 || pool.job == seen) pthread_cond_wait(&pool.wake, &pool.lock);
        seen = pool.job;
        --pool.seats;
        ++pool.busy;
        const Task task = pool.task;
        void* const context = pool.context;
        const int64_t count = pool.count;
        pthread_mutex_unlock(&pool.lock);
        work(task, context, count);
        pthread_mutex_lock(&pool.lock);
        if (--pool.busy == 0) pthread_cond_signal(&pool.done);
        pthread_mutex_unlock(&pool.lock);
        look_for([&] { return pool.job.load(std::memory_order_relaxed) != seen; });
        pthread_mutex_lock(&pool.lock);
    }
    return nullptr;
}

// A forked child has only the forking thread, so it starts with an empty pool and fresh locks.
void after_fork() {
    pthread_mutex_init(&pool.run_lock, nullptr);
    pthread_mutex_init(&pool.lock, nullptr);
    pthread_cond_init(&pool.wake, nullptr);
    pthread_cond_init(&pool.done, nullptr);
    pool.started = pool.seats = 0;
    pool.busy = 0;
    inside = false;
    number = 0;
}

void start_missing(int needed) {  // call with pool.lock held
    if (pool.started == 0) {
        static bool registered = false;
        if (!registered) pthread_atfork(nullptr, nullptr, after_fork);
        registered = true;
    }
    for (; pool.started < needed; ++pool.started) {
        pthread_t thread;
        void* const its_number = reinterpret_cast<void*>(intptr_t(pool.started + 1));
        if (pthread_create(&thread, nullptr, thread_main, its_number) != 0) break;  // fewer threads, same result
        pthread_detach(thread);
    }
}

}  // namespace

void set_threads(int n) {
    pthread_mutex_lock(&pool.lock);
    pool.wanted = n < 1 ? 1 : n > MAX_THREADS ? MAX_THREADS : n;
    pthread_mutex_unlock(&pool.lock);
}

int get_threads() {
    pthread_mutex_lock(&pool.lock);
    const int n = pool.wanted;
    pthread_mutex_unlock(&pool.lock);
    return n;
}

int thread_number() { return number; }

void run_tasks(int64_t n, Task task, void* context) {
    const int helpers = static_cast<int>(n - 1 < get_threads() - 1 ? n - 1 : get_threads() - 1);
    if (helpers <= 0 || inside) {  // a nested parallel_for runs on the calling thread
        for (int64_t i = 0; i < n; ++i) task(context, i);
        return;
    }
    pthread_mutex_lock(&pool.run_lock);
    pthread_mutex_lock(&pool.lock);
    start_missing(helpers);
    pool.task = task;
    pool.context = context;
    pool.count = n;
    pool.next.store(0, std::memory_order_relaxed);
    pool.seats = helpers;
    ++pool.job;
    pthread_cond_broadcast(&pool.wake);
    pthread_mutex_unlock(&pool.lock);
    inside = true;
    work(task, context, n);
    inside = false;
    pthread_mutex_lock(&pool.lock);
    pool.seats = 0;  // no thread joins from now on
    pthread_mutex_unlock(&pool.lock);
    look_for([] { return pool.busy.load(std::memory_order_relaxed) == 0; });
    pthread_mutex_lock(&pool.lock);
    while (pool.busy > 0) pthread_cond_wait(&pool.done, &pool.lock);
    pthread_mutex_unlock(&pool.lock);
    pthread_mutex_unlock(&pool.run_lock);
}

}  // namespace gs2d_shared

GS2D_EXPORT void gs2d_set_threads(int n) { gs2d::set_threads(n); }
GS2D_EXPORT int gs2d_get_threads() { return gs2d::get_threads(); }
