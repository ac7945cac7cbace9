// State of one view between forward and backward pass.
#pragma once

#include <atomic>
#include <stdlib.h>
#include <string.h>
#if defined(__linux__)
#include <sys/mman.h>
#endif

#include "core/blend.h"
#include "core/project.h"
#include "core/tile.h"
#include "cpu/simd.h"

namespace gs2d {

constexpr size_t LINE = 64, HUGE_PAGE = size_t(2) << 20;

// Grow-only memory aligned to cache lines. It stays allocated when a Frame is freed, since new pages are expensive.
template <class T> struct Buffer {
    T* data = nullptr;
    size_t capacity = 0;
    // Discards the contents. Returns false if out of memory. A buffer that must grow gets 1/16 more than requested,
    // since views differ slightly.
    bool reserve(size_t n) {
        if (n <= capacity) return true;
        const size_t wanted = (capacity ? n + n / 16 : n) * sizeof(T), bytes = (wanted + LINE - 1) / LINE * LINE;
        const size_t alignment = bytes >= HUGE_PAGE ? HUGE_PAGE : LINE;
        free(data);
        void* memory = nullptr;
        data = posix_memalign(&memory, alignment, bytes) == 0 ? static_cast<T*>(memory) : nullptr;
        capacity = data ? bytes / sizeof(T) : 0;
#if defined(MADV_HUGEPAGE)
        // a hint only: access is scattered
        if (data && alignment == HUGE_PAGE) madvise(data, bytes, MADV_HUGEPAGE);
#endif
        return data != nullptr;
    }
    void release() {
        free(data);
        data = nullptr;
        capacity = 0;
    }
    T& operator[](size_t i) const { return data[i]; }
};

// Packed field by field in render/cpu_passes.py; change both.
struct View {
    double R[9], t[3], center[3];  // x_cam = R x + t; camera centre in the world
    double fx, fy, cx, cy;
    double near, far, alpha_min, alpha_max, transmittance_min, error_cutoff, lowpass_px, mip_px;
    double background[3];
    // exact_masks = 0 disables culling inside tiles, including splats without an ellipse (tests)
    int32_t width, height, sh_degree, exact_masks;
    int32_t near_plane_policy;  // rule 19: NEAR_PLANE_*
    const void* rays;           // rule 25: [H, W, 4] reals, or null for a pinhole camera
};

struct Parameters {
    int64_t count, sh_rest;  // N; coefficients stored in shN per splat
    const real *means, *quats, *log_scales, *opacity_logits, *sh0, *shN;
};

struct Images {
    // color and normal [H, W, 3], else [H, W]
    real *color, *alpha, *normal, *depth_mean, *depth_median, *distortion;
    real* radii;  // [N]
};

struct ImageGradients {  // null: no gradient
    const real *color, *alpha, *normal, *depth_mean, *depth_median, *distortion;
    const real* depth_transmittance;  // after find_transmittance_depth
};

struct ParameterGradients {  // null: not computed
    real *means, *quats, *log_scales, *opacity_logits, *sh0, *shN, *probe;
    int64_t probe_columns;  // columns of the screen probe: 2 or 4
    const uint8_t* rows;    // [N] 0: gradients of this splat are 0; null: all are computed
};

// Plain channels in addition to the three of sh0, blended with the same weights (features.cpp).
struct Features {
    int64_t count;           // F
    const real* values;      // [N, F]
    const real* background;  // [F]
    real* color;             // [H, W, 3 + F]; the first three channels are not written
    const real* upstream;    // gradient of `color`; like the next member, backward pass only
    real* gradients;         // [N, F]
};

// True if gradients of anything but colours are computed.
inline bool wants_geometry(const ParameterGradients& g) {
    return g.means || g.quats || g.log_scales || g.opacity_logits || g.probe;
}

#if GS2D_RAYS
constexpr int GRADIENT = (RECORD_FIELDS + LANES - 1) / LANES * LANES, RECORD = GRADIENT;  // in whole vectors

struct CullRecord {
    real chord, disc, k, plain_from;  // see RayReach
    real x, y, z, unused;             // direction of the splat's centre
};

// The tiles that a splat may reach: a mask for each area (ray_bounds.h). Only the first areas are kept.
struct RayTiles {
    static constexpr int KEPT = 2;
    uint64_t tiles[KEPT];
    int32_t area[KEPT];
    int32_t areas;
};
#else
// Box tests per (tile, splat) in pixels; see Footprint.
struct CullRecord {
    real ex, ey, slope, half;
    // disc2 < 0: the splat has an outline instead of an ellipse, and ex is its k; plain_from: see is_plain
    real inv_y2, y_right, disc2, plain_from;
};
#endif

using TileRect = TileRectangle;

constexpr uint32_t ALL_BLOCKS = BLOCKS == 32 ? 0xffffffffu : (1u << (BLOCKS % 32)) - 1u;

// One splat in one tile.
struct Entry {
    // splat index; after the forward pass the highest bit is set if the splat is plain here (is_plain in core/blend.h)
    uint32_t word;
    uint32_t blocks;  // bit b: a live pixel of block b uses the splat (undefined before the forward pass)
    uint32_t splat() const { return word & 0x7fffffffu; }
    bool plain() const { return word >> 31; }
};

#if defined(GS2D_DOUBLE)
using DepthKey = uint64_t;
#else
using DepthKey = uint32_t;
#endif
struct DepthItem {
    DepthKey key;  // bits of z_c > 0: positive floats sort like integers
    uint32_t splat;
};

// Consecutive tiles whose gradients are in memory simultaneously.
struct GradientChunk {
    int64_t first_tile;
    int64_t first_slot;
    std::atomic<int64_t> groups_left, sums_left;  // groups of tiles left to blend; parts left to add to the sums
    std::atomic<int64_t> next_part;               // next part to add to the sums
};

// Gradients of each splat record, summed over the tiles.
struct Sums {
    real* data;  // [N, GRADIENT]
    // [N, columns]: values of GRADIENT_EXTRA for the densification signal, stored in the memory of its gradient
    real* extras;
    int columns;              // 0, 2 or 4
    int64_t coefficient_row;  // row length of the gradient of shN if `data` shares its memory, else 0
    real* row(int64_t splat) const { return data + splat * GRADIENT; }
    real* extra(int64_t splat) const { return extras + splat * columns; }
};

// Returns the bytes of the arrays of a forward pass over n splats.
inline size_t forward_scratch(int64_t n) {
    return static_cast<size_t>(n) * (sizeof(CullRecord) + sizeof(TileRect) + 2 * sizeof(DepthItem));
}

constexpr int64_t GROUP = 4;  // consecutive tiles that one thread blends

struct Frame {
    View view;
    PinholeCamera<real> camera;
    int64_t count = 0;
    int32_t tiles_x = 0, tiles_y = 0;
    int64_t tiles = 0;

