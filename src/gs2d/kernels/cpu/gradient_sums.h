// Gradients of records: each (tile, splat) writes its own slot, and the slots of a splat are added in the order of the
// tiles. Only the slots of two chunks of tiles are in memory: while one is blended, those of the one before are added.
// Neither the cut into chunks nor the number of threads changes the order in which a splat's slots are added.
#pragma once

#include <sched.h>

#include "cpu/frame.h"
#include "cpu/threads.h"

namespace gs2d {

// Consecutive slots. `extras` and `has_extra` are null where no densification signal is wanted: its parts are added in.
struct Slots {
    real* gradients;     // [slots, GRADIENT]
    real* extras;        // [slots, GRADIENT_EXTRA], only where has_extra
    uint8_t* has_extra;  // [slots]
    Slots from(int64_t slot) const {
        return {gradients + slot * GRADIENT, extras ? extras + slot * GRADIENT_EXTRA : nullptr, extras ? has_extra + slot : nullptr};
    }
};

class GradientSums {
  public:
    GradientSums(Frame& frame, int64_t sh_rest, const ParameterGradients& out) : f_(frame), out_(out), sh_rest_(sh_rest) {}

    // Cuts the tiles into chunks and sets f.sums to 0; false when memory is short.
    bool prepare();

    // Calls blend(tile, next, slots) for each tile with slots, on all threads, and adds the slots to f.sums. `next` is the
    // tile that this thread will probably blend then; there may be none of that number.
    // Tasks are handed out in order: those that blend chunk 0, chunk 1, those that add chunk 0, those that blend chunk 2 ...
    // Each waits only for tasks before it, which somebody is already working on.
    template <class F> void for_each_tile(F&& blend) {
        parallel_for(tasks_, [&](int64_t task) {
            int64_t c = 0;
            for (int64_t step = chunks_; step > 0; step /= 2)  // the last chunk whose first task is not behind this one
                while (c + step <= chunks_ && f_.chunks[c + step].first_task <= task) c += step;
            const int64_t k = task - f_.chunks[c].first_task, blends = blend_tasks(c);
            if (k >= blends) {
                GradientChunk& chunk = f_.chunks[c - 1];
                wait_for(chunk.tasks_left);
                if (c >= 2) wait_for(f_.chunks[c - 2].sums_left);  // a splat's slots are added in order
                add(c - 1, static_cast<uint32_t>(k - blends));
                chunk.sums_left.fetch_sub(1, std::memory_order_release);
                return;
            }
            if (c >= 2) wait_for(f_.chunks[c - 2].sums_left);  // its slots' memory is used again
            const int64_t end = f_.chunks[c + 1].first_tile, first = f_.chunks[c].first_tile + k * TILES_PER_TASK;
            for (int64_t tile = first; tile < first + TILES_PER_TASK && tile < end; ++tile) {
                const bool last = tile + 1 == first + TILES_PER_TASK;
                const int64_t next = last ? tile + 1 + (threads_ - 1) * TILES_PER_TASK : tile + 1;
                if (tile_slots(tile) > 0) blend(tile, next, slots(c).from(f_.slot_begin[tile] - f_.chunks[c].first_slot));
            }
            f_.chunks[c].tasks_left.fetch_sub(1, std::memory_order_release);
        });
    }

  private:
    static constexpr int64_t TILES_PER_TASK = 4;
    Frame& f_;
    const ParameterGradients& out_;
    const int64_t sh_rest_;
    int64_t chunks_ = 0, tasks_ = 0;
    int64_t threads_ = 1;
    uint32_t parts_ = 1;  // tasks that add a chunk, each some of the splats; a power of two

    int64_t blend_tasks(int64_t c) const {
        if (c == chunks_) return 0;
        return (f_.chunks[c + 1].first_tile - f_.chunks[c].first_tile + TILES_PER_TASK - 1) / TILES_PER_TASK;
    }
    int64_t tile_slots(int64_t tile) const { return f_.slot_begin[tile + 1] - f_.slot_begin[tile]; }
    void cut_into_chunks();
    Slots slots(int64_t c) const;
    void add(int64_t c, uint32_t part) const;

    static void wait_for(const std::atomic<int64_t>& left) {
        for (int n = 0; left.load(std::memory_order_acquire) != 0; ++n) {
#if defined(__x86_64__)
            __builtin_ia32_pause();
#endif
            if (n > 256) sched_yield();
        }
    }
};

}  // namespace gs2d
