"""Depth maps by a plane sweep over neighbouring images.

Each pixel is tried at depths evenly spaced in 1/z. At each depth, its patch is compared with the two best neighbours,
and the depth with the best normalised cross-correlation (NCC) wins (Collins 1996). The sweep runs on the CPU and makes
no random choices, so a resumed run finds the same depths.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gs2d.config.recipe import MAX_ANGLE, DenseStart
from gs2d.core.memory import trim
from gs2d.core.memory_limit import cache_bytes
from gs2d.core.spill import Spilled
from gs2d.data.prior_maps import ObservedPoints
from gs2d.data.scene import Scene, View
from gs2d.kernels.sweep import BestPlanes, sweep_planes
from gs2d.losses.formulas import flatness
from gs2d.training.start.sweep_range import SweepRange, sweep_range

PLANES = 64  # depths tried for each pixel
MIN_NCC = 0.5  # depths with a lower NCC are unknown
AGREE = 0.02  # depths of two views agree when they differ by at most this fraction
VOTES = 2  # neighbours that must agree on the depth of a splat
MAX_VIEWS = 120  # images that are swept, evenly chosen, beside those that they are compared with
MIN_POINTS = 20  # sparse points of a view, below which it is not swept
NEAREST = 2  # percentile of depth that counts as the nearest, because a few sparse points are wrong
MIN_SHARED = 8  # sparse points that neighbours must share
NEAR_MARGIN, FAR_MARGIN = 0.8, 1.5  # factors of the 1st and 99th percentile of depth: limits of the sweep
GREY = (0.3, 0.6, 0.1)
BEST_ANGLE, NARROW, WIDE = 10.0, 4.0, 12.0  # degrees: preferred angle of neighbours, and its tolerances
TRIM_EVERY = 8  # views between returns of freed memory, which would add up to 2 GB for 292 images
PLANES_AT_ONCE = 16  # 5 MB for each intermediate tensor at 200 px
SWEEP_BYTES = 1 << 30  # limit for each of downscaled views, depths and free space; the rest goes to the disk

T = TypeVar("T")


@dataclass(frozen=True)
class Windows:
    """The patches that are compared."""

    radius: int  # px; patches have 2 radius + 1 pixels a side
    noise: float  # variance of grey values, [0, 1]^2, added to both variances of the NCC
    texture: float  # variance of a patch below which every depth fits


FINE_WINDOWS = Windows(3, 1e-4, 2e-5)
WIDE_WINDOWS = Windows(7, 1e-5, 2e-6)  # for bare pixels, where only faint shading reveals the depth
BARE = 127  # flatness, 0 to 255, of these


@dataclass(frozen=True, eq=False)
class SmallView:
    """A downscaled training view; depths are in world units."""

    color: Tensor  # [3, H, W]
    grey: Tensor  # [1, 1, H, W]
    usable: np.ndarray  # [H, W] bool; unmasked, opaque pixels
    K: np.ndarray  # [3, 3] float64; intrinsics at this size
    T: np.ndarray  # [4, 4] float64; T_cam_world
    near: float  # limits of the sweep; 0 if the view shows too few points
    far: float
    middle: float  # median depth of the sparse points that it shows; 0 as above
    pixels: np.ndarray  # [M, 2] px; these points, if the capture lists the points of each image; empty if guessed
    depth: np.ndarray  # [M] of the same points
    nearest: float  # depth of all sparse points inside the image, matched there or not (2nd percentile)

    @property
    def size(self) -> tuple[int, int]:
        """H, W."""
        return int(self.grey.shape[2]), int(self.grey.shape[3])


@dataclass(frozen=True, eq=False)
class Sweep:
    """Result of a sweep."""

    views: Sequence[SmallView]  # training views in order; not all are in memory
    neighbours: tuple[tuple[int, ...], ...]  # of each view, best first; empty for views that were not swept
    depths: Sequence[np.ndarray]  # [H, W] float64 world units, along the optical axis; 0 where unknown
    scores: Sequence[np.ndarray]  # [H, W] float32; NCC of these depths

    def consistent(self, index: int) -> np.ndarray:
        """Return the pixels on whose depth enough neighbours agree, bool [H, W]."""
        return self.agreeing(index, AGREE) >= min(VOTES, max(1, len(self.neighbours[index]) - 1))

    def agreeing(self, index: int, fraction: float) -> np.ndarray:
        """Return the number of neighbours that have the same depth for the point of each pixel, int [H, W]."""
        view, depth = self.views[index], self.depths[index]
        votes = np.zeros(depth.shape, dtype=np.int64)
        valid = depth > 0
        places = unproject(view, depth)[valid]
        for other in self.neighbours[index]:
            z, column, row, inside = project(self.views[other], places)
            there = self.depths[other][row, column]
            votes[valid] += inside & (there > 0) & (np.abs(there - z) <= fraction * z)
        return votes


def sweep_views(scene: Scene, settings: DenseStart) -> Sweep:
    """Compute depth maps of the training views of a scene.

    Raises DataError if the capture has neither sparse points nor bounds that two images show.
    """
    depth_range, factor = sweep_range(scene), sweep_downscale(scene, settings)
    limit = 0 if scene.ahead else cache_bytes(SWEEP_BYTES)
    views = Spilled(_trimming(_shrunk(view, depth_range, factor) for view in scene.train), limit)
    neighbours = _neighbours(scene, views, depth_range.observed, settings)
    maps = Spilled(_trimming(_depths(views, index, neighbours[index]) for index in range(len(views))), limit)
    return Sweep(views, neighbours, maps.column(0), maps.column(1))


def sweep_downscale(scene: Scene, settings: DenseStart) -> int:
    """Return the factor by which the training views are downscaled for the sweep."""
    longest = max(max(view.camera.width, view.camera.height) for view in scene.train)
    return max(1, round(longest / settings.side))


def _trimming(results: Iterable[T]) -> Iterator[T]:
    """Yield the results, and return freed memory to the system now and then."""
    for done, result in enumerate(results, start=1):
        yield result
        if done % TRIM_EVERY == 0:
            trim()
    trim()


def unproject(view: SmallView, depth: np.ndarray) -> np.ndarray:
    """Return the points [H, W, 3] world units of the pixels of a downscaled view at depths [H, W]."""
    height, width = depth.shape
    y, x = np.mgrid[0:height, 0:width] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(view.K).T
    T = np.linalg.inv(view.T)
    return np.asarray((rays * depth[..., None]) @ T[:3, :3].T + T[:3, 3])


def _shrunk(view: View, depth_range: SweepRange, factor: int) -> SmallView:
    camera, observed = view.camera, depth_range.observed
    image = torch.from_numpy(np.ascontiguousarray(view.target((0.0, 0.0, 0.0)))).permute(2, 0, 1)[None]
    height, width = camera.height // factor * factor, camera.width // factor * factor
    small = F.avg_pool2d(image[:, :, :height, :width], factor)
    usable: np.ndarray = np.ones((camera.height, camera.width), dtype=bool)
    for mask in (view.mask(), None if (alpha := view.alpha()) is None else alpha >= 0.5):
        if mask is not None:
            usable[~mask] = False
    blocks = usable[:height, :width].reshape(height // factor, factor, width // factor, factor)
    valid = np.logical_and.reduce(blocks, axis=(1, 3))
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    K[:2] /= factor
    shown = observed.in_view(view.name, camera)
    enough = len(shown.depth) >= MIN_POINTS
    near, far = np.percentile(shown.depth, (1, 99)) * (NEAR_MARGIN, FAR_MARGIN) if enough else (0.0, 0.0)
    near, far = depth_range.limits.get(view.name, (near, far))
    middle = float(np.median(shown.depth)) if len(shown.depth) else 0.0
    exact = slice(0) if observed.guessed else slice(None)
    pixels = np.minimum(shown.pixels[exact] / factor, np.array((width // factor, height // factor)) - 0.5)
    grey = (small * torch.tensor(GREY)[:, None, None]).sum(dim=1, keepdim=True)
    T = np.asarray(camera.T_cam_world, dtype=np.float64)
    everywhere = observed.inside(camera).depth  # an image matches only some of the points inside it
    nearest = float(np.percentile(everywhere, NEAREST)) if enough else 0.0
    return SmallView(small[0], grey, valid, K, T, float(near), float(far), middle, pixels, shown.depth[exact], nearest)


def _neighbours(
    scene: Scene, views: Sequence[SmallView], observed: ObservedPoints, settings: DenseStart
) -> tuple[tuple[int, ...], ...]:
    """Return the neighbours of each view: many shared points, and viewing directions about ten degrees apart.

    Of many views, evenly chosen ones and their neighbours are swept.
    """
    count = len(views)
    centers = np.stack([view.camera.center for view in scene.train])
    shared_points = _shared([observed.by_view.get(view.name, np.zeros(0, dtype=np.int64)) for view in scene.train])
    chosen = np.unique(np.linspace(0, count - 1, min(count, MAX_VIEWS)).round().astype(int)).tolist()

    def compared(index: int) -> tuple[int, ...]:
        view, small = scene.train[index], views[index]
        if small.far == 0:
            return ()
        target = view.camera.center + view.camera.forward * small.middle
        mine, theirs = view.camera.center - target, centers - target
        lengths = np.maximum(np.linalg.norm(theirs, axis=1) * np.linalg.norm(mine), 1e-12)
        angle = np.degrees(np.arccos(np.clip(theirs @ mine / lengths, -1, 1)))
        shared = shared_points[[index]].toarray()[0]
        fits = (angle >= settings.min_angle) & (angle <= MAX_ANGLE) & (shared >= MIN_SHARED)
        fits[index] = False
        width = np.where(angle < BEST_ANGLE, NARROW, WIDE)
        score = np.where(fits, shared * np.exp(-((angle - BEST_ANGLE) ** 2) / (2 * width**2)), 0.0)
        order = np.argsort(-score, kind="stable")[: settings.neighbours]
        return tuple(int(i) for i in order if score[i] > 0)

    neighbours = {index: compared(index) for index in chosen}
    for index in sorted({other for others in neighbours.values() for other in others} - neighbours.keys()):
        neighbours[index] = compared(index)
    return tuple(neighbours.get(index, ()) for index in range(count))


def _shared(rows: Sequence[np.ndarray]) -> Any:
    """Return the number of points that each two views share, sparse [V, V]; ``rows`` are the points of each view."""
    from scipy.sparse import csr_matrix

    ends = np.cumsum([0, *map(len, rows)])
    points = np.concatenate(rows)
    shows = csr_matrix(
        (np.ones(len(points), dtype=np.int64), points, ends), shape=(len(rows), points.max(initial=0) + 1)
    )
    return csr_matrix(shows @ shows.T)


@torch.no_grad()
def _depths(views: Sequence[SmallView], index: int, neighbours: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth map [H, W] world units of a view, 0 where unknown, and its NCC."""
    view = views[index]
    height, width = view.size
    if not neighbours:
        return np.zeros((height, width)), np.zeros((height, width), dtype=np.float32)
    step = (1 / view.near - 1 / view.far) / (PLANES - 1)
    z = (1 / (1 / view.far + step * torch.arange(PLANES, dtype=torch.float64))).float()  # far to near
    others = [views[other] for other in neighbours]

    def swept(windows: Windows) -> tuple[Tensor, Tensor]:
        best = best_planes(view, others, z, windows)
        bend = best.before - 2 * best.score + best.after
        shift = torch.where(bend < -1e-6, 0.5 * (best.before - best.after) / bend, torch.zeros_like(bend))
        depth = 1 / (1 / view.far + step * (best.plane + shift.clamp(-0.5, 0.5)).double())
        valid = (best.score >= MIN_NCC) & (best.plane > 0) & (best.plane < PLANES - 1)
        valid &= (_variance(view, windows.radius)[0, 0] >= windows.texture) & torch.from_numpy(view.usable)
        return torch.where(valid, depth, torch.zeros_like(depth)), best.score

    depth, score = swept(FINE_WINDOWS)
    edges = (flatness(view.color.permute(1, 2, 0)) <= BARE).float()[None, None]
    # Windows without edges: at an outline, the sky would get the depth of the roof.
    radius = WIDE_WINDOWS.radius
    bare = F.max_pool2d(edges, 2 * radius + 1, 1, radius)[0, 0] == 0
    bare &= (depth == 0) & torch.from_numpy(view.usable)
    if bare.any() and min(view.size) > radius:
        wide = swept(WIDE_WINDOWS)
        depth, score = (torch.where(bare, a, b) for a, b in zip(wide, (depth, score), strict=True))
    return depth.numpy(), score.numpy()


