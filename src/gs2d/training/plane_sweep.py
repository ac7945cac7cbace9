"""Depths of photographs by comparing each with its neighbours over a sweep of planes, and splats to start from.

A pixel is tried at depths evenly spaced in 1/z; its patch is fetched from the neighbours at each, and the depth with
the best normalised cross-correlation wins (Collins 1996; the two best neighbours count). Depths on which neighbours
agree become points. On the host's processor, and without any random choice: a resume finds the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gs2d.config.robust import DenseStart
from gs2d.core.memory import trim
from gs2d.core.memory_limit import cache_bytes
from gs2d.core.spill import Spilled
from gs2d.core.transforms import nearest_distances
from gs2d.data.prior_maps import ObservedPoints
from gs2d.data.scene import PointCloud, Scene, View
from gs2d.errors import DataError
from gs2d.kernels.sweep import BestPlanes, sweep_planes
from gs2d.training.sweep_range import SweepRange, sweep_range

MIN_POINTS = 20  # sparse points of a view, below which its depths are unknown
NEAREST = 2  # percentile of depth that stands for the nearest: a few sparse points are wrong
MIN_SHARED = 8  # sparse points that neighbours must both show
NEAR_MARGIN, FAR_MARGIN = 0.8, 1.5  # of the 1st and 99th percentile of depth: where the sweep begins and ends
NOISE = 1e-4  # variance of grey values, [0, 1]^2, that is no texture: added to both sides of the NCC
MIN_TEXTURE = 2e-5  # variance of a patch below which every depth fits
GREY = (0.3, 0.6, 0.1)
BEST_ANGLE, NARROW, WIDE = 10.0, 4.0, 12.0  # degrees: neighbours' baselines, and how fast narrower and wider ones lose
TRIM_EVERY = 8  # views; what is freed between results that stay was 2 GB of a capture of 292 photographs
PLANES_AT_ONCE = 16  # 5 MB of each of what a comparison is made of, at 200 px; fewer would make threads wait more
SWEEP_BYTES = 1 << 30  # of shrunk views, of depths, of free space: each; what is beyond goes to the disk
WAITING = 500_000  # places that wait to be thinned; those of 292 photographs were a GB
REPEATED = 3.0  # cells: sparse points within that of a swept one start no splat of their own

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class SmallView:
    """A training view, shrunk.

    Attributes
    ----------
    color : Tensor [3, H, W]
    grey : Tensor [1, 1, H, W]
    usable : ndarray [H, W] bool
        Pixels that the photograph's mask and alpha leave in.
    K, T : ndarray [3, 3], [4, 4] float64
        Intrinsics at this size; T_cam_world.
    near, far : float, world units
        Where the sweep begins and ends; 0 where the view shows too few points.
    middle : float, world units
        Median depth of the sparse points that it shows; 0 as above.
    pixels, depth : ndarray [M, 2] px, [M] world units
        Those points, where the capture says that it shows them; empty where that is a guess.
    nearest : float, world units
        Nearest depth of all sparse points in its picture, whether it was found to show them or not (2nd percentile).
    """

    color: Tensor
    grey: Tensor
    usable: np.ndarray
    K: np.ndarray
    T: np.ndarray
    near: float
    far: float
    middle: float
    pixels: np.ndarray
    depth: np.ndarray
    nearest: float

    @property
    def size(self) -> tuple[int, int]:
        """H, W."""
        return int(self.grey.shape[2]), int(self.grey.shape[3])


@dataclass(frozen=True, eq=False)
class Sweep:
    """What a sweep found.

    Attributes
    ----------
    views : sequence of SmallView
        Of the training views, in their order. Of many, not all are in memory.
    neighbours : tuple of tuple of int
        Of each view, best first; empty for views that were not swept.
    depths : sequence of ndarray [H, W] float64 world units
        Along the optical axis; 0 where unknown.
    scores : sequence of ndarray [H, W] float32
        NCC of those depths.
    """

    views: Sequence[SmallView]
    neighbours: tuple[tuple[int, ...], ...]
    depths: Sequence[np.ndarray]
    scores: Sequence[np.ndarray]

    def agreeing(self, index: int, fraction: float) -> np.ndarray:
        """Return how many neighbours have, where a pixel's place appears in them, the same depth: int [H, W]."""
        view, depth = self.views[index], self.depths[index]
        votes = np.zeros(depth.shape, dtype=np.int64)
        known = depth > 0
        places = unproject(view, depth)[known]
        for other in self.neighbours[index]:
            z, column, row, inside = project(self.views[other], places)
            there = self.depths[other][row, column]
            votes[known] += inside & (there > 0) & (np.abs(there - z) <= fraction * z)
        return votes


