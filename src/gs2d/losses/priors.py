"""Known depths and normals of training views: sparse points, depth maps and normal maps.

Nothing here is part of the training state; it follows from the capture and the recipe.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gs2d.config.recipe import DepthPrior, NormalPrior, Recipe
from gs2d.core.memory_limit import cache_bytes
from gs2d.data.prior_maps import ObservedPoints, PointsInView, PriorDepth
from gs2d.data.scene import Scene, View
from gs2d.errors import DataError
from gs2d.losses.prior_formulas import Depths, MetricDepth, NormalTarget, PointDepths, RelativeDepths, fit_line

FIT_POINTS = 10  # points in a map that its scale and shift need
SAMPLED_VIEWS = 20  # views that determine the unit and the space of the maps
FACING = 0.9  # least fraction of normals that face the camera


@dataclass(frozen=True, eq=False)
class DepthPlan:
    """Interpretation of the known depths of a capture."""

    source: str  # "sparse", "sensor" or "relative"
    observed: ObservedPoints | None = None  # None if they are unknown or not needed
    unit: float | None = None  # world units of a value of 1 in all sensor maps; None: the unit of each file
    space: str = "disparity"  # "disparity" or "depth": the quantity that relative maps are linear in


def plan_depths(scene: Scene, settings: DepthPrior) -> DepthPlan:
    """Choose the source of known depths of a capture, and how it is read.

    Raise DataError if the capture does not have the requested source.
    """
    mapped = [view for view in scene.train if view.maps is not None and view.maps.files.depth is not None]
    source = settings.source
    if source == "auto":
        metric = any(view.maps is not None and view.maps.files.metric for view in mapped)
        source = "sensor" if metric else "relative" if mapped else "sparse"
    if source == "sparse":
        observed = scene.observed(guessed=False)
        if observed is None:
            raise DataError(
                f"{scene.name} must have sparse points with the images that show them (COLMAP does), or depth maps in "
                "depths/ or depth_file_path, got neither; train without --depth-prior"
            )
        if not any(len(points_in(view, observed, settings).depth) for view in scene.train):
            raise DataError(
                f"no training view of {scene.name} shows a sparse point of {settings.min_track} photographs or more "
                f"with an error up to {settings.max_error:g} px; --set depth_prior.min_track=2 takes more"
            )
        return DepthPlan(source, observed)
    if not mapped:
        raise DataError(
            f"no training view of {scene.name} has a depth map; put them in {scene.root}/depths under the names of the "
            "photographs (16-bit PNG or .npy), or name them as depth_file_path in transforms.json"
        )
    needs_points = settings.unit is None if source == "sensor" else settings.align == "points"
    observed = scene.observed(guessed=False) if needs_points else None
    if source == "sensor":
        return DepthPlan(source, observed, settings.unit or _fitted_unit(mapped, observed, settings))
    space = settings.space if settings.space != "auto" else _fitted_space(mapped, observed, settings)
    return DepthPlan(source, observed, space=space)


def _sampled_views(mapped: list[View]) -> list[View]:
    """Return evenly chosen views."""
    return mapped[:: max(1, -(-len(mapped) // SAMPLED_VIEWS))]


def _fitted_unit(mapped: list[View], observed: ObservedPoints | None, settings: DepthPrior) -> float | None:
    """Return the unit that fits the maps to the points; None without points.

    Raise DataError if too few points lie on pixels with a depth.
    """
    if observed is None:
        return None
    ratios = [depth / values for depth, values in (_pairs(view, observed, settings) for view in _sampled_views(mapped))]
    units = np.concatenate(ratios)
    if len(units) < FIT_POINTS:
        raise DataError(
            f"the scale of the depth maps needs {FIT_POINTS} sparse points on known pixels, got {len(units)}; set "
            "--set depth_prior.unit=... (units of the capture for a value of 1)"
        )
    return float(np.median(units))


def _fitted_space(mapped: list[View], observed: ObservedPoints | None, settings: DepthPrior) -> str:
    """Return the space in which lines fit the maps to the points with the smaller error; disparity without points."""
    errors: dict[str, list[float]] = {"disparity": [], "depth": []}
    for view in _sampled_views(mapped) if observed is not None else ():
        assert observed is not None
        depth, values = _pairs(view, observed, settings)
        for space, samples in errors.items():
            line = line_of(values, depth, space)
            if line is None:
                samples.append(np.inf)
                continue
            on_line = line[0] * values + line[1]
            with np.errstate(divide="ignore"):
                z = 1 / np.maximum(on_line, 0) if space == "disparity" else on_line
            samples.append(float(np.median(np.abs(z / depth - 1))))
    return "depth" if errors["depth"] and np.median(errors["depth"]) < np.median(errors["disparity"]) else "disparity"


def _pairs(view: View, observed: ObservedPoints, settings: DepthPrior) -> tuple[np.ndarray, np.ndarray]:
    """Return the depths [M] of points of a view on valid pixels of its map, and the values of the map there."""
    assert view.maps is not None
    return _values_at(points_in(view, observed, settings), view.maps.depth())


def _values_at(points: PointsInView, map_: PriorDepth) -> tuple[np.ndarray, np.ndarray]:
    columns, rows = np.floor(points.pixels).astype(np.int64).T
    values = map_.values[rows, columns].astype(np.float64)
    return points.depth[values > 0], values[values > 0]


def line_of(values: np.ndarray, depth: np.ndarray, space: str) -> tuple[float, float] | None:
    """Fit map values to disparities or depths of points; return scale > 0 and shift, or None if there is no fit."""
    if len(values) < FIT_POINTS:
        return None
    middle, spread = values.mean(), values.std()
    if not spread > 1e-9 * abs(middle):
        return None
    x, y = torch.from_numpy((values - middle) / spread), torch.from_numpy(1 / depth if space == "disparity" else depth)
    scale, shift = (float(number) for number in fit_line(x, y, torch.ones_like(x), rounds=20))
    return (scale / spread, shift - scale * middle / spread) if scale > 0 else None


def points_in(view: View, observed: ObservedPoints, settings: DepthPrior) -> PointsInView:
    """Return the points of a view that pass the limits of the settings."""
    return observed.in_view(view.name, view.camera, min_track=settings.min_track, max_error=settings.max_error)


class Priors:
    """Known depths and normals of each training view. The first that fit in ``limit_bytes`` are cached.

    The default limit is 1 GiB in host memory and 4 GiB on a device. Others are decoded each time.

    The constructor raises DataError if the capture does not have what the recipe requires.
    """

    def __init__(
        self,
        scene: Scene,
        recipe: Recipe,
        *,
        device: torch.device | str = "cpu",
        limit_bytes: int | None = None,
    ) -> None:
        self._views, self._recipe, self._device = scene.train, recipe, device
        by_place = 1 << 30 if torch.device(device).type == "cpu" else 1 << 32
        self._room = cache_bytes(by_place) if limit_bytes is None else limit_bytes
        self._cached: dict[int, tuple[Depths | None, NormalTarget | None]] = {}
        self.plan = None if recipe.depth_prior is None else plan_depths(scene, recipe.depth_prior)
        self.axes = None if recipe.normal_prior is None else plan_normals(scene, recipe.normal_prior)

    def at(self, index: int, dtype: torch.dtype) -> tuple[Depths | None, NormalTarget | None]:
        """Return the known depths and normals of view ``index``."""
        cached = self._cached.get(index)
        if cached is not None:
            return cached
        view = self._views[index]
        depth = normal = None
        if self.plan is not None:
            assert self._recipe.depth_prior is not None
            depth = metric_depths(view, self.plan, self._recipe.depth_prior, dtype, self._device)
        if self.axes is not None and view.maps is not None and view.maps.files.normal is not None:
            normal = world_normals(view, self.axes, dtype, self._device)
        tensors = [value for prior in (depth, normal) if prior is not None for value in vars(prior).values()]
        nbytes = sum(tensor.nbytes for tensor in tensors if isinstance(tensor, torch.Tensor))
        if nbytes <= self._room:
            self._room -= nbytes
            self._cached[index] = depth, normal
        return depth, normal


def metric_depths(
    view: View,
    plan: DepthPlan,
    settings: DepthPrior,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Depths | None:
    """Return the known depths of a view; None if it has none."""

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array).to(device, dtype)

    def there(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array).to(device)

    if plan.source == "sparse":
        assert plan.observed is not None
        points = points_in(view, plan.observed, settings)
        pixels, weights, depth = _around(points, view.camera.width)
        return PointDepths(there(pixels), tensor(weights), tensor(depth)) if len(depth) else None
    if view.maps is None or view.maps.files.depth is None:
        return None
    map_ = view.maps.depth()
    values = map_.values.astype(np.float64)
    valid = values > 0
    if not valid.any():
        return None
    safe = np.where(valid, values, 1)
    if plan.source == "sensor":
        unit = plan.unit or view.maps.files.unit or (1e-3 if map_.whole else 1.0)
        return MetricDepth(tensor(valid / (safe * unit)), there(valid))
    line = None
    if plan.observed is not None:
        depth, at_points = _values_at(points_in(view, plan.observed, settings), map_)
        line = line_of(at_points, depth, plan.space)
    if line is None:
        middle, spread = values[valid].mean(), values[valid].std()
        centred = np.where(valid, (values - middle) / (spread if spread > 1e-9 * middle else 1), 0)
        return RelativeDepths(tensor(centred), there(valid), plan.space)
    on_line = line[0] * safe + line[1]
    good = valid & (on_line > 1e-3 * np.median(on_line[valid]))  # other values have no depth in front of the camera
    safe = np.where(good, on_line, 1)
    return MetricDepth(tensor(good * (safe if plan.space == "disparity" else 1 / safe)), there(good))


def _around(points: PointsInView, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the four pixels around each point [M, 4], their bilinear weights, and the depths [M]."""
    at = points.pixels - 0.5
    left, top = np.floor(at).astype(np.int64).T
    u, v = (at - np.floor(at)).T
    pixels = np.stack([top * width + left, top * width + left + 1, (top + 1) * width + left], axis=1)
    pixels = np.concatenate([pixels, pixels[:, 2:] + 1], axis=1)
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], axis=1)
    return pixels, weights, points.depth


