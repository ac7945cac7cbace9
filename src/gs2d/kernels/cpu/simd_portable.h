// simd.h for any processor, by GCC's and clang's vector extensions: 8 floats, or 8 doubles for the tests.
#pragma once

namespace gs2d {

#if defined(GS2D_DOUBLE)
using real = double;
using lane_int = int64_t;
#else
using real = float;
using lane_int = int32_t;
#endif
constexpr int LANES = 8, REGISTERS = 16;

typedef real vreal __attribute__((vector_size(LANES * sizeof(real))));
typedef lane_int vint __attribute__((vector_size(LANES * sizeof(real))));

struct M {
    vint m;
};
struct V {
    vreal v;
    V() = default;
    GS2D_HD V(vreal x) : v(x) {}
    GS2D_HD V(real x) : v(x - vreal{}) {}
};

template <class F> GS2D_HD V per_lane(F f) {
    vreal r{};
    for (int i = 0; i < LANES; ++i) r[i] = f(i);
    return r;
}

GS2D_HD V operator+(V a, V b) { return a.v + b.v; }
GS2D_HD V operator-(V a, V b) { return a.v - b.v; }
GS2D_HD V operator*(V a, V b) { return a.v * b.v; }
GS2D_HD V operator/(V a, V b) { return a.v / b.v; }
GS2D_HD vreal pick(vint m, vreal a, vreal b) { return (vreal)((m & (vint)a) | (~m & (vint)b)); }
// Without a fused instruction a call per lane would cost ten times the rest: round twice there. The double library
// always rounds twice: it is compared with finite differences, not bit for bit.
GS2D_HD V fma(V a, V b, V c) {
#if (defined(__FP_FAST_FMAF) || defined(__ARM_FEATURE_FMA)) && !defined(GS2D_DOUBLE)
    return per_lane([&](int i) { return __builtin_fmaf(a.v[i], b.v[i], c.v[i]); });
#else
    return a.v * b.v + c.v;
#endif
}
GS2D_HD V fnma(V a, V b, V c) { return fma(V(-a.v), b, c); }
GS2D_HD V min(V a, V b) { return pick(a.v < b.v, a.v, b.v); }
GS2D_HD V max(V a, V b) { return pick(a.v > b.v, a.v, b.v); }
GS2D_HD V abs(V a) { return pick(a.v < vreal{}, -a.v, a.v); }
#if defined(GS2D_DOUBLE)
GS2D_HD V sqrt(V a) { return per_lane([&](int i) { return __builtin_sqrt(a.v[i]); }); }
GS2D_HD V exp2(V a) { return per_lane([&](int i) { return __builtin_exp2(a.v[i]); }); }
GS2D_HD V exp(V a) { return per_lane([&](int i) { return __builtin_exp(a.v[i]); }); }
GS2D_HD V log2(V a) { return per_lane([&](int i) { return __builtin_log2(a.v[i]); }); }
GS2D_HD V round(V a) { return per_lane([&](int i) { return __builtin_rint(a.v[i]); }); }
#else
GS2D_HD V sqrt(V a) { return per_lane([&](int i) { return __builtin_sqrtf(a.v[i]); }); }
GS2D_HD V round(V a) { return (a.v + 12582912.f) - 12582912.f; }  // |a| < 2^22; needs value-safe floating point
GS2D_HD V scale2(V a, V n) {
    const vint e = ((vint)(n.v + 12582912.f) - 0x4b400000 + 127) << 23;
    return a.v * (vreal)e;
}
GS2D_HD V split2(V x, V& e) {
    const vint i = (vint)x.v, n = (i - 0x3f3504f3) >> 23;
    e = __builtin_convertvector(n, vreal);
    return (vreal)(i - (n << 23));
}
#endif

GS2D_HD M operator<(V a, V b) { return {a.v < b.v}; }
GS2D_HD M operator<=(V a, V b) { return {a.v <= b.v}; }
GS2D_HD M operator>(V a, V b) { return {a.v > b.v}; }
GS2D_HD M operator>=(V a, V b) { return {a.v >= b.v}; }
GS2D_HD M operator&(M a, M b) { return {a.m & b.m}; }
GS2D_HD M operator|(M a, M b) { return {a.m | b.m}; }
GS2D_HD M operator~(M a) { return {~a.m}; }
GS2D_HD M and_not(M a, M b) { return {a.m & ~b.m}; }  // a & ~b
GS2D_HD uint32_t bits(M m) {
    uint32_t b = 0;
    for (int i = 0; i < LANES; ++i) b |= static_cast<uint32_t>(m.m[i] & 1) << i;
    return b;
}
GS2D_HD bool any(M m) {
    lane_int a = 0;
    for (int i = 0; i < LANES; ++i) a |= m.m[i];
    return a != 0;
}
GS2D_HD bool any_positive(V a, M m) { return any((a > V(0)) & m); }
GS2D_HD bool all(M m) { return !any(~m); }
GS2D_HD M mask_of(uint32_t b) {
    vint m{};
    for (int i = 0; i < LANES; ++i) m[i] = -static_cast<lane_int>((b >> i) & 1u);
    return {m};
}
GS2D_HD M first(int n) { return mask_of((1u << n) - 1u); }
GS2D_HD V select(M m, V a, V b) { return pick(m.m, a.v, b.v); }
GS2D_HD V keep(M m, V a) { return (vreal)(m.m & (vint)a.v); }

GS2D_HD V load(const real* p) {
    V r;
    __builtin_memcpy(&r.v, p, sizeof(r.v));
    return r;
}
GS2D_HD void store(real* p, V a) { __builtin_memcpy(p, &a.v, sizeof(a.v)); }
GS2D_HD V load_first(const real* p, int n) {
    return per_lane([&](int i) { return i < n ? p[i] : real(0); });
}
GS2D_HD void store_first(real* p, V a, int n) {
    for (int i = 0; i < n; ++i) p[i] = a.v[i];
}
GS2D_HD V iota() {
    return per_lane([](int i) { return real(i); });
}
GS2D_HD real sum(V a) {
    return ((a.v[0] + a.v[4]) + (a.v[2] + a.v[6])) + ((a.v[1] + a.v[5]) + (a.v[3] + a.v[7]));
}
// In place, LANES x LANES.
GS2D_HD void transpose(V* v) {
    real t[LANES][LANES];
    for (int i = 0; i < LANES; ++i) store(t[i], v[i]);
    for (int i = 0; i < LANES; ++i) v[i] = per_lane([&](int j) { return t[j][i]; });
}
template <int K> GS2D_HD void transpose_reduce(const V* v, real* p) {
    for (int k = 0; k < K; ++k) p[k] = sum(v[k]);
}

}  // namespace gs2d
