// Footprints against tiles, one splat at a time (the CPU tests many blocks at once: cpu/tile.h).
#pragma once

#include "core/base.h"
#include "core/project.h"

namespace gs2d {

constexpr int TILE_PX = 16;  // side of a tile

// Tiles, half open; empty for culled splats.
struct TileRectangle {
    unsigned short x0, y0, x1, y1;
};

// Least value over the box of the pixel-centre metric of Footprint <= 1, or the low-pass disc reaches it. The least value
// of a convex quadratic over a box that does not hold its minimum is on a side that faces the minimum: two candidates.
template <class V> struct BoxTest {
    V ex, ey, a, b, c;   // conic
    V cx, cy, disc2;     // low-pass disc; disc2 < 0: unbounded, reaches everything
    V slope_y, slope_x;  // best y for a given x, and the reverse
};

template <class V> GS2D_HD BoxTest<V> box_test(const V* cull) {
    const V a = cull[2], b = cull[3], c = cull[4];
    return {cull[0], cull[1], a, b, c, cull[5], cull[6], cull[7], -b / c, -b / a};
}

template <class V> GS2D_HD bool reaches(const BoxTest<V>& s, V x0, V y0, V x1, V y1) {
    const V px = min(max(s.ex, x0), x1) - s.ex, py = min(max(s.ey, y0), y1) - s.ey;  // nearest in x, in y
    const V qy = min(max(fma(s.slope_y, px, s.ey), y0), y1) - s.ey;                  // best y on the side x = px
    const V qx = min(max(fma(s.slope_x, py, s.ex), x0), x1) - s.ex;
    const V f1 = fma(s.a * px, px, fma(s.c * qy, qy, V(2) * s.b * px * qy));
    const V f2 = fma(s.a * qx, qx, fma(s.c * py, py, V(2) * s.b * qx * py));
    const V dx = min(max(s.cx, x0), x1) - s.cx, dy = min(max(s.cy, y0), y1) - s.cy;
    return (s.disc2 < V(0)) | (f1 <= V(1)) | (f2 <= V(1)) | (fma(dx, dx, dy * dy) <= s.disc2);
}

template <class V> GS2D_HD int tile_floor(V px, int tiles) {  // first tile that reaches px; px may be anything but NaN
    const V t = px * V(1.0 / TILE_PX);
    return t <= V(0) ? 0 : t >= V(tiles) ? tiles : static_cast<int>(t);
}

// Tiles whose pixel centres the widened box of a footprint can reach.
template <class V>
GS2D_HD TileRectangle tile_rectangle(const Footprint<V>& o, int width, int height, int tiles_x, int tiles_y) {
    if (o.unbounded) return {0, 0, (unsigned short)tiles_x, (unsigned short)tiles_y};
    const V margin = V(0.05), half = V(0.5);
    const V x0 = o.x_min - margin, y0 = o.y_min - margin, x1 = o.x_max + margin, y1 = o.y_max + margin;
    if (!((x1 >= half) & (y1 >= half) & (x0 <= V(width) - half) & (y0 <= V(height) - half))) return {0, 0, 0, 0};
    const int tx1 = tile_floor(x1 - half, tiles_x), ty1 = tile_floor(y1 - half, tiles_y);
    return {(unsigned short)tile_floor(x0 - half, tiles_x), (unsigned short)tile_floor(y0 - half, tiles_y),
            (unsigned short)(tx1 < tiles_x ? tx1 + 1 : tiles_x), (unsigned short)(ty1 < tiles_y ? ty1 + 1 : tiles_y)};
}

// Rule 14.
template <class V> GS2D_HD V clipped_radius(const Footprint<V>& o, int width, int height) {
    const V w = V(width), h = V(height), half = V(0.5), zero = V(0);
    if (o.crosses) return max(w, h) * half;
    const V x0 = max(o.x_min, zero), x1 = min(o.x_max, w), y0 = max(o.y_min, zero), y1 = min(o.y_max, h);
    if (!((ceil(x0 - half) + half <= x1) & (ceil(y0 - half) + half <= y1))) return zero;
    return max(x1 - x0, y1 - y0) * half;
}

}  // namespace gs2d
