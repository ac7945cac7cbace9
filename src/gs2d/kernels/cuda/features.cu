// Blending of further channels, in addition to the splat colour: a second pass over the used entries recomputes the
// weights, for groups of channels whose sums fit in registers.
#include "cuda/pixels.h"

namespace gs2d {

struct FeatureArguments {
    View view;
    const float* records;
    const uint* entries;
    const int64* ranges;
    const int* tiles;
    const uint* seen;
    const float* final_T;
    Features features;
};

constexpr int PART = 4 * CHANNELS;

extern "C" __global__ void __launch_bounds__(128, 4) features_forward(FeatureArguments a) {
    __shared__ float4 staged[4][4][32];  // warp, quarter of a record, entry
    __shared__ uint rows[4][32];
    const Place at = place_of(a.view, a.tiles);
    float4(*records)[32] = staged[at.warp];
    const BlendLimits<float> limits = limits_of(a.view);
    const float x = float(at.x) + 0.5f, y = float(at.y) + 0.5f;
    const int64 begin = a.ranges[2 * int64(at.tile)], pixels = int64(a.view.width) * a.view.height;
    const int entries = int(a.ranges[2 * int64(at.tile) + 1] - begin);
    for (int64 first = 0; first < a.features.count; first += PART) {
        const int channels = a.features.count - first < PART ? int(a.features.count - first) : PART;
        float T[HALVES] = {at.inside[0] ? 1.f : 0.f, at.inside[1] ? 1.f : 0.f};
        float sums[HALVES][PART] = {};
        for (int chunk = 0; 32 * chunk < entries; ++chunk) {
            const uint* words = a.seen + word_of(begin, at.tile, chunk);
            const uint hits[HALVES] = {uniform(words[at.sub_block[0]], at.lane),
                                       uniform(words[at.sub_block[1]], at.lane)};
            const uint wanted = hits[0] | hits[1];
            if (wanted == 0u) continue;  // uniform over the warp
            bool mine_is_plain = false;
            if (wanted >> at.lane & 1u) {
                rows[at.warp][at.lane] = a.entries[begin + 32 * chunk + at.lane] >> 8;
                fetch_record(a.records, rows[at.warp][at.lane], records, at.lane);
                mine_is_plain = plain_for_warp(a.view, at, records);
            }
            const uint plain = __ballot_sync(FULL_MASK, mine_is_plain);
            __syncwarp();
            for_each_splat(wanted, plain, [&](auto is_plain, int j, uint bit) {
                const Record<float> s = record_of(records[0][j], records[1][j], records[2][j], records[3][j]);
                const float dx = x - s.cx, dy = y - s.cy;
                PlaneAt<float> planes[HALVES];
                planes_of(s, dx, dy, planes);
                float w[HALVES] = {0.f, 0.f};
#pragma unroll
                for (int h = 0; h < HALVES; ++h)
                    if (hits[h] & bit)  // uniform over the warp
                        w[h] = pass_weight(hit_of<decltype(is_plain)::value>(s, planes[h], dx, dy + float(4 * h), limits),
                                           limits, T[h]);
                const float* values = a.features.values + int64(rows[at.warp][j]) * a.features.count + first;
#pragma unroll
                for (int k = 0; k < PART; k += 4) {
                    if (k >= channels) continue;
                    const float4 v = *reinterpret_cast<const float4*>(values + k);
#pragma unroll
                    for (int h = 0; h < HALVES; ++h) {
                        float* sum = sums[h] + k;
                        sum[0] = fma(w[h], v.x, sum[0]), sum[1] = fma(w[h], v.y, sum[1]);
                        sum[2] = fma(w[h], v.z, sum[2]), sum[3] = fma(w[h], v.w, sum[3]);
                    }
                }
            });
            __syncwarp();  // the records are overwritten in the next iteration
        }
#pragma unroll
        for (int h = 0; h < HALVES; ++h) {
            if (!at.inside[h]) continue;
            const int64 i = int64(at.y + 4 * h) * a.view.width + at.x;
#pragma unroll
            for (int k = 0; k < PART; ++k)
                if (k < channels)
                    a.features.images[(first + k) * pixels + i] =
                        fma(a.final_T[i], a.features.background[first + k], sums[h][k]);
        }
    }
}

}  // namespace gs2d
