// Photometric refinement of a mesh (docs/math.md, "Mesh refinement"), for meshing/warped_ncc.py.
//
// gs2d_raster_mesh draws the depth of a mesh, gs2d_match_views compares an image with a neighbour that is warped through
// this depth, and gs2d_gather_vertices adds the result up on the vertices. Rows are independent in the first two, and the
// third runs on one thread, so the result does not depend on the number of threads.
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>

#include "core/base.h"
#include "cpu/export.h"
#include "cpu/simd.h"
#include "cpu/threads.h"

namespace gs2d {

constexpr double MIN_SCALE = 0.1;  // depth in the neighbour / depth in the view; points below are too close

// Intrinsics of an image in px from the centre of its first pixel.
struct Lens {
    double fx, fy, cx, cy;
};
static Lens lens_of(const double* lens) { return {lens[0], lens[1], lens[2] - 0.5, lens[3] - 0.5}; }

// An image interpolated between pixel centres, and its derivatives.
struct Sampled {
    double value, by_x, by_y;
};
// Bilinear interpolation at (x, y) in the unit square; a b is the upper row, c d the lower row.
static Sampled between(double a, double b, double c, double d, double x, double y) {
    const double right = b - a, bend = (d - c) - right;
    const double by_x = fma(bend, y, right), by_y = fma(bend, x, c - a);
    return {fma(y, by_y, fma(x, right, a)), by_x, by_y};
}

struct RasterArguments {
    int64_t vertices, faces, width, height;
    double lens[4];           // fx, fy, cx, cy, as in `Camera`
    double pose[12];          // world to camera, [3, 4]
    double near;              // faces that come nearer are left out
    const double* positions;  // [P, 3] world units
    const int32_t* corners;   // [F, 3]
    double* flat;             // [P, 3]: written, x and y in px and 1 / z
    int32_t* face;            // [H, W]: written, -1 without a surface
    real* depth;              // [H, W] world units: written, 0 without a surface
};

struct MatchArguments {
    int64_t width, height, source_width, source_height, radius;
    double lens[4], source_lens[4];
    double motion[12];               // from the view's camera to the neighbour's, [3, 4]
    double texture;                  // variance of grey that counts as noise
    double poor, good;               // NCC: weights rise from 0 to 1 between them
    double occluded;                 // of the depth: a neighbour that sees nearer does not see the point
    const real *grey, *source;       // [H, W], [h, w]
    const uint8_t *usable, *source_usable;  // [H, W], [h, w]: 0 for ignored pixels; or null
    const real *depth, *source_depth;       // [H, W], [h, w] world units; 0: no surface
    real* planes;                    // [7, H, W] workspace
    real *gradient, *curvature;      // [H, W]: added to, by depth
    double* sums;                    // [2]: added to, weight * (1 - NCC) and weight
};

struct GatherArguments {
    int64_t width, height;
    double lens[4];
    double grazing;          // cosine between ray and face below which a pixel is left out
    const double* local;     // [P, 3] camera axes
    const double* normals;   // [P, 3] unit, camera axes: the directions in which vertices move
    const int32_t* corners;  // [F, 3]
    const int32_t* face;     // [H, W]
    const real *gradient, *curvature;  // [H, W]
    double *by_vertex, *bend_by_vertex;  // [P]: added to
};

namespace {

constexpr int64_t BAND = 16;          // rows per piece
constexpr int64_t VERTICES = 1 << 14;  // per piece
constexpr double ENOUGH = 0.5;        // fraction of a window that must be visible in both images
constexpr double MARGIN = 1e-6;       // px, for rounding

// -- depth of a mesh --------------------------------------------------------------------------------------------------
void place(const RasterArguments& a, int64_t i) {
    const double *p = a.positions + 3 * i, *m = a.pose;
    double x[3];
    for (int k = 0; k < 3; ++k) x[k] = m[4 * k] * p[0] + m[4 * k + 1] * p[1] + m[4 * k + 2] * p[2] + m[4 * k + 3];
    const bool ahead = x[2] > a.near;
    const double inverse = ahead ? 1 / x[2] : 0;
    double* const to = a.flat + 3 * i;
    to[0] = a.lens[0] * x[0] * inverse + a.lens[2] - 0.5, to[1] = a.lens[1] * x[1] * inverse + a.lens[3] - 0.5;
    to[2] = inverse;
}

double smallest(double a, double b, double c) { return a < b ? (a < c ? a : c) : (b < c ? b : c); }
double largest(double a, double b, double c) { return a > b ? (a > c ? a : c) : (b > c ? b : c); }

// Twice the area of (pixel, a, b); exactly opposite for (pixel, b, a), so that no pixel falls between two faces.
double area(const double* a, const double* b, double x, double y) {
    return (a[0] - x) * (b[1] - y) - (b[0] - x) * (a[1] - y);
}

void draw_rows(const RasterArguments& a, int64_t top, int64_t end) {
    for (int64_t i = top * a.width; i < end * a.width; ++i) a.face[i] = -1, a.depth[i] = 0;
    for (int64_t f = 0; f < a.faces; ++f) {
        const int32_t* const c = a.corners + 3 * f;
        const double *p = a.flat + 3 * int64_t(c[0]), *q = a.flat + 3 * int64_t(c[1]), *r = a.flat + 3 * int64_t(c[2]);
        if (!(p[2] > 0 && q[2] > 0 && r[2] > 0)) continue;
        const double low = smallest(p[1], q[1], r[1]), high = largest(p[1], q[1], r[1]);
        if (!(high >= double(top) - 1 && low <= double(end))) continue;
        const double left = smallest(p[0], q[0], r[0]), right = largest(p[0], q[0], r[0]);
        if (!(right >= 0 && left <= double(a.width - 1))) continue;
        const int64_t y0 = low <= double(top) ? top : int64_t(std::ceil(low - MARGIN));
        const int64_t y1 = high >= double(end - 1) ? end - 1 : int64_t(std::floor(high + MARGIN));
        const int64_t x0 = left <= 0 ? 0 : int64_t(std::ceil(left - MARGIN));
        const int64_t x1 = right >= double(a.width - 1) ? a.width - 1 : int64_t(std::floor(right + MARGIN));
        for (int64_t y = y0; y <= y1; ++y) {
            for (int64_t x = x0; x <= x1; ++x) {
                const double u = area(q, r, double(x), double(y)), v = area(r, p, double(x), double(y));
                const double w = area(p, q, double(x), double(y));
                if (!((u >= 0 && v >= 0 && w >= 0) || (u <= 0 && v <= 0 && w <= 0))) continue;
                const double total = u + v + w;
                if (total == 0) continue;
                const real z = real(total / (u * p[2] + v * q[2] + w * r[2]));
                const int64_t at = y * a.width + x;
                if (a.face[at] < 0 || z < a.depth[at]) a.face[at] = int32_t(f), a.depth[at] = z;
            }
        }
    }
}

// -- two images -------------------------------------------------------------------------------------------------------
// Planes of the workspace: the warped neighbour, its derivative by depth and its visibility; then what windows pass back
// to their pixels: factors of the view's grey, of the neighbour's grey and of 1, and the curvature.
enum Plane { WARPED, SLOPE, VISIBLE, BY_GREY, BY_WARPED, BY_ONE, BEND, PLANES };

struct Neighbour {
    const MatchArguments& a;
    const Lens here = lens_of(a.lens), there = lens_of(a.source_lens);

