// The vector wrapper's own arithmetic, for the tests.
#include "cpu/export.h"
#include "cpu/simd.h"

using namespace gs2d;

// out = f(in), n a multiple of the lanes; which: 0 exp2, 1 exp, 2 log2, 3 round, 4 sqrt. Returns false for others.
GS2D_EXPORT int gs2d_selftest_unary(int which, const real* in, real* out, int64_t n) {
    for (int64_t i = 0; i < n; i += LANES) {
        const V x = load(in + i);
        switch (which) {
            case 0: store(out + i, exp2(x)); break;
            case 1: store(out + i, exp(x)); break;
            case 2: store(out + i, log2(x)); break;
            case 3: store(out + i, round(x)); break;
            case 4: store(out + i, sqrt(x)); break;
            default: return 0;
        }
    }
    return 1;
}

// in, out: [LANES, LANES].
GS2D_EXPORT void gs2d_selftest_transpose(const real* in, real* out) {
    V v[LANES];
    for (int i = 0; i < LANES; ++i) v[i] = load(in + i * LANES);
    transpose(v);
    for (int i = 0; i < LANES; ++i) store(out + i * LANES, v[i]);
}

// in: [20, LANES]; out: [20], sums over lanes of the first 16 and the last 4 vectors.
GS2D_EXPORT void gs2d_selftest_transpose_reduce(const real* in, real* out) {
    V v[20];
    for (int i = 0; i < 20; ++i) v[i] = load(in + i * LANES);
    transpose_reduce<16>(v, out);
    transpose_reduce<4>(v + 16, out + 16);
}

// The indices i < n whose masks[i] has the bit; `masks` and `out` padded by LANES. Returns how many.
GS2D_EXPORT int gs2d_selftest_indices_with_bit(const uint32_t* masks, int n, int bit, uint32_t* out) {
    return indices_with_bit(masks, n, bit, out);
}

namespace {
template <int K> void repack_there_and_back(const real* in, real* out, real* back) {
    V v[K];
    load_packed<K>(in, v);
    for (int k = 0; k < K; ++k) store(out + k * LANES, v[k]);
    store_packed<K>(back, v);
}
}  // namespace

// in: [LANES, k] rows; out: [k, LANES]; back: like in. k: 2, 3 or 4.
GS2D_EXPORT void gs2d_selftest_packed(int k, const real* in, real* out, real* back) {
    if (k == 2) repack_there_and_back<2>(in, out, back);
    if (k == 3) repack_there_and_back<3>(in, out, back);
    if (k == 4) repack_there_and_back<4>(in, out, back);
}

// Four masks of LANES bits.
GS2D_EXPORT uint64_t gs2d_selftest_interleave(const uint32_t* masks) {
    const M m[4] = {mask_of(masks[0]), mask_of(masks[1]), mask_of(masks[2]), mask_of(masks[3])};
    return interleave(m);
}

// in: [LANES / rows, 4], rows = 4 with 16 lanes and 8 with 8; out: [4, LANES].
GS2D_EXPORT void gs2d_selftest_spread(const real* in, real* out) {
    const real* rows[4] = {in, in + 4, in + 8, in + 12};
    V v[4];
    spread(rows, v);
    for (int k = 0; k < 4; ++k) store(out + k * LANES, v[k]);
}
