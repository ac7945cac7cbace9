// Delaunay tetrahedra of points on an integer grid (reference: scipy.spatial.Delaunay, meshing/tetrahedra.py).
//
// Incremental insertion (Bowyer 1981, Watson 1981): find the tetrahedron of a point by a walk, remove all tetrahedra
// whose circumsphere contains the point, and connect the faces of the cavity with it. Coordinates are integers below
// 2^22, so the two predicates are exact: in double with an error bound, and in 128-bit integers where that is too
// coarse. Points on a sphere count as outside it, which may leave flat tetrahedra; the cavity then grows until every
// face of it sees the point from inside, so the result is always a valid triangulation.
#include <cmath>
#include <cstdint>
#include <cstdlib>

#include "cpu/export.h"

namespace gs2d {

struct TetrahedraArguments {
    int64_t points;        // in xyz; the last 8 are the corners of a cube around all others, x fastest
    const int32_t* xyz;    // [points, 3] in [0, 2^22)
    const int32_t* order;  // [points - 8] order of insertion
    int64_t capacity;      // rows of `corners` and `neighbours`
    int32_t* corners;      // [capacity, 4] points, positively oriented; -1 in unused rows
    int32_t* neighbours;   // [capacity, 4]: opposite to the corner; -1 outside the cube
    uint8_t* inserted;     // [points]: 1 if the point is a corner; 0 for duplicates
    int64_t count;         // result: rows in use, including unused ones in between; -1 if capacity is too small
};

namespace {

using Wide = __int128;

constexpr int64_t TABLE = int64_t(1) << 16;  // edges of a cavity: three halves of its faces
constexpr double ORIENT_ERROR = 1e-14, SPHERE_ERROR = 2e-13;  // of the product of the largest differences

template <class T> T det3(const T* a, const T* b, const T* c) {
    return a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0]);
}

int sign(Wide x) { return (x > 0) - (x < 0); }
int sign(double x) { return (x > 0) - (x < 0); }

// Sign of the volume of (a, b, c, d): of det(b - a, c - a, d - a).
int orient(const int32_t* a, const int32_t* b, const int32_t* c, const int32_t* d) {
    double r[3][3], most[3];
    const int32_t* ends[3] = {b, c, d};
    for (int k = 0; k < 3; ++k) {
        most[k] = 0;
        for (int i = 0; i < 3; ++i) {
            r[i][k] = double(ends[i][k] - a[k]);
            most[k] = std::fmax(most[k], std::fabs(r[i][k]));
        }
    }
    const double volume = det3(r[0], r[1], r[2]);
    if (std::fabs(volume) > ORIENT_ERROR * most[0] * most[1] * most[2]) return sign(volume);
    Wide e[3][3];
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) e[i][k] = ends[i][k] - a[k];
    return sign(det3(e[0], e[1], e[2]));
}

// det of the rows (v - p, |v - p|^2) for the four corners v.
template <class T> T sphere_det(const T (*r)[3]) {
    T lift[4];
    for (int i = 0; i < 4; ++i) lift[i] = r[i][0] * r[i][0] + r[i][1] * r[i][1] + r[i][2] * r[i][2];
    return lift[1] * det3(r[0], r[2], r[3]) - lift[0] * det3(r[1], r[2], r[3]) + lift[3] * det3(r[0], r[1], r[2]) -
           lift[2] * det3(r[0], r[1], r[3]);
}

class Triangulation {
public:
    explicit Triangulation(TetrahedraArguments& arguments) : a(arguments) {}
    ~Triangulation() {
        std::free(state);
        std::free(cavity);
        std::free(unused);
        std::free(keys);
        std::free(sides);
        std::free(filled);
    }

