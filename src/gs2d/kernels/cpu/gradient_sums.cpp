#include "cpu/gradient_sums.h"

namespace gs2d {
namespace {

constexpr int64_t LEAST_SLOTS = 4096;  // minimum of a chunk, if the view has as many
constexpr int BATCH = 256;             // entries per batch of slots to add

// The coefficient gradients are written last, so their memory holds the sums until then.
bool fits_in_coefficients(const ParameterGradients& out, int64_t sh_rest) { return out.shN && 3 * sh_rest >= GRADIENT; }

}  // namespace

bool GradientSums::prepare() {
    Frame& f = f_;
    if (!f.slot_begin.reserve(f.tiles + 1)) return false;
    parallel_ranges(f.tiles, 64, [&](int64_t first, int64_t last) {
        for (int64_t t = first; t < last; ++t) {
            int64_t slots = f.tile_count[t];
            if (out_.rows) {
                const Entry* const entries = &f.entries[f.tile_begin[t]];
                slots = 0;
                for (int32_t i = 0; i < f.tile_count[t]; ++i) slots += out_.rows[entries[i].splat()] != 0;
            }
            f.slot_begin[t + 1] = slots;
        }
    });
    f.slot_begin[0] = 0;
    for (int64_t t = 0; t < f.tiles; ++t) f.slot_begin[t + 1] += f.slot_begin[t];
    // Two consecutive chunks have more than LEAST_SLOTS slots.
    const int64_t most = f.slot_begin[f.tiles] / (LEAST_SLOTS / 2);
    if (!f.chunks.reserve((most < f.tiles ? most : f.tiles) + 3)) return false;
    cut_into_chunks();
    f.sums = {out_.shN, out_.probe, out_.probe ? static_cast<int>(out_.probe_columns) : 0, 3 * sh_rest_};
    if (!fits_in_coefficients(out_, sh_rest_)) {
        if (!f.own_sums.reserve(f.count * GRADIENT)) return false;
        f.sums.data = f.own_sums.data, f.sums.coefficient_row = 0;
    }
    parallel_ranges(f.count, 2048, [&](int64_t first, int64_t last) {
        memset(f.sums.row(first), 0, (last - first) * GRADIENT * sizeof(real));
        if (f.sums.columns) memset(f.sums.extra(first), 0, (last - first) * f.sums.columns * sizeof(real));
        if (!features_) return;
        const int64_t F = features_->count;
        memset(features_->gradients + first * F, 0, (last - first) * F * sizeof(real));
    });
    return f.scratch.reserve(2 * chunk_bytes());
}

// A chunk has as many slots as fit twice into the memory of the forward pass. Large chunks reduce waiting for
// interrupted threads.
void GradientSums::cut_into_chunks() {
    Frame& f = f_;
    const int64_t room = static_cast<int64_t>(forward_scratch(f.count) / (2 * slot_bytes()));
    const int64_t limit = room > LEAST_SLOTS ? room : LEAST_SLOTS;
    f.largest_chunk = chunks_ = 0;
    f.chunks[0].first_tile = f.chunks[0].first_slot = 0;
    for (int64_t g = 1; g <= f.groups(); ++g) {
        const int64_t t = g * GROUP < f.tiles ? g * GROUP : f.tiles, next = t + GROUP < f.tiles ? t + GROUP : f.tiles;
        const int64_t slots = f.slot_begin[t] - f.chunks[chunks_].first_slot;
        if (t < f.tiles && f.slot_begin[next] - f.chunks[chunks_].first_slot <= limit) continue;
        if (slots > f.largest_chunk) f.largest_chunk = slots;
        ++chunks_;
        f.chunks[chunks_].first_tile = t, f.chunks[chunks_].first_slot = f.slot_begin[t];
    }
    threads_ = get_threads();
    for (parts_ = 1; parts_ < static_cast<uint32_t>(threads_) && parts_ < 16;) parts_ *= 2;
    for (int64_t c = 0; c <= chunks_; ++c) {
        GradientChunk& chunk = f.chunks[c];
        chunk.groups_left.store(c < chunks_ ? first_group(c + 1) - first_group(c) : 0, std::memory_order_relaxed);
        chunk.sums_left.store(parts_, std::memory_order_relaxed);
        chunk.next_part.store(0, std::memory_order_relaxed);
    }
    memset(static_cast<void*>(f.taken.data), 0, f.groups());
}

Slots GradientSums::slots(int64_t c) const {
    if (!out_.probe) return {gradients(c), nullptr, nullptr};
    real* const extras = feature_slots(c) + f_.largest_chunk * feature_row();
    return {gradients(c), extras, reinterpret_cast<uint8_t*>(extras + f_.largest_chunk * GRADIENT_EXTRA)};
}

void GradientSums::add(int64_t c, uint32_t part) const {
    constexpr int VECTORS = GRADIENT / LANES, AHEAD = 8;
    const Frame& f = f_;
    const Slots from = slots(c);
    uint32_t splats[BATCH + AHEAD] = {};
    int64_t slots[BATCH];
    int64_t slot = 0;
    for (int64_t tile = f.chunks[c].first_tile; tile < f.chunks[c + 1].first_tile; ++tile) {
        const Entry* const entries = &f.entries[f.tile_begin[tile]];
        for (int32_t begin = 0; begin < f.tile_count[tile]; begin += BATCH) {
            const int32_t end = begin + BATCH < f.tile_count[tile] ? begin + BATCH : f.tile_count[tile];
            int count = 0;
            for (int32_t i = begin; i < end; ++i) {
                const uint32_t splat = entries[i].splat();
                const bool has_slot = !out_.rows || out_.rows[splat];
                splats[count] = splat, slots[count] = slot;
                count += has_slot && (splat >> 4 & (parts_ - 1)) == part;
                slot += has_slot;
            }
            for (int i = 0; i < count; ++i) {
                __builtin_prefetch(f.sums.row(splats[i + AHEAD]), 1);
                real* const row = f.sums.row(splats[i]);
                const Slots s = from.from(slots[i]);
                for (int k = 0; k < VECTORS; ++k)
                    store(row + k * LANES, load(row + k * LANES) + load(s.gradients + k * LANES));
                if (s.extras && *s.has_extra)
                    for (int k = 0; k < f.sums.columns; ++k) f.sums.extra(splats[i])[k] += s.extras[k];
            }
            for (int i = 0; features_ && i < count; ++i) {
                real* const row = features_->gradients + splats[i] * features_->count;
                const real* const slot_row = feature_slots(c) + slots[i] * feature_row();
                for (int64_t k = 0; k < features_->count; ++k) row[k] += slot_row[k];
            }
        }
    }
}

}  // namespace gs2d
