// simd.h for AVX-512: 16 floats, masks in k registers.
#pragma once

#include <immintrin.h>

namespace gs2d {

using real = float;
constexpr int LANES = 16, REGISTERS = 32;

struct M {
    __mmask16 k;
};
struct V {
    __m512 v;
    V() = default;
    GS2D_HD V(__m512 x) : v(x) {}
    GS2D_HD V(float x) : v(_mm512_set1_ps(x)) {}
};

GS2D_HD V operator+(V a, V b) { return _mm512_add_ps(a.v, b.v); }
GS2D_HD V operator-(V a, V b) { return _mm512_sub_ps(a.v, b.v); }
GS2D_HD V operator*(V a, V b) { return _mm512_mul_ps(a.v, b.v); }
GS2D_HD V operator/(V a, V b) { return _mm512_div_ps(a.v, b.v); }
GS2D_HD V fma(V a, V b, V c) { return _mm512_fmadd_ps(a.v, b.v, c.v); }
GS2D_HD V fnma(V a, V b, V c) { return _mm512_fnmadd_ps(a.v, b.v, c.v); }
GS2D_HD V min(V a, V b) { return _mm512_min_ps(a.v, b.v); }
GS2D_HD V max(V a, V b) { return _mm512_max_ps(a.v, b.v); }
GS2D_HD V sqrt(V a) { return _mm512_sqrt_ps(a.v); }
GS2D_HD V abs(V a) { return _mm512_abs_ps(a.v); }
GS2D_HD V round(V a) { return _mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC); }
GS2D_HD V scale2(V a, V n) { return _mm512_scalef_ps(a.v, n.v); }

#define GS2D_OWN_EXP2
constexpr Exp2Table<5> EXP2_TABLE;
// Computes 2^x for x in [-126, 127]; relative error below 2e-7. The table of 32 values needs only a degree 2 minimax
// polynomial on [-1/64, 1/64], which halves the number of multiplications.
GS2D_HD V exp2_small(V x) {
    const V t = x + V(EXP2_TABLE.ROUND), f = x - (t - V(EXP2_TABLE.ROUND));
    const __m512i n = _mm512_castps_si512(t.v), *const table = reinterpret_cast<const __m512i*>(EXP2_TABLE.of);
    const __m512i root = _mm512_permutex2var_epi32(_mm512_load_si512(table), n, _mm512_load_si512(table + 1));
    const V power = _mm512_castsi512_ps(_mm512_add_epi32(root, _mm512_slli_epi32(n, EXP2_TABLE.SHIFT)));
    return power * fma(fma(V(0.24022707f), f, V(0.69315734f)), f, V(1.f));
}

GS2D_HD V split2(V x, V& e) {
    const V m = _mm512_getmant_ps(x.v, _MM_MANT_NORM_p75_1p5, _MM_MANT_SIGN_src);
    e = _mm512_getexp_ps(_mm512_div_ps(x.v, m.v));
    return m;
}

GS2D_HD M operator<(V a, V b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)}; }
GS2D_HD M operator<=(V a, V b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LE_OQ)}; }
GS2D_HD M operator>(V a, V b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)}; }
GS2D_HD M operator>=(V a, V b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
GS2D_HD M operator&(M a, M b) { return {_kand_mask16(a.k, b.k)}; }
GS2D_HD M operator|(M a, M b) { return {_kor_mask16(a.k, b.k)}; }
GS2D_HD M operator~(M a) { return {_knot_mask16(a.k)}; }
GS2D_HD M and_not(M a, M b) { return {_kandn_mask16(b.k, a.k)}; }  // a & ~b
GS2D_HD bool any(M m) { return !_kortestz_mask16_u8(m.k, m.k); }
#define GS2D_OWN_NONZERO
GS2D_HD uint32_t nonzero(const uint16_t* p) {  // of 16 values
    const __m256i v = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p));
    return _mm256_test_epi16_mask(v, v);
}
GS2D_HD bool all(M m) { return _kortestc_mask16_u8(m.k, m.k); }
GS2D_HD uint32_t bits(M m) { return _cvtmask16_u32(m.k); }
GS2D_HD M mask_of(uint32_t b) { return {static_cast<__mmask16>(b)}; }
GS2D_HD M first(int n) { return {static_cast<__mmask16>((1u << n) - 1u)}; }
GS2D_HD V select(M m, V a, V b) { return _mm512_mask_blend_ps(m.k, b.v, a.v); }
GS2D_HD V keep(M m, V a) { return _mm512_maskz_mov_ps(m.k, a.v); }

