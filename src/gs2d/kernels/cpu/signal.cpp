// Densification signal of a view: adds the norms of the screen gradients to the sums of visible splats.
#include "cpu/export.h"
#include "cpu/simd.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

constexpr int64_t PIECE = 8192;  // splats

struct Signal {
    const real *signal, *radii;       // [N, columns], [N]
    real *signed_sum, *absolute_sum;  // [N]; absolute_sum: only with four columns
    real* count;                      // [N]
};

V norm(V x, V y) { return sqrt(fma(x, x, y * y)); }

template <int COLUMNS> void add_vector(const Signal& s, int64_t i) {
    V signal[COLUMNS];
    load_packed<COLUMNS>(s.signal + COLUMNS * i, signal);
    const M seen = load(s.radii + i) > V(real(0));
    store(s.signed_sum + i, load(s.signed_sum + i) + keep(seen, norm(signal[0], signal[1])));
    if constexpr (COLUMNS == 4)
        store(s.absolute_sum + i, load(s.absolute_sum + i) + keep(seen, norm(signal[2], signal[3])));
    store(s.count + i, load(s.count + i) + keep(seen, V(real(1))));
}

template <int COLUMNS> void add_range(const Signal& s, int64_t begin, int64_t end) {
    int64_t i = begin;
    for (; i + LANES <= end; i += LANES) add_vector<COLUMNS>(s, i);
    if (i == end) return;
    // Process the remainder in a buffer with the same arithmetic, so the result does not depend on the position.
    real signal[COLUMNS * LANES] = {}, radii[LANES] = {}, sums[3][LANES] = {};
    for (int64_t k = 0; k < end - i; ++k) {
        for (int c = 0; c < COLUMNS; ++c) signal[k * COLUMNS + c] = s.signal[(i + k) * COLUMNS + c];
        radii[k] = s.radii[i + k], sums[0][k] = s.signed_sum[i + k], sums[2][k] = s.count[i + k];
        if (COLUMNS == 4) sums[1][k] = s.absolute_sum[i + k];
    }
    add_vector<COLUMNS>({signal, radii, sums[0], sums[1], sums[2]}, 0);
    for (int64_t k = 0; k < end - i; ++k) {
        s.signed_sum[i + k] = sums[0][k], s.count[i + k] = sums[2][k];
        if (COLUMNS == 4) s.absolute_sum[i + k] = sums[1][k];
    }
}

}  // namespace
}  // namespace gs2d

using namespace gs2d;

// columns: 2, or 4 with the absolute signal.
GS2D_EXPORT void gs2d_accumulate_signal(const real* signal, int columns, const real* radii, int64_t n, real* signed_sum,
                                        real* absolute_sum, real* count) {
    const Signal s = {signal, radii, signed_sum, absolute_sum, count};
    parallel_ranges(n, PIECE, [&](int64_t begin, int64_t end) {
        columns == 4 ? add_range<4>(s, begin, end) : add_range<2>(s, begin, end);
    });
}
