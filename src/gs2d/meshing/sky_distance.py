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
    height, width = (size // factor for size in sky.shape)

    def blocks(values: np.ndarray) -> np.ndarray:
        cut = values[: height * factor, : width * factor]
        return np.asarray(cut.reshape(height, factor, width, factor).mean(axis=(1, 3)))

    column, row = np.minimum(pixels / factor, (width - 1, height - 1)).astype(np.int64).T
    sparse = np.zeros((height, width))
    sparse[row, column] = depth
    nearest = distance_transform_edt(sparse == 0, return_distances=False, return_indices=True)
    brightness = np.log(np.maximum(blocks(image.mean(axis=2)), DARKEST))
    return SmoothArea(camera, factor, brightness, blocks(sky) == 1, sparse[tuple(nearest)])


def at_infinity(areas: Sequence[SmoothArea]) -> bool:
    """Return whether images agree better on smooth areas at infinity than at the depth of the sparse points nearby.

    False if the areas are too small, or too few images share them: nothing speaks against a surface.
    """
    rows, far, near = _matches(areas)
    if len(rows) < LEAST:
        return False
    return _disagreement(areas, rows, far) < _disagreement(areas, rows, near)


def _matches(areas: Sequence[SmoothArea]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels and where another image shows them, at infinity and at their depth: (image, row, column) [M, 3]."""
    parts: list[tuple[np.ndarray, ...]] = []
    rng = np.random.default_rng(0)
    for index, area in enumerate(areas):
        row, column = np.nonzero(area.inside)
        some = rng.permutation(len(row))[:SAMPLES]
        row, column = row[some], column[some]
        camera = area.camera
        x, y = (column + 0.5) * area.factor, (row + 0.5) * area.factor
        rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(len(x))], axis=1)
        for other, there in enumerate(areas):
            if other == index or not len(row):
                continue
            motion = there.camera.T_cam_world @ np.linalg.inv(camera.T_cam_world)
            turned = rays @ motion[:3, :3].T
            moved = turned * area.depth[row, column, None] + motion[:3, 3]
            (far, inside_far), (near, inside_near) = _places(there, turned), _places(there, moved)
            fits = inside_far & inside_near & (np.linalg.norm(far - near, axis=1) > APART)
            here = np.stack([np.full(len(row), index), row, column], axis=1)[fits]
            ends = (np.insert(places[fits], 0, other, axis=1) for places in (far, near))
            parts.append((here, *ends))
    if not parts:
        return (np.zeros((0, 3), np.int64),) * 3
    here, far, near = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    some = rng.permutation(len(here))[:MOST]
    return here[some], far[some], near[some]


def _places(area: SmoothArea, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns [M, 2] of points [M, 3] of the camera's frame, and which are in the smooth area."""
    camera, (height, width) = area.camera, area.inside.shape
    z = np.maximum(points[:, 2], 1e-12)
    row = np.floor((camera.fy * points[:, 1] / z + camera.cy) / area.factor)
    column = np.floor((camera.fx * points[:, 0] / z + camera.cx) / area.factor)
    shown = (points[:, 2] > 0) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    places = np.stack([np.where(shown, row, 0), np.where(shown, column, 0)], axis=1).astype(np.int64)
    return places, shown & area.inside[places[:, 0], places[:, 1]]


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
