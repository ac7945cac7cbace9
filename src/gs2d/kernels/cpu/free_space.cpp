// Counts splats in the free space of an image and splats on its surface (torch version:
// training/robust/free_space_maps.py). Splats are independent, so the result does not depend on the number of threads.
#include <cmath>
#include <cstdint>

#include "cpu/simd.h"
#include "cpu/export.h"
#include "cpu/threads.h"

namespace gs2d {

// Arrays are contiguous.
struct FreeSpaceArguments {
    int64_t count, places, height, width;
    const real* ends;     // [places, count, 3] sample points in world coordinates; the first is the centre
    const real* reach;    // [count], world units: largest distance of a sample point from the centre
    const real* project;  // [3, 4]: (x z, y z, z) = project (p, 1), px
    const real* center;   // [3] camera centre, world
    real radius;          // radius of the ball around the camera that is free space
    const real* limit;    // [height, width]: points closer than this are in free space
    const real* known;    // [height, width]: depth of the surface, infinite if unknown
    real fraction;        // tolerance for a centre on the surface, relative to that depth
    int32_t* against;     // [count]: incremented if a sample point is in free space
    int32_t* support;     // [count]: incremented if the centre is on the surface
};

namespace {

constexpr int64_t PIECE = 4096;  // splats

struct Plane {
    real x, y, z, offset, norm;
    real at(const real* p) const { return x * p[0] + y * p[1] + z * p[2] + offset; }
};

// Half space of an image border: points with a positive value are inside.
Plane plane(real x, real y, real z, real offset) { return {x, y, z, offset, std::sqrt(x * x + y * y + z * z)}; }

struct View {
    const FreeSpaceArguments& a;
    Plane rows[3], borders[5];

    explicit View(const FreeSpaceArguments& arguments) : a(arguments) {
        const real* m = a.project;
        for (int i = 0; i < 3; ++i) rows[i] = plane(m[4 * i], m[4 * i + 1], m[4 * i + 2], m[4 * i + 3]);
        const auto opposite = [&](int i, int64_t size) {
            real n[4];
            for (int k = 0; k < 4; ++k) n[k] = real(size) * m[8 + k] - m[4 * i + k];
            return plane(n[0], n[1], n[2], n[3]);
        };
        borders[0] = rows[2], borders[1] = rows[0], borders[2] = rows[1];
        borders[3] = opposite(0, a.width), borders[4] = opposite(1, a.height);
    }

    // True if no point within `reach` can be in the image, with a margin for rounding.
    bool misses(const real* p, real reach) const {
        const real size = std::fabs(p[0]) + std::fabs(p[1]) + std::fabs(p[2]);
        for (const Plane& border : borders) {
            const real slack = border.norm * (real(1.001) * reach + real(1e-6) * size) + real(1e-6) * std::fabs(border.offset);
            if (border.at(p) < -slack) return true;
        }
        return false;
    }

    // Computes the depth and pixel of a point; returns false if no pixel shows it.
    bool shows(const real* p, real& z, int64_t& pixel) const {
        z = rows[2].at(p);
        if (!(z > 0)) return false;
        const real front = z > real(1e-12) ? z : real(1e-12), x = rows[0].at(p) / front, y = rows[1].at(p) / front;
        if (!(x >= 0 && y >= 0 && x < real(a.width) && y < real(a.height))) return false;
        pixel = int64_t(y) * a.width + int64_t(x);
        return true;
    }

    void look(int64_t i) const {
        const real* p = a.ends + 3 * i;
        const real dx = p[0] - a.center[0], dy = p[1] - a.center[1], dz = p[2] - a.center[2];
        bool free = std::sqrt(dx * dx + dy * dy + dz * dz) < a.radius;
        if (misses(p, a.reach[i])) {
            a.against[i] += free;
            return;
        }
        real z;
        int64_t pixel;
        if (shows(p, z, pixel)) {
            free |= z < a.limit[pixel];
            const real known = a.known[pixel];
            a.support[i] += std::isfinite(known) && std::fabs(z - known) <= a.fraction * known;
        }
        for (int64_t k = 1; k < a.places && !free; ++k)
            if (shows(a.ends + 3 * (k * a.count + i), z, pixel)) free = z < a.limit[pixel];
        a.against[i] += free;
    }
};

}  // namespace
}  // namespace gs2d

using namespace gs2d;

GS2D_EXPORT void gs2d_free_space(const FreeSpaceArguments* arguments) {
    const View view(*arguments);
    parallel_ranges(arguments->count, PIECE, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) view.look(i);
    });
}
