// Adam on several attributes in one call, and the check for non-finite gradients.
#include "core/adam.h"

#include "cpu/export.h"
#include "cpu/simd.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

constexpr int64_t PIECE = 8192;  // elements per task: 160 KB read and written

struct AdamAttribute {
    real *parameter, *mean, *square;          // [N, columns]
    const real* gradient;                     // [N, columns], or [M, columns] with `compact`
    const int64_t* rows;                      // [M]: rows to update, or null: all
    int64_t height, count, columns, compact;  // N; M or N
    double step_size, root_2;
};

// Updates `n` consecutive elements.
void step(real* parameter, real* mean, real* square, const real* gradient, int64_t n, const AdamConstants<V>& k) {
    for (int64_t i = 0; i < n; i += LANES) {
        const int left = n - i < LANES ? static_cast<int>(n - i) : LANES;
        if (left == LANES) {
            V p = load(parameter + i), m = load(mean + i), s = load(square + i);
            adam(load(gradient + i), p, m, s, k);
            store(parameter + i, p), store(mean + i, m), store(square + i, s);
        } else {
            V p = load_first(parameter + i, left), m = load_first(mean + i, left), s = load_first(square + i, left);
            adam(load_first(gradient + i, left), p, m, s, k);
            store_first(parameter + i, p, left), store_first(mean + i, m, left), store_first(square + i, s, left);
        }
    }
}

// Updates elements [begin, end) of an attribute; with `rows`, whole rows.
void step_piece(const AdamAttribute& a, int64_t begin, int64_t end, const AdamConstants<V>& k) {
    if (!a.rows) return step(a.parameter + begin, a.mean + begin, a.square + begin, a.gradient + begin, end - begin, k);
    for (int64_t i = begin / a.columns; i < end / a.columns; ++i) {
        const int64_t at = a.rows[i] * a.columns;
        step(a.parameter + at, a.mean + at, a.square + at, a.gradient + (a.compact ? i * a.columns : at), a.columns, k);
    }
}

// Calls f(i, begin, end) for pieces of n arrays with elements(i) elements; pieces are multiples of columns(i).
template <class E, class C, class F> void for_pieces(int n, E&& elements, C&& columns, F&& f) {
    const auto piece = [&](int i) { return columns(i) < PIECE ? PIECE / columns(i) * columns(i) : columns(i); };
    const auto pieces = [&](int i) { return (elements(i) + piece(i) - 1) / piece(i); };
    int64_t total = 0;
    for (int i = 0; i < n; ++i) total += pieces(i);
    parallel_for(total, [&](int64_t task) {
        int i = 0;
        for (; task >= pieces(i); ++i) task -= pieces(i);
        const int64_t begin = task * piece(i), end = begin + piece(i);
        f(i, begin, end < elements(i) ? end : elements(i));
    });
}

bool all_finite(const real* x, int64_t n) {
    constexpr real LARGEST = sizeof(real) == 4 ? real(3.40282346638528859812e38) : real(1.79769313486231570815e308);
    const auto finite = [](V v) { return abs(v) <= V(LARGEST); };
    M so_far[4] = {finite(V(real(0))), finite(V(real(0))), finite(V(real(0))), finite(V(real(0)))};
    int64_t i = 0;
    for (; i + 4 * LANES <= n; i += 4 * LANES)
        for (int j = 0; j < 4; ++j) so_far[j] = so_far[j] & finite(load(x + i + j * LANES));
    for (; i < n; i += LANES)
        so_far[0] = so_far[0] & finite(load_first(x + i, n - i < LANES ? static_cast<int>(n - i) : LANES));
    return all((so_far[0] & so_far[1]) & (so_far[2] & so_far[3]));
}

}  // namespace
}  // namespace gs2d

using namespace gs2d;

// Updates the attributes in place. The result is bit-identical for any number of threads. Returns 1, without changes,
// if an index in `rows` is out of range.
GS2D_EXPORT int gs2d_adam(const AdamAttribute* attributes, int n, double beta1, double beta2, double eps) {
    for (int i = 0; i < n; ++i)
        for (int64_t k = 0; attributes[i].rows && k < attributes[i].count; ++k)
            if (attributes[i].rows[k] < 0 || attributes[i].rows[k] >= attributes[i].height) return 1;
    const auto elements = [&](int i) { return attributes[i].count * attributes[i].columns; };
    for_pieces(
        n, elements, [&](int i) { return attributes[i].columns; },
        [&](int i, int64_t begin, int64_t end) {
            const AdamAttribute& a = attributes[i];
            const auto v = [](double x) { return V(real(x)); };
            step_piece(a, begin, end, {v(1 - beta1), v(beta2), v(1 - beta2), v(eps), v(a.step_size), v(a.root_2)});
        });
    return 0;
}

// Returns the index of the first array that contains a NaN or an infinity, or n if all are finite.
GS2D_EXPORT int gs2d_first_not_finite(const real* const* arrays, const int64_t* sizes, int n) {
    int first = n;
    for_pieces(
        n, [&](int i) { return sizes[i]; }, [](int) { return int64_t(1); },
        [&](int i, int64_t begin, int64_t end) {
            if (all_finite(arrays[i] + begin, end - begin)) return;
            int seen = __atomic_load_n(&first, __ATOMIC_RELAXED);
            while (i < seen &&
                   !__atomic_compare_exchange_n(&first, &seen, i, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
            }
        });
    return first;
}
