// Tests of footprints against tiles. V may be a vector of boxes, S is a scalar.
#pragma once

#include "core/base.h"
#include "core/project.h"

namespace gs2d {

constexpr int TILE_PX = 16;  // side of a tile

// Half-open range of tiles; empty for culled splats.
struct TileRectangle {
    unsigned short x0, y0, x1, y1;
};

// A footprint, where the pixel-centre metric of Footprint is <= 1, and its low-pass disc.
template <class V> struct BoxTest {
    V ex, ey, a, b, c;   // ellipse
    V cx, cy, disc2;     // low-pass disc
    V slope_y, slope_x;  // best y for a given x, and vice versa: -b / c, -b / a
};

// Returns where the footprint reaches the box, unless it is unbounded. The minimum of a convex quadratic over a box
// that does not contain the unconstrained minimum is on a side facing it: two candidates.
template <class V> GS2D_HD mask_t<V> reaches(const BoxTest<V>& s, V x0, V y0, V x1, V y1) {
    const V px = min(max(s.ex, x0), x1) - s.ex, py = min(max(s.ey, y0), y1) - s.ey;  // nearest in x, in y
    const V qy = min(max(fma(s.slope_y, px, s.ey), y0), y1) - s.ey;                  // best y on the side x = px
    const V qx = min(max(fma(s.slope_x, py, s.ex), x0), x1) - s.ex;
    const V f1 = fma(s.a * px, px, fma(s.c * qy, qy, V(2) * s.b * px * qy));
    const V f2 = fma(s.a * qx, qx, fma(s.c * py, py, V(2) * s.b * qx * py));
    const V dx = min(max(s.cx, x0), x1) - s.cx, dy = min(max(s.cy, y0), y1) - s.cy;
    return (f1 <= V(1)) | (f2 <= V(1)) | (fma(dx, dx, dy * dy) <= s.disc2);
}

// A footprint by rows: at height ey + dy its ellipse covers x = ex + slope dy +- half sqrt(1 - inv_y2 dy^2). Its
// rightmost point is at dy = y_right, its leftmost point at -y_right.
template <class V> struct Chords {
    V ex, ey, slope, half, inv_y2, y_right;
    V cx, cy, disc2;  // low-pass disc
};

// Computes the interval of a footprint in rows y0 to y1; empty if left > right. Both shapes contain (cx, cy), so it is
// one interval unless a far end of the ellipse extends beyond the disc.
template <class V> GS2D_HD void reach_in_rows(const Chords<V>& s, V y0, V y1, V& left, V& right) {
    const V far = V(1e30), a = y0 - s.ey, b = y1 - s.ey;
    const V yr = min(max(s.y_right, a), b), yl = min(max(-s.y_right, a), b);
    const V r2 = fnma(yr * s.inv_y2, yr, V(1)), l2 = fnma(yl * s.inv_y2, yl, V(1));
    const V dy = min(max(s.cy, y0), y1) - s.cy, d2 = fnma(dy, dy, s.disc2), d = sqrt(d2);
    const auto near = d2 >= V(0);
    right = fma(s.half, sqrt(r2), fma(s.slope, yr, s.ex)), left = fnma(s.half, sqrt(l2), fma(s.slope, yl, s.ex));
    // NaN outside the ellipse: max and min then return the other operand
    right = max(right, select(near, s.cx + d, -far)), left = min(left, select(near, s.cx - d, far));
}

// The visible part of a disc that reaches the camera plane has no ellipse, but it is convex and bounded beyond `near`.
// It lies inside half planes a dx + b dy + c >= 0, with dx and dy relative to the projected centre. The footprint also
// contains the low-pass disc (docs/math.md, "Footprint").
template <class V> struct HalfPlane {
    V a, b, c;
};
constexpr int DIRECTIONS = 8, SIDES = DIRECTIONS + 1;
// relative to the sum of absolute terms; the relative error of the kernels' X, Y and I is about 1e-6
constexpr double OUTLINE_SLACK = 1e-5;
template <class V> struct Outline {
    HalfPlane<V> sides[SIDES];
    V disc2;
    mask_t<V> unknown;  // not finite: covers all pixels
};

// Bounds the region with (X^2 + Y^2) / I^2 <= k^2 and 0 < I <= 1 / near, for planes X, Y, I of a record.
template <class V>
GS2D_HD Outline<V> outline_of(V au, V bu, V av, V bv, V ai, V bi, V iz, V cx, V cy, V k, V disc2, V near, V width,
                              V height) {
    // (cos, sin) of multiples of 45 degrees: X cos + Y sin <= |(X, Y)| <= k I
    const V h = V(0.70710678f), zero = V(0), one = V(1), eps = V(float(OUTLINE_SLACK));
    const V cosines[DIRECTIONS] = {one, h, zero, -h, -one, -h, zero, h},
            sines[DIRECTIONS] = {zero, h, one, h, zero, -h, -one, -h};
    const V reach_x = max(abs(cx), abs(width - cx)) + V(TILE_PX), reach_y = max(abs(cy), abs(height - cy)) + V(TILE_PX);
    const V size_i = fma(abs(ai), reach_x, fma(abs(bi), reach_y, abs(iz)));
    const V size = fma(abs(au) + abs(av), reach_x, fma(abs(bu) + abs(bv), reach_y, k * size_i)), inv_near = one / near;
    Outline<V> o;
    GS2D_UNROLL
    for (int i = 0; i < DIRECTIONS; ++i) {
        const V c = cosines[i], s = sines[i];
        o.sides[i] = {fma(k, ai, -fma(c, au, s * av)), fma(k, bi, -fma(c, bu, s * bv)), fma(eps, size, k * iz)};
    }
    o.sides[DIRECTIONS] = {-ai, -bi, fma(eps, size_i + inv_near, inv_near - iz)};
    o.disc2 = disc2;
    o.unknown = invert(size + inv_near < V(1e30f));
    return o;
}

// Computes the interval of an outline in rows y0 to y1, relative to the projected centre; empty if left > right.
template <class V> GS2D_HD void reach_in_rows(const Outline<V>& s, V y0, V y1, V& left, V& right) {
    const V far = V(1e30f), zero = V(0);
    left = -far, right = far;
    GS2D_UNROLL
    for (int i = 0; i < SIDES; ++i) {  // each side at its best row; NaN and a = 0 have no effect
        const HalfPlane<V> h = s.sides[i];
        const V x = -(max(h.b * y0, h.b * y1) + h.c) / h.a;
        left = select(h.a > zero, max(x, left), left), right = select(h.a < zero, min(x, right), right);
    }
    const auto none = left > right;
    const V dy = min(max(zero, y0), y1), d2 = fnma(dy, dy, s.disc2), d = sqrt(max(d2, zero));
    const auto near = d2 >= zero;
    left = min(select(none, far, left), select(near, -d, far)),
    right = max(select(none, -far, right), select(near, d, -far));
    left = select(s.unknown, -far, left), right = select(s.unknown, far, right);
}

// The exact box of a footprint in px, not clipped.
template <class S> struct PixelBox {
    S x_min, y_min, x_max, y_max;
};

// first tile that reaches px, which must not be NaN
template <class S> GS2D_HD int tile_floor(S px, int tiles) {
    const S t = px * S(1.0 / TILE_PX);
    return t <= S(0) ? 0 : t >= S(tiles) ? tiles : static_cast<int>(t);
}

// Returns the tiles whose pixel centres the widened box of a footprint can reach.
template <class S>
GS2D_HD TileRectangle tile_rectangle(const PixelBox<S>& o, bool unbounded, int width, int height, int tiles_x,
                                     int tiles_y) {
    if (unbounded) return {0, 0, (unsigned short)tiles_x, (unsigned short)tiles_y};
    const S margin = S(0.05), half = S(0.5);
    const S x0 = o.x_min - margin, y0 = o.y_min - margin, x1 = o.x_max + margin, y1 = o.y_max + margin;
    if (!(x1 >= half && y1 >= half && x0 <= S(width) - half && y0 <= S(height) - half)) return {0, 0, 0, 0};
    const int tx0 = tile_floor(x0 - half, tiles_x), ty0 = tile_floor(y0 - half, tiles_y);
    const int tx1 = tile_floor(x1 - half, tiles_x), ty1 = tile_floor(y1 - half, tiles_y);
    return {(unsigned short)tx0, (unsigned short)ty0, (unsigned short)(tx1 < tiles_x ? tx1 + 1 : tiles_x),
            (unsigned short)(ty1 < tiles_y ? ty1 + 1 : tiles_y)};
}

// Returns the tiles x0 to x1 of a row whose pixel centres may be between left and right, in px.
template <class S> GS2D_HD bool tiles_between(S left, S right, int width, int tiles_x, int& x0, int& x1) {
    const S margin = S(0.05), half = S(0.5), from = left - margin, to = right + margin;
    if (!(from <= S(width) - half && to >= half && from <= to)) return false;
    x0 = tile_floor(from - half, tiles_x), x1 = tile_floor(to - half, tiles_x);
    x1 = x1 < tiles_x ? x1 + 1 : tiles_x;
    return true;
}

// Extends the bounding rectangle by the tiles x0 to x1 of row y; start with {0, 0, 0, 0}.
GS2D_HD TileRectangle with_row(const TileRectangle& r, int x0, int x1, int y) {
    if (r.x1 <= r.x0) return {(unsigned short)x0, (unsigned short)y, (unsigned short)x1, (unsigned short)(y + 1)};
    return {(unsigned short)(x0 < r.x0 ? x0 : r.x0), r.y0, (unsigned short)(x1 > r.x1 ? x1 : r.x1),
            (unsigned short)(y + 1)};
}

// Rule 19, "box": returns the tiles that a square (centre and half side, px) touches; none if it is not finite.
template <class S> GS2D_HD TileRectangle square_tiles(S x, S y, S half, int tiles_x, int tiles_y) {
    if (!(abs(x) + abs(y) + half < S(1e9))) return {0, 0, 0, 0};
    const S side = ceil(half), left = x - S(0.5) - side, top = y - S(0.5) - side;
    const S end = side + side + S(TILE_PX - 1);
    return {(unsigned short)tile_floor(left, tiles_x), (unsigned short)tile_floor(top, tiles_y),
            (unsigned short)tile_floor(left + end, tiles_x), (unsigned short)tile_floor(top + end, tiles_y)};
}

// Returns half the longer side of a tile rectangle, clipped to the image; 0 if empty.
template <class S> GS2D_HD S tiles_radius(const TileRectangle& t, int width, int height) {
    if (t.x1 <= t.x0 || t.y1 <= t.y0) return S(0);
    const int right = t.x1 * TILE_PX < width ? t.x1 * TILE_PX : width,
              bottom = t.y1 * TILE_PX < height ? t.y1 * TILE_PX : height;
    const int w = right - t.x0 * TILE_PX, h = bottom - t.y0 * TILE_PX;
    return S(w > h ? w : h) / S(2);
}

// Rule 14. `crosses`: the splat disc reaches the camera plane.
template <class S> GS2D_HD S clipped_radius(const PixelBox<S>& o, bool crosses, int width, int height) {
    const S w = S(width), h = S(height), half = S(0.5), zero = S(0);
    if (crosses) return (w > h ? w : h) / S(2);
    const S x0 = o.x_min > zero ? o.x_min : zero, x1 = o.x_max < w ? o.x_max : w;
    const S y0 = o.y_min > zero ? o.y_min : zero, y1 = o.y_max < h ? o.y_max : h;
    if (!(ceil(x0 - half) + half <= x1 && ceil(y0 - half) + half <= y1)) return zero;
    return (x1 - x0 > y1 - y0 ? x1 - x0 : y1 - y0) / S(2);
}

}  // namespace gs2d
