// simd.h for AVX2 and FMA: 8 floats, masks as vectors of all-ones or all-zeros.
#pragma once

#include <immintrin.h>

namespace gs2d {

using real = float;
constexpr int LANES = 8, REGISTERS = 16;

struct M {
    __m256 m;
};
struct V {
    __m256 v;
    V() = default;
    GS2D_HD V(__m256 x) : v(x) {}
    GS2D_HD V(float x) : v(_mm256_set1_ps(x)) {}
};

GS2D_HD V operator+(V a, V b) { return _mm256_add_ps(a.v, b.v); }
GS2D_HD V operator-(V a, V b) { return _mm256_sub_ps(a.v, b.v); }
GS2D_HD V operator*(V a, V b) { return _mm256_mul_ps(a.v, b.v); }
GS2D_HD V operator/(V a, V b) { return _mm256_div_ps(a.v, b.v); }
GS2D_HD V fma(V a, V b, V c) { return _mm256_fmadd_ps(a.v, b.v, c.v); }
GS2D_HD V fnma(V a, V b, V c) { return _mm256_fnmadd_ps(a.v, b.v, c.v); }
GS2D_HD V min(V a, V b) { return _mm256_min_ps(a.v, b.v); }
GS2D_HD V max(V a, V b) { return _mm256_max_ps(a.v, b.v); }
GS2D_HD V sqrt(V a) { return _mm256_sqrt_ps(a.v); }
GS2D_HD V abs(V a) { return _mm256_andnot_ps(_mm256_set1_ps(-0.f), a.v); }
GS2D_HD V round(V a) { return _mm256_round_ps(a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC); }
GS2D_HD V scale2(V a, V n) {
    const __m256i e = _mm256_slli_epi32(_mm256_add_epi32(_mm256_cvtps_epi32(n.v), _mm256_set1_epi32(127)), 23);
    return _mm256_mul_ps(a.v, _mm256_castsi256_ps(e));
}

#define GS2D_OWN_EXP2
constexpr Exp2Table<3> EXP2_TABLE;
// Computes 2^x for x in [-126, 127]; relative error below 2e-7. Table of 8 values, degree 3 minimax on [-1/16, 1/16].
GS2D_HD V exp2_small(V x) {
    const V t = x + V(EXP2_TABLE.ROUND), f = x - (t - V(EXP2_TABLE.ROUND));
    const __m256i n = _mm256_castps_si256(t.v);
    const __m256i root = _mm256_permutevar8x32_epi32(*reinterpret_cast<const __m256i*>(EXP2_TABLE.of), n);
    const V power = _mm256_castsi256_ps(_mm256_add_epi32(root, _mm256_slli_epi32(n, EXP2_TABLE.SHIFT)));
    return power * fma(fma(fma(V(0.05549622f), f, V(0.24025763f)), f, V(0.69314721f)), f, V(1.f));
}

GS2D_HD V split2(V x, V& e) {
    const __m256i i = _mm256_castps_si256(x.v), root_half = _mm256_set1_epi32(0x3f3504f3);
    const __m256i n = _mm256_srai_epi32(_mm256_sub_epi32(i, root_half), 23);
    e = _mm256_cvtepi32_ps(n);
    return _mm256_castsi256_ps(_mm256_sub_epi32(i, _mm256_slli_epi32(n, 23)));
}

GS2D_HD M operator<(V a, V b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_LT_OQ)}; }
GS2D_HD M operator<=(V a, V b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_LE_OQ)}; }
GS2D_HD M operator>(V a, V b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GT_OQ)}; }
GS2D_HD M operator>=(V a, V b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GE_OQ)}; }
GS2D_HD M operator&(M a, M b) { return {_mm256_and_ps(a.m, b.m)}; }
GS2D_HD M operator|(M a, M b) { return {_mm256_or_ps(a.m, b.m)}; }
GS2D_HD M and_not(M a, M b) { return {_mm256_andnot_ps(b.m, a.m)}; }  // a & ~b
GS2D_HD M operator~(M a) { return {_mm256_xor_ps(a.m, _mm256_castsi256_ps(_mm256_set1_epi32(-1)))}; }
GS2D_HD uint32_t bits(M m) { return static_cast<uint32_t>(_mm256_movemask_ps(m.m)); }
GS2D_HD bool any(M m) { return bits(m) != 0; }
#define GS2D_OWN_NONZERO
GS2D_HD uint32_t nonzero(const uint8_t* p) {  // of 32 values
    const __m256i v = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p));
    return ~static_cast<uint32_t>(_mm256_movemask_epi8(_mm256_cmpeq_epi8(v, _mm256_setzero_si256())));
}
GS2D_HD bool all(M m) { return bits(m) == 0xffu; }
GS2D_HD M mask_of(uint32_t b) {
    const __m256i bit = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
    const __m256i v = _mm256_and_si256(_mm256_set1_epi32(static_cast<int>(b)), bit);
    return {_mm256_castsi256_ps(_mm256_cmpeq_epi32(v, bit))};
}
GS2D_HD M first(int n) {
    return {_mm256_castsi256_ps(_mm256_cmpgt_epi32(_mm256_set1_epi32(n), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7)))};
}
GS2D_HD V select(M m, V a, V b) {
    __m256 r;  // assembly, because with the intrinsic gcc 12 first compares the mask with 0
    asm("vblendvps %3, %2, %1, %0" : "=x"(r) : "x"(b.v), "x"(a.v), "x"(m.m));
    return r;
}
GS2D_HD V keep(M m, V a) { return _mm256_and_ps(m.m, a.v); }

