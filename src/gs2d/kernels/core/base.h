// Basic arithmetic of core/ on a value type V.
//
// core/ contains every formula of the rasterizer once, as header-only templates on V. V is float or double (float in a
// CUDA thread), or on the CPU a vector of pixels or splats, for which cpu/simd.h overloads the same names. Rules: no
// branches on a V (use select), no std::, and every fused multiply-add is written as fma, so that the forward and
// backward passes of all backends round alike.
#pragma once

#if defined(__CUDACC__) || defined(__CUDACC_RTC__) || defined(__AMDGCN__)
#define GS2D_HD __host__ __device__ __forceinline__
#define GS2D_UNROLL _Pragma("unroll")
#else
#define GS2D_HD inline __attribute__((always_inline))
#define GS2D_UNROLL _Pragma("GCC unroll 16")
#endif

// With GS2D_RAYS 1 the rasterizer is compiled for cameras with any ray per pixel, in a namespace of its own, else for
// pinhole cameras; a build has both (CMakeLists.txt).
#if GS2D_RAYS
#define gs2d gs2d_rays
#endif

namespace gs2d {

constexpr double LN2 = 0.69314718055994530942;
constexpr double LOG2E = 1.44269504088896340736;

#if defined(__CUDACC_RTC__)
GS2D_HD float fma(float a, float b, float c) { return fmaf(a, b, c); }
GS2D_HD float sqrt(float a) { return sqrtf(a); }
GS2D_HD float abs(float a) { return fabsf(a); }
GS2D_HD float exp(float a) { return expf(a); }
GS2D_HD float exp2(float a) { return exp2f(a); }
GS2D_HD float log2(float a) { return log2f(a); }
GS2D_HD float ceil(float a) { return ceilf(a); }
#else
GS2D_HD float fma(float a, float b, float c) { return __builtin_fmaf(a, b, c); }
GS2D_HD float sqrt(float a) { return __builtin_sqrtf(a); }
GS2D_HD float abs(float a) { return __builtin_fabsf(a); }
GS2D_HD float exp(float a) { return __builtin_expf(a); }
GS2D_HD float exp2(float a) { return __builtin_exp2f(a); }
GS2D_HD float log2(float a) { return __builtin_log2f(a); }
GS2D_HD float ceil(float a) { return __builtin_ceilf(a); }
GS2D_HD double fma(double a, double b, double c) { return __builtin_fma(a, b, c); }
GS2D_HD double sqrt(double a) { return __builtin_sqrt(a); }
GS2D_HD double abs(double a) { return __builtin_fabs(a); }
GS2D_HD double exp(double a) { return __builtin_exp(a); }
GS2D_HD double exp2(double a) { return __builtin_exp2(a); }
GS2D_HD double log2(double a) { return __builtin_log2(a); }
GS2D_HD double ceil(double a) { return __builtin_ceil(a); }
#endif

// select(m, a, b) is a where m holds, else b; keep(m, a) is a or 0. min(a, b) is b when a is NaN.
GS2D_HD float select(bool m, float a, float b) { return m ? a : b; }
GS2D_HD double select(bool m, double a, double b) { return m ? a : b; }
GS2D_HD bool and_not(bool a, bool b) { return a && !b; }  // a & ~b
GS2D_HD bool invert(bool a) { return !a; }
GS2D_HD float keep(bool m, float a) { return m ? a : 0.f; }
GS2D_HD double keep(bool m, double a) { return m ? a : 0.; }
GS2D_HD float min(float a, float b) { return a < b ? a : b; }
GS2D_HD float max(float a, float b) { return a > b ? a : b; }
GS2D_HD double min(double a, double b) { return a < b ? a : b; }
GS2D_HD double max(double a, double b) { return a > b ? a : b; }
GS2D_HD float whole(float a) { return float(int(a)); }  // floor for non-negative values that fit in 31 bits
GS2D_HD double whole(double a) { return double(int(a)); }

// Functions for the innermost loops. On a GPU their instructions have errors of 1 or 2 units in the last place, the
// same in the forward and the backward pass; elsewhere they have the precision of the type.

// 2^x for x <= 0; the result must not be used for very negative or non-finite x.
template <class V> GS2D_HD V exp2_small(V x) { return exp2(x); }
template <class V> GS2D_HD V reciprocal(V a) { return V(1) / a; }
template <class V> GS2D_HD V quotient(V a, V b) { return a / b; }
#if defined(__CUDACC_RTC__)
GS2D_HD float exp2_small(float x) {
    float r;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
    return r;
}
GS2D_HD float reciprocal(float a) {
    float r;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(a));
    return r;
}
GS2D_HD float quotient(float a, float b) { return a * reciprocal(b); }
#elif defined(__AMDGCN__)
#if __has_builtin(__builtin_amdgcn_exp2f)  // older compilers generate the same instruction for exp2
GS2D_HD float exp2_small(float x) { return __builtin_amdgcn_exp2f(x); }
#endif
GS2D_HD float reciprocal(float a) { return __builtin_amdgcn_rcpf(a); }
GS2D_HD float quotient(float a, float b) { return a * reciprocal(b); }
#endif

// c - a * b, fused.
template <class V> GS2D_HD V fnma(V a, V b, V c) { return fma(-a, b, c); }

template <class V> struct Vec3 {
    V x, y, z;
};
template <class V> GS2D_HD Vec3<V> operator+(Vec3<V> a, Vec3<V> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class V> GS2D_HD Vec3<V> operator-(Vec3<V> a, Vec3<V> b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <class V> GS2D_HD Vec3<V> operator*(V s, Vec3<V> a) { return {s * a.x, s * a.y, s * a.z}; }
template <class V> GS2D_HD V dot(Vec3<V> a, Vec3<V> b) { return fma(a.x, b.x, fma(a.y, b.y, a.z * b.z)); }
template <class V> GS2D_HD Vec3<V> cross(Vec3<V> a, Vec3<V> b) {
    return {fma(a.y, b.z, -(a.z * b.y)), fma(a.z, b.x, -(a.x * b.z)), fma(a.x, b.y, -(a.y * b.x))};
}
// a + s * b
template <class V> GS2D_HD Vec3<V> axpy(V s, Vec3<V> b, Vec3<V> a) {
    return {fma(s, b.x, a.x), fma(s, b.y, a.y), fma(s, b.z, a.z)};
}

}  // namespace gs2d
