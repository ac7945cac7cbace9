// Converts rows of parameters of LANES splats to vectors and back.
#pragma once

#include "cpu/frame.h"

namespace gs2d {

// Sets lane i of v[k] to p[i * stride + k] for i < lanes; missing lanes repeat the last row, so no lane holds garbage.
template <int K> inline void load_rows(const real* p, int64_t stride, int lanes, V* v) {
    if constexpr (K >= LANES) {
        for (int k = 0; k < K; k += LANES) {
            const int from = k + LANES <= K ? k : K - LANES;  // the last part may overlap the previous one
            V part[LANES];
            for (int i = 0; i < LANES; ++i) part[i] = load(p + int64_t(i < lanes ? i : lanes - 1) * stride + from);
            transpose(part);
            for (int j = 0; j < LANES; ++j) v[from + j] = part[j];
        }
    } else if (stride == K && lanes == LANES) {
        load_packed<K>(p, v);
    } else {
        alignas(64) real t[K][LANES];
        for (int i = 0; i < LANES; ++i) {
            const real* row = p + int64_t(i < lanes ? i : lanes - 1) * stride;
            for (int k = 0; k < K; ++k) t[k][i] = row[k];
        }
        for (int k = 0; k < K; ++k) v[k] = load(t[k]);
    }
}

template <int K> inline void store_rows(real* p, int64_t stride, int lanes, const V* v) {
    if constexpr (K >= LANES) {
        for (int k = 0; k < K; k += LANES) {
            const int from = k + LANES <= K ? k : K - LANES;
            V part[LANES];
            for (int j = 0; j < LANES; ++j) part[j] = v[from + j];
            transpose(part);
            for (int i = 0; i < lanes; ++i) store(p + i * stride + from, part[i]);
        }
    } else if (stride == K && lanes == LANES) {
        store_packed<K>(p, v);
    } else {
        alignas(64) real t[K][LANES];
        for (int k = 0; k < K; ++k) store(t[k], v[k]);
        for (int i = 0; i < lanes; ++i)
            for (int k = 0; k < K; ++k) p[i * stride + k] = t[k][i];
    }
}

inline SplatParameters<V> load_parameters(const Parameters& s, int64_t first, int lanes) {
    V m[3], q[4], l[2], o[1];
    load_rows<3>(s.means + 3 * first, 3, lanes, m);
    load_rows<4>(s.quats + 4 * first, 4, lanes, q);
    load_rows<2>(s.log_scales + 2 * first, 2, lanes, l);
    load_rows<1>(s.opacity_logits + first, 1, lanes, o);
    return {{m[0], m[1], m[2]}, q[0], q[1], q[2], q[3], l[0], l[1], o[0]};
}

// Loads the coefficients of LANES splats: sh[3 * k + channel].
inline void load_sh(const Parameters& s, int64_t first, int lanes, int degree, V* sh) {
    load_rows<3>(s.sh0 + 3 * first, 3, lanes, sh);
    const int64_t stride = 3 * s.sh_rest;
    const real* rest = s.shN + stride * first;
    if (degree == 1) load_rows<9>(rest, stride, lanes, sh + 3);
    if (degree == 2) load_rows<24>(rest, stride, lanes, sh + 3);
    if (degree == 3) load_rows<45>(rest, stride, lanes, sh + 3);
}

// Prefetches the cache lines of `count` reals starting at p.
inline __attribute__((always_inline)) void ask_for(const real* p, int64_t count) {
    for (int64_t i = 0; i < count; i += LINE / sizeof(real)) __builtin_prefetch(p + i, 0, 3);
}

inline M is_finite(V a) { return abs(a) < V(__builtin_inff()); }  // false for NaN

inline void zero_rows(real* p, int64_t first, int64_t stride, int lanes) {
    if (p) memset(p + first * stride, 0, size_t(lanes * stride) * sizeof(real));
}

// Computes the coefficient gradients of LANES splats from their colour gradients.
inline void write_sh(int degree, int64_t sh_rest, const ParameterGradients& out, int64_t i, int lanes,
                     const Vec3<V>& g_color, const V* basis) {
    V g[3 * SH_MAX];
    const int count = sh_count(degree);
    for (int k = 0; k < count; ++k)
        g[3 * k] = basis[k] * g_color.x, g[3 * k + 1] = basis[k] * g_color.y, g[3 * k + 2] = basis[k] * g_color.z;
    if (out.sh0) store_rows<3>(out.sh0 + 3 * i, 3, lanes, g);
    if (!out.shN) return;
    const int64_t stride = 3 * sh_rest;
    real* rest = out.shN + stride * i;
    if (sh_rest > count - 1) zero_rows(rest, 0, stride, lanes);
    if (count == 4) store_rows<9>(rest, stride, lanes, g + 3);
    if (count == 9) store_rows<24>(rest, stride, lanes, g + 3);
    if (count == 16) store_rows<45>(rest, stride, lanes, g + 3);
}

}  // namespace gs2d