GS2D_HD V load(const float* p) { return _mm512_loadu_ps(p); }
GS2D_HD void store(float* p, V a) { _mm512_storeu_ps(p, a.v); }
GS2D_HD V load_first(const float* p, int n) { return _mm512_maskz_loadu_ps(first(n).k, p); }
GS2D_HD void store_first(float* p, V a, int n) { _mm512_mask_storeu_ps(p, first(n).k, a.v); }
GS2D_HD V iota() { return _mm512_setr_ps(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15); }
GS2D_HD float sum(V a) { return _mm512_reduce_add_ps(a.v); }

#define GS2D_OWN_AFTER
// Returns elements K .. K + LANES - 1 of the concatenation of a and b.
template <int K> GS2D_HD V after(V a, V b) {
    return _mm512_castsi512_ps(_mm512_alignr_epi32(_mm512_castps_si512(b.v), _mm512_castps_si512(a.v), K));
}

// Transposes LANES x LANES values in place.
GS2D_HD void transpose(V* v) {
    __m512 t[16], r[16];
    for (int i = 0; i < 16; i += 2) {
        t[i] = _mm512_unpacklo_ps(v[i].v, v[i + 1].v);
        t[i + 1] = _mm512_unpackhi_ps(v[i].v, v[i + 1].v);
    }
    for (int i = 0; i < 16; i += 4) {  // 128-bit part m of r[i + j]: column 4 m + j of rows i .. i + 3
        const __m512d a = _mm512_castps_pd(t[i]), b = _mm512_castps_pd(t[i + 1]);
        const __m512d c = _mm512_castps_pd(t[i + 2]), d = _mm512_castps_pd(t[i + 3]);
        r[i] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, c)), r[i + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, c));
        r[i + 2] = _mm512_castpd_ps(_mm512_unpacklo_pd(b, d)), r[i + 3] = _mm512_castpd_ps(_mm512_unpackhi_pd(b, d));
    }
    for (int j = 0; j < 4; ++j) {
        const __m512 e = _mm512_shuffle_f32x4(r[j], r[4 + j], 0x88),
                     f = _mm512_shuffle_f32x4(r[8 + j], r[12 + j], 0x88);
        const __m512 g = _mm512_shuffle_f32x4(r[j], r[4 + j], 0xdd),
                     h = _mm512_shuffle_f32x4(r[8 + j], r[12 + j], 0xdd);
        v[j] = _mm512_shuffle_f32x4(e, f, 0x88), v[8 + j] = _mm512_shuffle_f32x4(e, f, 0xdd);
        v[4 + j] = _mm512_shuffle_f32x4(g, h, 0x88), v[12 + j] = _mm512_shuffle_f32x4(g, h, 0xdd);
    }
}

#define GS2D_OWN_COLUMNS
// Sets lane i of v[k] to rows[i][k], k < 8.
GS2D_HD void columns_of_8(const float* const* rows, V* v) {
    __m512 r[8];
    for (int i = 0; i < 8; ++i) {  // rows `first` to `first + 3` of the low half, the next 4 in the high half
        const int first = i % 4 + i / 4 * 8;
        r[i] = _mm512_insertf32x8(_mm512_castps256_ps512(_mm256_loadu_ps(rows[first])),
                                  _mm256_loadu_ps(rows[first + 4]), 1);
    }
    __m512 q[8];
    for (int i = 0; i < 8; i += 4) {  // q[i + j]: columns j and 4 + j of the rows in r[i .. i + 3]
        const __m512 a = _mm512_unpacklo_ps(r[i], r[i + 1]), b = _mm512_unpackhi_ps(r[i], r[i + 1]);
        const __m512 c = _mm512_unpacklo_ps(r[i + 2], r[i + 3]), d = _mm512_unpackhi_ps(r[i + 2], r[i + 3]);
        q[i] = _mm512_shuffle_ps(a, c, 0x44), q[i + 1] = _mm512_shuffle_ps(a, c, 0xee);
        q[i + 2] = _mm512_shuffle_ps(b, d, 0x44), q[i + 3] = _mm512_shuffle_ps(b, d, 0xee);
    }
    for (int j = 0; j < 4; ++j) {
        v[j] = _mm512_shuffle_f32x4(q[j], q[4 + j], 0x88);
        v[4 + j] = _mm512_shuffle_f32x4(q[j], q[4 + j], 0xdd);
    }
}