    // Kept between forward and backward pass.
    Buffer<real> records;        // [N, RECORD]
    Buffer<int64_t> tile_begin;  // [tiles + 1]
    Buffer<Entry> entries;
    Buffer<std::atomic<uint8_t>> taken;  // [groups]: nonzero if a thread has taken these tiles (share_out)
    Buffer<int32_t> tile_count;  // [tiles] entries that survive the forward pass, moved to the front of their tile
    Buffer<real> saved;          // [4, H W]: T_final, M1, M2, inverse_depth0
    Buffer<real> depth_slope;    // [2, H W]: depth by transmittance, and -dT/dz at that depth
    real inv_depth_width = 0;
    int64_t visible = 0;
    int64_t groups() const { return (tiles + GROUP - 1) / GROUP; }

    // One allocation for data that only a single pass needs: the arrays below in the forward pass, slots in the
    // backward pass.
    Buffer<char> scratch;
    CullRecord* cull = nullptr;         // [N]
    TileRect* rects = nullptr;          // [N]
    DepthItem* order = nullptr;         // [visible], sorted by depth; projection stores the keys of all splats
    TileRect* ordered_rects = nullptr;  // [visible], like order
    Buffer<uint32_t> histogram;         // [chunks, tiles]
#if GS2D_RAYS
    Buffer<char> areas;  // bounds (ray_bounds.h)
    int64_t area_count = 0;
    Buffer<RayTiles> ray_tiles;  // [N]
#endif