    // Writes a row of WARPED, SLOPE and VISIBLE.
    void warp(int64_t y, real* warped, real* slope, real* visible) const {
        const double* const m = a.motion;
        const double ray_y = (double(y) - here.cy) / here.fy;
        for (int64_t x = 0; x < a.width; ++x) {
            const int64_t at = y * a.width + x;
            warped[x] = slope[x] = visible[x] = 0;
            const double z = a.depth[at];
            if (!(z > 0) || (a.usable != nullptr && !a.usable[at])) continue;
            const double ray_x = (double(x) - here.cx) / here.fx;
            const double dx = m[0] * ray_x + m[1] * ray_y + m[2], dy = m[4] * ray_x + m[5] * ray_y + m[6];
            const double dz = m[8] * ray_x + m[9] * ray_y + m[10];
            const double far = z * dz + m[11];
            if (!(far > MIN_SCALE * z)) continue;
            const double inverse = 1 / far, u = (z * dx + m[3]) * inverse, v = (z * dy + m[7]) * inverse;
            const double px = there.fx * u + there.cx, py = there.fy * v + there.cy;
            if (!(px >= 0 && py >= 0 && px < double(a.source_width - 1) && py < double(a.source_height - 1))) continue;
            const int64_t i = int64_t(px), j = int64_t(py), from = j * a.source_width + i;
            const int64_t nearest = from + (px - double(i) >= 0.5) + (py - double(j) >= 0.5) * a.source_width;
            if (a.source_usable != nullptr && !a.source_usable[nearest]) continue;
            if (!sees(from, far)) continue;
            const real* const p = a.source + from;
            const Sampled s = between(p[0], p[1], p[a.source_width], p[a.source_width + 1],
                                                      px - double(i), py - double(j));
            warped[x] = real(s.value);
            slope[x] = real((s.by_x * there.fx * (dx - u * dz) + s.by_y * there.fy * (dy - v * dz)) * inverse);
            visible[x] = 1;
        }
    }