using LaneInts = __m512i;
GS2D_HD LaneInts with_bits(LaneInts i, M m, uint32_t bits) {
    return _mm512_mask_or_epi32(i, m.k, i, _mm512_set1_epi32(static_cast<int>(bits)));
}
template <int N> GS2D_HD LaneInts shifted(LaneInts i) { return _mm512_slli_epi32(i, N); }
GS2D_HD void store(uint32_t* p, LaneInts i) { _mm512_storeu_si512(p, i); }
GS2D_HD LaneInts ints_of(V a) { return _mm512_cvttps_epi32(a.v); }
GS2D_HD LaneInts row_major(LaneInts j, int width, LaneInts i) {
    return _mm512_add_epi32(_mm512_mullo_epi32(j, _mm512_set1_epi32(width)), i);
}
GS2D_HD V gather(const float* p, LaneInts i) { return _mm512_i32gather_ps(i, p, 4); }
GS2D_HD void gather_pairs(const float* p, LaneInts i, V& a, V& b) {
    const __m512 low = _mm512_castpd_ps(_mm512_i32gather_pd(_mm512_castsi512_si256(i), p, 4));
    const __m512 high = _mm512_castpd_ps(_mm512_i32gather_pd(_mm512_extracti64x4_epi64(i, 1), p, 4));
    const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    a = _mm512_permutex2var_ps(low, even, high);
    b = _mm512_permutex2var_ps(low, _mm512_or_epi32(even, _mm512_set1_epi32(1)), high);
}

#define GS2D_OWN_INDICES
// Writes STRIDE * i for each i < n whose masks[i] has the bit set; both arrays are padded to a multiple of LANES.
// Returns the number of values written.
template <int STRIDE> GS2D_HD int multiples_with_bit(const uint32_t* masks, int n, int bit, uint32_t* out) {
    const __m512i wanted = _mm512_set1_epi32(1 << bit), step = _mm512_set1_epi32(16 * STRIDE);
    __m512i index = _mm512_mullo_epi32(_mm512_set1_epi32(STRIDE),
                                       _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15));
    int count = 0;
    for (int i = 0; i < n; i += 16, index = _mm512_add_epi32(index, step)) {
        const __mmask16 inside = static_cast<__mmask16>(n - i >= 16 ? 0xffffu : (1u << (n - i)) - 1u);
        const __mmask16 k = _mm512_mask_test_epi32_mask(inside, _mm512_loadu_si512(masks + i), wanted);
        _mm512_storeu_si512(out + count, _mm512_maskz_compress_epi32(k, index));
        count += __builtin_popcount(k);
    }
    return count;
}

#define GS2D_OWN_UNZIP
GS2D_HD void unzip_planes(const float* p, V& a, V& b, V& c) {
    const __m512 first = _mm512_broadcast_f32x4(_mm_loadu_ps(p)), second = _mm512_broadcast_f32x4(_mm_loadu_ps(p + 4));
    a = _mm512_maskz_shuffle_ps(0x7777, first, second, 0x08), b = _mm512_maskz_shuffle_ps(0x7777, first, second, 0x1d);
    c = _mm512_maskz_mov_ps(0xcccc, second);
}

// Each step halves the number of vectors and of partial sums per vector.
template <int K> GS2D_HD void transpose_reduce(const V* v, float* p) {
    static_assert(K == 16 || K == 4);
    __m512 q[K / 4];
    for (int i = 0; i < K / 4; ++i) {
        // 4 vectors -> 1: within each 128-bit part, lane k holds the partial sum of vector k
        const __m512 a = v[4 * i].v, b = v[4 * i + 1].v, c = v[4 * i + 2].v, d = v[4 * i + 3].v;
        const __m512 ab = _mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b));
        const __m512 cd = _mm512_add_ps(_mm512_unpacklo_ps(c, d), _mm512_unpackhi_ps(c, d));
        q[i] = _mm512_add_ps(_mm512_shuffle_ps(ab, cd, 0x44), _mm512_shuffle_ps(ab, cd, 0xee));
    }
    if constexpr (K == 16) {
        const __m512 s01 =
            _mm512_add_ps(_mm512_shuffle_f32x4(q[0], q[1], 0x88), _mm512_shuffle_f32x4(q[0], q[1], 0xdd));
        const __m512 s23 =
            _mm512_add_ps(_mm512_shuffle_f32x4(q[2], q[3], 0x88), _mm512_shuffle_f32x4(q[2], q[3], 0xdd));
        _mm512_storeu_ps(p, _mm512_add_ps(_mm512_shuffle_f32x4(s01, s23, 0x88), _mm512_shuffle_f32x4(s01, s23, 0xdd)));
    } else {
        const __m256 h = _mm256_add_ps(_mm512_castps512_ps256(q[0]), _mm512_extractf32x8_ps(q[0], 1));
        _mm_storeu_ps(p, _mm_add_ps(_mm256_castps256_ps128(h), _mm256_extractf128_ps(h, 1)));
    }
}

}  // namespace gs2d
