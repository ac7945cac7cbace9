"""Cached views of the native CPU backend, for training in which only the colours of some splats change.

With frozen geometry and opacity the image is affine in those colours, ``color = frozen + sum_k w_k max(0, c_k)``. A
:class:`CachedView` stores the frozen image and every weight w_k > 0 of one view, so rendering and gradients need no
blending. The weights have the bits of the blending. Images equal those of :func:`gs2d.render.api.rasterize` up to the
summation order, and do not depend on the number of threads (``docs/math.md``, "Cached views").
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.core.camera import Camera
from gs2d.core.checks import check_shapes
from gs2d.core.splats import ATTRIBUTES
from gs2d.errors import ShapeError
from gs2d.kernels.c_structures import filled, structure
from gs2d.kernels.library import Library
from gs2d.render.cpu_passes import ParameterGradients, forward, parameters_of, view_of
from gs2d.render.types import RasterSettings

TILE, SH_MAX = 16, 16  # px per side of a tile; basis functions of degree 3 (kernels/core/sh.h)


class CachedView:
    """One view of splats of which only the colours of ``rows`` splats change.

    ``arrays`` are those of ``struct CachedView``; their layout depends on the library's instruction set.
    """

    def __init__(
        self, library: Library, size: tuple[int, int], degree: int, rows: int, arrays: dict[str, Tensor]
    ) -> None:
        self.library = library
        self.height, self.width = size
        self.rows, self.arrays = rows, arrays
        sizes = {"width": self.width, "height": self.height, "tiles_x": -(-self.width // TILE)}
        sizes |= {"tiles": len(arrays["tile_entries"]) - 1, "rows": rows, "degree": degree}
        self.native = filled(structure("CachedView", "cpu"), **sizes, **arrays)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(array.nbytes for array in self.arrays.values())

    def render(self, sh0: Tensor, shN: Tensor) -> Tensor:
        """Return the image [H, W, 3], differentiable in the rows' coefficients sh0 [M, 1, 3] and shN [M, K - 1, 3].

        Raises ShapeError if the number of rows or coefficients or the dtype differ from the cached ones.
        """
        check_shapes({"sh0": (sh0, "M 1 3"), "shN": (shN, "M K 3")})
        degree = int(self.native.degree)
        if len(sh0) != self.rows or shN.shape[1] + 1 < (degree + 1) ** 2:
            raise ShapeError(
                f"the cached view holds {self.rows} rows of degree {degree}, got {len(sh0)} rows with "
                f"{1 + shN.shape[1]} coefficients; create it again with cache_view"
            )
        self.library.arrays(sh0=sh0, shN=shN)
        image: Tensor = _Render.apply(self, sh0, shN)
        return image


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, view: CachedView, sh0: Tensor, shN: Tensor) -> Tensor:
        sh0, shN = sh0.detach().contiguous(), shN.detach().contiguous()
        image = torch.empty(view.height, view.width, 3, dtype=sh0.dtype)
        colors = torch.empty(view.rows, 4, dtype=sh0.dtype)
        splats = parameters_of(dict.fromkeys(ATTRIBUTES, sh0) | {"shN": shN})  # only the coefficients are read
        view.library.call("gs2d_cached_render", view.native, splats, colors, image)
        ctx.view = view
        ctx.save_for_backward(colors, shN)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        view, (colors, shN) = ctx.view, ctx.saved_tensors
        sh0_gradient, shN_gradient = colors.new_empty(view.rows, 1, 3), torch.empty_like(shN)
        slots = colors.new_empty(len(view.arrays["entry_row"]), 4)
        out = filled(ParameterGradients, sh0=sh0_gradient, shN=shN_gradient)
        arguments = (view.native, upstream.contiguous(), colors, shN.shape[1], slots, out)
        view.library.call("gs2d_cached_gradients", *arguments)
        return None, sh0_gradient, shN_gradient


def cache_view(
    library: Library,
    camera: Camera,
    settings: RasterSettings,
    splats: Mapping[str, Tensor],
    rows: Tensor,
    limit_bytes: int,
) -> CachedView | None:
    """Cache one view of N splats of which only the colours of ``rows`` [M] int64, each once, change.

    ``splats`` are the contiguous parameters by name; the colours of ``rows`` do not matter. Returns None if the view
    exceeds ``limit_bytes``; its size depends only on the arguments.
    """
    if settings.sh_degree < 0:
        raise ShapeError("a cached view needs colours from harmonics, got plain colours (sh_degree -1)")
    if camera.rays is not None:
        return None  # there is no cache for cameras with rays
    height, width, count = camera.height, camera.width, len(rows)
    frame = forward(library, view_of(camera, settings, True), splats)[1]
    row_of = torch.full((len(splats["means"]),), -1, dtype=torch.int32)
    row_of[rows] = torch.arange(count, dtype=torch.int32)

    tiles = -(-width // TILE) * -(-height // TILE)
    tile_entries, tile_blocks = (torch.empty(tiles + 1, dtype=torch.int64) for _ in range(2))
    library.call("gs2d_cached_measure", frame.pointer, row_of, tile_entries, tile_blocks)
    entries, blocks = int(tile_entries[-1]), int(tile_blocks[-1])
    sizes: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
        "entry_row": ((entries,), torch.int32),
        "entry_blocks": ((entries,), torch.int32),
        "row_begin": ((count + 1,), torch.int64),
        "row_entries": ((entries,), torch.int32),
        "weights": ((blocks, library.lanes), library.dtype),
        "frozen": ((tiles, 3, TILE * TILE), library.dtype),
        "basis": ((-(-count // library.lanes), SH_MAX, library.lanes), library.dtype),
    }
    nbytes = sum(torch.Size(shape).numel() * dtype.itemsize for shape, dtype in sizes.values())
    if nbytes + tile_entries.nbytes + tile_blocks.nbytes > limit_bytes:
        return None
    arrays = {name: torch.empty(shape, dtype=dtype) for name, (shape, dtype) in sizes.items()}
    arrays |= {"tile_entries": tile_entries, "tile_blocks": tile_blocks}
    cached = CachedView(library, (height, width), settings.sh_degree, count, arrays)
    learning = {name: tensor[rows] for name, tensor in splats.items()}
    library.call("gs2d_cached_fill", frame.pointer, row_of, parameters_of(learning), cached.native)
    return cached
