"""Score a reconstructed mesh against the ground truth, over the surface visible to the cameras.

The protocol of this project (docs/notebook/evaluation.md):

1. Points are sampled on both surfaces, area-weighted and from a seed.
2. Completeness and recall use the distances from true points to the reconstruction. Only true surface visible to at
   least ``min_views`` cameras counts, by view counts per face that come with the data, or by depth buffers.
3. Accuracy and precision use the distances from reconstructed points to the whole true surface. Only reconstructed
   surface that a camera would see counts: interior surface, which no image shows, does not change the score.
4. Distances are to triangles, or to the nearest point of a point cloud.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from gs2d.contrib.lab.nearest import Cloud
from gs2d.contrib.lab.surface_protocols import VISIBLE_SURFACE
from gs2d.contrib.lab.visibility import frustum_counts, visible_counts
from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.core.similarity import similarity_scale
from gs2d.data.image_files import write_image
from gs2d.errors import DataError
from gs2d.io.ply_format import write_ply

# -- points on surfaces, and exact distances to triangles --------------------------------------------------------------
_CANDIDATES = 8  # triangles per point
_CHUNK = 1 << 16  # points per chunk


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points sampled evenly on a mesh: ``points`` [n, 3] float64 and the ``faces`` [n] they lie on."""

    points: np.ndarray
    faces: np.ndarray


def face_areas(mesh: Mesh) -> np.ndarray:
    """Return the area [F] of every face, world units^2."""
    t = mesh.vertices.astype(np.float64)[mesh.faces]
    return np.asarray(0.5 * np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1))


def sample_surface(mesh: Mesh, count: int, *, seed: int = 0) -> SurfaceSamples:
    """Sample ``count`` points, area-weighted and stratified in the order of the faces; none without area."""
    ends = np.cumsum(face_areas(mesh))
    if not len(ends) or ends[-1] <= 0:
        return SurfaceSamples(np.zeros((0, 3)), np.zeros(0, np.int64))
    rng = np.random.default_rng(seed)
    at = (np.arange(count) + rng.random(count)) / count * ends[-1]  # one in each of `count` equal parts of the area
    faces = np.minimum(np.searchsorted(ends, at, side="right"), len(ends) - 1)
    u, v = rng.random((2, count))
    root = np.sqrt(u)  # Turk 1990: (1 - sqrt u) A + sqrt u (1 - v) B + sqrt u v C is uniform
    t = mesh.vertices.astype(np.float64)[mesh.faces[faces]]
    points = (1 - root)[:, None] * t[:, 0] + (root * (1 - v))[:, None] * t[:, 1] + (root * v)[:, None] * t[:, 2]
    return SurfaceSamples(points, faces)


def distances_to_mesh(queries: np.ndarray, mesh: Mesh, *, samples: int = 200_000) -> np.ndarray:
    """Return the distance [Q] of each query [Q, 3] to the surface (``nearest_on_mesh``)."""
    return nearest_on_mesh(queries, mesh, samples=samples)[0]


def nearest_on_mesh(queries: np.ndarray, mesh: Mesh, *, samples: int = 200_000) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance [Q] of each query [Q, 3] to the surface, and the nearest face [Q].

    It is the smallest exact distance to the faces of the eight nearest points among all face centroids and ``samples``
    points of the surface. In rare cases, the nearest face is large and has no sample nearby; then the distance is too
    long by less than the spacing of the samples.
    """
    t = mesh.vertices.astype(np.float64)[mesh.faces]
    spread = sample_surface(mesh, samples)
    points = np.concatenate([t.mean(axis=1), spread.points])
    _, index = Cloud(points).nearest(queries, neighbours=_CANDIDATES)
    owner = np.concatenate([np.arange(len(t)), spread.faces, [0]])[index]  # a missing neighbour stands for face 0
    distances, first = _min_distances(queries, t, owner)
    return distances, np.take_along_axis(owner, first[:, None], axis=1)[:, 0]


def _min_distances(queries: np.ndarray, t: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least distances [Q] of queries to their triangles ``faces`` [Q, K], and the columns [Q] of these."""
    corners = _tensor(t)
    best, column = np.empty(len(queries)), np.empty(len(queries), np.int64)
    for start in range(0, len(queries), _CHUNK):
        part = slice(start, start + _CHUNK)
        p, columns = _tensor(queries[part]), _tensor(faces[part], np.int64).unbind(dim=1)
        least = torch.stack([triangle_distances(p, corners[index]) for index in columns]).min(dim=0)
        best[part], column[part] = least.values.numpy(), least.indices.numpy()
    return best, column