    bool build() {
        state = static_cast<uint8_t*>(std::calloc(size_t(a.capacity), 1));
        cavity = static_cast<int32_t*>(std::malloc(size_t(a.capacity) * sizeof(int32_t)));
        unused = static_cast<int32_t*>(std::malloc(size_t(a.capacity) * sizeof(int32_t)));
        keys = static_cast<int64_t*>(std::malloc(TABLE * sizeof(int64_t)));
        sides = static_cast<int64_t*>(std::malloc(TABLE * sizeof(int64_t)));
        filled = static_cast<int32_t*>(std::malloc(TABLE * sizeof(int32_t)));
        if (!state || !cavity || !unused || !keys || !sides || !filled || a.capacity < 5) return false;
        for (int64_t i = 0; i < TABLE; ++i) keys[i] = -1;
        start();
        for (int64_t i = 0; i < a.points - 8; ++i)
            if (!insert(a.order[i])) return false;
        for (int64_t i = 0; i < free_count; ++i) corner(unused[i])[0] = -1;
        a.count = rows;
        return true;
    }

private:
    TetrahedraArguments& a;
    uint8_t* state = nullptr;    // [capacity]: 1 in the cavity
    int32_t* cavity = nullptr;   // [capacity] tetrahedra of the cavity
    int32_t* unused = nullptr;   // [capacity] free rows
    int64_t* keys = nullptr;     // [TABLE] edges of the cavity's faces
    int64_t* sides = nullptr;    // [TABLE] 4 * tetrahedron + facet that waits for its neighbour there
    int32_t* filled = nullptr;   // [TABLE] entries of the table that are in use
    int64_t rows = 0, free_count = 0, removed = 0, edges = 0;
    int32_t last = 0;

    const int32_t* point(int32_t i) const { return a.xyz + 3 * int64_t(i); }
    int32_t* corner(int32_t t) const { return a.corners + 4 * int64_t(t); }
    int32_t* beside(int32_t t) const { return a.neighbours + 4 * int64_t(t); }

    // Sign of the side of facet k on which p is: 1 on the side of the tetrahedron.
    int side(int32_t t, int k, const int32_t* p) const {
        const int32_t* v[4];
        for (int i = 0; i < 4; ++i) v[i] = i == k ? p : point(corner(t)[i]);
        return orient(v[0], v[1], v[2], v[3]);
    }

    bool in_sphere(int32_t t, const int32_t* p) const {
        double r[4][3], most[3] = {0, 0, 0};
        for (int i = 0; i < 4; ++i) {
            const int32_t* v = point(corner(t)[i]);
            for (int k = 0; k < 3; ++k) {
                r[i][k] = double(v[k] - p[k]);
                most[k] = std::fmax(most[k], std::fabs(r[i][k]));
            }
        }
        const double largest = std::fmax(std::fmax(most[0], most[1]), most[2]), found = sphere_det(r);
        if (std::fabs(found) > SPHERE_ERROR * most[0] * most[1] * most[2] * largest * largest) return found < 0;
        Wide e[4][3];
        for (int i = 0; i < 4; ++i)
            for (int k = 0; k < 3; ++k) e[i][k] = point(corner(t)[i])[k] - p[k];
        return sphere_det(e) < 0;
    }

    // Five tetrahedra of the cube: one in the middle and four at corners.
    void start() {
        static constexpr int32_t CORNERS[5][4] = {{0, 3, 5, 6}, {1, 0, 3, 5}, {2, 0, 6, 3}, {4, 0, 5, 6}, {7, 3, 6, 5}};
        for (int32_t t = 0; t < 5; ++t) {
            for (int k = 0; k < 4; ++k) {
                corner(t)[k] = int32_t(a.points) - 8 + CORNERS[t][k];
                beside(t)[k] = -1;
            }
            const int32_t* v = corner(t);
            if (orient(point(v[0]), point(v[1]), point(v[2]), point(v[3])) < 0) {
                const int32_t kept = corner(t)[2];
                corner(t)[2] = corner(t)[3];
                corner(t)[3] = kept;
            }
        }
        for (int32_t t = 1; t < 5; ++t)
            for (int k = 0; k < 4; ++k) {  // the facet of the middle one without a corner of t
                bool shared = false;
                for (int i = 0; i < 4; ++i) shared |= corner(t)[i] == corner(0)[k];
                if (!shared) beside(0)[k] = t, beside(t)[0] = 0;
            }
        rows = 5;
        for (int k = 0; k < 8; ++k) a.inserted[a.points - 8 + k] = 1;
    }

    int32_t locate(const int32_t* p) const {
        int32_t t = last, from = -1;
        for (uint32_t step = 0;; ++step) {
            int32_t next = -1;
            for (uint32_t i = 0; i < 4 && next < 0; ++i) {
                const int k = int((i + step) % 4);  // a fixed order could walk in circles
                const int32_t n = beside(t)[k];
                if (n >= 0 && n != from && side(t, k, p) < 0) next = n;
            }
            if (next < 0) return t;
            from = t;
            t = next;
        }
    }

