// Backward pass variants for further channels.
#include "cpu/tile_vjp.h"

namespace gs2d {

TileVjp feature_variant(bool dist, bool abs) {
    if (dist) return abs ? tile_vjp<true, true, true, false, true> : tile_vjp<true, true, false, false, true>;
    return abs ? tile_vjp<true, false, true, false, true> : tile_vjp<true, false, false, false, true>;
}

}  // namespace gs2d