def _tensor(array: np.ndarray, dtype: type = np.float64) -> Tensor:
    """Convert an array to a tensor, copied only if its type differs or it is not writable (torch warns about those)."""
    return torch.from_numpy(np.require(array, dtype, ["C", "W"]))


def triangle_distances(p: Tensor, t: Tensor) -> Tensor:
    """Return the distance [n] of points [n, 3] to triangles [n, 3, 3]: to the plane, or to the edges if outside."""
    a, b, c = t.unbind(dim=1)
    normal = torch.linalg.cross(b - a, c - a)
    squared = normal.square().sum(dim=1)
    inside = squared > 0
    for u, v in ((a, b), (b, c), (c, a)):
        inside &= (torch.linalg.cross(v - u, p - u) * normal).sum(dim=1) >= 0
    plane = ((p - a) * normal).sum(dim=1).abs() / squared.where(squared > 0, 1).sqrt()
    edges = _segment(p, a, b).minimum(_segment(p, b, c)).minimum(_segment(p, c, a))
    return plane.where(inside, edges)


def _segment(p: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return the distances of points to segments."""
    along = b - a
    length = along.square().sum(dim=1)
    s = (((p - a) * along).sum(dim=1) / length.where(length > 0, 1)).clamp(0, 1)
    return (p - a - s[:, None] * along).square().sum(dim=1).sqrt()


# -- the scored points as files ----------------------------------------------------------------------------------------
GOOD, NEAR, FAR, OUT = (40, 150, 80), (235, 200, 60), (200, 40, 40), (150, 150, 160)
PRECISION, RECALL, IMAGE = "precision.ply", "recall.ply", "surface.png"
_SIDE = 320  # px of one panel
_FEW = 50_000  # points


@dataclass(frozen=True, eq=False)
class ScoredClouds:
    """Scored points of both surfaces, with their distances to the other surface, in one coordinate system."""

    mesh: np.ndarray  # [P, 3], with distances [P]
    mesh_distances: np.ndarray
    truth: np.ndarray  # [Q, 3], with distances [Q]
    truth_distances: np.ndarray
    tau: float  # threshold, in the same units


def distance_colors(distances: np.ndarray, tau: float) -> np.ndarray:
    """Return colours [P, 3] uint8: green up to tau, then yellow to red at 5 tau and beyond; grey if infinite."""
    t = np.clip((np.where(np.isfinite(distances), distances, 0) / tau - 1) / 4, 0, 1)[:, None]
    colors = (1 - t) * np.array(NEAR) + t * np.array(FAR)
    colors[distances < tau] = GOOD
    colors[~np.isfinite(distances)] = OUT
    return np.rint(colors).astype(np.uint8)


def write_clouds(folder: Path, clouds: ScoredClouds) -> dict[str, str]:
    """Write ``precision.ply`` (reconstruction), ``recall.ply`` (truth) and ``surface.png``; return the names."""
    for name, points, distances in (
        (PRECISION, clouds.mesh, clouds.mesh_distances),
        (RECALL, clouds.truth, clouds.truth_distances),
    ):
        rows = np.empty(len(points), [(c, "<f4") for c in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")])
        colors = distance_colors(distances, clouds.tau)
        for i in range(3):
            rows["xyz"[i]] = points[:, i]
            rows[("red", "green", "blue")[i]] = colors[:, i]
        write_ply(folder / name, {"vertex": rows})
    write_image(folder / IMAGE, draw_clouds(clouds))
    return {"precision_cloud": PRECISION, "recall_cloud": RECALL, "picture": IMAGE}


def draw_clouds(clouds: ScoredClouds) -> np.ndarray:
    """Draw both clouds along x, y and z, uint8 [2 side, 3 side, 3]: the reconstruction above the truth.

    The frame is the bounding box of the truth with a margin, so that distant outliers do not shrink the rest.
    """
    inside = clouds.truth if len(clouds.truth) else clouds.mesh
    low, high = (inside.min(axis=0), inside.max(axis=0)) if len(inside) else (np.zeros(3), np.ones(3))
    size = 1.1 * max(float((high - low).max()), 1e-12)
    low = (low + high - size) / 2
    rows = []
    for points, distances in ((clouds.mesh, clouds.mesh_distances), (clouds.truth, clouds.truth_distances)):
        colors = distance_colors(distances, clouds.tau)
        rows.append(np.concatenate([_panel(points, colors, axis, low, size) for axis in range(3)], axis=1))
    image = Image.fromarray(np.concatenate(rows))
    draw = ImageDraw.Draw(image)
    for row, (word, distances) in enumerate((("precision", clouds.mesh_distances), ("recall", clouds.truth_distances))):
        fraction = f"{(distances < clouds.tau).mean():.3f}" if len(distances) else "nothing"
        for column, axis in enumerate("xyz"):
            text = f"{word} {fraction} within {clouds.tau:g}" if column == 0 else ""
            draw.text((column * _SIDE + 6, row * _SIDE + 4), f"along {axis}  {text}", fill=(0, 0, 0))
    return np.asarray(image)


def _panel(points: np.ndarray, colors: np.ndarray, axis: int, low: np.ndarray, size: float) -> np.ndarray:
    """Draw points as pixels (few points as 2x2), projected along an axis; points on one pixel are averaged."""
    across, up = [i for i in range(3) if i != axis]
    column, row = (np.floor((points[:, i] - low[i]) / size * _SIDE).astype(np.int64) for i in (across, up))
    dots = [(0, 0), (1, 0), (0, 1), (1, 1)] if len(points) < _FEW else [(0, 0)]
    column, row = (np.concatenate([values + dot[i] for dot in dots]) for i, values in enumerate((column, row)))
    colors = np.tile(colors, (len(dots), 1))
    shown = (column >= 0) & (column < _SIDE) & (row >= 0) & (row < _SIDE)
    at, colors = ((_SIDE - 1 - row) * _SIDE + column)[shown], colors[shown]
    count = np.bincount(at, minlength=_SIDE * _SIDE)
    panel = np.full((_SIDE * _SIDE, 3), 255.0)
    hit = count > 0
    for i in range(3):
        panel[hit, i] = np.bincount(at, weights=colors[:, i], minlength=_SIDE * _SIDE)[hit] / count[hit]
    return np.rint(panel).astype(np.uint8).reshape(_SIDE, _SIDE, 3)


# -- the score ---------------------------------------------------------------------------------------------------------
_Counts = Callable[[np.ndarray, Mesh], np.ndarray]  # number of views in which points [P, 3] of a mesh are visible


@dataclass(frozen=True)
class ThresholdScore:
    """Precision, recall and their harmonic mean at one threshold, in units of the truth; None if undefined."""

    threshold: float
    precision: float | None
    recall: float | None
    f_score: float | None


@dataclass(frozen=True)
class SurfaceScore:
    """Distances between two surfaces, in units of the truth; None, with ``reason``, if nothing can be measured."""

    accuracy: float | None  # mean distance from the reconstruction to the truth
    completeness: float | None  # mean distance from the truth to the reconstruction
    chamfer: float | None  # the mean of both
    accuracy_median: float | None
    completeness_median: float | None
    scores: tuple[ThresholdScore, ...]
    diagonal: float  # diagonal of the bounding box of the truth
    mesh_points: int  # number of scored points
    truth_points: int
    # fraction of the area (of the points, for a cloud) that the cameras do not see, which is not scored
    mesh_hidden: float
    truth_hidden: float
    reason: str | None = None
    # The scored points with their distances, in the frame and units of the mesh; tau is the first threshold.
    clouds: ScoredClouds | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True, eq=False)
class _Side:
    """Scored points of one surface, and the fraction that is not scored."""

    points: np.ndarray
    hidden: float


def evaluate_surface(
    mesh: Mesh,
    truth: Mesh | np.ndarray,
    *,
    cameras: Sequence[Camera] = (),
    view_counts: np.ndarray | None = None,
    min_views: int = VISIBLE_SURFACE.min_views,
    T_truth_mesh: np.ndarray | None = None,
    thresholds: Sequence[float] | None = None,
    samples: int = VISIBLE_SURFACE.samples,
) -> SurfaceScore:
    """Score a mesh in the frame of the cameras against a true surface or points [P, 3] in their own frame.

    The cameras determine the visible surface; without them all surface is scored, unless ``view_counts`` [F] has the
    number of views that see each true face. True surface visible in fewer than ``min_views`` is not scored.
    ``T_truth_mesh`` [4, 4] is a similarity transform from the frame of the mesh to that of the truth. ``thresholds``
    are in units of the truth; default 0.25 %, 0.5 % and 1 % of the diagonal of its bounding box. ``samples`` is the
    number of points on each surface.

    Raises DataError if the truth is empty, no part of it is visible, or the length of ``view_counts`` differs from its
    number of faces.
    """
    T = np.eye(4) if T_truth_mesh is None else np.asarray(T_truth_mesh, dtype=np.float64)
    scale = similarity_scale(T, "T_truth_mesh")
    truth_points = np.asarray(truth.vertices[np.unique(truth.faces)] if isinstance(truth, Mesh) else truth, np.float64)
    if not len(truth_points) or not np.isfinite(truth_points).all():
        raise DataError("expected a ground truth with finite points, got none; check the file")
    diagonal = float(np.linalg.norm(np.ptp(truth_points, axis=0)))
    tau = [f * diagonal for f in VISIBLE_SURFACE.fractions] if thresholds is None else [float(t) for t in thresholds]

    # All computations are in the frame of the mesh; distances are converted to units of the truth at the end.
    local = _moved(truth, np.linalg.inv(T))
    tolerance = VISIBLE_SURFACE.seen_tolerance * diagonal / scale
    counts = partial(visible_counts, cameras=cameras, tolerance=tolerance)
    theirs = _true_side(local, cameras, view_counts, min_views, samples, counts)
    ours = _reconstructed_side(mesh, cameras, samples, counts)
    if not len(mesh.faces) or not len(ours.points):
        why = "the mesh is empty" if not len(mesh.faces) else "no camera sees any of the mesh"
        nothing = tuple(ThresholdScore(t, None, 0.0, 0.0) for t in tau)
        n = len(theirs.points)
        return SurfaceScore(None, None, None, None, None, nothing, diagonal, 0, n, ours.hidden, theirs.hidden, why)
    if isinstance(local, Mesh):
        accuracy = scale * distances_to_mesh(ours.points, local, samples=samples)
    else:
        accuracy = scale * Cloud(local).nearest(ours.points)[0][:, 0]
    completeness = scale * distances_to_mesh(theirs.points, mesh, samples=samples)
    return SurfaceScore(
        accuracy=float(accuracy.mean()),
        completeness=float(completeness.mean()),
        chamfer=float(0.5 * (accuracy.mean() + completeness.mean())),
        accuracy_median=float(np.median(accuracy)),
        completeness_median=float(np.median(completeness)),
        scores=tuple(_threshold_score(accuracy, completeness, t) for t in tau),
        diagonal=diagonal,
        mesh_points=len(ours.points),
        truth_points=len(theirs.points),
        mesh_hidden=ours.hidden,
        truth_hidden=theirs.hidden,
        clouds=ScoredClouds(ours.points, accuracy / scale, theirs.points, completeness / scale, tau[0] / scale),
    )


def _threshold_score(accuracy: np.ndarray, completeness: np.ndarray, threshold: float) -> ThresholdScore:
    """Return the fractions of the points nearer than the threshold (Knapitsch et al. 2017)."""
    precision, recall = float((accuracy < threshold).mean()), float((completeness < threshold).mean())
    both = precision + recall
    return ThresholdScore(threshold, precision, recall, 2 * precision * recall / both if both > 0 else 0.0)


def _true_side(
    truth: Mesh | np.ndarray,
    cameras: Sequence[Camera],
    view_counts: np.ndarray | None,
    min_views: int,
    samples: int,
    counts: _Counts,
) -> _Side:
    """Return true points that enough cameras see."""
    if not isinstance(truth, Mesh):
        if view_counts is not None:
            raise DataError("view counts per face need a true mesh, got a point cloud")
        keep = frustum_counts(truth, cameras) >= min_views if len(cameras) else np.ones(len(truth), bool)
        return _side(truth, keep, samples)
    spread = sample_surface(truth, samples)
    if view_counts is not None:
        if len(view_counts) != len(truth.faces):
            raise DataError(f"expected one count for each of {len(truth.faces)} true faces, got {len(view_counts)}")
        return _side(spread.points, np.asarray(view_counts)[spread.faces] >= min_views, samples)
    if not len(cameras):
        return _side(spread.points, np.ones(len(spread.points), bool), samples)
    return _side(spread.points, counts(spread.points, truth) >= min_views, samples)


def _side(points: np.ndarray, keep: np.ndarray, samples: int) -> _Side:
    if not keep.any():
        raise DataError("no camera sees any part of the ground truth; check its coordinate system")
    scored = points[keep]
    if len(scored) > samples:  # a large point cloud
        scored = scored[np.sort(np.random.default_rng(0).choice(len(scored), samples, replace=False))]
    return _Side(scored, float(1.0 - keep.mean()))


def _reconstructed_side(mesh: Mesh, cameras: Sequence[Camera], samples: int, counts: _Counts) -> _Side:
    """Return reconstructed points that a camera would see."""
    points = sample_surface(mesh, samples, seed=1).points  # different points even if mesh and truth are equal
    if not len(points) or not len(cameras):
        return _Side(points, 0.0)
    keep = counts(points, mesh) > 0
    return _Side(points[keep], float(1.0 - keep.mean()))


def _moved(truth: Mesh | np.ndarray, T: np.ndarray) -> Mesh | np.ndarray:
    """Apply a transform [4, 4] to the truth."""
    if isinstance(truth, Mesh):
        return Mesh(truth.vertices @ T[:3, :3].T + T[:3, 3], truth.faces)
    return np.asarray(truth, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]