def best_planes(view: SmallView, others: Sequence[SmallView], z: Tensor, windows: Windows) -> BestPlanes:
    """Compare a view with others at depths z [D], natively if possible, else in torch."""
    pairs = [_homography(view, other) for other in others]
    turned, moved = (torch.stack([pair[k] for pair in pairs]).float() for k in (0, 1))
    grey = [other.grey[0, 0] for other in others]
    usable = torch.from_numpy(view.usable)
    native = sweep_planes(view.grey[0, 0], usable, grey, turned, moved, z, radius=windows.radius, noise=windows.noise)
    return native or best_planes_reference(view, others, z, windows)


def best_planes_reference(view: SmallView, others: Sequence[SmallView], z: Tensor, windows: Windows) -> BestPlanes:
    """Compare a view with others at depths z [D] in torch."""
    variance = _variance(view, windows.radius)
    each = [_ncc(view, other, z, variance, windows) for other in others]
    score = torch.stack(each).topk(min(2, len(each)), dim=0).values.mean(dim=0)  # [D, H, W]
    best, plane = score.max(dim=0)
    inner = plane.clamp(1, len(z) - 2)
    before, after = (score.gather(0, (inner + offset)[None])[0] for offset in (-1, 1))
    return BestPlanes(best, plane, before, after)


