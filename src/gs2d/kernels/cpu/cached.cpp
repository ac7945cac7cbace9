// Views with frozen geometry and opacity. The image is affine in the colours of the trained splats,
//     color(pixel) = frozen(pixel) + sum over rows k of w_k(pixel) max(0, c_k),
// so a view stores `frozen` and the weights and needs no blending (docs/math.md, "Cached views"). Images and gradients
// are bit-identical to those of the blending, because the sums have the same order. Weights are stored by tile, splat
// (front to back) and block, LANES reals each, and read in that order.
#include "cpu/export.h"
#include "cpu/frame.h"
#include "cpu/planes.h"
#include "cpu/splat_group.h"
#include "cpu/threads.h"

namespace gs2d {

// `row`: index among the trained splats.
struct CachedView {
    int64_t width, height, tiles_x, tiles, rows, degree;
    int64_t *tile_entries, *tile_blocks;  // [tiles + 1]: first entry and first weight block of each tile
    int32_t* entry_row;                   // [entries]
    int32_t* entry_blocks;                // [entries]: bit b is set if block b has weights
    int64_t* row_begin;                   // [rows + 1]
    int32_t* row_entries;                 // [entries]: entries of each row, in tile order
    real* weights;                        // [blocks, LANES]
    real* frozen;                         // [tiles, 3, PIXELS], pixels in block order, background included
    real* basis;                          // [groups of LANES rows, SH_MAX, LANES]
};

namespace {

constexpr int COLOR = 4;  // reals per colour: one quarter of a line

TileArea area_of(const CachedView& c, int64_t tile) {
    TileArea a;
    a.x0 = static_cast<int>(tile % c.tiles_x) * TILE, a.y0 = static_cast<int>(tile / c.tiles_x) * TILE;
    a.width = c.width - a.x0 < TILE ? static_cast<int>(c.width - a.x0) : TILE;
    a.height = c.height - a.y0 < TILE ? static_cast<int>(c.height - a.y0) : TILE;
    return a;
}

// Processes a tile like the backward pass: frozen splats add their colour, trained splats store their weights.
void fill_tile(const Frame& f, int64_t tile, const int32_t* row_of, const CachedView& c, const BlendLimits<V>& limits) {
    alignas(64) real T[PIXELS];
    const TileArea area = tile_area(f, tile);
    real* const frozen = c.frozen + tile * 3 * PIXELS;
    memset(frozen, 0, sizeof(real) * 3 * PIXELS);
    for (int b = 0; b < BLOCKS; ++b)
        store(T + b * LANES, keep(lanes_inside(block_x(b), block_y(b), area.width, area.height), V(1)));
    const Centres centres(f, area);
    int64_t to = c.tile_entries[tile];
    real* weights = c.weights + c.tile_blocks[tile] * LANES;
    const Entry* const begin = &f.entries[f.tile_begin[tile]];
    for (const Entry* entry = begin; entry < begin + f.tile_count[tile]; ++entry) {
        const real* const record = &f.records[size_t(entry->splat()) * RECORD];
        const Record<V> splat = broadcast(record);
        const V zc = reciprocal(splat.iz);
        SplatPlanes planes;
        planes.set(record, centres);
        const int32_t row = row_of[entry->splat()];
        if (row >= 0) {
            c.entry_row[to] = row;
            c.entry_blocks[to++] = static_cast<int32_t>(entry->blocks);
        }
        for (uint32_t blocks = entry->blocks; blocks; blocks &= blocks - 1) {
            const int b = __builtin_ctz(blocks), at = b * LANES;
            const Hit<V> hit = hit_at(splat, zc, planes.at(b, centres), entry->plain(), centres, b, limits);
            V pixel_T = load(T + at);
            if (row >= 0) {
                Vec3<V> sum = {V(0), V(0), V(0)};
                composite_color_vjp(hit, limits, {V(1), V(0), V(0)}, pixel_T, sum);
                store(weights, sum.x);
                weights += LANES;
            } else {
                Vec3<V> sum = {load(frozen + at), load(frozen + PIXELS + at), load(frozen + 2 * PIXELS + at)};
                composite_color_vjp(hit, limits, {splat.red, splat.green, splat.blue}, pixel_T, sum);
                store(frozen + at, sum.x), store(frozen + PIXELS + at, sum.y), store(frozen + 2 * PIXELS + at, sum.z);
            }
            store(T + at, pixel_T);
        }
    }
    read_planes<1>(&f.saved[0], f.view.width, area, T);
    for (int k = 0; k < 3; ++k)
        for (int i = 0; i < PIXELS; i += LANES) {
            real* const p = frozen + k * PIXELS + i;
            store(p, fma(load(T + i), V(real(f.view.background[k])), load(p)));
        }
}

void list_entries_of_rows(const CachedView& c) {
    const int64_t entries = c.tile_entries[c.tiles];
    memset(c.row_begin, 0, sizeof(int64_t) * size_t(c.rows + 1));
    for (int64_t e = 0; e < entries; ++e) ++c.row_begin[c.entry_row[e] + 1];
    for (int64_t r = 0; r < c.rows; ++r) c.row_begin[r + 1] += c.row_begin[r];
    for (int64_t e = 0; e < entries; ++e) c.row_entries[c.row_begin[c.entry_row[e]]++] = static_cast<int32_t>(e);
    for (int64_t r = c.rows; r > 0; --r) c.row_begin[r] = c.row_begin[r - 1];
    c.row_begin[0] = 0;
}

template <class F> void for_each_group(const CachedView& c, F&& visit) {
    parallel_ranges(c.rows, 16 * LANES, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; i += LANES) visit(i, end - i < LANES ? static_cast<int>(end - i) : LANES);
    });
}

