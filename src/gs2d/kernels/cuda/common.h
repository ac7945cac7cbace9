// Shared code of the CUDA kernels. Every kernel takes one struct by value (a ctypes structure in Python) and uses only
// compiler built-ins, no toolkit headers. Warp collectives require convergent code and the full mask: the tests run
// these sources on the CPU, where anything else is an error (tests/helpers/emulator.h).
#pragma once

#include "core/blend.h"
#include "core/project.h"
#include "core/tile.h"

namespace gs2d {

typedef unsigned int uint;
typedef unsigned short ushort;
typedef unsigned char uchar;
typedef long long int64;

constexpr uint FULL_MASK = 0xffffffffu;

// Parameters of one view.
struct View {
    PinholeCamera<float> camera;
    float near, lowpass_px, inv_lowpass2, log2_alpha_min, alpha_max, transmittance_min;
    float error_k2;          // error_cutoff^2
    float distortion_scale;  // (far near / (far - near))^2
    float inv_depth_width;   // for rule 22
    float background[3];
    int width, height, tiles_x, tiles_y;
    int sh_degree, near_plane_policy;
    float mip_px;  // rule 24; 0: no Mip filter
};

__device__ __forceinline__ BlendLimits<float> limits_of(const View& v) {
    return {v.inv_lowpass2, v.near, v.log2_alpha_min, v.alpha_max, v.transmittance_min,
            v.inv_depth_width};
}

// Test of a splat against the sub-blocks of a tile. Cull record: ex, ey, a, b, c, cx, cy, disc2. If disc2 < 0, the
// splat has an outline instead of an ellipse, ex is its k, and this test passes for every sub-block.
struct Culling {
    BoxTest<float> test;
    bool unbounded;
    // relative to the first pixel of the tile, for precision at large coordinates
    __device__ __forceinline__ Culling(const float* cull, int left, int top) {
        const float4* from = reinterpret_cast<const float4*>(cull);
        const float4 lo = from[0], hi = from[1];
        const float x = float(left), y = float(top), a = lo.z, b = lo.w, c = hi.x;
        test = {lo.x - x, lo.y - y, a, b, c, hi.y - x, hi.z - y, hi.w, -b / c, -b / a};
        unbounded = hi.w < 0.f;
    }
    // columns (block & 1) * 8, rows (block >> 1) * 4
    __device__ __forceinline__ bool reaches_block(int block) const {
        const float x = float((block & 1) * 8) + 0.5f, y = float((block >> 1) * 4) + 0.5f;
        return unbounded | reaches(test, x, y, x + 7.f, y + 3.f);
    }
};

// Returns a bit mask of the sub-blocks of the tile at (left, top) that an outline reaches. r: the record of the splat.
__device__ __forceinline__ uint blocks_outlined(const float* cull, const float* r, int left, int top, float near,
                                                int width, int height) {
    const float4* from = reinterpret_cast<const float4*>(r);
    const float4 lo = from[0], hi = from[1];
    const Outline<float> outline = outline_of(lo.z, lo.w, hi.x, hi.y, hi.z, hi.w, r[8], lo.x, lo.y, cull[0], -cull[7],
                                              near, float(width), float(height));
    const float cx = lo.x - float(left), cy = lo.y - float(top);
    uint mask = 0;
    for (int row = 0; row < 4; ++row) {
        float first, last;
        reach_in_rows(outline, float(4 * row) + 0.5f - cy, float(4 * row) + 3.5f - cy, first, last);
        mask |= (uint(last >= 0.5f - cx && first <= 7.5f - cx) | uint(last >= 8.5f - cx && first <= 15.5f - cx) << 1)
                << 2 * row;
    }
    return mask;
}

// A record or another row of 16 floats, aligned to 64 bytes; accessed four floats at a time.
__device__ __forceinline__ Record<float> record_of(const float4& a, const float4& b, const float4& c, const float4& d) {
    return {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, c.x, c.y, c.z, c.w, d.x, d.y, d.z, d.w};
}

// Returns byte / 255, rounded like a division: a product plus its error.
__device__ __forceinline__ float part_of_255(uchar byte) {
    constexpr float PART = 1.f / 255.f;
    const float x = float(byte), q = x * PART;
    return fma(fma(-q, 255.f, x), PART, q);
}

}  // namespace gs2d