    // Backward pass.
    Buffer<int64_t> slot_begin;    // [tiles + 1]
    Buffer<GradientChunk> chunks;  // [tiles + 1] at most
    int64_t largest_chunk = 0;     // slots
    Buffer<real> own_sums;         // used if no parameter gradient has room for the sums
    Buffer<real> feature_planes;   // both passes: [threads, rows of channels, FEATURE_STRIDE]
    Sums sums = {};

    // Splat errors.
    Buffer<real> target;           // [tiles, 4, PIXELS]
    Buffer<int64_t> splat_begin;   // [N + 2]
    Buffer<uint32_t> splat_slots;  // entry indices of each splat, in tile order

    Frame* next_free = nullptr;
};

Frame* take_frame();
void give_back(Frame* frame);

inline BlendLimits<V> limits_of(const View& v) {
    return {V(real(1 / (v.lowpass_px * v.lowpass_px))), V(real(v.near)), V(real(log2(v.alpha_min))),
            V(real(v.alpha_max)), V(real(v.transmittance_min))};
}

inline Record<V> broadcast(const real* r) {
#if GS2D_RAYS
    return {{V(r[0]), V(r[1]), V(r[2])},
            {V(r[3]), V(r[4]), V(r[5])},
            {V(r[6]), V(r[7]), V(r[8])},
            V(r[9]),
            V(r[10]),
            V(r[11]),
            V(r[12]),
            V(r[13]),
            V(r[14]),
            V(r[15]),
            {V(r[16]), V(r[17]), V(r[18])},
            V(r[19])};
#else
    return {V(r[0]), V(r[1]), V(r[2]),  V(r[3]),  V(r[4]),  V(r[5]),  V(r[6]),  V(r[7]),
            V(r[8]), V(r[9]), V(r[10]), V(r[11]), V(r[12]), V(r[13]), V(r[14]), V(r[15])};
#endif
}

// Pixel centres of a block whose first pixel is (x, y).
inline V lane_x(int x) {
    alignas(64) real v[LANES];
    for (int i = 0; i < LANES; ++i) v[i] = real(x + i % BLOCK_W) + real(0.5);
    return load(v);
}
inline V lane_y(int y) {
    alignas(64) real v[LANES];
    for (int i = 0; i < LANES; ++i) v[i] = real(y + i / BLOCK_W) + real(0.5);
    return load(v);
}
// Mask of the lanes of that block that are inside the image.
inline M lanes_inside(int x, int y, int width, int height) {
    uint32_t b = 0;
    for (int i = 0; i < LANES; ++i) b |= uint32_t(x + i % BLOCK_W < width && y + i / BLOCK_W < height) << i;
    return mask_of(b);
}

// Which pixels a splat footprint must contain.
enum class Reach {
    BLEND,           // alpha >= alpha_min; more transparent splats are culled
    ERRORS,          // rho <= error_cutoff^2
    ERRORS_OCCLUDED  // union of both
};

// The passes, in order. Functions that return bool return false if out of memory.
bool project_splats(Frame& frame, const Parameters& splats, Reach reach, real* radii);
bool bin_splats(Frame& frame);
bool blend_tiles(Frame& frame, const Images& images);
// Call after blend_tiles.
bool blend_features(Frame& frame, const Features& features);
// `features` may be null. With features, geometry gradients are computed too, and out.rows must be null.
bool blend_tiles_vjp(Frame& frame, const Images& images, const ImageGradients& gradients, int64_t sh_rest,
                     const ParameterGradients& out, bool geometry, const Features* features);
// Rule 22; call after blend_tiles. `alpha` and `median` are its images; `width`: half width relative to the depth.
bool find_transmittance_depth(Frame& frame, const real* alpha, const real* median, double width, real* depth);
bool splat_errors(Frame& frame, const real* image, const uint8_t* mask, real* errors);
bool occluded_splat_errors(Frame& frame, const real* image, const uint8_t* mask, real* errors);
void project_splats_vjp(Frame& frame, const Parameters& splats, const ParameterGradients& out, real* intrinsics);

}  // namespace gs2d