void load_basis(const CachedView& c, int64_t row, V* basis) {
    for (int k = 0; k < SH_MAX; ++k) basis[k] = load(c.basis + (row * SH_MAX + k * LANES));
}

void render_tile(const CachedView& c, int64_t tile, const real* colors, real* image) {
    alignas(64) real planes[3 * PIXELS];
    memcpy(planes, c.frozen + tile * 3 * PIXELS, sizeof planes);
    const real* weights = c.weights + c.tile_blocks[tile] * LANES;
    for (int64_t e = c.tile_entries[tile]; e < c.tile_entries[tile + 1]; ++e) {
        const real* color = colors + int64_t(c.entry_row[e]) * COLOR;
        const V red = V(color[0]), green = V(color[1]), blue = V(color[2]);
        for (uint32_t blocks = static_cast<uint32_t>(c.entry_blocks[e]); blocks;
             blocks &= blocks - 1, weights += LANES) {
            real* const p = planes + __builtin_ctz(blocks) * LANES;
            const V w = load(weights);
            store(p, fma(w, red, load(p)));
            store(p + PIXELS, fma(w, green, load(p + PIXELS)));
            store(p + 2 * PIXELS, fma(w, blue, load(p + 2 * PIXELS)));
        }
    }
    write_planes<3>(planes, image, static_cast<int>(c.width), area_of(c, tile));
}

// Writes one slot of colour gradients per entry.
void gather_tile(const CachedView& c, int64_t tile, const real* gradient, real* slots) {
    const int64_t first = c.tile_entries[tile], last = c.tile_entries[tile + 1];
    if (first == last) return;
    alignas(64) real planes[3 * PIXELS];
    read_planes<3>(gradient, static_cast<int>(c.width), area_of(c, tile), planes);
    const real* weights = c.weights + c.tile_blocks[tile] * LANES;
    for (int64_t e = first; e < last; ++e) {
        Vec3<V> sum = {V(0), V(0), V(0)};
        for (uint32_t blocks = static_cast<uint32_t>(c.entry_blocks[e]); blocks;
             blocks &= blocks - 1, weights += LANES) {
            const real* const p = planes + __builtin_ctz(blocks) * LANES;
            sum = axpy(load(weights), Vec3<V>{load(p), load(p + PIXELS), load(p + 2 * PIXELS)}, sum);
        }
        const V fields[4] = {sum.x, sum.y, sum.z, V(0)};
        transpose_reduce<4>(fields, slots + e * COLOR);
    }
}

}  // namespace
}  // namespace gs2d

using namespace gs2d;

