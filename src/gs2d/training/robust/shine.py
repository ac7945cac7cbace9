"""Find shiny surfaces, whose brightness changes with the viewing direction.

Reflections are texture that is not on the surface, so colours mislead the geometry below them as much as where there is
no texture. For pairs of neighbouring photographs, warped by the rendered depth, u is the share of brightness in their
difference (``meshing.warped_ncc.brightness_share``). A map of each photograph holds

    255 clamp((u - MATT) / (SHINY - MATT), 0, 1) clamp((c - RARELY) / (OFTEN - RARELY), 0, 1)

in CELLS x CELLS cells, with c the part of their pixels that can be compared; both are averaged over REACH cells. The
maps of neighbours must show it at the same surface, because people who walk by are bright in one photograph only.
Losses take shiny pixels for pixels without texture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gs2d.core.image_arrays import at_cells
from gs2d.kernels.library import Library
from gs2d.meshing.refine import MATT, OFTEN, RARELY, SHINY
from gs2d.meshing.warped_ncc import DrawnMesh, GreyImage, MatchSettings, brightness_share
from gs2d.training.robust.view_cells import ViewCells, lower_median_elsewhere

CELLS, REACH = 48, 7  # cells a side of a map, and of the windows of means: shiny surfaces have matt-looking spots
TINY = 1e-12
WORKERS = 4  # threads; those of the library come on top
LEAST = 0.05  # mean weight below which a cell is matt: no texture, which flatness handles


@dataclass(frozen=True, eq=False)
class _RenderedView:
    """A photograph, usable away from outlines, and the rendered depth [H, W] world units, 0 without a surface."""

    image: GreyImage
    depth: np.ndarray


def shine_maps(
    rendered: Callable[[int], tuple[GreyImage, np.ndarray]], neighbours: Sequence[Sequence[int]], library: Library
) -> Tensor:
    """Return how shiny the surface is in each photograph: [V, CELLS, CELLS] uint8, from 0, matt, to 255.

    ``rendered`` returns a downscaled photograph and its rendered depth [H, W] in world units, 0 without a surface.
    ``neighbours`` are the photographs that each one is compared with; without any, all of it counts as matt.
    """

    def drawn(index: int) -> _RenderedView:
        image, depth = rendered(index)
        inner = DrawnMesh(np.zeros(0, np.int32), depth).inner(image.camera.fx)
        return _RenderedView(replace(image, usable=inner if image.usable is None else inner & image.usable), depth)

    # All views that are compared, in memory: at most 120 and their neighbours, downscaled.
    compared = {index: others for index, others in enumerate(neighbours) if others}
    views = {index: drawn(index) for index in sorted({*compared, *(one for others in neighbours for one in others)})}
    maps, confirmed = np.zeros((2, len(neighbours), CELLS, CELLS))
    with ThreadPoolExecutor(min(WORKERS, torch.get_num_threads())) as pool:
        beside = ([views[other] for other in others] for others in compared.values())
        results = pool.map(partial(_shine, library=library), map(views.__getitem__, compared), beside)
        for index, shine in zip(compared, results, strict=True):
            maps[index] = shine
    cells = {row: ViewCells(view.image.camera, maps[row], at_cells(view.depth, CELLS)) for row, view in views.items()}
    for index, others in compared.items():
        there, _ = lower_median_elsewhere(cells[index], [cells[other] for other in others])
        confirmed[index] = np.minimum(maps[index], there)
    return torch.from_numpy(np.rint(255 * confirmed).astype(np.uint8))


def _shine(view: _RenderedView, beside: Sequence[_RenderedView], library: Library) -> np.ndarray:
    """Return how shiny the surface is in the cells of a photograph, from 0 to 1."""
    pairs = [(other.image, other.depth) for other in beside]
    share, weight, compared = brightness_share(view.image, view.depth, pairs, MatchSettings(), library)
    values = np.stack([share * weight, weight, compared, view.depth > 0]).astype(np.float64)
    sums = F.adaptive_avg_pool2d(torch.from_numpy(values)[:, None], CELLS)
    means = F.avg_pool2d(sums, REACH, 1, REACH // 2, count_include_pad=False)[:, 0].numpy()
    bright, textured, often, drawn = means
    shiny = np.clip((bright / np.maximum(textured, TINY) - MATT) / (SHINY - MATT), 0, 1)
    shiny *= np.clip((often / np.maximum(drawn, TINY) - RARELY) / (OFTEN - RARELY), 0, 1)
    return np.where(textured > LEAST, shiny, 0.0)