def _variance(view: SmallView, radius: int) -> Tensor:
    """Return the variance [1, 1, H, W] of the grey values of each patch."""
    return (_blurred(view.grey * view.grey, radius) - _blurred(view.grey, radius) ** 2).clamp_min(0)


def _homography(view: SmallView, other: SmallView) -> tuple[Tensor, Tensor]:
    """Return float64 M [3, 3] and b [3]: pixel p (x, y, 1) at depth z maps to z M p + b in another view."""
    motion = other.T @ np.linalg.inv(view.T)
    turned = other.K @ motion[:3, :3] @ np.linalg.inv(view.K)
    return torch.from_numpy(turned), torch.from_numpy(other.K @ motion[:3, 3])


def _ncc(view: SmallView, other: SmallView, z: Tensor, variance: Tensor, windows: Windows) -> Tensor:
    """Return the NCC [D, H, W] of patches of a view and another one at depths z [D]; -1 outside the other."""
    (height, width), (rows, columns) = view.size, other.size
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)]).reshape(3, -1).double()
    matrix, shift = _homography(view, other)
    turned, moved = (matrix @ pixels).float(), shift.float()  # [3, HW], [3]
    radius, mine = windows.radius, _blurred(view.grey, windows.radius)

    def at_depths(some: Tensor) -> Tensor:
        projected = turned[:, None, :] * some[None, :, None] + moved[:, None, None]  # [3, D, HW]
        depth = projected[2].clamp_min(1e-9)
        at = torch.stack([projected[0] / depth * (2 / columns) - 1, projected[1] / depth * (2 / rows) - 1], dim=-1)
        inside = (at.abs() < 1).all(dim=-1) & (projected[2] > 0)
        fetched = F.grid_sample(other.grey, at[None], align_corners=False, padding_mode="border")
        fetched = fetched.reshape(len(some), 1, height, width)
        mean = _blurred(fetched, radius)
        spread = (_blurred(fetched * fetched, radius) - mean * mean).clamp_min(0)
        common = _blurred(fetched * view.grey, radius) - mean * mine
        ncc = common / ((spread + windows.noise) * (variance + windows.noise)).sqrt()
        return torch.where(inside.reshape(len(some), height, width), ncc[:, 0], torch.full((), -1.0))

    return torch.cat([at_depths(some) for some in z.split(PLANES_AT_ONCE)])


def _blurred(image: Tensor, radius: int) -> Tensor:
    """Return the mean over patches of 2 radius + 1 pixels a side, with reflected edges."""
    return F.avg_pool2d(F.pad(image, (radius,) * 4, mode="reflect"), 2 * radius + 1, 1)


def project(view: SmallView, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return depth, clipped column and clipped row of points [..., 3] in a view, and which are inside."""
    local = places @ view.T[:3, :3].T + view.T[:3, 3]
    z = local[..., 2]
    front = np.maximum(z, 1e-12)
    x = view.K[0, 0] * local[..., 0] / front + view.K[0, 2]
    y = view.K[1, 1] * local[..., 1] / front + view.K[1, 2]
    height, width = view.size
    inside = (z > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    column = np.clip(np.nan_to_num(x), 0, width - 1).astype(np.int64)
    return z, column, np.clip(np.nan_to_num(y), 0, height - 1).astype(np.int64), inside
