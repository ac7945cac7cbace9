// Response curve and vignetting of rendered images, and their gradients. Pieces have a fixed size and are summed in
// order, so the result is bit-identical for any number of threads.
#include "core/photometry.h"

#include <cmath>
#include <cstdlib>

#include "cpu/export.h"
#include "cpu/pixels.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

constexpr int64_t PIECE = 2048;  // pixels
constexpr int SUMS = 4;          // three of the falloff, one of the shift

// Layout mirrored in render/native_image_ops.py.
struct Shown {
    const real* color;     // [pixels, 3]
    const real* coverage;  // [pixels], or null: 1
    const real* squares;   // [pixels] squared radii, or null: no vignetting
    int64_t pixels;
    double falloff[3];
    double shift;
    double background[3];
};

struct Pixels {
    V light[3], behind[3], u, kept;
    M opaque;
};

Pixels pixels_at(const Shown& s, int64_t first) {
    Pixels p;
    load_pixels(s.color, first, s.pixels, p.light);
    const V coverage = s.coverage ? load_plane(s.coverage, first, s.pixels) : V(real(1));
    for (int c = 0; c < 3; ++c) {
        p.behind[c] = (V(real(1)) - coverage) * V(real(s.background[c]));
        p.light[c] = p.light[c] - p.behind[c];
    }
    p.opaque = coverage >= V(real(1));
    const V a[3] = {V(real(s.falloff[0])), V(real(s.falloff[1])), V(real(s.falloff[2]))};
    p.u = s.squares ? load_plane(s.squares, first, s.pixels) : V(real(0));
    p.kept = s.squares ? falloff(p.u, a) : V(real(1));
    return p;
}

Curve<V> curve_of(const Shown& s) {
    return {V(real(std::exp(s.shift))), V(real(std::exp(-s.shift)))};
}

}  // namespace
}  // namespace gs2d

using namespace gs2d;

GS2D_EXPORT void gs2d_shown(const Shown* shown, real* out) {
    const Curve<V> curve = curve_of(*shown);
    parallel_ranges(shown->pixels, PIECE, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; i += LANES) {
            const Pixels p = pixels_at(*shown, i);
            V seen[3];
            for (int c = 0; c < 3; ++c) {
                const V bent = select(p.opaque, bend(p.light[c], curve).value, p.light[c]);
                seen[c] = fma(p.kept, bent, p.behind[c]);
            }
            store_pixels(out, i, shown->pixels, seen);
        }
    });
}

// sums [4]: the gradients of the falloff and of the shift. Returns 1 if out of memory.
GS2D_EXPORT int gs2d_shown_vjp(const Shown* shown, const real* upstream, real* to_color, double* sums) {
    const int64_t pieces = (shown->pixels + PIECE - 1) / PIECE;
    auto* const of_pieces = static_cast<double*>(std::malloc(static_cast<size_t>(pieces * SUMS + 1) * sizeof(double)));
    if (!of_pieces) return 1;
    const Curve<V> curve = curve_of(*shown);
    parallel_ranges(shown->pixels, PIECE, [&](int64_t begin, int64_t end) {
        V totals[SUMS];
        for (V& total : totals) total = V(real(0));
        for (int64_t i = begin; i < end; i += LANES) {
            const Pixels p = pixels_at(*shown, i);
            V given[3], gradient[3], weight = V(real(0)), shifted = V(real(0));
            load_pixels(upstream, i, shown->pixels, given);
            for (int c = 0; c < 3; ++c) {
                const Bent<V> bent = bend(p.light[c], curve);
                const V through = given[c] * p.kept;
                gradient[c] = through * select(p.opaque, bent.slope, V(real(1)));
                weight = fma(through, select(p.opaque, bent.value, p.light[c]), weight);
                shifted = fma(through, keep(p.opaque, bent.by_shift), shifted);
            }
            V power = weight * p.u;
            for (int k = 0; k < 3; ++k, power = power * p.u) totals[k] = totals[k] - power;
            totals[3] = totals[3] + shifted;
            store_pixels(to_color, i, shown->pixels, gradient);
        }
        for (int k = 0; k < SUMS; ++k) of_pieces[begin / PIECE * SUMS + k] = double(sum(totals[k]));
    });
    for (int k = 0; k < SUMS; ++k) {
        sums[k] = 0;
        for (int64_t i = 0; i < pieces; ++i) sums[k] += of_pieces[i * SUMS + k];
    }
    std::free(of_pieces);
    return 0;
}