GS2D_HD V load(const float* p) { return _mm256_loadu_ps(p); }
GS2D_HD void store(float* p, V a) { _mm256_storeu_ps(p, a.v); }
GS2D_HD V load_first(const float* p, int n) { return _mm256_maskload_ps(p, _mm256_castps_si256(first(n).m)); }
GS2D_HD void store_first(float* p, V a, int n) { _mm256_maskstore_ps(p, _mm256_castps_si256(first(n).m), a.v); }
GS2D_HD V iota() { return _mm256_setr_ps(0, 1, 2, 3, 4, 5, 6, 7); }
GS2D_HD float sum(V a) {
    __m128 h = _mm_add_ps(_mm256_castps256_ps128(a.v), _mm256_extractf128_ps(a.v, 1));
    h = _mm_add_ps(h, _mm_movehl_ps(h, h));
    return _mm_cvtss_f32(_mm_add_ss(h, _mm_movehdup_ps(h)));
}

// Transposes LANES x LANES values in place.
GS2D_HD void transpose(V* v) {
    __m256 t[8], r[8];
    for (int i = 0; i < 8; i += 2) {
        t[i] = _mm256_unpacklo_ps(v[i].v, v[i + 1].v);
        t[i + 1] = _mm256_unpackhi_ps(v[i].v, v[i + 1].v);
    }
    for (int i = 0; i < 8; i += 4) {  // 128-bit part m of r[i + j]: column 4 m + j of rows i .. i + 3
        r[i] = _mm256_shuffle_ps(t[i], t[i + 2], 0x44), r[i + 1] = _mm256_shuffle_ps(t[i], t[i + 2], 0xee);
        r[i + 2] = _mm256_shuffle_ps(t[i + 1], t[i + 3], 0x44), r[i + 3] = _mm256_shuffle_ps(t[i + 1], t[i + 3], 0xee);
    }
    for (int j = 0; j < 4; ++j) {
        v[j] = _mm256_permute2f128_ps(r[j], r[4 + j], 0x20);
        v[4 + j] = _mm256_permute2f128_ps(r[j], r[4 + j], 0x31);
    }
}