def sweep_views(scene: Scene, settings: DenseStart) -> Sweep:
    """Find depths of the training views of a scene.

    Parameters
    ----------
    scene : Scene
    settings : DenseStart

    Raises
    ------
    DataError
        The capture says nothing of depths: no sparse points that photographs show, no places that two of them see.
    """
    known, factor = sweep_range(scene), sweep_downscale(scene, settings)
    limit = 0 if scene.ahead else cache_bytes(SWEEP_BYTES)
    views = Spilled(_trimming(_shrunk(view, known, factor) for view in scene.train), limit)
    neighbours = _neighbours(scene, views, known.observed, settings)
    found = Spilled(_trimming(_depths(views, index, neighbours[index], settings) for index in range(len(views))), limit)
    return Sweep(views, neighbours, found.column(0), found.column(1))


def sweep_downscale(scene: Scene, settings: DenseStart) -> int:
    """Return by how much the training views of a scene are shrunk before they are swept."""
    longest = max(max(view.camera.width, view.camera.height) for view in scene.train)
    return max(1, round(longest / settings.side))


def _trimming(results: Iterable[T]) -> Iterator[T]:
    """Yield the results one by one; the holes that their making leaves between them are given back now and then."""
    for done, result in enumerate(results, start=1):
        yield result
        if done % TRIM_EVERY == 0:
            trim()
    trim()


def unproject(view: SmallView, depth: np.ndarray) -> np.ndarray:
    """Return the places [H, W, 3] world units of the pixels of a shrunk view at depths [H, W]."""
    height, width = depth.shape
    y, x = np.mgrid[0:height, 0:width] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(view.K).T
    T = np.linalg.inv(view.T)
    return np.asarray((rays * depth[..., None]) @ T[:3, :3].T + T[:3, 3])


def start_points(
    scene: Scene, sweep: Sweep, settings: DenseStart, around: tuple[np.ndarray, ...] | None = None
) -> PointCloud:
    """Return points to start from: swept ones, and sparse ones where none of those is near.

    For a fitted start, sparse ones keep the size that they have among all sparse points (:attr:`PointCloud.sizes`).

    Parameters
    ----------
    scene : Scene
    sweep : Sweep
    settings : DenseStart
    around : tuple of ndarray, optional
        More of them, of a size of their own: places, colours in [0, 1], normals [P, 3], sizes [P].

    Raises
    ------
    DataError
        There are none: no view has a neighbour to be compared with, or no depths agree.
    """
    if not any(sweep.neighbours) and not _has_points(scene):
        raise DataError(
            f"a plane sweep of {scene.name} needs photographs whose lines of sight are {settings.min_angle:g} to "
            f"{settings.max_angle:g} degrees apart, got none; set dense_start.min_angle or max_angle, or train with "
            "--set dense_start=null"
        )
    swept = _thinned((_swept(sweep, index, settings) for index in range(len(sweep.views))), settings.cell)
    parts: list[tuple[np.ndarray, ...]] = [
        (swept.places, swept.colors, swept.normals, np.zeros(len(swept.places))),
    ]
    if scene.points is not None and _has_points(scene):
        parts.append(_apart(scene.points, swept, settings.cell))
    elif len(swept.places) < 2:
        raise DataError(
            f"a plane sweep of {scene.name} found {len(swept.places)} places on which photographs agree, expected at "
            "least 2; do photographs and cameras belong together? Train with --set dense_start=null"
        )
    if settings.fit is None:  # sparse ones are as large as what was swept around leaves room for
        parts = [(*part[:3], np.zeros(len(part[3]))) for part in parts]
    if around is not None:
        parts.append(around)
    places, colors, normals, sizes = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    colors = np.clip(np.rint(colors * 255), 0, 255).astype(np.uint8)
    return PointCloud(places, colors, normals, sizes if (sizes > 0).any() else None)


def _has_points(scene: Scene) -> bool:
    return scene.points is not None and len(scene.points) > 0


@dataclass(frozen=True, eq=False)
class _Found:
    places: np.ndarray  # [M, 3] world units
    colors: np.ndarray  # [M, 3] in [0, 1]
    normals: np.ndarray  # [M, 3]
    pixel: np.ndarray  # [M] world units: the size of a pixel there
    score: np.ndarray  # [M]


