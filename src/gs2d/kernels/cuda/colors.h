// Colours of splats from SH coefficients, and their gradients. The degree is a template parameter inside, so that
// coefficients stay in registers.
#pragma once

#include "cuda/common.h"

namespace gs2d {

// SH coefficients of one splat: coefficient 0 in `first`, all others in `rest`.
struct Coefficients {
    const float *first, *rest;
};
struct CoefficientGradients {  // null: not computed
    float *first, *rest;
};

template <int DEGREE> struct Basis {
    static constexpr int COUNT = DEGREE < 0 ? 1 : (DEGREE + 1) * (DEGREE + 1);
    float values[COUNT], sh[3 * COUNT];
    __device__ __forceinline__ Basis(const Coefficients& from, Vec3<float> direction) {
        sh_basis(direction, DEGREE, values);
#pragma unroll
        for (int k = 0; k < 3 * COUNT; ++k) sh[k] = k < 3 ? from.first[k] : from.rest[k - 3];
    }
    // colour + 1/2, not clamped
    __device__ __forceinline__ Vec3<float> color() const { return sh_color(sh, values, DEGREE); }
};

// Calls f with the degree as a type.
template <int DEGREE> struct Degree {
    static constexpr int value = DEGREE;
};
template <class F> __device__ __forceinline__ Vec3<float> with_degree(int degree, F f) {
    switch (degree) {
        case -1: return f(Degree<-1>());  // no harmonics, see sh.h
        case 0: return f(Degree<0>());
        case 1: return f(Degree<1>());
        case 2: return f(Degree<2>());
        default: return f(Degree<3>());
    }
}

// Computes colour + 1/2, not clamped; `size` is the sum of the absolute coefficients.
__device__ __forceinline__ Vec3<float> color_of(int degree, const Coefficients& from, Vec3<float> direction,
                                                float& size) {
    return with_degree(degree, [&](auto d) {
        const Basis<decltype(d)::value> b(from, direction);
        size = 0.f;
#pragma unroll
        for (int k = 0; k < b.COUNT; ++k)
            size = size + (abs(b.sh[3 * k]) + abs(b.sh[3 * k + 1]) + abs(b.sh[3 * k + 2]));
        return b.color();
    });
}

// Writes the gradients of the coefficients, zeros for those beyond the degree. Returns the gradient of the unit vector
// to the splat.
__device__ __forceinline__ Vec3<float> color_vjp(int degree, const Coefficients& from, int rest,
                                                 const CoefficientGradients& to, Vec3<float> direction, Vec3<float> g) {
    return with_degree(degree, [&](auto d) {
        constexpr int DEGREE = decltype(d)::value;
        const Basis<DEGREE> b(from, direction);
        const Vec3<float> c = b.color();
        g = {clamped_color_vjp(c.x, DEGREE, g.x), clamped_color_vjp(c.y, DEGREE, g.y),
             clamped_color_vjp(c.z, DEGREE, g.z)};
        float along[b.COUNT];
#pragma unroll
        for (int k = 0; k < b.COUNT; ++k) {
            along[k] = fma(g.x, b.sh[3 * k], fma(g.y, b.sh[3 * k + 1], g.z * b.sh[3 * k + 2]));
            float* row = k == 0 ? to.first : to.rest ? to.rest + 3 * (k - 1) : nullptr;
            if (row) row[0] = b.values[k] * g.x, row[1] = b.values[k] * g.y, row[2] = b.values[k] * g.z;
        }
        if (to.rest)
            for (int k = 3 * (b.COUNT - 1); k < 3 * rest; ++k) to.rest[k] = 0.f;
        return sh_basis_vjp(direction, DEGREE, along);
    });
}

}  // namespace gs2d
