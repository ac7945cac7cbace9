// Gradients of splat records. Each (tile, splat) pair writes its own slot, and the slots of a splat are added in tile
// order. Only the slots of two chunks of tiles are in memory: while one chunk is blended, the slots of the previous
// chunk are added. The order of these additions depends neither on the chunk size nor on the number of threads.
#pragma once

#include <sched.h>

#include "cpu/features.h"
#include "cpu/frame.h"
#include "cpu/threads.h"

namespace gs2d {

// Consecutive slots. `extras` and `has_extra` are null without a densification signal; its parts are then added in.
struct Slots {
    real* gradients;     // [slots, GRADIENT]
    real* extras;        // [slots, GRADIENT_EXTRA], only where has_extra
    uint8_t* has_extra;  // [slots]
    Slots from(int64_t slot) const {
        return {gradients + slot * GRADIENT, extras ? extras + slot * GRADIENT_EXTRA : nullptr,
                extras ? has_extra + slot : nullptr};
    }
};

class GradientSums {
  public:
    GradientSums(Frame& frame, int64_t sh_rest, const ParameterGradients& out, const Features* features)
        : f_(frame), out_(out), features_(features), sh_rest_(sh_rest) {}

    // Splits the tiles into chunks and sets f.sums to 0; returns false if out of memory.
    bool prepare();

    // Calls blend(tile, next, slots, feature_slots, piece) for each tile with slots, on all threads, and adds the slots
    // to f.sums and to the feature gradients. `next` is the tile that this thread probably blends next; it may not
    // exist. `piece` < get_threads() differs between concurrent calls. Every thread processes the chunks in order: it
    // blends groups of chunk c until all are taken, then adds parts of chunk c - 1 until all are taken. It waits only
    // for work in progress on another thread.
    template <class F> void for_each_tile(F&& blend) {
        parallel_for(threads_, [&](int64_t piece) {
            for (int64_t c = 0; c <= chunks_; ++c) {
                if (c < chunks_)
                    share_out(first_group(c), first_group(c + 1), f_.taken.data,
                              [&](int64_t group) { blend_group(c, group, piece, blend); });
                if (c > 0) add_parts(c - 1);
            }
        });
    }

  private:
    Frame& f_;
    const ParameterGradients& out_;
    const Features* const features_;  // or null
    const int64_t sh_rest_;
    int64_t chunks_ = 0, threads_ = 1;
    uint32_t parts_ = 1;  // number of parts in which a chunk is added, each for a subset of the splats; a power of two

    // chunks contain whole groups
    int64_t first_group(int64_t c) const { return (f_.chunks[c].first_tile + GROUP - 1) / GROUP; }
    int64_t tile_slots(int64_t tile) const { return f_.slot_begin[tile + 1] - f_.slot_begin[tile]; }
    void cut_into_chunks();
    int64_t feature_row() const { return features_ ? feature_rows(features_->count) : 0; }
    size_t slot_bytes() const {
        return (GRADIENT + feature_row()) * sizeof(real) + (out_.probe ? GRADIENT_EXTRA * sizeof(real) + 1 : 0);
    }
    size_t chunk_bytes() const { return (size_t(f_.largest_chunk) * slot_bytes() + LINE - 1) / LINE * LINE; }
    real* gradients(int64_t c) const { return reinterpret_cast<real*>(f_.scratch.data + (c % 2) * chunk_bytes()); }
    // [slots, feature_row()]
    real* feature_slots(int64_t c) const { return gradients(c) + f_.largest_chunk * GRADIENT; }
    Slots slots(int64_t c) const;
    void add(int64_t c, uint32_t part) const;

    template <class F> void blend_group(int64_t c, int64_t group, int64_t piece, F&& blend) {
        if (c >= 2) wait_for(f_.chunks[c - 2].sums_left);  // the memory of its slots is reused
        const int64_t first = group * GROUP, last = first + GROUP - 1;
        for (int64_t tile = first; tile <= last && tile < f_.tiles; ++tile) {
            const int64_t next = tile == last ? tile + 1 + (threads_ - 1) * GROUP : tile + 1;
            if (tile_slots(tile) == 0) continue;
            const int64_t slot = f_.slot_begin[tile] - f_.chunks[c].first_slot;
            blend(tile, next, slots(c).from(slot), feature_slots(c) + slot * feature_row(), piece);
        }
        f_.chunks[c].groups_left.fetch_sub(1, std::memory_order_release);
    }

    void add_parts(int64_t c) {
        GradientChunk& chunk = f_.chunks[c];
        for (int64_t part; (part = chunk.next_part.fetch_add(1, std::memory_order_relaxed)) < parts_;) {
            wait_for(chunk.groups_left);
            if (c >= 1) wait_for(f_.chunks[c - 1].sums_left);  // the slots of a splat are added in order
            add(c, static_cast<uint32_t>(part));
            chunk.sums_left.fetch_sub(1, std::memory_order_release);
        }
    }

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