# -- normals -------------------------------------------------------------------------------------------------------
def plan_normals(scene: Scene, settings: NormalPrior) -> str:
    """Return the axes of a capture's normal maps: "opencv" or "opengl".

    Raise DataError if there are none, or they do not face the camera.
    """
    mapped = [view for view in scene.train if view.maps is not None and view.maps.files.normal is not None]
    if not mapped:
        raise DataError(
            f"no training view of {scene.name} has a normal map; put them in {scene.root}/normals under the names of "
            "the photographs (RGB of (n + 1) / 2, in the camera's frame), or leave out --normal-prior"
        )
    fractions = {"opencv": [], "opengl": []}  # type: dict[str, list[float]]
    for view in _sampled_views(mapped):
        assert view.maps is not None
        normals = view.maps.normal()
        for axes, shares in fractions.items():
            facing = (_in_opencv(normals, axes) * rays(view)).sum(axis=2)[(normals != 0).any(axis=2)] < 0
            shares.append(float(facing.mean()) if facing.size else 1.0)
    means = {axes: float(np.mean(shares)) for axes, shares in fractions.items()}
    chosen = max(means, key=means.__getitem__) if settings.axes == "auto" else settings.axes
    if means[chosen] < FACING:
        raise DataError(
            f"the normal maps of {scene.name} must face the camera, got {means[chosen]:.0%} with axes {chosen}; they "
            "must be in the camera's frame, see --set normal_prior.axes=opencv or opengl"
        )
    return chosen


def rays(view: View) -> np.ndarray:
    """Return the directions (x, y, 1) of the pixels of a view [H, W, 3], OpenCV axes."""
    camera = view.camera
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=2)


def _in_opencv(normals: np.ndarray, axes: str) -> np.ndarray:
    return normals * np.array((1, -1, -1) if axes == "opengl" else (1, 1, 1), dtype=np.float32)


def world_normals(
    view: View, axes: str, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> NormalTarget:
    """Return the known normals of a view in the world frame."""
    assert view.maps is not None
    normals = view.maps.normal()
    valid = (normals != 0).any(axis=2)
    directions = torch.as_tensor(_in_opencv(normals, axes) @ view.camera.rotation)
    return NormalTarget(directions.to(device, dtype), torch.as_tensor(valid).to(device, dtype))
