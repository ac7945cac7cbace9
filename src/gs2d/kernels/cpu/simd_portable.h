// simd.h for any CPU, using GCC and clang vector extensions: 8 floats, or 8 doubles for the tests.
#pragma once

#define GS2D_IN_PARTS

namespace gs2d {

#if defined(GS2D_DOUBLE)
using real = double;
using lane_int = int64_t;
#else
using real = float;
using lane_int = int32_t;
#endif
constexpr int LANES = 8, REGISTERS = 16;

// A vector consists of 16-byte parts, which any CPU supports: g++ compares wider vectors lane by lane.
constexpr int WIDE = 16 / sizeof(real), PARTS = LANES / WIDE;
typedef real Part __attribute__((vector_size(16)));
typedef lane_int PartMask __attribute__((vector_size(16)));

struct M {
    PartMask of[PARTS];
};
struct V {
    Part of[PARTS];
    V() = default;
    GS2D_HD V(real x);
    GS2D_HD real operator[](int i) const { return of[i / WIDE][i % WIDE]; }
};

// Combines the results of f(k) for each part k. Unrolled by hand: a loop would keep its arrays in memory.
template <class T, class F> GS2D_HD T per_part(F f) {
    T r;
    r.of[0] = f(0), r.of[1] = f(1);
    if constexpr (PARTS == 4) r.of[2] = f(2), r.of[3] = f(3);
    return r;
}
template <class F> GS2D_HD V per_lane(F f) {
    return per_part<V>([&](int k) {
        Part r{};
        for (int i = 0; i < WIDE; ++i) r[i] = f(k * WIDE + i);
        return r;
    });
}
GS2D_HD V::V(real x) {
    *this = per_part<V>([&](int) { return x - Part{}; });
}

GS2D_HD V operator+(V a, V b) {
    return per_part<V>([&](int k) { return a.of[k] + b.of[k]; });
}
GS2D_HD V operator-(V a, V b) {
    return per_part<V>([&](int k) { return a.of[k] - b.of[k]; });
}
GS2D_HD V operator*(V a, V b) {
    return per_part<V>([&](int k) { return a.of[k] * b.of[k]; });
}
GS2D_HD V operator/(V a, V b) {
    return per_part<V>([&](int k) { return a.of[k] / b.of[k]; });
}
// Rounds twice if the CPU has no fused instruction, where a library call per lane would be about ten times slower. The
// double library always rounds twice: it is compared with finite differences, not bit for bit.
GS2D_HD V fma(V a, V b, V c) {
#if (defined(__FP_FAST_FMAF) || defined(__ARM_FEATURE_FMA)) && !defined(GS2D_DOUBLE)
    return per_lane([&](int i) { return __builtin_fmaf(a[i], b[i], c[i]); });
#else
    return a * b + c;
#endif
}
GS2D_HD V negated(V a) {
    return per_part<V>([&](int k) { return -a.of[k]; });
}
GS2D_HD V fnma(V a, V b, V c) { return fma(negated(a), b, c); }

GS2D_HD M operator<(V a, V b) {
    return per_part<M>([&](int k) { return a.of[k] < b.of[k]; });
}
GS2D_HD M operator<=(V a, V b) {
    return per_part<M>([&](int k) { return a.of[k] <= b.of[k]; });
}
GS2D_HD M operator>(V a, V b) { return b < a; }
GS2D_HD M operator>=(V a, V b) { return b <= a; }
GS2D_HD M operator&(M a, M b) {
    return per_part<M>([&](int k) { return a.of[k] & b.of[k]; });
}
GS2D_HD M operator|(M a, M b) {
    return per_part<M>([&](int k) { return a.of[k] | b.of[k]; });
}
GS2D_HD M operator~(M a) {
    return per_part<M>([&](int k) { return ~a.of[k]; });
}
GS2D_HD M and_not(M a, M b) {  // a & ~b
    return per_part<M>([&](int k) { return a.of[k] & ~b.of[k]; });
}
GS2D_HD V select(M m, V a, V b) {
    return per_part<V>([&](int k) { return (Part)((m.of[k] & (PartMask)a.of[k]) | (~m.of[k] & (PartMask)b.of[k])); });
}
GS2D_HD V keep(M m, V a) {
    return per_part<V>([&](int k) { return (Part)(m.of[k] & (PartMask)a.of[k]); });
}
GS2D_HD V min(V a, V b) { return select(a < b, a, b); }
GS2D_HD V max(V a, V b) { return select(a > b, a, b); }
GS2D_HD V abs(V a) { return select(a < V(real(0)), negated(a), a); }
#if defined(GS2D_DOUBLE)
GS2D_HD V sqrt(V a) {
    return per_lane([&](int i) { return __builtin_sqrt(a[i]); });
}
GS2D_HD V exp2(V a) {
    return per_lane([&](int i) { return __builtin_exp2(a[i]); });
}
GS2D_HD V exp(V a) {
    return per_lane([&](int i) { return __builtin_exp(a[i]); });
}
GS2D_HD V log2(V a) {
    return per_lane([&](int i) { return __builtin_log2(a[i]); });
}
GS2D_HD V round(V a) {
    return per_lane([&](int i) { return __builtin_rint(a[i]); });
}
#else
GS2D_HD V sqrt(V a) {
    return per_lane([&](int i) { return __builtin_sqrtf(a[i]); });
}
GS2D_HD V round(V a) { return (a + V(12582912.f)) - V(12582912.f); }  // |a| < 2^22; needs value-safe floating point
// Unsigned arithmetic, which wraps around: lanes that are masked out later may hold any value here.
typedef uint32_t PartBits __attribute__((vector_size(16)));
GS2D_HD V scale2(V a, V n) {
    return per_part<V>(
        [&](int k) { return a.of[k] * (Part)(((PartBits)(n.of[k] + 12582912.f) - 0x4b400000u + 127u) << 23); });
}
GS2D_HD V split2(V x, V& e) {
    const auto exponent = [](Part part) { return (PartMask)((PartBits)part - 0x3f3504f3u) >> 23; };
    e = per_part<V>([&](int k) { return __builtin_convertvector(exponent(x.of[k]), Part); });
    return per_part<V>([&](int k) { return (Part)((PartBits)x.of[k] - ((PartBits)exponent(x.of[k]) << 23)); });
}
#endif

// Sets bit i in lane i.
GS2D_HD M own_bits() {
    return per_part<M>([](int k) {
        PartMask r{};
        for (int i = 0; i < WIDE; ++i) r[i] = lane_int(1) << (k * WIDE + i);
        return r;
    });
}
GS2D_HD PartMask or_of_parts(M m) {
    if constexpr (PARTS == 4)
        return (m.of[0] | m.of[1]) | (m.of[2] | m.of[3]);
    else
        return m.of[0] | m.of[1];
}
GS2D_HD uint32_t bits(M m) {
    const PartMask part = or_of_parts(m & own_bits());
    uint32_t b = 0;
    for (int i = 0; i < WIDE; ++i) b |= static_cast<uint32_t>(part[i]);
    return b;
}
GS2D_HD bool any(M m) {
    typedef int64_t Two __attribute__((vector_size(16)));
    const Two two = (Two)or_of_parts(m);
    return (two[0] | two[1]) != 0;
}
GS2D_HD bool all(M m) { return !any(~m); }
GS2D_HD M mask_of(uint32_t b) {
    const M own = own_bits();
    return per_part<M>([&](int k) { return (own.of[k] & (lane_int(b) - PartMask{})) == own.of[k]; });
}
GS2D_HD M first(int n) { return mask_of((1u << n) - 1u); }

using LaneInts = M;
GS2D_HD LaneInts with_bits(LaneInts i, M m, uint32_t bits) {
    return per_part<M>([&](int k) { return i.of[k] | (m.of[k] & (lane_int(bits) - PartMask{})); });
}
template <int N> GS2D_HD LaneInts shifted(LaneInts i) {
    return per_part<M>([&](int k) { return i.of[k] << N; });
}
GS2D_HD void store(uint32_t* p, LaneInts n) {
    for (int i = 0; i < LANES; ++i) p[i] = static_cast<uint32_t>(n.of[i / WIDE][i % WIDE]);
}
GS2D_HD LaneInts ints_of(V a) {
    return per_part<M>([&](int k) { return __builtin_convertvector(a.of[k], PartMask); });
}
GS2D_HD LaneInts row_major(LaneInts j, int width, LaneInts i) {
    return per_part<M>([&](int k) { return j.of[k] * lane_int(width) + i.of[k]; });
}
GS2D_HD V gather(const real* p, LaneInts n) {
    return per_lane([&](int i) { return p[n.of[i / WIDE][i % WIDE]]; });
}
GS2D_HD void gather_pairs(const real* p, LaneInts n, V& a, V& b) { a = gather(p, n), b = gather(p + 1, n); }

GS2D_HD V load(const real* p) {
    V r;
    __builtin_memcpy(&r.of, p, sizeof(r.of));
    return r;
}
GS2D_HD void store(real* p, V a) { __builtin_memcpy(p, &a.of, sizeof(a.of)); }
GS2D_HD V load_first(const real* p, int n) {
    return per_lane([&](int i) { return i < n ? p[i] : real(0); });
}
GS2D_HD void store_first(real* p, V a, int n) {
    for (int i = 0; i < n; ++i) p[i] = a[i];
}
GS2D_HD V iota() {
    return per_lane([](int i) { return real(i); });
}
#if defined(GS2D_DOUBLE)
GS2D_HD real sum(V a) {  // ((0 + 4) + (2 + 6)) + ((1 + 5) + (3 + 7)), here and below
    const Part p = (a.of[0] + a.of[2]) + (a.of[1] + a.of[3]);
    return p[0] + p[1];
}
// Transposes LANES x LANES values in place.
GS2D_HD void transpose(V* v) {
    real t[LANES][LANES];
    for (int i = 0; i < LANES; ++i) store(t[i], v[i]);
    for (int i = 0; i < LANES; ++i) v[i] = per_lane([&](int j) { return t[j][i]; });
}
template <int K> GS2D_HD void transpose_reduce(const V* v, real* p) {
    for (int k = 0; k < K; ++k) p[k] = sum(v[k]);
}
#else
GS2D_HD real sum(V a) {
    const Part p = a.of[0] + a.of[1];
    return (p[0] + p[2]) + (p[1] + p[3]);
}
// Transposes 4 x 4 values in place: one part of each of four vectors.
GS2D_HD void transpose(Part& a, Part& b, Part& c, Part& d) {
    const Part ab = __builtin_shufflevector(a, b, 0, 4, 1, 5), cd = __builtin_shufflevector(c, d, 0, 4, 1, 5);
    const Part ab2 = __builtin_shufflevector(a, b, 2, 6, 3, 7), cd2 = __builtin_shufflevector(c, d, 2, 6, 3, 7);
    a = __builtin_shufflevector(ab, cd, 0, 1, 4, 5), b = __builtin_shufflevector(ab, cd, 2, 3, 6, 7);
    c = __builtin_shufflevector(ab2, cd2, 0, 1, 4, 5), d = __builtin_shufflevector(ab2, cd2, 2, 3, 6, 7);
}
GS2D_HD void transpose(V* v) {
    for (int k = 0; k < 2; ++k)
        for (int i = 0; i < 8; i += 4) transpose(v[i].of[k], v[i + 1].of[k], v[i + 2].of[k], v[i + 3].of[k]);
    for (int i = 0; i < 4; ++i) {
        const Part upper = v[i].of[1];
        v[i].of[1] = v[i + 4].of[0], v[i + 4].of[0] = upper;
    }
}
template <int K> GS2D_HD void transpose_reduce(const V* v, real* p) {
    for (int k = 0; k < K; k += 4) {
        const auto half = [&](int i) { return v[k + i].of[0] + v[k + i].of[1]; };
        Part a = half(0), b = half(1), c = half(2), d = half(3);
        transpose(a, b, c, d);
        const Part sums = (a + c) + (b + d);
        __builtin_memcpy(p + k, &sums, sizeof sums);
    }
}
#endif

}  // namespace gs2d
