// A vector of LANES reals (V) and a mask of LANES bits (M). Only this header depends on the instruction set.
//
// Each library is compiled for one instruction set (CMakeLists.txt), so `V` is one type per library:
//
//   library    real     LANES   file
//   v4         float    16      simd_avx512.h
//   v3         float    8       simd_avx2.h
//   portable   float    8       simd_portable.h (GCC vector extensions; any processor)
//   f64        double   8       simd_portable.h (tests only)
//
// Operations, in addition to + - * / on V, < <= > >= on V returning M, and & | ~ on M:
//   V(real)                   broadcast               load(p), store(p, v)        unaligned, LANES reals
//   load_first(p, n)          first n lanes, rest 0   store_first(p, v, n)        n in 0..LANES
//   fma(a,b,c), fnma(a,b,c)   a*b+c, c-a*b            min, max, abs, sqrt, round  min(a,b) is b where a is NaN
//   exp2, exp, log2           a few ulp               select(m, a, b)             m ? a : b
//   whole(a)                  floor, |a| < 2^22
//   keep(m, a)                m ? a : 0               any(m), all(m), bits(m), mask_of(bits), first(n)
//   iota()                    0, 1, 2, ...            sum(v)                      fixed order
//   REGISTERS                 number of vector registers of the CPU
//   transpose(v)              in place, LANES vectors
//   transpose_reduce<K>(v, p) p[k] = sum(v[k]), K = 16 or 4, fixed order
//   columns_of_8(rows, v)     converts LANES rows of 8 reals to 8 vectors
//   unzip_planes(p, a, b, c)  slopes in x, slopes in y and constants of a splat's planes, repeated
//   with_bits(i, m, bits)     i | bits in the lanes of m (LaneInts); shifted<N>(i): i << N; store(p, i): LANES integers
//   ints_of(v)                LaneInts of whole numbers that fit in 31 bits; row_major(j, width, i): j width + i
//   gather(p, i)              p[i] per lane; gather_pairs(p, i, a, b): p[i] and p[i + 1]
//   load_packed<K>(p, v)      converts LANES rows of K reals to K vectors; store_packed<K> is the inverse
#pragma once

#include <cstddef>
#include <cstdint>
#include <type_traits>
#include <utility>

#include "core/base.h"

namespace gs2d {

// For each 8-bit mask, the indices of its set bits in ascending order.
struct BitNumbers {
    uint8_t of[256][8] = {};
    constexpr BitNumbers() {
        for (int mask = 0; mask < 256; ++mask)
            for (int bit = 0, n = 0; bit < 8; ++bit)
                if (mask >> bit & 1) of[mask][n++] = static_cast<uint8_t>(bit);
    }
};
constexpr BitNumbers BIT_NUMBERS;

// The same indices times STRIDE.
template <int STRIDE> struct BitMultiples {
    static_assert(7 * STRIDE < 1 << 16);
    alignas(16) uint16_t of[256][8] = {};
    constexpr BitMultiples() {
        for (int mask = 0; mask < 256; ++mask)
            for (int i = 0; i < 8; ++i) of[mask][i] = static_cast<uint16_t>(BIT_NUMBERS.of[mask][i] * STRIDE);
    }
};
template <int STRIDE> constexpr BitMultiples<STRIDE> BIT_MULTIPLES;

// Table for 2^x = 2^(n + k / N) 2^f. Entries are the bits of 2^(k / N), minus k << SHIFT: shifting the integer N n + k
// to the exponent leaves those bits in the mantissa. Adding `ROUND` to x leaves N n + k in the lowest bits.
template <int LOG_N> struct Exp2Table {
    static constexpr int N = 1 << LOG_N, SHIFT = 23 - LOG_N;
    static constexpr float ROUND = 1.5f * float(1 << SHIFT);
    alignas(64) uint32_t of[N] = {};
    constexpr Exp2Table() {
        double root = 2, power = 1;
        for (int i = 0; i < LOG_N; ++i) {  // root = sqrt(root), by Newton's method
            double r = root;
            for (int n = 0; n < 40; ++n) r = 0.5 * (r + root / r);
            root = r;
        }
        for (int k = 0; k < N; ++k, power *= root)
            of[k] = __builtin_bit_cast(uint32_t, float(power)) - (uint32_t(k) << SHIFT);
    }
};

}  // namespace gs2d

