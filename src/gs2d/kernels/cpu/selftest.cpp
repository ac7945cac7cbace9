// Exposes the arithmetic of the vector wrapper to the tests.
#include "core/tile.h"
#include "cpu/export.h"
#include "cpu/simd.h"

using namespace gs2d;

// out = f(in), n a multiple of LANES; which: 0 exp2, 1 exp, 2 log2, 3 round, 4 sqrt. Returns false for other values.
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

// Transposes in: [LANES, LANES] to out: [LANES, LANES].
GS2D_EXPORT void gs2d_selftest_transpose(const real* in, real* out) {
    V v[LANES];
    for (int i = 0; i < LANES; ++i) v[i] = load(in + i * LANES);
    transpose(v);
    for (int i = 0; i < LANES; ++i) store(out + i * LANES, v[i]);
}

// in: [20, LANES]; out: [20], lane sums of the first 16 and the last 4 vectors.
GS2D_EXPORT void gs2d_selftest_transpose_reduce(const real* in, real* out) {
    V v[20];
    for (int i = 0; i < 20; ++i) v[i] = load(in + i * LANES);
    transpose_reduce<16>(v, out);
    transpose_reduce<4>(v + 16, out + 16);
}

// Writes the indices i < n whose masks[i] has the bit set; `masks` and `out` are padded by LANES. Returns their number.
GS2D_EXPORT int gs2d_selftest_indices_with_bit(const uint32_t* masks, int n, int bit, uint32_t* out) {
    constexpr int STRIDE = 736;
    const int count = multiples_with_bit<STRIDE>(masks, n, bit, out);
    for (int i = 0; i < count; ++i) out[i] = out[i] % STRIDE ? ~0u : out[i] / STRIDE;
    return count;
}

namespace {
template <int K> void repack_there_and_back(const real* in, real* out, real* back) {
    V v[K];
    load_packed<K>(in, v);
    for (int k = 0; k < K; ++k) store(out + k * LANES, v[k]);
    store_packed<K>(back, v);
}
}  // namespace

// in: [LANES, k] rows; out: [k, LANES]; back: same layout as in. k: 2, 3 or 4.
GS2D_EXPORT void gs2d_selftest_packed(int k, const real* in, real* out, real* back) {
    if (k == 2) repack_there_and_back<2>(in, out, back);
    if (k == 3) repack_there_and_back<3>(in, out, back);
    if (k == 4) repack_there_and_back<4>(in, out, back);
}

// in: [LANES, 8]; out: [8, LANES].
GS2D_EXPORT void gs2d_selftest_columns(const real* in, real* out) {
    const real* rows[LANES];
    for (int i = 0; i < LANES; ++i) rows[i] = in + i * 8;
    V v[8];
    columns_of_8(rows, v);
    for (int k = 0; k < 8; ++k) store(out + k * LANES, v[k]);
}

// Sets bits[0] in the lanes of masks[0], shifts left by 4, then sets bits[1] in the lanes of masks[1].
GS2D_EXPORT void gs2d_selftest_with_bits(const uint32_t* masks, const uint32_t* bits, uint32_t* out) {
    store(out, with_bits(shifted<4>(with_bits(LaneInts{}, mask_of(masks[0]), bits[0])), mask_of(masks[1]), bits[1]));
}

// in: 8 reals; out: [3, LANES].
GS2D_EXPORT void gs2d_selftest_unzip(const real* in, real* out) {
    V v[3];
    unzip_planes(in, v[0], v[1], v[2]);
    for (int k = 0; k < 3; ++k) store(out + k * LANES, v[k]);
}

// Returns a mask whose bit b is set if in[b] is not 0, for the blocks of a tile.
GS2D_EXPORT uint32_t gs2d_selftest_nonzero(const uint32_t* in) {
    LaneBits of[BLOCKS];
    for (int b = 0; b < BLOCKS; ++b) of[b] = LaneBits(in[b]);
    return nonzero(of);
}

// in: [11, LANES], the per-splat arguments of outline_of; image: near, width, height. left, right: [LANES], the
// interval of each outline in rows y0 to y1.
GS2D_EXPORT void gs2d_selftest_outline(const real* in, const real* image, real y0, real y1, real* left, real* right) {
    V v[11], from, to;
    for (int k = 0; k < 11; ++k) v[k] = load(in + k * LANES);
    const Outline<V> outline = outline_of(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8], v[9], v[10],
                                          V(image[0]), V(image[1]), V(image[2]));
    reach_in_rows(outline, V(y0) - v[8], V(y1) - v[8], from, to);
    store(left, from), store(right, to);
}
