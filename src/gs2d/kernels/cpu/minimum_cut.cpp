// Minimum cut of a graph whose nodes have at most four neighbours (called by meshing/minimum_cut.py).
//
// The algorithm of Boykov and Kolmogorov (2004): a tree grows from either terminal, each path where they meet is
// saturated, and nodes that lose their parent look for another one in their tree. Whole numbers and a fixed order make
// the cut exact and repeatable.
#include <cstdint>
#include <cstdlib>

#include "cpu/export.h"

namespace gs2d {

struct CutArguments {
    int64_t nodes;
    const int32_t* neighbours;  // [nodes, 4]; -1: none
    const uint8_t* mirror;      // [nodes, 4]: index of the arc back
    int32_t* capacity;          // [nodes, 4] of the arc to the neighbour; becomes what is left
    int32_t* terminal;          // [nodes] capacity from the source, or minus that to the sink; becomes what is left
    uint8_t* source_side;       // [nodes] result: 1 if capacity is left on a path from the source
    int64_t flow;               // result; -1 without memory
};

namespace {

constexpr int8_t NONE = -1, TERMINAL = 4, ORPHAN = 5;
constexpr uint8_t FREE = 0, SOURCE = 1, SINK = 2;
constexpr int32_t END = -2;  // of the list of active nodes

template <class T> T* allocate(int64_t count) { return static_cast<T*>(std::malloc(size_t(count ? count : 1) * sizeof(T))); }

class MinimumCut {
public:
    explicit MinimumCut(CutArguments& arguments) : a(arguments) {
        tree = allocate<uint8_t>(a.nodes);
        parent = allocate<int8_t>(a.nodes);
        time = allocate<int32_t>(a.nodes);
        distance = allocate<int32_t>(a.nodes);
        next = allocate<int32_t>(a.nodes);
        orphans = allocate<int32_t>(a.nodes);
    }
    ~MinimumCut() {
        std::free(tree);
        std::free(parent);
        std::free(time);
        std::free(distance);
        std::free(next);
        std::free(orphans);
    }

    bool run() {
        if (!tree || !parent || !time || !distance || !next || !orphans) return false;
        for (int64_t i = 0; i < a.nodes; ++i) {
            const int32_t t = a.terminal[i];
            tree[i] = t > 0 ? SOURCE : t < 0 ? SINK : FREE;
            parent[i] = t ? TERMINAL : NONE;
            time[i] = 0, distance[i] = 1, next[i] = -1;
            if (t) activate(int32_t(i));
        }
        for (int32_t current = -1;;) {
            int32_t i = current;
            if (i < 0 || tree[i] == FREE) {
                i = pop();
                if (i == END) break;
                if (tree[i] == FREE) continue;
            }
            current = -1;
            int32_t from;
            int arc;
            if (!grow(i, from, arc)) continue;
            ++now;
            augment(from, arc);
            adopt();
            current = i;  // has neighbours that were not looked at
        }
        for (int64_t i = 0; i < a.nodes; ++i) a.source_side[i] = tree[i] == SOURCE;
        return true;
    }

private:
    CutArguments& a;
    uint8_t* tree = nullptr;      // [nodes]
    int8_t* parent = nullptr;     // [nodes] arc to the parent
    int32_t* time = nullptr;      // [nodes] when `distance` was computed
    int32_t* distance = nullptr;  // [nodes] arcs to the terminal
    int32_t* next = nullptr;      // [nodes] in the list of active nodes; -1 outside the list, END for the last one
    int32_t* orphans = nullptr;   // [nodes] ring
    int64_t first_orphan = 0, orphan_count = 0;
    int32_t head = END, tail = END, now = 0;

    int32_t node(int32_t i, int k) const { return a.neighbours[4 * int64_t(i) + k]; }
    int32_t& ahead(int32_t i, int k) { return a.capacity[4 * int64_t(i) + k]; }
    int32_t& back(int32_t i, int k) { return a.capacity[4 * int64_t(node(i, k)) + a.mirror[4 * int64_t(i) + k]]; }

    // Capacity of arc k of node i away from the tree's terminal.
    int32_t outward(int32_t i, int k) { return tree[i] == SOURCE ? ahead(i, k) : back(i, k); }

    void activate(int32_t i) {
        if (next[i] != -1) return;
        next[i] = END;
        if (head == END) head = i;
        else next[tail] = i;
        tail = i;
    }

    int32_t pop() {
        const int32_t i = head;
        if (i == END) return END;
        head = next[i];
        next[i] = -1;
        return i;
    }

    void orphan(int32_t i, bool in_front) {
        parent[i] = ORPHAN;
        if (in_front) {
            first_orphan = first_orphan ? first_orphan - 1 : a.nodes - 1;
            orphans[first_orphan] = i;
        } else {
            orphans[(first_orphan + orphan_count) % a.nodes] = i;
        }
        ++orphan_count;
    }

