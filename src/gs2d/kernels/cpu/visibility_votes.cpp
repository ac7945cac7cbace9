// Votes of lines of sight for tetrahedra inside and outside a surface (called by meshing/minimum_cut.py).
//
// Lines are independent and add whole numbers, so the result does not depend on the number of threads.
#include <atomic>
#include <cmath>
#include <cstdint>

#include "cpu/export.h"
#include "cpu/threads.h"

namespace gs2d {

struct VoteArguments {
    int64_t lines, surfaces;  // the first `surfaces` lines end on a surface, the others in free space
    const double* xyz;          // [points, 3]
    const int32_t* corners;     // [tetrahedra, 4], positively oriented
    const int32_t* neighbours;  // [tetrahedra, 4], opposite to the corner; -1 outside
    const uint8_t* mirror;      // [tetrahedra, 4]: facet of the neighbour that leads back
    const int32_t* first;       // [points]: a tetrahedron at the point, or -1
    const int32_t* ends;        // [lines] points that are seen
    const double* starts;       // [lines, 3] camera centres
    const double* sigma;        // [lines] uncertainty of the point along the line, world units
    const int32_t* weight;      // [lines]
    int32_t* facets;            // [tetrahedra, 4]: cost of a facet with its tetrahedron outside and the neighbour inside
    int32_t* full;              // [tetrahedra]: cost of being outside
    uint8_t* cameras;           // [tetrahedra]: 1 where a line starts
};

namespace {

constexpr int64_t LINES = 1024;      // a task of a thread
constexpr int64_t STEPS = 1 << 20;   // of a walk, which rounding could let run in circles
constexpr double PARALLEL = -1e-12;  // cosine between line and facet above which the line does not cross the facet

void add(int32_t* place, int32_t amount) {
    std::atomic_ref<int32_t>(*place).fetch_add(amount, std::memory_order_relaxed);
}

// A straight walk through the tetrahedra from a corner of one of them.
struct Walk {
    const VoteArguments& a;
    const double* origin;
    double direction[3];  // unit vector
    int32_t at = -1;      // tetrahedron
    int out = -1;         // its facet through which the line leaves
    double distance = 0;  // from the origin to there
    int64_t steps = 0;

    const double* point(int32_t i) const { return a.xyz + 3 * int64_t(i); }

    // Finds the tetrahedron at the point into which the line goes; false if rounding prevents it.
    bool begin(int32_t number) {
        at = a.first[number];
        origin = point(number);
        for (; at >= 0 && steps < STEPS; ++steps) {
            const int32_t* v = a.corners + 4 * int64_t(at);
            int own = 0;
            while (own < 3 && v[own] != number) ++own;
            int worst = -1;
            double most = PARALLEL;
            for (int k = 0; k < 4; ++k) {
                if (k == own) continue;
                double n[3];
                inward(at, k, n);
                const double rate = dot(n, direction) / std::sqrt(dot(n, n));
                if (rate < most) most = rate, worst = k;
            }
            if (worst < 0) {
                out = own;
                distance = leave(own);
                return true;
            }
            at = a.neighbours[4 * int64_t(at) + worst];
        }
        return false;
    }

    // Enters the next tetrahedron; false at the end of the space.
    bool step() {
        const int64_t facet = 4 * int64_t(at) + out;
        const int32_t next = a.neighbours[facet];
        if (next < 0 || ++steps > STEPS) return false;
        const int entry = a.mirror[facet];
        at = next;
        double nearest = INFINITY;
        out = -1;
        for (int k = 0; k < 4; ++k) {
            if (k == entry) continue;
            const double found = leave(k);
            if (found < nearest) nearest = found, out = k;
        }
        if (out < 0) return false;
        if (nearest > distance) distance = nearest;
        return true;
    }

private:
    static double dot(const double* x, const double* y) { return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]; }

    // Normal of facet k, towards its tetrahedron.
    void inward(int32_t t, int k, double* n) const {
        // corners of facet k in an order for which (b - a) x (c - a) points to corner k
        static constexpr int FACE[4][3] = {{1, 3, 2}, {0, 2, 3}, {0, 3, 1}, {0, 1, 2}};
        const int32_t* v = a.corners + 4 * int64_t(t);
        const double *p = point(v[FACE[k][0]]), *q = point(v[FACE[k][1]]), *r = point(v[FACE[k][2]]);
        const double u[3] = {q[0] - p[0], q[1] - p[1], q[2] - p[2]}, w[3] = {r[0] - p[0], r[1] - p[1], r[2] - p[2]};
        n[0] = u[1] * w[2] - u[2] * w[1];
        n[1] = u[2] * w[0] - u[0] * w[2];
        n[2] = u[0] * w[1] - u[1] * w[0];
    }

    // Distance at which the line leaves through the plane of facet k; infinite if it does not.
    double leave(int k) const {
        double n[3];
        inward(at, k, n);
        const double rate = dot(n, direction);
        if (!(rate < 0)) return INFINITY;
        const int32_t* v = a.corners + 4 * int64_t(at);
        const double* p = point(v[k == 0 ? 1 : 0]);
        const double away[3] = {origin[0] - p[0], origin[1] - p[1], origin[2] - p[2]};
        return -dot(n, away) / rate;
    }
};

// Length of the line, and its unit direction from the point to the camera.
double towards(const VoteArguments& a, int64_t line, double* direction) {
    const double *from = a.xyz + 3 * int64_t(a.ends[line]), *to = a.starts + 3 * line;
    double length = 0;
    for (int k = 0; k < 3; ++k) direction[k] = to[k] - from[k], length += direction[k] * direction[k];
    length = std::sqrt(length);
    for (int k = 0; k < 3; ++k) direction[k] /= length;
    return length;
}

// Adds the weight of a line to the facets in front of its point, and to the tetrahedron one sigma behind it.
void vote(const VoteArguments& a, int64_t line) {
    Walk walk{a, nullptr, {}};
    const double length = towards(a, line, walk.direction), sigma = a.sigma[line];
    const int32_t weight = a.weight[line];
    if (walk.begin(a.ends[line])) {
        bool inside = true;
        while (inside && walk.distance < length) {
            const double d = walk.distance / sigma;
            const int64_t facet = 4 * int64_t(walk.at) + walk.out;
            const int32_t next = a.neighbours[facet];
            const auto amount = int32_t(std::lround(weight * (1 - std::exp(-0.5 * d * d))));
            if (next >= 0 && amount) add(a.facets + 4 * int64_t(next) + a.mirror[facet], amount);
            inside = walk.step();
        }
        if (inside) std::atomic_ref<uint8_t>(a.cameras[walk.at]).store(1, std::memory_order_relaxed);
    }
    if (line >= a.surfaces) return;
    Walk behind{a, nullptr, {-walk.direction[0], -walk.direction[1], -walk.direction[2]}};
    if (!behind.begin(a.ends[line])) return;
    while (behind.distance < sigma && behind.step()) {}
    add(a.full + behind.at, weight);
}

}  // namespace
}  // namespace gs2d

using namespace gs2d;

GS2D_EXPORT void gs2d_votes(const VoteArguments* arguments) {
    parallel_ranges(arguments->lines, LINES, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) vote(*arguments, i);
    });
}
