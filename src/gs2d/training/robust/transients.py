"""Find what a single photograph shows: people who walk by, cars, the photographer's shadow.

The rendering of a photograph differs from it there, while at the same surface the photographs of other views are
rendered well. Both conditions are needed: detail that is not learned yet differs in all photographs, and a surface that
few photographs show may be what they say. Such pixels do not take part in training, fusion, refinement and texture.
A cell of a photograph is transient if

    d > max(LEAST, TYPICAL * median of d in all views)
        + TIMES * (lower median of d at the same surface in the SEEN nearest views that show it)

with d the largest channel of |photograph - rendering|, averaged over 3x3 cells, where at least SHOWING views show it.
The median of all views says how much a rendering can be trusted yet.
Cells that are not part of a transient square of SIDE x SIDE cells do not count; then the rim is added.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from operator import getitem

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import binary_dilation, binary_opening
from scipy.spatial import cKDTree
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.image_arrays import at_cells
from gs2d.data.scene import Scene
from gs2d.training.robust.view_cells import ViewCells, lower_median_elsewhere
from gs2d.training.state import Cells, TrainState

CELLS = 96  # a side of a map
LEAST = 0.06  # of colours in [0, 1]; exposure that is not learned and highlights stay below
TYPICAL, TIMES = 6.0, 3.0
SEEN, SHOWING = 12, 3
SIDE = 3  # thin parts that are not built yet are narrower
MOST = 0.5  # of a photograph; if more differs, its light or camera does, and it stays whole


def differences(camera: Camera, difference: Tensor, depth: np.ndarray, usable: np.ndarray) -> ViewCells:
    """Return d of each cell from photograph minus rendering [H, W, 3]; 0 where the photograph is not ``usable``."""
    counted = (difference * torch.from_numpy(usable)[..., None]).permute(2, 0, 1)
    cells = F.adaptive_avg_pool2d(counted[:, None].float(), CELLS)
    means = F.avg_pool2d(cells, 3, 1, 1, count_include_pad=False)[:, 0].abs().amax(dim=0)
    return ViewCells(camera, means.numpy(), at_cells(depth, CELLS))


def transient_maps(views: Iterable[ViewCells]) -> Tensor:
    """Return what single views show, [V, CELLS, CELLS] uint8: 1 transient, 0 not."""
    views = list(views)
    centres = np.stack([view.camera.center for view in views])
    nearest = np.asarray(cKDTree(centres).query(centres, k=range(2, min(SEEN, len(views) - 1) + 2))[1])
    least = max(LEAST, TYPICAL * float(np.median([view.values for view in views])))
    maps = [_transient(view, [views[row] for row in rows], least) for view, rows in zip(views, nearest, strict=True)]
    return torch.from_numpy(np.stack(maps).astype(np.uint8))


def _transient(view: ViewCells, others: Sequence[ViewCells], least: float) -> np.ndarray:
    elsewhere, count = lower_median_elsewhere(view, others)
    differs = (count >= SHOWING) & (view.values > least + TIMES * elsewhere)
    found: np.ndarray = binary_dilation(binary_opening(differs, np.ones((SIDE, SIDE), bool)), np.ones((3, 3), bool))
    return found & (found.mean() <= MOST)


def with_maps(scene: Scene, state: TrainState, cells: Cells = getitem) -> Scene:
    """Return the scene with the maps of its training views, whose masks leave out what single views show."""
    maps = {name: values > 0 if name == "transient" else values for name, values in state.maps.items()}
    train = (
        view.with_cells(**{name: cells(values, row).cpu().numpy() for name, values in maps.items()})
        for row, view in enumerate(scene.train)
    )
    return replace(scene, train=tuple(train))
