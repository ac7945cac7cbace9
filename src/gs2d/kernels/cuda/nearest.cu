// Exact nearest neighbours in a k-d tree that torch has built (nearest.py), and the choice of points that keep a distance.
//
// The tree is complete: node n has the children 2 n and 2 n + 1, and each leaf the same number of places. So a thread
// needs no stack: one bit a level says whether the node's sibling is done. Everything is float64, as in scipy's trees.
#include "cuda/common.h"

namespace gs2d {

constexpr int LEAF = 8;  // points; nearest.py has the same

struct Tree {
    int64 leaves;          // a power of two, at most 2^27
    const double* boxes;   // [2 * leaves, 6]: lower and upper corner of each node; empty ones are (inf, -inf)
    const double* points;  // [LEAF * leaves, 3]; infinite where there is none
};

struct NearestArguments {
    Tree tree;
    int64 count;
    double limit;           // squared: only what is nearer counts
    const double* queries;  // [count, 3]
    double* distances;      // [count, K], squared, ascending; `limit` where there are fewer
    int64* places;          // [count, K]; -1 where there are fewer
};

struct SpreadArguments {
    Tree tree;
    int64 count;
    double limit;         // squared: those nearer to each other cannot both be taken
    const int64* open;    // [count]: places that are not decided
    const int64* turns;   // [places]: who comes before whom
    uchar* states;        // [places]
};

struct Point {
    double x, y, z;
};

__device__ __forceinline__ Point point_at(const double* from, int64 i) { return {from[3 * i], from[3 * i + 1], from[3 * i + 2]}; }

__device__ __forceinline__ double squared_distance(const Point& a, const Point& b) {
    const double x = a.x - b.x, y = a.y - b.y, z = a.z - b.z;
    return x * x + y * y + z * z;
}

// Squared distance from a point to a node's box; infinity for an empty one.
__device__ __forceinline__ double gap(const Tree& t, int64 node, const Point& q) {
    const double* b = t.boxes + 6 * node;
    const double x = max(max(b[0] - q.x, q.x - b[3]), 0.), y = max(max(b[1] - q.y, q.y - b[4]), 0.);
    const double z = max(max(b[2] - q.z, q.z - b[5]), 0.);
    return x * x + y * y + z * z;
}

// Calls visit(place, squared distance) for every point nearer than visit.limit(), which may shrink, nearer nodes first.
template <class Visit> __device__ __forceinline__ void walk(const Tree& t, const Point& q, Visit& visit) {
    int64 node = 1;
    uint done = 1u;  // bit d: the sibling of the ancestor d levels up is done; the root has none
    for (;;) {
        if (node < t.leaves) {
            const double left = gap(t, 2 * node, q), right = gap(t, 2 * node + 1, q);
            if (min(left, right) < visit.limit()) {
                node = 2 * node + (right < left), done <<= 1;
                continue;
            }
        } else {
            const int64 first = (node - t.leaves) * LEAF;
            for (int i = 0; i < LEAF; ++i) {
                const double d = squared_distance(point_at(t.points, first + i), q);
                if (d < visit.limit()) visit(first + i, d);
            }
        }
        do {  // to the first sibling on the way up that is not done and near enough
            while (done & 1u) {
                if (node == 1) return;
                node >>= 1, done >>= 1;
            }
            node ^= 1, done |= 1u;
        } while (!(gap(t, node, q) < visit.limit()));
    }
}

template <int K> struct Nearest {
    double distances[K];
    int64 places[K];
    __device__ __forceinline__ explicit Nearest(double limit) {
#pragma unroll
        for (int k = 0; k < K; ++k) distances[k] = limit, places[k] = -1;
    }
    __device__ __forceinline__ double limit() const { return distances[K - 1]; }
    __device__ __forceinline__ void operator()(int64 place, double d) {
#pragma unroll
        for (int k = 0; k < K; ++k) {
            const bool before = d < distances[k];
            const double passed = before ? distances[k] : d;
            const int64 passed_place = before ? places[k] : place;
            distances[k] = before ? d : distances[k], places[k] = before ? place : places[k];
            d = passed, place = passed_place;
        }
    }
};

template <int K> __device__ __forceinline__ void find_nearest(const NearestArguments& a) {
    const int64 i = int64(blockIdx.x) * blockDim.x + threadIdx.x;
    if (i >= a.count) return;
    Nearest<K> found(a.limit);
    walk(a.tree, point_at(a.queries, i), found);
#pragma unroll
    for (int k = 0; k < K; ++k) a.distances[K * i + k] = found.distances[k], a.places[K * i + k] = found.places[k];
}

extern "C" __global__ void __launch_bounds__(128) nearest_1(NearestArguments a) { find_nearest<1>(a); }
extern "C" __global__ void __launch_bounds__(128) nearest_8(NearestArguments a) { find_nearest<8>(a); }

enum State : uchar { OPEN, TAKEN, GONE };  // nearest.py has the same

// What those that come before a point say of it. One that is taken ends the walk.
struct Before {
    double reach;
    int64 self, turn;
    const int64* turns;
    const uchar* states;
    bool waits = false, gone = false;
    __device__ __forceinline__ double limit() const { return gone ? 0. : reach; }
    __device__ __forceinline__ void operator()(int64 place, double) {
        if (place == self || turns[place] >= turn) return;
        gone |= states[place] == TAKEN, waits |= states[place] == OPEN;
    }
};

// A point is taken once all before it that are too near are gone, and gone once one of them is taken. Decisions are never
// taken back, so it does not matter whether a neighbour's is seen in this launch or in the next.
extern "C" __global__ void __launch_bounds__(128) spread_points(SpreadArguments a) {
    const int64 i = int64(blockIdx.x) * blockDim.x + threadIdx.x;
    if (i >= a.count) return;
    const int64 self = a.open[i];
    Before before = {a.limit, self, a.turns[self], a.turns, a.states};
    walk(a.tree, point_at(a.tree.points, self), before);
    if (before.gone) a.states[self] = GONE;
    else if (!before.waits) a.states[self] = TAKEN;
}

}  // namespace gs2d
