// Bounds of the rays of a view: of all of them, of squares of tiles, and of tiles.
#if GS2D_RAYS
#include "cpu/ray_bounds.h"

#include "cpu/threads.h"

namespace gs2d {
namespace {

// Returns the bound of a tile's rays, and adds their sum.
RayBound bound_of(const TileRays& rays, Vec3<real>& total) {
    Vec3<V> lanes_sum = {V(0), V(0), V(0)};
    for (int b = 0; b < BLOCKS; ++b) lanes_sum = lanes_sum + rays.at(b);
    RayBound bound;
    bound.add({sum(lanes_sum.x), sum(lanes_sum.y), sum(lanes_sum.z)});
    total = total + bound.sum;
    bound.point();
    LaneBound lanes;
    for (int b = 0; b < BLOCKS; ++b)
        lanes.widen(rays.at(b), rays.density_at(b), rays.density_at(b) < V(NO_RAY), bound.sum);
    return lanes.bound(bound.sum);
}

}  // namespace

bool bound_rays(Frame& f) {
    const int64_t areas_x = (f.tiles_x + AREA - 1) / AREA, areas_y = (f.tiles_y + AREA - 1) / AREA;
    f.area_count = areas_x * areas_y;
    const int64_t padded = whole_vectors(f.area_count);
    if (!f.areas.reserve(sizeof(RayBounds<1>) + 5 * sizeof(real) * padded + sizeof(AreaTiles) * f.area_count))
        return false;
    const BoundArrays areas = bounds_of_areas(f), all = bound_of_view(f).arrays();
    parallel_for(f.area_count, [&](int64_t a) {
        RayBound tiles[AREA * AREA], area;
        for (int t = 0; t < AREA * AREA; ++t) {
            const int64_t x = a % areas_x * AREA + t % AREA, y = a / areas_x * AREA + t / AREA;
            if (x < f.tiles_x && y < f.tiles_y)
                tiles[t] = bound_of(TileRays(f, tile_area(f, y * f.tiles_x + x)), area.sum);
            tiles[t].store_to(tiles_of_areas(f)[a].arrays(), t);
        }
        area.point();
        for (const RayBound& tile : tiles) area.include(tile);
        area.store_to(areas, a);
    });
    for (int64_t i = f.area_count; i < padded; ++i) RayBound().store_to(areas, i);
    // The cone around all rays is exact, since it decides which radii are 0.
    const real* const map = static_cast<const real*>(f.view.rays);
    const int64_t pixels = int64_t(f.view.width) * f.view.height;
    double total[3] = {};
    for (int64_t i = 0; i < pixels; ++i)
        for (int k = 0; k < 3; ++k) total[k] += map[4 * i + k];
    RayBound view;
    view.add({real(total[0]), real(total[1]), real(total[2])});
    view.point();
    for (int64_t i = 0; i < pixels; ++i) {
        const Vec3<real> d = Vec3<real>{map[4 * i], map[4 * i + 1], map[4 * i + 2]} - view.sum;
        if (map[4 * i + 3] < NO_RAY)
            view.chord2 = max(view.chord2, dot(d, d)), view.side2 = max(view.side2, 1 / map[4 * i + 3]);
    }
    for (int i = 0; i < RayBounds<1>::COUNT; ++i) view.store_to(all, i);
    return true;
}

}  // namespace gs2d
#endif
