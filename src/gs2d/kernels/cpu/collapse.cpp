// Edge collapse by quadric errors; formulas: meshing/simplify.py.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>

#include "cpu/export.h"

namespace gs2d {

struct Candidate {
    double cost;  // px^2
    int32_t a, b;
    int32_t stamp;  // sum of the stamps of a and b: the candidate is outdated if it differs
    int32_t padding;
};

// Arrays are contiguous; quadric and color are zeros at the start.
struct CollapseArguments {
    int64_t vertices, faces, capacity;
    int64_t target;         // stop at this number of faces
    double limit;           // largest cost, px^2
    double length_weight, tint_weight, border_weight, turn, pull;  // see meshing/simplify.py
    double* points;         // [vertices, 3]
    const double* scale;    // [vertices] px per unit of length
    const double* colors;   // [vertices, 3], or null
    int32_t* corners;       // [faces, 3]; the first corner of a removed face is -1
    double* quadric;        // [vertices, 12]: A (6), b (3), c, area, area px^2 / unit^2
    double* color;          // [vertices, 4]: sums of area colour (3) and area |colour|^2; empty without colours
    int32_t* next;          // [faces, 3]: next corner at the same vertex, or -1
    int32_t *head, *tail;   // [vertices]: first and last corner
    int32_t *stamp, *mark;  // [vertices]
    uint8_t* border;        // [vertices]: 1 on a border, 2 on an edge of more than two faces, which stays
    Candidate* heap;        // [capacity]
};

namespace {

struct V {
    double x, y, z;
};
V operator+(V a, V b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
V operator-(V a, V b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
V operator*(double s, V a) { return {s * a.x, s * a.y, s * a.z}; }
double dot(V a, V b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
V cross(V a, V b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

bool later(const Candidate& p, const Candidate& q) {
    if (p.cost != q.cost) return p.cost > q.cost;
    if (p.a != q.a) return p.a > q.a;
    return p.b != q.b ? p.b > q.b : p.stamp > q.stamp;
}

struct Collapse {
    const CollapseArguments& g;
    int64_t live, size = 0;
    int32_t token = 0;

    V point(int32_t i) const { return {g.points[3 * i], g.points[3 * i + 1], g.points[3 * i + 2]}; }

    // Calls visit(corner, second, third) for each face at a vertex.
    template <typename Visit>
    void around(int32_t u, Visit visit) const {
        for (int32_t c = g.head[u]; c >= 0; c = g.next[c]) {
            const int32_t f = c / 3 * 3, k = c - f;
            if (g.corners[f] >= 0) visit(c, g.corners[f + (k + 1) % 3], g.corners[f + (k + 2) % 3]);
        }
    }

    void add_plane(int32_t i, V n, V at, double weight) {
        double* q = g.quadric + 12 * int64_t(i);
        const double d = -dot(n, at);
        const double terms[10] = {n.x * n.x, n.x * n.y, n.x * n.z, n.y * n.y, n.y * n.z, n.z * n.z,
                                  n.x * d,   n.y * d,   n.z * d,   d * d};
        for (int k = 0; k < 10; ++k) q[k] += weight * terms[k];
    }

    void start() {
        for (int64_t i = 0; i < g.vertices; ++i) g.head[i] = g.tail[i] = -1, g.stamp[i] = g.mark[i] = g.border[i] = 0;
        for (int64_t c = 0; c < 3 * g.faces; ++c) {
            const int32_t u = g.corners[c];
            g.next[c] = -1;
            (g.tail[u] < 0 ? g.head[u] : g.next[g.tail[u]]) = int32_t(c);
            g.tail[u] = int32_t(c);
        }
        for (int64_t f = 0; f < g.faces; ++f) {
            const int32_t* t = g.corners + 3 * f;
            const V a = point(t[0]), n = cross(point(t[1]) - a, point(t[2]) - a);
            const double length = std::sqrt(dot(n, n)), area = 0.5 * length;
            if (!(length > 0)) continue;
            const double s = (g.scale[t[0]] + g.scale[t[1]] + g.scale[t[2]]) / 3;
            for (int k = 0; k < 3; ++k) {
                add_plane(t[k], (1 / length) * n, a, area * s * s);
                g.quadric[12 * int64_t(t[k]) + 10] += area;
                g.quadric[12 * int64_t(t[k]) + 11] += area * s * s;
            }
        }
        for (int64_t i = 0; i < g.vertices; ++i) {
            if (g.colors == nullptr) continue;
            const double area = g.quadric[12 * i + 10], *c = g.colors + 3 * i;
            for (int k = 0; k < 3; ++k) g.color[4 * i + k] = area * c[k];
            g.color[4 * i + 3] = area * (c[0] * c[0] + c[1] * c[1] + c[2] * c[2]);
        }
        for (int32_t u = 0; u < g.vertices; ++u) mark_borders(u);
        for (int32_t u = 0; u < g.vertices; ++u) push_edges(u, true);
    }

    // Adds, for each edge on a border, the plane through it that is perpendicular to its face.
    void mark_borders(int32_t u) {
        around(u, [&](int32_t, int32_t p, int32_t q) {
            for (const int32_t w : {p, q}) {
                int faces = 0;
                around(u, [&](int32_t, int32_t i, int32_t j) { faces += i == w || j == w; });
                if (faces > 2) g.border[u] = 2;
                if (faces != 1) continue;
                g.border[u] = std::max<uint8_t>(g.border[u], 1);
                const V a = point(u), edge = point(w) - a, n = cross(point(p) - a, point(q) - a), across = cross(edge, n);
                const double length = std::sqrt(dot(across, across)), s = (g.scale[u] + g.scale[w]) / 2;
                if (length > 0) add_plane(u, (1 / length) * across, a, g.border_weight * dot(edge, edge) * s * s);
            }
        });
    }

    // Cost in px^2 of moving u and v to one point, and that point.
    double cost(int32_t u, int32_t v, V& best) const {
        const double *p = g.quadric + 12 * int64_t(u), *q = g.quadric + 12 * int64_t(v);
        double s[12];
        for (int k = 0; k < 12; ++k) s[k] = p[k] + q[k];
        const V a = point(u), b = point(v), middle = 0.5 * (a + b);
        const double pull = g.pull * (s[0] + s[3] + s[5]);
        const double xx = s[0] + pull, yy = s[3] + pull, zz = s[5] + pull, xy = s[1], xz = s[2], yz = s[4];
        const V right{pull * middle.x - s[6], pull * middle.y - s[7], pull * middle.z - s[8]};
        const V x{xx, xy, xz}, y{xy, yy, yz}, z{xz, yz, zz};
        const double determinant = dot(x, cross(y, z));
        best = middle;
        if (determinant > 0)
            best = {dot(right, cross(y, z)) / determinant, dot(right, cross(z, x)) / determinant,
                    dot(right, cross(x, y)) / determinant};
        const double area = s[10], scale = area > 0 ? s[11] / area : 0;
        const auto at = [&](const double* m) {
            const double value = m[0] * best.x * best.x + m[3] * best.y * best.y + m[5] * best.z * best.z +
                                 2 * (m[1] * best.x * best.y + m[2] * best.x * best.z + m[4] * best.y * best.z) +
                                 2 * (m[6] * best.x + m[7] * best.y + m[8] * best.z) + m[9];
            return m[10] > 0 ? std::max(value, 0.0) / m[10] : 0.0;
        };
        double error = std::max(at(p), at(q));
        error += g.length_weight * scale * dot(b - a, b - a);
        return error + (g.colors != nullptr && area > 0 ? g.tint_weight * change(u, v, area) : 0.0);
    }

    // Mean squared change of colour at u or v, if both get their mean colour.
    double change(int32_t u, int32_t v, double area) const {
        const double *p = g.color + 4 * int64_t(u), *q = g.color + 4 * int64_t(v);
        const V mean{(p[0] + q[0]) / area, (p[1] + q[1]) / area, (p[2] + q[2]) / area};
        double worst = 0;
        for (const int32_t i : {u, v}) {
            const double *c = g.color + 4 * int64_t(i), own = g.quadric[12 * int64_t(i) + 10];
            if (own > 0) worst = std::max(worst, (c[3] - 2 * dot(mean, {c[0], c[1], c[2]})) / own + dot(mean, mean));
        }
        return worst;
    }

    void push(int32_t u, int32_t v) {
        if (g.border[u] > 1 || g.border[v] > 1) return;
        V best;
        const Candidate item{cost(u, v, best), std::min(u, v), std::max(u, v), g.stamp[u] + g.stamp[v], 0};
        if (!(item.cost <= g.limit)) return;
        if (size == g.capacity) {  // at most one candidate of an edge is up to date, so there is room afterwards
            size = std::remove_if(g.heap, g.heap + size, [&](const Candidate& c) { return outdated(c); }) - g.heap;
            std::make_heap(g.heap, g.heap + size, later);
        }
        g.heap[size++] = item;
        std::push_heap(g.heap, g.heap + size, later);
    }

    bool outdated(const Candidate& c) const { return g.stamp[c.a] + g.stamp[c.b] != c.stamp; }

    // Pushes the edges of u, each once; `higher`: only those to vertices of a higher number.
    void push_edges(int32_t u, bool higher) {
        ++token;
        around(u, [&](int32_t, int32_t p, int32_t q) {
            for (const int32_t w : {p, q})
                if (g.mark[w] != token) {
                    g.mark[w] = token;
                    if (!higher || w > u) push(u, w);
                }
        });
    }

    // Whether the surface stays a manifold, and no face turns over.
    bool allowed(int32_t u, int32_t v, V at) {
        const int32_t first = ++token, both = ++token;
        int shared = 0, common = 0;
        bool good = true;
        around(u, [&](int32_t, int32_t p, int32_t q) { g.mark[p] = g.mark[q] = first, shared += p == v || q == v; });
        around(v, [&](int32_t, int32_t p, int32_t q) {
            for (const int32_t w : {p, q})
                if (g.mark[w] == first) {
                    g.mark[w] = both, ++common;
                    int faces = 0;
                    around(w, [&](int32_t, int32_t, int32_t) { ++faces; });
                    good &= faces > 3 || g.border[w];
                }
        });
        if (!good || common != shared || shared < 1 || shared > 2) return false;
        if (shared == 2 && g.border[u] && g.border[v]) return false;
        for (const auto& [i, j] : {std::pair(u, v), std::pair(v, u)})
            around(i, [&, i = i, j = j](int32_t, int32_t p, int32_t q) {
                if (p == j || q == j) return;
                const V old = cross(point(p) - point(i), point(q) - point(i)), now = cross(point(p) - at, point(q) - at);
                const double size = std::sqrt(dot(old, old) * dot(now, now));
                good &= dot(old, now) > g.turn * size || !(dot(old, old) > 0);
            });
        return good;
    }

    void merge(int32_t u, int32_t v, V at) {
        around(v, [&](int32_t c, int32_t p, int32_t q) {
            if (p == u || q == u) g.corners[c / 3 * 3] = -1, --live;
            else g.corners[c] = u;
        });
        (g.tail[u] < 0 ? g.head[u] : g.next[g.tail[u]]) = g.head[v];
        int32_t first = -1, last = -1;
        around(u, [&](int32_t c, int32_t, int32_t) {
            (last < 0 ? first : g.next[last]) = c;
            last = c;
        });
        if (last >= 0) g.next[last] = -1;
        g.head[u] = first, g.tail[u] = last, g.head[v] = g.tail[v] = -1;
        for (int k = 0; k < 12; ++k) g.quadric[12 * int64_t(u) + k] += g.quadric[12 * int64_t(v) + k];
        for (int k = 0; k < 4 && g.colors != nullptr; ++k) g.color[4 * int64_t(u) + k] += g.color[4 * int64_t(v) + k];
        g.points[3 * int64_t(u)] = at.x, g.points[3 * int64_t(u) + 1] = at.y, g.points[3 * int64_t(u) + 2] = at.z;
        g.border[u] = std::max(g.border[u], g.border[v]);
        ++g.stamp[u], ++g.stamp[v];
        push_edges(u, false);
    }

    void run() {
        start();
        while (size > 0 && live > g.target) {
            std::pop_heap(g.heap, g.heap + size, later);
            const Candidate item = g.heap[--size];
            if (outdated(item)) continue;
            V at;
            cost(item.a, item.b, at);
            if (allowed(item.a, item.b, at)) merge(item.a, item.b, at);
        }
    }
};

}  // namespace
}  // namespace gs2d

using namespace gs2d;

GS2D_EXPORT void gs2d_collapse(const CollapseArguments* arguments) {
    Collapse work{*arguments, arguments->faces};
    work.run();
}
