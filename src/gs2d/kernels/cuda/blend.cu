// Blending, front to back: one block of four warps per 16x16 tile; a warp has 8x8 pixels, a thread two of them.
//
// Warps vote only among their own lanes and never wait for each other. In a chunk of 32 entries, each lane reads one
// entry, the sub-block masks select the splats for the warp, and the selected lanes fetch the records into shared
// memory. A chunk therefore waits for memory only once.
//
// Pieces of a long list are blended at the same time (pixels.h). A first kernel computes the transmittance of each piece
// but the last, so that every piece starts with the transmittance in front of it and stops where the whole list would.
// The warp that finishes the last piece of its pixels adds up the sums of the pieces.
#include "cuda/pixels.h"

namespace gs2d {

struct BlendArguments {
    View view;
    const float* records;  // [N, 16]
    const uint* entries;   // splat << 8 | mask of sub-blocks
    const int64* ranges;   // [tiles + 1, 2]
    const int* tiles;      // [tiles]: tile of each block, or null
    float *color, *alpha, *normal, *depth_mean, *depth_median, *distortion;  // [H, W (, 3)]
    float* final_T;                                                          // [H, W]
    float* moments;  // [H, W, 3]: M1, M2, inverse depth of the first pair; written with the distortion
    // [words, 8] or null: bit j of a word is set if a live pixel of the sub-block uses entry j of the chunk
    uint* seen;
    Pieces pieces;
};

template <bool DIST>
__device__ __forceinline__ void write_pixel(const BlendArguments& a, int x, int y, const Pixel<float>& p) {
    const View& v = a.view;
    const int64 at = int64(y) * v.width + x;
    a.color[3 * at] = fma(p.T, v.background[0], p.red);
    a.color[3 * at + 1] = fma(p.T, v.background[1], p.green);
    a.color[3 * at + 2] = fma(p.T, v.background[2], p.blue);
    a.alpha[at] = p.alpha, a.final_T[at] = p.T;
    a.normal[3 * at] = p.nx, a.normal[3 * at + 1] = p.ny, a.normal[3 * at + 2] = p.nz;
    a.depth_mean[at] = p.alpha > 0.f ? p.depth / p.alpha : 0.f;
    a.depth_median[at] = p.median;
    if constexpr (DIST) {
        a.distortion[at] = p.distortion * v.distortion_scale;
        a.moments[3 * at] = 0.5f * p.M1_twice, a.moments[3 * at + 1] = p.M2, a.moments[3 * at + 2] = p.inverse_depth0;
    }
}

constexpr Pixel<float> FRESH = {1.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, 0.f, true};

// Stores the sums of a piece. The warp that does so last replaces the sums of each piece by those of the pieces in
// front, for the backward pass, and writes the pixels.
template <bool DIST>
__device__ __forceinline__ void finish_piece(const BlendArguments& a, Pixel<float> (&p)[HALVES]) {
#pragma unroll
    for (int h = 0; h < HALVES; ++h)
        for_each_sum<DIST>(p[h], [&](int k, float v) { state_of(a.pieces, blockIdx.x, k, h) = v; });
    __threadfence();
    __syncwarp();
    const Part part = part_of(a.pieces, a.ranges, a.tiles);  // again, which saves registers
    const Place at = place_of(a.view, part.tile);
    int finished = 0;
    if (at.lane == 0) finished = 1 + atomicAdd(a.pieces.table + PIECE_ROW * part.first + 2 + at.warp, 1);
    if (!__any_sync(FULL_MASK, finished == part.pieces)) return;
    __threadfence();
#pragma unroll 1  // saves registers
    for (int h = 0; h < HALVES; ++h) {
        Pixel<float> sum = FRESH;
        for (int piece = part.first; piece < part.first + part.pieces; ++piece) {
            Pixel<float> next = FRESH;
            for_each_sum<DIST>(next, [&](int k, float& v) { v = state_of(a.pieces, piece, k, h); });
            for_each_sum<DIST>(sum, [&](int k, float v) { state_of(a.pieces, piece, k, h) = v; });
            append(next, sum);
        }
        const int y = at.y + 4 * h;
        if (at.x < a.view.width && y < a.view.height) write_pixel<DIST>(a, at.x, y, sum);
    }
}

// ONLY_T: compute the transmittance of the previous piece.
template <bool DIST, bool ONLY_T = false>
__device__ __forceinline__ void blend(const BlendArguments& a, float4 (*records)[32]) {
    const Part part = part_of(a.pieces, a.ranges, a.tiles, ONLY_T);
    if (part.tile < 0) return;
    const Place at = place_of(a.view, part.tile);
    const BlendLimits<float> limits = limits_of(a.view);
    Pixel<float> p[HALVES];
#pragma unroll
    for (int h = 0; h < HALVES; ++h) {
        p[h] = FRESH;
        if (!ONLY_T) p[h].T = in_front(a.pieces, part, h, limits.transmittance_min);
        p[h].live = at.inside[h] && p[h].T > 0.f;
    }
    const float x = float(at.x) + 0.5f, y = float(at.y) + 0.5f;
    const int begin = part.begin, count = part.count;

    int chunk = 0;
    for (; 32 * chunk < count; ++chunk) {
        const int i = 32 * chunk + at.lane;
        const uint entry = i < count ? a.entries[begin + i] : 0u;
        uint hits[HALVES];  // uniform over the warp
#pragma unroll
        for (int h = 0; h < HALVES; ++h) {
            const bool live = __any_sync(FULL_MASK, p[h].live);
            const uint touched = __ballot_sync(FULL_MASK, entry >> at.sub_block[h] & 1u);
            hits[h] = live ? touched : 0u;
        }
        if (!__any_sync(FULL_MASK, p[0].live || p[1].live)) break;
        const uint wanted = hits[0] | hits[1];
        bool mine_is_plain = false;
        if (wanted >> at.lane & 1u) {
            fetch_record(a.records, entry >> 8, records, at.lane);
            mine_is_plain = plain_for_warp(a.view, at, records);
        }
        const uint plain = __ballot_sync(FULL_MASK, mine_is_plain);
        __syncwarp();
        uint seen[HALVES] = {0u, 0u};
        for_each_splat(wanted, plain, [&](auto is_plain, int j, uint bit) {
            const Record<float> s = record_of(records[0][j], records[1][j], records[2][j], records[3][j]);
            const float dx = x - s.cx, dy = y - s.cy;
            PlaneAt<float> planes[HALVES];
            planes_of(s, dx, dy, planes);
#pragma unroll
            for (int h = 0; h < HALVES; ++h) {
                if (!(hits[h] & bit)) continue;  // uniform over the warp
                const Hit<float> hit = hit_of<decltype(is_plain)::value>(s, planes[h], dx, dy + float(4 * h), limits);
                if constexpr (ONLY_T) {
                    pass_weight(hit, limits, p[h].T);
                    p[h].live = p[h].T > 0.f;
                } else {
                    const bool saw = composite(s, hit.alpha, hit.depth, hit.inverse_depth, limits, p[h]);
                    seen[h] |= saw ? bit : 0u;
                }
            }
        });
        __syncwarp();  // the records are overwritten in the next iteration
        if (!ONLY_T && a.seen) {
            const int64 words = word_of(begin, part.tile, chunk);
#pragma unroll
            for (int h = 0; h < HALVES; ++h) {
                const uint word = or_over_warp(seen[h]);
                if (at.lane == 0) a.seen[words + at.sub_block[h]] = word;
            }
        }
    }
    if constexpr (ONLY_T) {
#pragma unroll
        for (int h = 0; h < HALVES; ++h) state_of(a.pieces, blockIdx.x, 0, h) = p[h].T;
        return;
    }
    if (a.seen)  // no pixel uses entries behind the last live one
        for (chunk += at.lane; 32 * chunk < count; chunk += 32)
#pragma unroll
            for (int h = 0; h < HALVES; ++h) a.seen[word_of(begin, part.tile, chunk) + at.sub_block[h]] = 0u;
    if (blockIdx.x < a.pieces.capacity) return finish_piece<DIST>(a, p);
#pragma unroll
    for (int h = 0; h < HALVES; ++h)
        if (at.inside[h]) write_pixel<DIST>(a, at.x, at.y + 4 * h, p[h]);
}

// Minimum blocks per multiprocessor: 8 would leave 64 registers per thread, with which sm_75 and sm_80 spill. With the
// distortion, sm_120 spills at 72.
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ < 800
constexpr int BLOCKS = 6, BLOCKS_DISTORTION = 5;
#elif defined(__CUDA_ARCH__) && __CUDA_ARCH__ == 800
constexpr int BLOCKS = 7, BLOCKS_DISTORTION = 6;
#elif defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 1200
constexpr int BLOCKS = 8, BLOCKS_DISTORTION = 6;
#else
constexpr int BLOCKS = 8, BLOCKS_DISTORTION = 7;
#endif

// The distortion's three moments cost registers and time; without it `distortion` and `moments` are not written.
extern "C" __global__ void __launch_bounds__(128, BLOCKS) blend_forward(BlendArguments a) {
    __shared__ float4 records[4][4][32];  // warp, quarter of a record, entry
    blend<false>(a, records[threadIdx.x >> 5]);
}

extern "C" __global__ void __launch_bounds__(128, BLOCKS_DISTORTION) blend_forward_distortion(BlendArguments a) {
    __shared__ float4 records[4][4][32];
    blend<true>(a, records[threadIdx.x >> 5]);
}

extern "C" __global__ void __launch_bounds__(128, BLOCKS) pieces_forward(BlendArguments a) {
    __shared__ float4 records[4][4][32];
    blend<false, true>(a, records[threadIdx.x >> 5]);
}

}  // namespace gs2d
