// Deterministic gradients: instead of adding to a splat's record, each warp writes to its own slot (blend_vjp.cu with
// `slots`), and the slots of a splat, which are consecutive, are summed here in a fixed order.
#include "cuda/common.h"

namespace gs2d {

struct SlotArguments {
    int64 count;
    int64 candidates;    // number with slots; pairs beyond the capacity were dropped
    const int64* order;  // [N]: splats by depth
    // [N]: running sum of candidates in depth order; each candidate has four slots, one per warp of a tile
    const int64* ends;
    const float *slots, *extra_slots;  // [4 * candidates, 16] or null, [4 * candidates, 4]
    float *gradients, *extras;         // [N, 16] or null, [N, 4]
    const float* feature_slots;        // [4 * candidates, channels] or null
    float* features;                   // [N, channels]
    int64 channels;
};

// One warp per splat. A lane sums the slots of the same tile warps over all tiles. Slots of tiles without the splat are
// 0, and adding 0 is exact.
extern "C" __global__ void __launch_bounds__(128) sum_slots(SlotArguments a) {
    const int64 place = (int64(blockIdx.x) * blockDim.x + threadIdx.x) >> 5;
    const int lane = threadIdx.x & 31;
    if (place >= a.count) return;  // uniform over the warp
    const int64 splat = a.order[place], end = a.ends[place] < a.candidates ? a.ends[place] : a.candidates;
    const int64 first = place > 0 ? 4 * a.ends[place - 1] : 0, last = 4 * end;
    float sum = 0.f, extra = 0.f;
    for (int64 row = first + (lane >> 4); a.slots && row < last; row += 2) sum = sum + a.slots[16 * row + (lane & 15)];
    for (int64 row = first + (lane >> 2); lane < 16 && row < last; row += 4)
        extra = extra + a.extra_slots[4 * row + (lane & 3)];
    sum = sum + __shfl_xor_sync(FULL_MASK, sum, 16);
#pragma unroll
    for (int step = 8; step >= 4; step >>= 1) extra = extra + __shfl_xor_sync(FULL_MASK, extra, step);
    if (lane < 16 && a.gradients) a.gradients[16 * splat + lane] = sum;
    if (lane < 4) a.extras[4 * splat + lane] = extra;
    for (int64 c = lane; a.feature_slots && c < a.channels; c += 32) {
        float feature = 0.f;
        for (int64 row = first; row < last; ++row) feature = feature + a.feature_slots[a.channels * row + c];
        a.features[a.channels * splat + c] = feature;
    }
}

}  // namespace gs2d