// Measures the size of a cached view after a forward pass. `row_of` [N]: the row of a trained splat, or -1.
GS2D_EXPORT void gs2d_cached_measure(const Frame* frame, const int32_t* row_of, int64_t* tile_entries,
                                     int64_t* tile_blocks) {
    const Frame& f = *frame;
    parallel_ranges(f.tiles, 16, [&](int64_t first, int64_t last) {
        for (int64_t tile = first; tile < last; ++tile) {
            const Entry* const begin = &f.entries[f.tile_begin[tile]];
            int64_t entries = 0, blocks = 0;
            for (const Entry* e = begin; e < begin + f.tile_count[tile]; ++e) {
                if (row_of[e->splat()] < 0) continue;
                ++entries;
                blocks += __builtin_popcount(e->blocks);
            }
            tile_entries[tile + 1] = entries, tile_blocks[tile + 1] = blocks;
        }
    });
    tile_entries[0] = tile_blocks[0] = 0;
    for (int64_t t = 0; t < f.tiles; ++t) tile_entries[t + 1] += tile_entries[t], tile_blocks[t + 1] += tile_blocks[t];
}

// Fills a view whose arrays have the measured sizes; `splats` are the trained rows.
GS2D_EXPORT void gs2d_cached_fill(const Frame* frame, const int32_t* row_of, const Parameters* splats,
                                  const CachedView* view) {
    const CachedView& c = *view;
    const BlendLimits<V> limits = limits_of(frame->view);
    parallel_for(c.tiles, [&](int64_t tile) { fill_tile(*frame, tile, row_of, c, limits); });
    list_entries_of_rows(c);
    for_each_group(c, [&](int64_t i, int lanes) {
        V basis[SH_MAX];
        for (V& b : basis) b = V(0);
        sh_basis(frame_of(load_parameters(*splats, i, lanes), frame->camera).to_splat, static_cast<int>(c.degree),
                 basis);
        for (int k = 0; k < SH_MAX; ++k) store(c.basis + (i * SH_MAX + k * LANES), basis[k]);
    });
}

// Renders the image [H, W, 3], and stores the row colours [rows, 4] for the backward pass.
GS2D_EXPORT void gs2d_cached_render(const CachedView* view, const Parameters* splats, real* colors, real* image) {
    const CachedView& c = *view;
    for_each_group(c, [&](int64_t i, int lanes) {
        V sh[3 * SH_MAX], basis[SH_MAX];
        load_sh(*splats, i, lanes, static_cast<int>(c.degree), sh);
        load_basis(c, i, basis);
        const Vec3<V> color = sh_color(sh, basis, static_cast<int>(c.degree));
        const V fields[COLOR] = {max(color.x, V(0)), max(color.y, V(0)), max(color.z, V(0)), V(0)};
        store_rows<COLOR>(colors + i * COLOR, COLOR, lanes, fields);
    });
    parallel_ranges(c.tiles, 4, [&](int64_t first, int64_t last) {
        for (int64_t tile = first; tile < last; ++tile) render_tile(c, tile, colors, image);
    });
}

// Computes the gradients of the row coefficients from the image gradient [H, W, 3]; `slots` [entries, 4] is scratch.
GS2D_EXPORT void gs2d_cached_gradients(const CachedView* view, const real* gradient, const real* colors,
                                       int64_t sh_rest, real* slots, const ParameterGradients* out) {
    const CachedView& c = *view;
    parallel_ranges(c.tiles, 4, [&](int64_t first, int64_t last) {
        for (int64_t tile = first; tile < last; ++tile) gather_tile(c, tile, gradient, slots);
    });
    for_each_group(c, [&](int64_t i, int lanes) {
        alignas(64) real sums[LANES][COLOR];
        memset(sums, 0, sizeof sums);
        uint32_t seen_bits = 0;
        for (int l = 0; l < lanes; ++l) {
            const int64_t first = c.row_begin[i + l], last = c.row_begin[i + l + 1];
            seen_bits |= uint32_t(last > first) << l;
            for (int64_t e = first; e < last; ++e)
                for (int k = 0; k < COLOR; ++k) sums[l][k] += slots[int64_t(c.row_entries[e]) * COLOR + k];
        }
        const M seen = mask_of(seen_bits);
        V g[COLOR], color[COLOR], basis[SH_MAX];
        load_rows<COLOR>(sums[0], COLOR, LANES, g);
        load_rows<COLOR>(colors + i * COLOR, COLOR, lanes, color);
        load_basis(c, i, basis);
        for (V& b : basis) b = keep(seen, b);
        const auto passed = [&](int k) { return keep((color[k] > V(0)) & seen, g[k]); };
        write_sh(static_cast<int>(c.degree), sh_rest, *out, i, lanes, Vec3<V>{passed(0), passed(1), passed(2)}, basis);
    });
}
