// Splat errors (rule 17): one warp per splat processes the pixels of its tile rectangle in a fixed order.
#include "cuda/reduce.h"

namespace gs2d {

struct ErrorArguments {
    View view;
    int64 count;
    const float* records;
    const float* cull;
    const ushort* rects;
    const int* tile_counts;
    const float* image;  // [H, W, 3]
    const uchar* mask;   // [H, W], 0 = ignore; or null
    float* errors;       // [N]
};

// Records are from a projection with `errors` set: the footprint is rho <= error_k2.
extern "C" __global__ void __launch_bounds__(128) splat_errors(ErrorArguments a) {
    const int64 splat = (int64(blockIdx.x) * blockDim.x + threadIdx.x) >> 5;
    const int lane = threadIdx.x & 31;
    if (splat >= a.count) return;  // uniform over the warp
    const View& v = a.view;
    float total = 0.f;
    const int tiles = a.tile_counts[splat];
    if (tiles > 0) {
        const BlendLimits<float> limits = limits_of(v);
        const float4* from = reinterpret_cast<const float4*>(a.records + RECORD * splat);
        const Record<float> s = record_of(from[0], from[1], from[2], from[3]);
        const float zc = reciprocal(s.iz);
        const ushort* rect = a.rects + 4 * splat;
        const int x0 = rect[0], y0 = rect[1], columns = rect[2] - x0;
        for (int t = 0; t < tiles; ++t) {
            const int left = (x0 + t % columns) * TILE_PX, top = (y0 + t / columns) * TILE_PX;
            const Culling culling(a.cull + 8 * splat, left, top);
            for (int b = 0; b < 8; ++b) {
                const int bx = (b & 1) * 8, by = (b >> 1) * 4;
                if (!culling.reaches_block(b)) continue;
                const int x = left + bx + (lane & 7), y = top + by + (lane >> 3);
                if (x >= v.width || y >= v.height) continue;
                const int64 at = int64(y) * v.width + x;
                if (a.mask && !a.mask[at]) continue;
                const Hit<float> h = intersect(s, zc, float(x) + 0.5f - s.cx, float(y) + 0.5f - s.cy, limits);
                if (!(h.rho <= v.error_k2 && h.depth >= v.near)) continue;
                const float* c = a.image + 3 * at;
                total = total + (abs(s.red - c[0]) + abs(s.green - c[1]) + abs(s.blue - c[2]));
            }
        }
    }
    total = sum_over_warp(total);
    if (lane == 0) a.errors[splat] = total;
}

}  // namespace gs2d
