// Exposure of rendered images, and its gradients. Pieces have a fixed size and are summed in order, so the result is
// bit-identical for any number of threads.
#include "core/exposure.h"

#include <cstdlib>

#include "cpu/export.h"
#include "cpu/pixels.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

constexpr int64_t PIECE = 2048;  // pixels
constexpr int SUMS = 12;

// Filled in render/exposure_transform.py.
struct Picture {
    const real* color;     // [pixels, 3]
    const real* coverage;  // [pixels], or null: 1
    int64_t pixels;
    double transform[3][4];  // A, b
    double background[3];
};

Exposure<V> exposure_of(const Picture& p) {
    Exposure<V> e;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) e.A[i][j] = V(real(p.transform[i][j]));
        e.b[i] = V(real(p.transform[i][3])), e.background[i] = V(real(p.background[i]));
    }
    return e;
}

V coverage_at(const Picture& p, int64_t first) {
    return p.coverage ? load_plane(p.coverage, first, p.pixels) : V(real(1));
}

}  // namespace
}  // namespace gs2d

using namespace gs2d;

// Unnamed parameters of the exported functions are reserved and null.
GS2D_EXPORT void gs2d_expose(const Picture* picture, const void*, real* out, void*) {
    const Exposure<V> e = exposure_of(*picture);
    parallel_ranges(picture->pixels, PIECE, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; i += LANES) {
            V color[3], seen[3];
            load_pixels(picture->color, i, picture->pixels, color);
            expose(color, coverage_at(*picture, i), e, seen);
            store_pixels(out, i, picture->pixels, seen);
        }
    });
}

// sums: the gradient of the transform [3, 4]. Returns 1 if out of memory.
GS2D_EXPORT int gs2d_expose_vjp(const Picture* picture, const void*, const real* upstream, real* to_color,
                                double* sums) {
    const int64_t pieces = (picture->pixels + PIECE - 1) / PIECE;
    auto* const of_pieces = static_cast<double*>(std::malloc(static_cast<size_t>(pieces * SUMS + 1) * sizeof(double)));
    if (!of_pieces) return 1;
    const Exposure<V> e = exposure_of(*picture);
    parallel_ranges(picture->pixels, PIECE, [&](int64_t begin, int64_t end) {
        V totals[3][4];
        for (auto& row : totals)
            for (V& total : row) total = V(real(0));
        for (int64_t i = begin; i < end; i += LANES) {
            V color[3], given[3], gradient[3];
            load_pixels(picture->color, i, picture->pixels, color);
            load_pixels(upstream, i, picture->pixels, given);
            expose_vjp(given, color, coverage_at(*picture, i), e, gradient, totals);
            store_pixels(to_color, i, picture->pixels, gradient);
        }
        for (int k = 0; k < SUMS; ++k) of_pieces[begin / PIECE * SUMS + k] = double(sum(totals[k / 4][k % 4]));
    });
    for (int k = 0; k < SUMS; ++k) {
        sums[k] = 0;
        for (int64_t i = 0; i < pieces; ++i) sums[k] += of_pieces[i * SUMS + k];
    }
    std::free(of_pieces);
    return 0;
}
