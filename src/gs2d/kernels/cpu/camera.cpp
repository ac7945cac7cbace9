// Computes the derivative with respect to a rigid camera motion from the splat gradients (docs/math.md, "Camera").
// Pieces have a fixed size and are summed in order, so the result is bit-identical for any number of threads.
#include "core/sh.h"

#include <cstdlib>

#include "cpu/export.h"
#include "cpu/splat_group.h"
#include "cpu/threads.h"

namespace gs2d {
namespace {

constexpr int64_t PIECE = 1024;  // rows
constexpr int SUMS = 6;          // force, torque

// Filled in render/pose_gradient.py.
struct Moved {
    int64_t count;
    const real *points, *to_points;  // [N, 3] and their gradients
    const real *quats, *to_quats;    // [N, 4]; or null
    const real *shN, *to_sh0;        // [N, sh_rest, 3], [N, 3]; or null
    int64_t sh_rest, degree;
    double center[3];
};

Vec3<V> load_vector(const real* p, int64_t i, int lanes) {
    V v[3];
    load_rows<3>(p + 3 * i, 3, lanes, v);
    return {v[0], v[1], v[2]};
}
Vec3<V> keep(M m, Vec3<V> a) { return {keep(m, a.x), keep(m, a.y), keep(m, a.z)}; }
M is_finite(Vec3<V> a) { return is_finite(a.x) & is_finite(a.y) & is_finite(a.z); }

// Adds the derivative with respect to a small rotation of q to dq * q.
Vec3<V> turn_of_quats(const Moved& s, int64_t i, int lanes) {
    V q[4], g[4];
    load_rows<4>(s.quats + 4 * i, 4, lanes, q);
    load_rows<4>(s.to_quats + 4 * i, 4, lanes, g);
    const M here = first(lanes) & is_finite(q[0]) & is_finite({q[1], q[2], q[3]});
    const Vec3<V> v = {q[1], q[2], q[3]}, gv = {g[1], g[2], g[3]};
    return keep(here, V(real(0.5)) * (cross(v, gv) + q[0] * gv - g[0] * v));
}

// Adds the derivative with respect to a rotation of the view directions of the colours.
Vec3<V> turn_of_colors(const Moved& s, int64_t i, int lanes, Vec3<V> to_splat) {
    V rest[3 * (SH_MAX - 1)], along[SH_MAX];
    const int64_t stride = 3 * s.sh_rest;
    if (s.degree == 1) load_rows<9>(s.shN + i * stride, stride, lanes, rest);
    if (s.degree == 2) load_rows<24>(s.shN + i * stride, stride, lanes, rest);
    if (s.degree == 3) load_rows<45>(s.shN + i * stride, stride, lanes, rest);
    const Vec3<V> g = V(real(1 / 0.28209479177387814)) * load_vector(s.to_sh0, i, lanes);
    along[0] = V(real(0));
    for (int k = 1; k < sh_count(int(s.degree)); ++k)
        along[k] = dot(g, {rest[3 * k - 3], rest[3 * k - 2], rest[3 * k - 1]});
    const Vec3<V> d = V(real(1)) / sqrt(dot(to_splat, to_splat)) * to_splat;
    const Vec3<V> turn = cross(d, sh_basis_vjp(d, int(s.degree), along));
    // A zero gradient contributes 0, even if the coefficients are not finite.
    const M asked = first(lanes) & ((abs(g.x) + abs(g.y) + abs(g.z)) > V(real(0)));
    return keep(asked, turn);
}

}  // namespace
}  // namespace gs2d

using namespace gs2d;

// sums: derivatives with respect to a translation [3] and a rotation [3] of the scene about the centre. Non-finite rows
// contribute 0. Returns 1 if out of memory.
GS2D_EXPORT int gs2d_camera_wrench(const Moved* moved, double* sums) {
    const Moved& s = *moved;
    const int64_t pieces = (s.count + PIECE - 1) / PIECE;
    auto* const of_pieces = static_cast<double*>(std::malloc(static_cast<size_t>(pieces * SUMS + 1) * sizeof(double)));
    if (!of_pieces) return 1;
    const Vec3<V> center = {V(real(s.center[0])), V(real(s.center[1])), V(real(s.center[2]))};
    parallel_ranges(s.count, PIECE, [&](int64_t begin, int64_t end) {
        const V zero = V(real(0));
        Vec3<V> force = {zero, zero, zero}, torque = {zero, zero, zero};
        for (int64_t i = begin; i < end; i += LANES) {
            const int lanes = end - i < LANES ? static_cast<int>(end - i) : LANES;
            const Vec3<V> arm = load_vector(s.points, i, lanes) - center;
            const M here = first(lanes) & is_finite(arm);
            const Vec3<V> g = keep(here, load_vector(s.to_points, i, lanes));
            force = force + g;
            torque = torque + keep(here, cross(arm, g));
            if (s.quats) torque = torque + turn_of_quats(s, i, lanes);
            if (s.to_sh0) torque = torque - keep(here, turn_of_colors(s, i, lanes, arm));
        }
        const V of[SUMS] = {force.x, force.y, force.z, torque.x, torque.y, torque.z};
        for (int k = 0; k < SUMS; ++k) of_pieces[begin / PIECE * SUMS + k] = double(sum(of[k]));
    });
    for (int k = 0; k < SUMS; ++k) {
        sums[k] = 0;
        for (int64_t i = 0; i < pieces; ++i) sums[k] += of_pieces[i * SUMS + k];
    }
    std::free(of_pieces);
    return 0;
}