    // Adds the neighbours of an active node to its tree; true if one is in the other tree: arc `arc` of `from` then
    // leads from the tree of the source to that of the sink.
    bool grow(int32_t i, int32_t& from, int& arc) {
        for (int k = 0; k < 4; ++k) {
            const int32_t j = node(i, k);
            if (j < 0 || outward(i, k) <= 0) continue;
            const auto reverse = int8_t(a.mirror[4 * int64_t(i) + k]);
            if (tree[j] == FREE) {
                tree[j] = tree[i];
                parent[j] = reverse;
                time[j] = time[i];
                distance[j] = distance[i] + 1;
                activate(j);
            } else if (tree[j] != tree[i]) {
                from = tree[i] == SOURCE ? i : j;
                arc = tree[i] == SOURCE ? k : reverse;
                return true;
            } else if (time[j] <= time[i] && distance[j] > distance[i] + 1) {
                parent[j] = reverse;  // a shorter way to the terminal
                time[j] = time[i];
                distance[j] = distance[i] + 1;
            }
        }
        return false;
    }

    void augment(int32_t from, int arc) {
        const int32_t to = node(from, arc);
        int32_t most = ahead(from, arc), i;
        for (i = from; parent[i] != TERMINAL; i = node(i, parent[i])) most = least(most, back(i, parent[i]));
        most = least(most, a.terminal[i]);
        for (i = to; parent[i] != TERMINAL; i = node(i, parent[i])) most = least(most, ahead(i, parent[i]));
        most = least(most, -a.terminal[i]);

        ahead(from, arc) -= most;
        back(from, arc) += most;
        for (i = from; parent[i] != TERMINAL;) {
            const int k = parent[i];
            const int32_t up = node(i, k);
            ahead(i, k) += most;
            if (!(back(i, k) -= most)) orphan(i, true);
            i = up;
        }
        if (!(a.terminal[i] -= most)) orphan(i, true);
        for (i = to; parent[i] != TERMINAL;) {
            const int k = parent[i];
            const int32_t up = node(i, k);
            back(i, k) += most;
            if (!(ahead(i, k) -= most)) orphan(i, true);
            i = up;
        }
        if (!(a.terminal[i] += most)) orphan(i, true);
        a.flow += most;
    }

    static int32_t least(int32_t x, int32_t y) { return x < y ? x : y; }

    void adopt() {
        while (orphan_count) {
            const int32_t i = orphans[first_orphan];
            first_orphan = (first_orphan + 1) % a.nodes;
            --orphan_count;
            find_parent(i);
        }
    }

    // Arcs from node i to its terminal, or -1 if its root is an orphan.
    int32_t rooted(int32_t i) {
        int32_t steps = 0, j = i;
        for (;; j = node(j, parent[j])) {
            if (time[j] == now) {
                steps += distance[j];
                break;
            }
            if (parent[j] == ORPHAN) return -1;
            ++steps;
            if (parent[j] == TERMINAL) {
                time[j] = now;
                distance[j] = 1;
                break;
            }
        }
        int32_t left = steps;
        for (j = i; time[j] != now; j = node(j, parent[j])) time[j] = now, distance[j] = left--;
        return steps;
    }

    void find_parent(int32_t i) {
        const uint8_t own = tree[i];
        int best = NONE;
        int32_t nearest = INT32_MAX;
        for (int k = 0; k < 4; ++k) {
            const int32_t j = node(i, k);
            if (j < 0 || tree[j] != own || parent[j] == NONE) continue;
            if ((own == SOURCE ? back(i, k) : ahead(i, k)) <= 0) continue;
            const int32_t steps = rooted(j);
            if (steps >= 0 && steps < nearest) nearest = steps, best = k;
        }
        if (best != NONE) {
            parent[i] = int8_t(best);
            time[i] = now;
            distance[i] = nearest + 1;
            return;
        }
        for (int k = 0; k < 4; ++k) {
            const int32_t j = node(i, k);
            if (j < 0 || tree[j] != own || parent[j] == NONE) continue;
            if ((own == SOURCE ? back(i, k) : ahead(i, k)) > 0) activate(j);
            if (parent[j] >= 0 && parent[j] < TERMINAL && node(j, parent[j]) == i) orphan(j, false);
        }
        tree[i] = FREE;
        parent[i] = NONE;
    }
};

}  // namespace
}  // namespace gs2d

using namespace gs2d;

GS2D_EXPORT void gs2d_minimum_cut(CutArguments* arguments) {
    arguments->flow = 0;
    if (!MinimumCut(*arguments).run()) arguments->flow = -1;
}