    void take(int32_t t) {
        state[t] = 1;
        cavity[removed++] = t;
    }

    // Finds the tetrahedra that the point replaces; false if there is no valid cavity.
    bool dig(int32_t t, const int32_t* p) {
        removed = 0;
        take(t);
        for (int64_t i = 0; i < removed; ++i)
            for (int k = 0; k < 4; ++k) {
                const int32_t n = beside(cavity[i])[k];
                if (n >= 0 && !state[n] && in_sphere(n, p)) take(n);
            }
        for (bool grown = true; grown;) {
            grown = false;
            for (int64_t i = 0; i < removed; ++i)
                for (int k = 0; k < 4; ++k) {
                    const int32_t n = beside(cavity[i])[k];
                    if ((n >= 0 && state[n]) || side(cavity[i], k, p) > 0) continue;
                    if (n < 0) return false;
                    take(n);
                    grown = true;
                }
        }
        return true;
    }

    int32_t row() { return free_count ? unused[--free_count] : rows < a.capacity ? int32_t(rows++) : -1; }

    int64_t slot(int64_t key) const {
        uint64_t h = uint64_t(key) * 0x9E3779B97F4A7C15u;
        int64_t i = int64_t(h >> 48);
        while (keys[i] >= 0 && keys[i] != key) i = (i + 1) & (TABLE - 1);
        return i;
    }

    // Connects facet k of t, which contains the new point, with the other new tetrahedron at the same edge.
    void join(int32_t t, int k, int own) {
        int64_t ends[2];
        int found = 0;
        for (int i = 0; i < 4; ++i)
            if (i != k && i != own) ends[found++] = corner(t)[i];
        const int64_t low = ends[0] < ends[1] ? ends[0] : ends[1], high = ends[0] + ends[1] - low;
        const int64_t i = slot(low << 31 | high);
        if (keys[i] < 0) {
            keys[i] = low << 31 | high;
            filled[edges++] = int32_t(i);
            sides[i] = 4 * int64_t(t) + k;
        } else {
            const int32_t other = int32_t(sides[i] / 4);
            beside(t)[k] = other;
            beside(other)[sides[i] % 4] = t;
        }
    }

    bool insert(int32_t number) {
        const int32_t* p = point(number);
        const int32_t t = locate(p);
        for (int k = 0; k < 4; ++k) {
            const int32_t* v = point(corner(t)[k]);
            if (v[0] == p[0] && v[1] == p[1] && v[2] == p[2]) return true;
        }
        int64_t faces = 0;
        bool valid = dig(t, p);
        for (int64_t i = 0; i < removed; ++i)
            for (int k = 0; k < 4; ++k) {
                const int32_t n = beside(cavity[i])[k];
                faces += n < 0 || !state[n];
            }
        valid = valid && 3 * faces < TABLE;  // the table is at most half full
        if (!valid) {
            for (int64_t i = 0; i < removed; ++i) state[cavity[i]] = 0;
            return true;
        }
        for (int64_t i = 0; i < removed; ++i)
            for (int k = 0; k < 4; ++k) {
                const int32_t old = cavity[i], n = beside(old)[k];
                if (n >= 0 && state[n]) continue;
                const int32_t fresh = row();
                if (fresh < 0) return false;
                for (int j = 0; j < 4; ++j) corner(fresh)[j] = j == k ? number : corner(old)[j];
                beside(fresh)[k] = n;
                if (n >= 0)
                    for (int j = 0; j < 4; ++j)
                        if (beside(n)[j] == old) beside(n)[j] = fresh;
                for (int j = 0; j < 4; ++j)
                    if (j != k) join(fresh, j, k);
                last = fresh;
            }
        for (int64_t i = 0; i < edges; ++i) keys[filled[i]] = -1;
        edges = 0;
        for (int64_t i = 0; i < removed; ++i) {
            state[cavity[i]] = 0;
            unused[free_count++] = cavity[i];
        }
        a.inserted[number] = 1;
        return true;
    }
};

}  // namespace
}  // namespace gs2d

using namespace gs2d;

GS2D_EXPORT void gs2d_tetrahedra(TetrahedraArguments* arguments) {
    if (!Triangulation(*arguments).build()) arguments->count = -1;
}