def _joined(found: Sequence[_Found]) -> _Found:
    return _Found(*(np.concatenate([getattr(f, name) for f in found]) for name in _Found.__dataclass_fields__))


def _thinned(found: Iterable[_Found], cell: float) -> _Found:
    """Return what :func:`_thin` leaves of all views together, without having all of them in memory."""
    waiting: list[_Found] = []
    for some in found:
        waiting.append(some)
        if sum(len(one.score) for one in waiting) > max(WAITING, 2 * len(waiting[0].score)):
            waiting = [_thin(_joined(waiting), cell)]
    return _thin(_joined(waiting), cell)


def _thin(found: _Found, cell: float) -> _Found:
    """One of each cell of so many pixels, that with the best score; cells are of sizes that are powers of two."""
    level = np.rint(np.log2(found.pixel * cell))
    keys = np.concatenate([np.floor(found.places / np.exp2(level)[:, None]), level[:, None]], axis=1)
    order = np.argsort(-found.score, kind="stable")
    _, first = _unique_rows(keys[order])
    rows = order[first]
    return _Found(*(getattr(found, name)[rows] for name in _Found.__dataclass_fields__))


def _unique_rows(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``np.unique(keys, axis=0, return_index=True)`` of whole numbers [M, C], each as one number."""
    if not len(keys):
        return keys, np.zeros(0, dtype=np.int64)
    low = keys.min(axis=0)
    sizes = (keys.max(axis=0) - low + 1).astype(np.float64)
    if sizes.prod() >= 2.0**62:
        return np.unique(keys, axis=0, return_index=True)
    flat = np.ravel_multi_index(tuple((keys - low).astype(np.int64).T), tuple(sizes.astype(np.int64)))
    first = np.unique(flat, return_index=True)[1]
    return keys[first], first


def _swept(sweep: Sweep, index: int, settings: DenseStart) -> _Found:
    """Return the places on which enough neighbours of a view agree."""
    view, depth = sweep.views[index], sweep.depths[index]
    places = unproject(view, depth)
    kept = sweep.agreeing(index, settings.agree) >= min(settings.votes, max(1, len(sweep.neighbours[index]) - 1))
    normals = np.cross(np.gradient(places, axis=1), np.gradient(places, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    colors = view.color.permute(1, 2, 0).numpy()
    return _Found(places[kept], colors[kept], normals[kept], (depth / view.K[0, 0])[kept], sweep.scores[index][kept])


def _apart(points: PointCloud, swept: _Found, cell: float) -> tuple[np.ndarray, ...]:
    """Sparse points that lie apart from the swept ones: places, colours in [0, 1], unknown normals, sizes."""
    from scipy.spatial import cKDTree

    finite = np.logical_and.reduce(np.isfinite(points.points), axis=1)
    places = np.asarray(points.points, dtype=np.float64)[finite]
    colors = np.full((len(places), 3), 0.5) if points.colors is None else points.colors[finite] / 255.0
    sizes = nearest_distances(places) if len(places) > 1 else np.zeros(len(places))
    apart: np.ndarray = np.ones(len(places), dtype=bool)
    if len(swept.places):
        apart &= cKDTree(swept.places).query(places)[0] > REPEATED * cell * float(np.median(swept.pixel))
    return places[apart], colors[apart], np.zeros((int(apart.sum()), 3)), sizes[apart]


def _shrunk(view: View, known: SweepRange, factor: int) -> SmallView:
    camera, observed = view.camera, known.observed
    image = torch.from_numpy(np.ascontiguousarray(view.target((0.0, 0.0, 0.0)))).permute(2, 0, 1)[None]
    height, width = camera.height // factor * factor, camera.width // factor * factor
    small = F.avg_pool2d(image[:, :, :height, :width], factor)
    usable: np.ndarray = np.ones((camera.height, camera.width), dtype=bool)
    for left_in in (view.mask(), None if (alpha := view.alpha()) is None else alpha >= 0.5):
        if left_in is not None:
            usable[~left_in] = False
    blocks = usable[:height, :width].reshape(height // factor, factor, width // factor, factor)
    left = np.logical_and.reduce(blocks, axis=(1, 3))
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    K[:2] /= factor
    shown = observed.in_view(view.name, camera)
    enough = len(shown.depth) >= MIN_POINTS
    near, far = np.percentile(shown.depth, (1, 99)) * (NEAR_MARGIN, FAR_MARGIN) if enough else (0.0, 0.0)
    near, far = known.limits.get(view.name, (near, far))
    middle = float(np.median(shown.depth)) if len(shown.depth) else 0.0
    certain = slice(0) if observed.guessed else slice(None)
    pixels = np.minimum(shown.pixels[certain] / factor, np.array((width // factor, height // factor)) - 0.5)
    grey = (small * torch.tensor(GREY)[:, None, None]).sum(dim=1, keepdim=True)
    T = np.asarray(camera.T_cam_world, dtype=np.float64)
    everywhere = observed.inside(camera).depth  # smooth things have few points, and a photograph finds some of them
    nearest = float(np.percentile(everywhere, NEAREST)) if enough else 0.0
    return SmallView(small[0], grey, left, K, T, float(near), float(far), middle, pixels, shown.depth[certain], nearest)


def _neighbours(
    scene: Scene, views: Sequence[SmallView], observed: ObservedPoints, settings: DenseStart
) -> tuple[tuple[int, ...], ...]:
    """Return the views that each is compared with: many shared points, and lines of sight some ten degrees apart.

    Of many views those are swept that are chosen evenly, and those that these are compared with: a place counts where
    depths of several agree.
    """
    count = len(views)
    centers = np.stack([view.camera.center for view in scene.train])
    shared_points = _shared([observed.seen.get(view.name, np.zeros(0, dtype=np.int64)) for view in scene.train])
    chosen = np.unique(np.linspace(0, count - 1, min(count, settings.max_views)).round().astype(int)).tolist()

    def compared(index: int) -> tuple[int, ...]:
        view, small = scene.train[index], views[index]
        if small.far == 0:
            return ()
        target = view.camera.center + view.camera.forward * small.middle
        mine, theirs = view.camera.center - target, centers - target
        lengths = np.maximum(np.linalg.norm(theirs, axis=1) * np.linalg.norm(mine), 1e-12)
        angle = np.degrees(np.arccos(np.clip(theirs @ mine / lengths, -1, 1)))
        shared = shared_points[[index]].toarray()[0]
        fits = (angle >= settings.min_angle) & (angle <= settings.max_angle) & (shared >= MIN_SHARED)
        fits[index] = False
        width = np.where(angle < BEST_ANGLE, NARROW, WIDE)
        worth = np.where(fits, shared * np.exp(-((angle - BEST_ANGLE) ** 2) / (2 * width**2)), 0.0)
        order = np.argsort(-worth, kind="stable")[: settings.neighbours]
        return tuple(int(i) for i in order if worth[i] > 0)

    found = {index: compared(index) for index in chosen}
    for index in sorted({other for others in found.values() for other in others} - found.keys()):
        found[index] = compared(index)
    return tuple(found.get(index, ()) for index in range(count))


def _shared(rows: Sequence[np.ndarray]) -> Any:
    """How many points each two views share, sparse [V, V]; ``rows`` are the points of each view, each once."""
    from scipy.sparse import csr_matrix

    ends = np.cumsum([0, *(len(found) for found in rows)])
    points = np.concatenate(rows)
    shows = csr_matrix(
        (np.ones(len(points), dtype=np.int64), points, ends), shape=(len(rows), points.max(initial=0) + 1)
    )
    return csr_matrix(shows @ shows.T)


@torch.no_grad()
def _depths(
    views: Sequence[SmallView], index: int, neighbours: Sequence[int], settings: DenseStart
) -> tuple[np.ndarray, np.ndarray]:
    """Depth [H, W] world units of a view, 0 where unknown, and its NCC."""
    view = views[index]
    height, width = view.size
    if not neighbours:
        return np.zeros((height, width)), np.zeros((height, width), dtype=np.float32)
    step = (1 / view.near - 1 / view.far) / (settings.planes - 1)
    z = (1 / (1 / view.far + step * torch.arange(settings.planes, dtype=torch.float64))).float()  # far to near
    best = best_planes(view, [views[other] for other in neighbours], z, settings.radius)
    bend = best.before - 2 * best.score + best.after
    shift = torch.where(bend < -1e-6, 0.5 * (best.before - best.after) / bend, torch.zeros_like(bend)).clamp(-0.5, 0.5)
    depth = 1 / (1 / view.far + step * (best.plane + shift).double())
    valid = (best.score >= settings.min_ncc) & (best.plane > 0) & (best.plane < settings.planes - 1)
    valid &= (_variance(view, settings.radius)[0, 0] >= MIN_TEXTURE) & torch.from_numpy(view.usable)
    return torch.where(valid, depth, torch.zeros_like(depth)).numpy(), best.score.numpy()


def best_planes(view: SmallView, others: Sequence[SmallView], z: Tensor, radius: int) -> BestPlanes:
    """Compare a view with others at depths z [D]: natively where that was built, else in torch; alike to rounding."""
    pairs = [_homography(view, other) for other in others]
    turned, moved = (torch.stack([pair[k] for pair in pairs]).float() for k in (0, 1))
    grey = [other.grey[0, 0] for other in others]
    usable = torch.from_numpy(view.usable)
    found = sweep_planes(view.grey[0, 0], usable, grey, turned, moved, z, radius=radius, noise=NOISE)
    return found or best_planes_reference(view, others, z, radius)


def best_planes_reference(view: SmallView, others: Sequence[SmallView], z: Tensor, radius: int) -> BestPlanes:
    """Do the same in torch."""
    variance = _variance(view, radius)
    each = [_ncc(view, other, z, variance, radius) for other in others]
    score = torch.stack(each).topk(min(2, len(each)), dim=0).values.mean(dim=0)  # [D, H, W]
    best, plane = score.max(dim=0)
    inner = plane.clamp(1, len(z) - 2)
    before, after = (score.gather(0, (inner + offset)[None])[0] for offset in (-1, 1))
    return BestPlanes(best, plane, before, after)


def _variance(view: SmallView, radius: int) -> Tensor:
    """Variance [1, 1, H, W] of the grey values of each patch."""
    return (_blurred(view.grey * view.grey, radius) - _blurred(view.grey, radius) ** 2).clamp_min(0)


def _homography(view: SmallView, other: SmallView) -> tuple[Tensor, Tensor]:
    """Return float64 M [3, 3], b [3]: pixel p (x, y, 1) at depth z is at z M p + b, homogeneous, in another view."""
    motion = other.T @ np.linalg.inv(view.T)
    turned = other.K @ motion[:3, :3] @ np.linalg.inv(view.K)
    return torch.from_numpy(turned), torch.from_numpy(other.K @ motion[:3, 3])


def _ncc(view: SmallView, other: SmallView, z: Tensor, variance: Tensor, radius: int) -> Tensor:
    """NCC [D, H, W] of the patches of a view with those of another at depths z [D]; -1 outside the other."""
    (height, width), (rows, columns) = view.size, other.size
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)]).reshape(3, -1).double()
    matrix, shift = _homography(view, other)
    turned, moved = (matrix @ pixels).float(), shift.float()  # [3, HW], [3]
    mine = _blurred(view.grey, radius)

    def at_depths(some: Tensor) -> Tensor:
        seen = turned[:, None, :] * some[None, :, None] + moved[:, None, None]  # [3, D, HW]
        depth = seen[2].clamp_min(1e-9)
        at = torch.stack([seen[0] / depth * (2 / columns) - 1, seen[1] / depth * (2 / rows) - 1], dim=-1)
        inside = (at.abs() < 1).all(dim=-1) & (seen[2] > 0)
        fetched = F.grid_sample(other.grey, at[None], align_corners=False, padding_mode="border")
        fetched = fetched.reshape(len(some), 1, height, width)
        mean = _blurred(fetched, radius)
        spread = (_blurred(fetched * fetched, radius) - mean * mean).clamp_min(0)
        common = _blurred(fetched * view.grey, radius) - mean * mine
        ncc = common / ((spread + NOISE) * (variance + NOISE)).sqrt()
        return torch.where(inside.reshape(len(some), height, width), ncc[:, 0], torch.full((), -1.0))

    return torch.cat([at_depths(some) for some in z.split(PLANES_AT_ONCE)])


def _blurred(image: Tensor, radius: int) -> Tensor:
    """Mean over patches of 2 radius + 1 pixels a side; images are mirrored at their edges."""
    return F.avg_pool2d(F.pad(image, (radius,) * 4, mode="reflect"), 2 * radius + 1, 1)


def project(view: SmallView, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return depth, column and row (clipped to the picture) of places [..., 3] in a view, and which are inside."""
    seen = places @ view.T[:3, :3].T + view.T[:3, 3]
    z = seen[..., 2]
    front = np.maximum(z, 1e-12)
    x = view.K[0, 0] * seen[..., 0] / front + view.K[0, 2]
    y = view.K[1, 1] * seen[..., 1] / front + view.K[1, 2]
    height, width = view.size
    inside = (z > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    column = np.clip(np.nan_to_num(x), 0, width - 1).astype(np.int64)
    return z, column, np.clip(np.nan_to_num(y), 0, height - 1).astype(np.int64), inside