#if defined(GS2D_DOUBLE)
#include "cpu/simd_portable.h"
#elif defined(__AVX512F__) && defined(__AVX512DQ__) && defined(__AVX512VL__) && defined(__AVX512BW__)
#include "cpu/simd_avx512.h"
#elif defined(__AVX2__) && defined(__FMA__)
#include "cpu/simd_avx2.h"
#else
#include "cpu/simd_portable.h"
#endif

namespace gs2d {

// A block is the pixels of one vector: 4 wide and LANES / 4 high.
constexpr int BLOCK_W = 4;
constexpr int BLOCK_H = LANES / BLOCK_W;
constexpr int TILE = 16;
constexpr int BLOCKS = TILE * TILE / LANES;
constexpr int BLOCKS_X = TILE / BLOCK_W;
using LaneBits = std::conditional_t<LANES == 16, uint16_t, uint8_t>;  // integer type for bits(m)

GS2D_HD M invert(M a) { return ~a; }
GS2D_HD V operator-(V a) { return V(real(0)) - a; }
GS2D_HD V& operator+=(V& a, V b) { return a = a + b; }
GS2D_HD V& operator-=(V& a, V b) { return a = a - b; }
GS2D_HD V& operator*=(V& a, V b) { return a = a * b; }
GS2D_HD V whole(V a) {
    const V nearest = round(a);
    return nearest - keep(nearest > a, V(real(1)));
}

#if !defined(GS2D_OWN_INDICES)
// Writes STRIDE * i for each i < n whose masks[i] has the bit set; both arrays are padded to a multiple of LANES.
// Returns the number of values written.
template <int STRIDE> GS2D_HD int multiples_with_bit(const uint32_t* masks, int n, int bit, uint32_t* out) {
    int count = 0;
    for (int i = 0; i < n; ++i) {
        out[count] = static_cast<uint32_t>(i * STRIDE);
        count += static_cast<int>(masks[i] >> bit & 1u);
    }
    return count;
}
#endif
#if !defined(GS2D_OWN_NONZERO)
// Returns a mask whose bit b is set if p[b] is not 0, b < BLOCKS.
GS2D_HD uint32_t nonzero(const LaneBits* p) {
    uint32_t all = 0;
    for (int b = 0; b < BLOCKS; ++b) all |= uint32_t(p[b] != 0) << b;
    return all;
}
#endif

// Conversion between LANES consecutive rows of K < LANES reals and K vectors, with K - 1 shuffles per vector.
// packed_source and packed_target return the source element for a lane of vector I when vector S is merged into the
// result so far.
template <int K, int I, int S> constexpr int packed_source(int lane) {
    const int e = lane * K + I, vector = e / LANES, at = e % LANES;
    return vector == S ? LANES + at : S > 1 ? lane : vector == 0 ? at : 0;
}
template <int K, int I, int S> constexpr int packed_target(int lane) {
    const int e = I * LANES + lane, vector = e % K, at = e / K;
    return vector == S ? LANES + at : S > 1 ? lane : vector == 0 ? at : 0;
}
template <int K, int I, int S, bool Load, int... L> GS2D_HD V merge_packed(V a, V b, std::integer_sequence<int, L...>) {
#if defined(GS2D_IN_PARTS)
    const auto lane = [&](int i) { return i < LANES ? a[i] : b[i - LANES]; };
    return per_lane([&](int i) { return lane(Load ? packed_source<K, I, S>(i) : packed_target<K, I, S>(i)); });
#else
    return __builtin_shufflevector(a.v, b.v, (Load ? packed_source<K, I, S>(L) : packed_target<K, I, S>(L))...);
#endif
}
template <int K, int I, bool Load, int S = 1> GS2D_HD V gather_packed(const V* v, V sofar) {
    if constexpr (S == K)
        return sofar;
    else
        return gather_packed<K, I, Load, S + 1>(
            v, merge_packed<K, I, S, Load>(sofar, v[S], std::make_integer_sequence<int, LANES>()));
}
template <int K, bool Load, int... I> GS2D_HD void repack(const V* from, V* to, std::integer_sequence<int, I...>) {
    ((to[I] = gather_packed<K, I, Load>(from, from[0])), ...);
}
template <int K> GS2D_HD void load_packed(const real* p, V* v) {
    V rows[K];
    for (int k = 0; k < K; ++k) rows[k] = load(p + k * LANES);
    repack<K, true>(rows, v, std::make_integer_sequence<int, K>());
}
template <int K> GS2D_HD void store_packed(real* p, const V* v) {
    V rows[K];
    repack<K, false>(v, rows, std::make_integer_sequence<int, K>());
    for (int k = 0; k < K; ++k) store(p + k * LANES, rows[k]);
}

#if !defined(GS2D_OWN_UNZIP)
// Splits p = a0 b0 a1 b1 a2 b2 c2 c3 into repetitions of a = a0 a1 a2 0, b = b0 b1 b2 0, c = 0 0 c2 c3.
GS2D_HD void unzip_planes(const real* p, V& a, V& b, V& c) {
    typedef real Four __attribute__((vector_size(4 * sizeof(real))));
    struct Row {
        Four of[LANES / 4];
    };
    Four first, second;
    __builtin_memcpy(&first, p, sizeof first), __builtin_memcpy(&second, p + 4, sizeof second);
    const auto repeated = [](Four v) {
        Row row;
        for (Four& part : row.of) part = v;
        return load(reinterpret_cast<const real*>(&row));
    };
    const Four zero = {};
    a = repeated(__builtin_shufflevector(__builtin_shufflevector(first, second, 0, 2, 4, 4), zero, 0, 1, 2, 4));
    b = repeated(__builtin_shufflevector(__builtin_shufflevector(first, second, 1, 3, 5, 5), zero, 0, 1, 2, 4));
    c = repeated(__builtin_shufflevector(zero, second, 0, 1, 6, 7));
}
#endif
#if !defined(GS2D_OWN_COLUMNS)
// Sets lane i of v[k] to rows[i][k], k < 8.
GS2D_HD void columns_of_8(const real* const* rows, V* v) {
    static_assert(LANES == 8);
    for (int i = 0; i < 8; ++i) v[i] = load(rows[i]);
    transpose(v);
}
#endif

#if !defined(GS2D_DOUBLE)
// Computes 2^x for x in [-126, 127]; relative error below 2e-7. Degree 5, minimax on [-1/2, 1/2].
#if !defined(GS2D_OWN_EXP2)
GS2D_HD V exp2_small(V x) {
    const V n = round(x), f = x - n;
    const V f2 = f * f;
    const V p01 = fma(V(0.69314697f), f, V(1.f)), p23 = fma(V(0.05550713f), f, V(0.2402212f));
    const V p45 = fma(V(0.0013276472f), f, V(0.0096755413f));
    return scale2(fma(fma(p45, f2, p23), f2, p01), n);
}
#endif
GS2D_HD V exp2(V x) { return exp2_small(min(max(x, V(-126.f)), V(127.f))); }

// Computes e^x; relative error below 4e-7 where the result is a normal number; saturates outside.
GS2D_HD V exp(V x) {
    const V n = round(min(max(x * V(float(LOG2E)), V(-126.f)), V(127.f)));
    V f = fnma(n, V(0.693359375f), x);
    f = fnma(n, V(-2.12194440e-4f), f);
    V p = fma(V(1.9875691500e-4f), f, V(1.3981999507e-3f));
    p = fma(p, f, V(8.3334519073e-3f));
    p = fma(p, f, V(4.1665795894e-2f));
    p = fma(p, f, V(1.6666665459e-1f));
    p = fma(p, f, V(0.5f));
    p = fma(p, f * f, f) + V(1.f);
    const V y = scale2(p, n);
    return select(x > V(88.02f), V(__builtin_inff()), select(x < V(-87.3f), V(0.f), y));
}

// Computes log2(x) for normal x > 0: x = 2^e m with m in [sqrt(1/2), sqrt 2], series of atanh((m - 1) / (m + 1)).
GS2D_HD V log2(V x) {
    V e;
    const V m = split2(x, e);
    const V s = (m - V(1.f)) / (m + V(1.f)), s2 = s * s;
    V p = fma(V(2.8853901f / 9.f), s2, V(2.8853901f / 7.f));
    p = fma(p, s2, V(2.8853901f / 5.f));
    p = fma(p, s2, V(2.8853901f / 3.f));
    p = fma(p, s2, V(2.8853901f));
    return fma(p, s, e);
}
#endif

}  // namespace gs2d
