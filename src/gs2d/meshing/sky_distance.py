"""Tell the sky from a ceiling: both are smooth, bright and above the horizon, but only the sky is infinitely far away.

A point of the sky has the same direction in all images, a point of a ceiling moves with its distance. Faint shading
shows which of both holds, if pixels of many images are compared: under the right assumption, matching pixels have the
same brightness, up to one gain per image and the lens's falloff towards the corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from gs2d.core.camera import Camera
from gs2d.meshing.fusion_bounds import backproject
from gs2d.meshing.sky import shrunk

SIDE = 100  # px: images are reduced to this longer side, which also averages their noise
SAMPLES = 200  # pixels of an image that are compared with each other image
APART = 3.0  # px: smallest distance between the matches of both assumptions
LEAST = 50  # compared pixels, below which images cannot decide
MOST = 20_000  # compared pixels, chosen at random
DARKEST = 0.02  # brightness, [0, 1], below which the logarithm is cut off
OUTLIER = 0.1  # largest difference of log brightness that counts
ROUNDS, TOLERANCE = 5, 2.0  # of reweighting; residuals that keep their weight, in medians


@dataclass(frozen=True, eq=False)
class SmoothArea:
    """Pixels of an image that may show the sky, on a grid of blocks of ``factor`` pixels."""

    camera: Camera
    factor: int
    brightness: np.ndarray  # [H, W] logarithm
    inside: np.ndarray  # [H, W] bool
    depth: np.ndarray  # [H, W] world units: of the nearest sparse point in the image


def smooth_area(
    camera: Camera, image: np.ndarray, sky: np.ndarray, pixels: np.ndarray, depth: np.ndarray
) -> SmoothArea:
    """Return the ``sky`` pixels [H, W] of an image [H, W, 3] with the depths [M] of its sparse points [M, 2] px."""
    factor = max(1, round(max(sky.shape) / SIDE))
    inside = shrunk(sky, factor) == 1
    height, width = inside.shape
    column, row = np.minimum(pixels / factor, (width - 1, height - 1)).astype(np.int64).T
    sparse = np.zeros((height, width))
    sparse[row, column] = depth
    nearest = distance_transform_edt(sparse == 0, return_distances=False, return_indices=True)
    brightness = np.log(np.maximum(shrunk(image, factor).mean(axis=2), DARKEST))
    return SmoothArea(camera, factor, brightness, inside, sparse[tuple(nearest)])


def at_infinity(areas: Sequence[SmoothArea]) -> bool:
    """Return whether images agree better on smooth areas at infinity than at the depth of the sparse points nearby.

    False if the areas are too small, or too few images share them: nothing speaks against a surface.
    """
    rows, far, near = _matches(areas)
    if len(rows) < LEAST:
        return False
    return _disagreement(areas, rows, far) < _disagreement(areas, rows, near)


def _matches(areas: Sequence[SmoothArea]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return blocks and where another image shows them, at infinity and at their depth: (image, row, column) [M, 3]."""
    parts: list[tuple[np.ndarray, ...]] = []
    rng = np.random.default_rng(0)
    for index, area in enumerate(areas):
        row, column = np.nonzero(area.inside)
        some = rng.permutation(len(row))[:SAMPLES]
        row, column = row[some], column[some]
        y, x = ((block + 0.5) * area.factor - 0.5 for block in (row, column))
        points = backproject(area.camera, area.depth[row, column], y, x)
        rays = points - area.camera.center
        for other, there in enumerate(areas):
            if other == index or not len(row):
                continue
            far, inside_far = _blocks_of(there, there.camera.center + rays)
            near, inside_near = _blocks_of(there, points)
            fits = inside_far & inside_near & (np.linalg.norm(far - near, axis=1) > APART)
            here = np.stack([np.full(len(row), index), row, column], axis=1)[fits]
            ends = (np.insert(blocks[fits], 0, other, axis=1) for blocks in (far, near))
            parts.append((here, *ends))
    if not parts:
        return (np.zeros((0, 3), np.int64),) * 3
    here, far, near = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    some = rng.permutation(len(here))[:MOST]
    return here[some], far[some], near[some]


def _blocks_of(area: SmoothArea, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns [M, 2] of world points [M, 3], 0 outside the image, and which are in the smooth area."""
    pixels, z = area.camera.project(points)
    blocks = np.floor(pixels[:, ::-1] / area.factor)
    shown = (z > 0) & (blocks >= 0).all(axis=1) & (blocks < area.inside.shape).all(axis=1)
    blocks = np.where(shown[:, None], blocks, 0).astype(np.int64)
    return blocks, shown & area.inside[tuple(blocks.T)]


def _disagreement(areas: Sequence[SmoothArea], one: np.ndarray, two: np.ndarray) -> float:
    """Return the mean difference of log brightness between matching pixels, after gains and falloff are fitted."""
    count = len(one)
    difference = _values(areas, one)[0] - _values(areas, two)[0]
    unknowns = np.zeros((count, len(areas) + 2))  # a gain per image, and two coefficients of the falloff
    unknowns[np.arange(count), one[:, 0]] += 1
    unknowns[np.arange(count), two[:, 0]] -= 1
    unknowns[:, -2:] = _values(areas, one)[1] - _values(areas, two)[1]
    weight = np.ones(count)
    residual = difference
    for _ in range(ROUNDS):
        solution = np.linalg.lstsq(unknowns * weight[:, None], difference * weight, rcond=None)[0]
        residual = np.abs(difference - unknowns @ solution)
        weight = 1 / np.sqrt(1 + (residual / (TOLERANCE * np.median(residual) + 1e-4)) ** 2)
    return float(np.minimum(residual, OUTLIER).mean())


def _values(areas: Sequence[SmoothArea], places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the log brightness [M], and squared and fourth power of the distance from the image centre [M, 2]."""
    brightness, square = np.zeros(len(places)), np.zeros(len(places))
    for index, area in enumerate(areas):
        mine = places[:, 0] == index
        row, column = places[mine, 1], places[mine, 2]
        height, width = area.inside.shape
        brightness[mine] = area.brightness[row, column]
        square[mine] = ((row + 0.5 - height / 2) ** 2 + (column + 0.5 - width / 2) ** 2) / (max(height, width) / 2) ** 2
    return brightness, np.stack([square, square**2], axis=1)