using LaneInts = __m256i;
GS2D_HD LaneInts with_bits(LaneInts i, M m, uint32_t bits) {
    return _mm256_or_si256(i, _mm256_and_si256(_mm256_castps_si256(m.m), _mm256_set1_epi32(static_cast<int>(bits))));
}
template <int N> GS2D_HD LaneInts shifted(LaneInts i) { return _mm256_slli_epi32(i, N); }
GS2D_HD void store(uint32_t* p, LaneInts i) { _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), i); }
GS2D_HD LaneInts ints_of(V a) { return _mm256_cvttps_epi32(a.v); }
GS2D_HD LaneInts row_major(LaneInts j, int width, LaneInts i) {
    return _mm256_add_epi32(_mm256_mullo_epi32(j, _mm256_set1_epi32(width)), i);
}
GS2D_HD V gather(const float* p, LaneInts i) { return _mm256_i32gather_ps(p, i, 4); }
GS2D_HD void gather_pairs(const float* p, LaneInts i, V& a, V& b) {
    const double* pairs = reinterpret_cast<const double*>(p);
    const __m256 low = _mm256_castpd_ps(_mm256_i32gather_pd(pairs, _mm256_castsi256_si128(i), 4));
    const __m256 high = _mm256_castpd_ps(_mm256_i32gather_pd(pairs, _mm256_extracti128_si256(i, 1), 4));
    const auto in_order = [](__m256 x) {  // from order 0, 1, 4, 5 and 2, 3, 6, 7
        return _mm256_castpd_ps(_mm256_permute4x64_pd(_mm256_castps_pd(x), 0xd8));
    };
    a = in_order(_mm256_shuffle_ps(low, high, 0x88));
    b = in_order(_mm256_shuffle_ps(low, high, 0xdd));
}

#define GS2D_OWN_INDICES
// Writes STRIDE * i for each i < n whose masks[i] has the bit set; both arrays are padded to a multiple of LANES.
// Returns the number of values written.
template <int STRIDE> GS2D_HD int multiples_with_bit(const uint32_t* masks, int n, int bit, uint32_t* out) {
    const __m128i shift = _mm_cvtsi32_si128(31 - bit);
    __m256i index = _mm256_setzero_si256();
    int count = 0;
    for (int i = 0; i < n; i += 8, index = _mm256_add_epi32(index, _mm256_set1_epi32(8 * STRIDE))) {
        const __m256i m = _mm256_sll_epi32(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(masks + i)), shift);
        uint32_t k = static_cast<uint32_t>(_mm256_movemask_ps(_mm256_castsi256_ps(m)));
        if (n - i < 8) k &= (1u << (n - i)) - 1u;
        const __m256i bits =
            _mm256_cvtepu16_epi32(_mm_load_si128(reinterpret_cast<const __m128i*>(BIT_MULTIPLES<STRIDE>.of[k])));
        _mm256_storeu_si256(reinterpret_cast<__m256i*>(out + count), _mm256_add_epi32(index, bits));
        count += __builtin_popcount(k);
    }
    return count;
}

#define GS2D_OWN_UNZIP
GS2D_HD void unzip_planes(const float* p, V& a, V& b, V& c) {
    const __m256 first = _mm256_broadcast_ps(reinterpret_cast<const __m128*>(p)), zero = _mm256_setzero_ps();
    const __m256 second = _mm256_broadcast_ps(reinterpret_cast<const __m128*>(p + 4));
    a = _mm256_blend_ps(_mm256_shuffle_ps(first, second, 0x08), zero, 0x88);
    b = _mm256_blend_ps(_mm256_shuffle_ps(first, second, 0x1d), zero, 0x88);
    c = _mm256_blend_ps(second, zero, 0x33);
}

template <int K> GS2D_HD void transpose_reduce(const V* v, float* p) {
    static_assert(K % 4 == 0);
    for (int i = 0; i < K / 4; ++i) {
        const __m256 a = v[4 * i].v, b = v[4 * i + 1].v, c = v[4 * i + 2].v, d = v[4 * i + 3].v;
        const __m256 ab = _mm256_add_ps(_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
        const __m256 cd = _mm256_add_ps(_mm256_unpacklo_ps(c, d), _mm256_unpackhi_ps(c, d));
        const __m256 q = _mm256_add_ps(_mm256_shuffle_ps(ab, cd, 0x44), _mm256_shuffle_ps(ab, cd, 0xee));
        _mm_storeu_ps(p + 4 * i, _mm_add_ps(_mm256_castps256_ps128(q), _mm256_extractf128_ps(q, 1)));
    }
}

}  // namespace gs2d