    // Whether the neighbour's depth at one of the four pixels around the place agrees.
    bool sees(int64_t from, double far) const {
        const real* const d = a.source_depth + from;
        const double tolerance = a.occluded * far;
        for (int64_t k : {int64_t(0), int64_t(1), a.source_width, a.source_width + 1})
            if (d[k] > 0 && std::fabs(double(d[k]) - far) <= tolerance) return true;
        return false;
    }
};

// Sums of `count` rows of numbers over the columns of a window, with zeros beyond the border.
struct Columns {
    int64_t width, radius;
    real* rows;  // [count, width + 2 radius]
    real* of(int k) const { return rows + k * (width + 2 * radius) + radius; }
    real across(int k, int64_t x) const {
        const real* const row = of(k) + x;
        real total = 0;
        for (int64_t i = -radius; i <= radius; ++i) total += row[i];
        return total;
    }
};

void window_row(const MatchArguments& a, int64_t y, const Columns& c, double* sums) {
    const int64_t size = a.width * a.height;
    for (int k = 0; k < 6; ++k) std::memset(c.of(k), 0, sizeof(real) * size_t(a.width));
    for (int64_t j = y - a.radius < 0 ? 0 : y - a.radius; j <= y + a.radius && j < a.height; ++j) {
        const real *const g = a.grey + j * a.width, *const b = a.planes + j * a.width, *const v = b + VISIBLE * size;
        real *const n = c.of(0), *const ga = c.of(1), *const gb = c.of(2), *const aa = c.of(3), *const bb = c.of(4),
                                 *const ab = c.of(5);
        for (int64_t x = 0; x < a.width; ++x) {
            const real seen = v[x], grey = seen * g[x], other = b[x];
            n[x] += seen, ga[x] += grey, gb[x] += other;
            aa[x] += grey * grey, bb[x] += other * other, ab[x] += grey * other;
        }
    }
    const double least = ENOUGH * double((2 * a.radius + 1) * (2 * a.radius + 1));
    real* const out = a.planes + BY_GREY * size + y * a.width;
    const real* const visible = a.planes + VISIBLE * size + y * a.width;
    for (int64_t x = 0; x < a.width; ++x) {
        for (int k = 0; k < 4; ++k) out[k * size + x] = 0;
        if (!(visible[x] > 0)) continue;
        const double n = c.across(0, x);
        if (n < least) continue;
        const double mean_a = c.across(1, x) / n, mean_b = c.across(2, x) / n;
        double var_a = c.across(3, x) / n - mean_a * mean_a, var_b = c.across(4, x) / n - mean_b * mean_b;
        const double both = c.across(5, x) / n - mean_a * mean_b;
        var_a = var_a > 0 ? var_a : 0, var_b = var_b > 0 ? var_b : 0;
        const double product = std::sqrt(var_a * var_b);
        if (!(product > 0)) continue;
        const double ncc = both / product;
        double trust = (ncc - a.poor) / (a.good - a.poor);
        trust = trust < 0 ? 0 : trust > 1 ? 1 : trust;
        const double weaker = var_a < var_b ? var_a : var_b;
        const double weight = trust * weaker / (weaker + a.texture);
        if (!(weight > 0)) continue;
        const double by_grey = weight / (n * product), by_warped = weight / (n * var_b);
        out[x] = real(-by_grey), out[size + x] = real(ncc * by_warped);
        out[2 * size + x] = real(by_grey * mean_a - ncc * by_warped * mean_b), out[3 * size + x] = real(by_warped);
        sums[0] += weight * (1 - ncc), sums[1] += weight;
    }
}

void pixel_row(const MatchArguments& a, int64_t y, const Columns& c) {
    const int64_t size = a.width * a.height;
    for (int k = 0; k < 4; ++k) {
        real* const to = c.of(k);
        std::memset(to, 0, sizeof(real) * size_t(a.width));
        for (int64_t j = y - a.radius < 0 ? 0 : y - a.radius; j <= y + a.radius && j < a.height; ++j) {
            const real* const from = a.planes + (BY_GREY + k) * size + j * a.width;
            for (int64_t x = 0; x < a.width; ++x) to[x] += from[x];
        }
    }
    const real *const b = a.planes + y * a.width, *const slope = b + SLOPE * size, *const seen = b + VISIBLE * size;
    const real* const grey = a.grey + y * a.width;
    for (int64_t x = 0; x < a.width; ++x) {
        if (!(seen[x] > 0)) continue;
        const real pull = c.across(0, x) * grey[x] + c.across(1, x) * b[x] + c.across(2, x);
        a.gradient[y * a.width + x] += pull * slope[x];
        a.curvature[y * a.width + x] += c.across(3, x) * slope[x] * slope[x];
    }
}

// Calls f(row, columns, piece) for all rows; returns false if out of memory.
template <class F> bool each_row(const MatchArguments& a, F&& f) {
    int failed = 0;
    parallel_ranges(a.height, BAND, [&](int64_t begin, int64_t end) {
        void* const block = std::calloc(size_t(6 * (a.width + 2 * a.radius)), sizeof(real));
        if (block == nullptr) return __atomic_store_n(&failed, 1, __ATOMIC_RELAXED);
        const Columns columns{a.width, a.radius, static_cast<real*>(block)};
        for (int64_t y = begin; y < end; ++y) f(y, columns, begin / BAND);
        std::free(block);
    });
    return failed == 0;
}

}  // namespace
}  // namespace gs2d

using namespace gs2d;

// Draws `face` and `depth`: the nearest face at each pixel centre, of equal depths the first.
GS2D_EXPORT void gs2d_raster_mesh(const RasterArguments* arguments) {
    const RasterArguments& a = *arguments;
    parallel_ranges(a.vertices, VERTICES, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) place(a, i);
    });
    const int64_t rows = 4 * BAND;
    parallel_ranges(a.height, rows, [&](int64_t begin, int64_t end) { draw_rows(a, begin, end); });
}

// Adds the derivatives of the sum of weight (1 - NCC) by the depth of each pixel, with constant weights, and of its
// Gauss-Newton curvature. Returns 0, or 1 if out of memory.
GS2D_EXPORT int gs2d_match_views(const MatchArguments* arguments) {
    const MatchArguments& a = *arguments;
    const int64_t size = a.width * a.height, pieces = (a.height + BAND - 1) / BAND;
    const Neighbour neighbour{a};
    parallel_ranges(a.height, BAND, [&](int64_t begin, int64_t end) {
        for (int64_t y = begin; y < end; ++y) {
            real* const row = a.planes + y * a.width;
            neighbour.warp(y, row, row + SLOPE * size, row + VISIBLE * size);
        }
    });
    double* const sums = static_cast<double*>(std::calloc(size_t(2 * pieces), sizeof(double)));
    if (sums == nullptr) return 1;
    bool done = each_row(a, [&](int64_t y, const Columns& c, int64_t piece) { window_row(a, y, c, sums + 2 * piece); });
    for (int64_t i = 0; i < pieces; ++i) a.sums[0] += sums[2 * i], a.sums[1] += sums[2 * i + 1];
    std::free(sums);
    done = done && each_row(a, [&](int64_t y, const Columns& c, int64_t) { pixel_row(a, y, c); });
    return done ? 0 : 1;
}

// Adds the derivatives of all pixels to the vertices of their faces, by the distance along `normals`.
GS2D_EXPORT void gs2d_gather_vertices(const GatherArguments* arguments) {
    const GatherArguments& g = *arguments;
    const Lens lens = lens_of(g.lens);
    for (int64_t y = 0; y < g.height; ++y) {
        for (int64_t x = 0; x < g.width; ++x) {
            const int64_t at = y * g.width + x;
            const double pull = g.gradient[at], bend = g.curvature[at];
            if (g.face[at] < 0 || (pull == 0 && bend == 0)) continue;
            const int32_t* const corner = g.corners + 3 * int64_t(g.face[at]);
            Vec3<double> p[3];
            for (int k = 0; k < 3; ++k) {
                const double* const from = g.local + 3 * int64_t(corner[k]);
                p[k] = {from[0], from[1], from[2]};
            }
            const Vec3<double> ray = {(double(x) - lens.cx) / lens.fx, (double(y) - lens.cy) / lens.fy, 1};
            const Vec3<double> normal = cross(p[1] - p[0], p[2] - p[0]);
            const double along = dot(normal, ray), length = dot(normal, normal) * dot(ray, ray);
            if (!(along < 0 && along * along > g.grazing * g.grazing * length)) continue;
            double share[3];
            for (int k = 0; k < 3; ++k) share[k] = dot(cross(p[(k + 1) % 3], p[(k + 2) % 3]), ray);
            const double total = share[0] + share[1] + share[2];
            for (int k = 0; k < 3; ++k) {
                const double* const n = g.normals + 3 * int64_t(corner[k]);
                const double by = (normal.x * n[0] + normal.y * n[1] + normal.z * n[2]) / along;
                g.by_vertex[corner[k]] += share[k] / total * by * pull;
                g.bend_by_vertex[corner[k]] += share[k] / total * by * by * bend;
            }
        }
    }
}
