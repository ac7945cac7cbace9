"""How near a reconstructed mesh is to the truth, over the surface that the cameras can see.

The protocol (ours; docs/notebook/evaluation.md):

1. Points are spread over both surfaces, area-weighted, from a seed.
2. Completeness and recall ask of every true point how far the reconstruction is. Only true surface seen by at least
   ``min_views`` cameras counts: by counts of each face that come with the data, else by our own depth buffers.
3. Accuracy and precision ask of every reconstructed point how far the truth is, all of it, seen or not. Only
   reconstructed surface that some camera would see counts, the reconstruction hiding itself: what is inside or below
   and cannot appear in any picture is neither rewarded nor punished.
4. Distances are to triangles, not to samples; or to the nearest point where the truth is a point cloud.
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

from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.core.similarity import similarity_scale
from gs2d.data.image_files import write_image
from gs2d.errors import DataError
from gs2d.evaluation.nearest import Cloud
from gs2d.evaluation.visibility import frustum_counts, visible_counts
from gs2d.evaluation.visible_surface import VISIBLE_SURFACE
from gs2d.io.ply_format import write_ply

# -- points on surfaces, and exact distances to triangles --------------------------------------------------------------
_CANDIDATES = 8  # triangles tried for each point
_CHUNK = 1 << 16  # points and triangles at a time


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points spread evenly over a mesh: ``points`` [n, 3] float64 and the ``faces`` [n] they lie on."""

    points: np.ndarray
    faces: np.ndarray


def face_areas(mesh: Mesh) -> np.ndarray:
    """Area [F] of every face, world units^2."""
    t = mesh.vertices.astype(np.float64)[mesh.faces]
    return np.asarray(0.5 * np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1))


def sample_surface(mesh: Mesh, count: int, *, seed: int = 0, mask: np.ndarray | None = None) -> SurfaceSamples:
    """``count`` points, area-weighted and stratified along the order of the faces; the same for the same seed.

    Parameters
    ----------
    mask : ndarray [F] bool, optional
        Only these faces.

    Returns
    -------
    SurfaceSamples
        Empty where there is no area.
    """
    areas = face_areas(mesh)
    if mask is not None:
        areas = np.where(mask, areas, 0.0)
    ends = np.cumsum(areas)
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


def distances_to_points(queries: np.ndarray, points: np.ndarray, *, workers: int | None = None) -> np.ndarray:
    """Return the distance [Q] of each query to the nearest of the points [P, 3]."""
    return Cloud(points, workers=workers).nearest(queries)[0][:, 0]


def distances_to_mesh(
    queries: np.ndarray,
    mesh: Mesh,
    *,
    samples: int = 200_000,
    seed: int = 0,
    workers: int | None = None,
) -> np.ndarray:
    """Distance [Q] of each query [Q, 3] to the surface.

    The least of the exact distances to the faces of the eight nearest among all face centroids and ``samples`` points
    of the surface. The spacing of the samples does not enter, as it would in a distance to the nearest sample, but for
    the rare query whose nearest face is large and has no sample near: then the distance is too long by less than it.
    """
    t = mesh.vertices.astype(np.float64)[mesh.faces]
    spread = sample_surface(mesh, samples, seed=seed)
    points = np.concatenate([t.mean(axis=1), spread.points])
    _, index = Cloud(points, workers=workers).nearest(queries, neighbours=_CANDIDATES)
    owner = np.concatenate([np.arange(len(t)), spread.faces, [0]])  # there may be fewer than eight points: any face
    return _min_distances(queries, t, owner[index])


def _min_distances(queries: np.ndarray, t: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Least distance [Q] of each query to some of the triangles [F, 3, 3], ``faces`` [Q, K]."""
    corners = _tensor(t)
    best = np.empty(len(queries))
    for start in range(0, len(queries), _CHUNK):
        part = slice(start, start + _CHUNK)
        p, columns = _tensor(queries[part]), _tensor(faces[part], np.int64).unbind(dim=1)
        found = [_triangle_distances(p, corners[column]) for column in columns]
        best[part] = torch.stack(found).amin(dim=0).numpy()
    return best


def point_triangle_distances(p: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Distance [n] of points [n, 3] to triangles [n, 3, 3]: to the plane where the foot lies inside, else the edges."""
    return np.asarray(_triangle_distances(_tensor(p), _tensor(t)).numpy())


def _tensor(array: np.ndarray, dtype: type = np.float64) -> Tensor:
    """Return an array as a tensor: the same memory if it has that type and is writable (torch warns of others)."""
    return torch.from_numpy(np.require(array, dtype, ["C", "W"]))


def _triangle_distances(p: Tensor, t: Tensor) -> Tensor:
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
    """Distance of points to segments."""
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
    """Points of both sides with the distance to the other one, in one frame.

    Attributes
    ----------
    mesh, truth : ndarray [P, 3], [Q, 3]
    mesh_distances, truth_distances : ndarray [P], [Q]
    tau : float
        The distance that counts as right, in the same units.
    """

    mesh: np.ndarray
    mesh_distances: np.ndarray
    truth: np.ndarray
    truth_distances: np.ndarray
    tau: float


def distance_colors(distances: np.ndarray, tau: float) -> np.ndarray:
    """Colours [P, 3] uint8: green up to tau, then from yellow to red at 5 tau and beyond; grey where infinite."""
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
    """Both clouds seen along x, y and z, uint8 [2 side, 3 side, 3]: above the reconstruction, below the truth.

    The frame is the truth's, a little widened: what floats far away must not shrink the rest to a dot.
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
    """Points as pixels (few points: as 2x2), seen along an axis; where several fall on one pixel, their mean colour."""
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
_Counts = Callable[[np.ndarray, Mesh], np.ndarray]  # in how many views points [P, 3] of a mesh are visible
FRACTIONS = VISIBLE_SURFACE.fractions  # of the truth's bounding-box diagonal
SEEN_TOLERANCE = VISIBLE_SURFACE.seen_tolerance  # of the same diagonal: how far behind the depth buffer one sees


@dataclass(frozen=True)
class ThresholdScore:
    """Precision, recall and their harmonic mean at one distance (truth's units). None: there was nothing to measure."""

    threshold: float
    precision: float | None
    recall: float | None
    f_score: float | None


@dataclass(frozen=True)
class SurfaceScore:
    """Distances between two surfaces, in the truth's units; None, with ``reason``, where there is nothing to measure.

    Attributes
    ----------
    accuracy, completeness : float or None
        Mean distance from the reconstruction to the truth, and from the truth to the reconstruction.
    chamfer : float or None
        Their mean.
    accuracy_median, completeness_median : float or None
    scores : tuple of ThresholdScore
    diagonal : float
        Of the truth's bounding box.
    mesh_points, truth_points : int
        Points that counted.
    mesh_hidden, truth_hidden : float
        Part of the area (of the points, for a cloud) that did not count because cameras do not see it.
    reason : str or None
    clouds : ScoredClouds or None
        The points that counted with their distances, in the mesh's frame and units; tau is the first threshold.
    """

    accuracy: float | None
    completeness: float | None
    chamfer: float | None
    accuracy_median: float | None
    completeness_median: float | None
    scores: tuple[ThresholdScore, ...]
    diagonal: float
    mesh_points: int
    truth_points: int
    mesh_hidden: float
    truth_hidden: float
    reason: str | None = None
    clouds: ScoredClouds | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True, eq=False)
class _Side:
    """Points of one surface that count, and the part that does not."""

    points: np.ndarray
    hidden: float


def evaluate_surface(
    mesh: Mesh,
    truth: Mesh | np.ndarray,
    *,
    cameras: Sequence[Camera] = (),
    seen: np.ndarray | None = None,
    min_views: int = VISIBLE_SURFACE.min_views,
    T_truth_mesh: np.ndarray | None = None,
    thresholds: Sequence[float] | None = None,
    samples: int = VISIBLE_SURFACE.samples,
    seed: int = 0,
    workers: int | None = None,
) -> SurfaceScore:
    """Score a reconstruction.

    Parameters
    ----------
    mesh : Mesh
        The reconstruction, in the cameras' frame.
    truth : Mesh or ndarray [P, 3]
        Surface or point cloud, in its own frame.
    cameras : sequence of Camera
        Who looks. Without cameras everything counts (unless ``seen`` is given).
    seen : ndarray [F], optional
        Number of views that see each true face, where the data come with it.
    min_views : int
        True surface seen by fewer views does not count.
    T_truth_mesh : ndarray [4, 4], optional
        Similarity that takes the mesh into the truth's frame.
    thresholds : sequence of float, optional
        In the truth's units; default 0.25 %, 0.5 % and 1 % of the diagonal of the truth's bounding box.
    samples : int
        Points on each surface.
    workers : int, optional
        Threads; default: all.

    Raises
    ------
    DataError
        If the truth is empty, no part of it is seen, or ``seen`` is of another length than its faces.
    """
    T = np.eye(4) if T_truth_mesh is None else np.asarray(T_truth_mesh, dtype=np.float64)
    scale = similarity_scale(T, "T_truth_mesh")
    truth_points = np.asarray(truth.vertices[np.unique(truth.faces)] if isinstance(truth, Mesh) else truth, np.float64)
    if not len(truth_points) or not np.isfinite(truth_points).all():
        raise DataError("a ground truth with finite points was expected, got none; check the file")
    diagonal = float(np.linalg.norm(np.ptp(truth_points, axis=0)))
    tau = [f * diagonal for f in FRACTIONS] if thresholds is None else [float(t) for t in thresholds]

    # Everything below happens in the mesh's frame; distances return to the truth's units at the end.
    local = _moved(truth, np.linalg.inv(T))
    tolerance = SEEN_TOLERANCE * diagonal / scale
    counts = partial(visible_counts, cameras=cameras, tolerance=tolerance, workers=workers)
    to_mesh = partial(distances_to_mesh, samples=samples, seed=seed, workers=workers)
    theirs = _true_side(local, cameras, seen, min_views, samples, seed, counts)
    ours = _reconstructed_side(mesh, cameras, samples, seed, counts)
    if not len(mesh.faces) or not len(ours.points):
        why = "the mesh is empty" if not len(mesh.faces) else "no camera sees any of the mesh"
        nothing = tuple(ThresholdScore(t, None, 0.0, 0.0) for t in tau)
        n = len(theirs.points)
        return SurfaceScore(None, None, None, None, None, nothing, diagonal, 0, n, ours.hidden, theirs.hidden, why)
    if isinstance(local, Mesh):
        accuracy = scale * to_mesh(ours.points, local)
    else:
        accuracy = scale * distances_to_points(ours.points, local, workers=workers)
    completeness = scale * to_mesh(theirs.points, mesh)
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
    """Parts of the points nearer than the threshold (Knapitsch et al. 2017)."""
    precision, recall = float((accuracy < threshold).mean()), float((completeness < threshold).mean())
    both = precision + recall
    return ThresholdScore(threshold, precision, recall, 2 * precision * recall / both if both > 0 else 0.0)


def _true_side(
    truth: Mesh | np.ndarray,
    cameras: Sequence[Camera],
    seen: np.ndarray | None,
    min_views: int,
    samples: int,
    seed: int,
    counts: _Counts,
) -> _Side:
    """Return true points that enough cameras see."""
    if not isinstance(truth, Mesh):
        if seen is not None:
            raise DataError("a true mesh was expected with counts of views of each face, got a point cloud")
        keep = frustum_counts(truth, cameras) >= min_views if len(cameras) else np.ones(len(truth), bool)
        return _side(truth, keep, samples, seed)
    if seen is not None:
        if len(seen) != len(truth.faces):
            raise DataError(f"one count for each of {len(truth.faces)} true faces was expected, got {len(seen)}")
        spread = sample_surface(truth, samples, seed=seed)
        return _side(spread.points, np.asarray(seen)[spread.faces] >= min_views, samples, seed)
    points = sample_surface(truth, samples, seed=seed).points
    if not len(cameras):
        return _side(points, np.ones(len(points), bool), samples, seed)
    return _side(points, counts(points, truth) >= min_views, samples, seed)


def _side(points: np.ndarray, keep: np.ndarray, samples: int, seed: int) -> _Side:
    if not keep.any():
        raise DataError("a ground truth that the cameras see was expected, no part of it is seen; check its frame")
    kept = points[keep]
    if len(kept) > samples:  # a point cloud: as it comes, thinned
        kept = kept[np.sort(np.random.default_rng(seed).choice(len(kept), samples, replace=False))]
    return _Side(kept, float(1.0 - keep.mean()))


def _reconstructed_side(mesh: Mesh, cameras: Sequence[Camera], samples: int, seed: int, counts: _Counts) -> _Side:
    """Reconstructed points that some camera would see."""
    points = sample_surface(mesh, samples, seed=seed + 1).points  # other points than on an equal truth
    if not len(points) or not len(cameras):
        return _Side(points, 0.0)
    keep = counts(points, mesh) > 0
    return _Side(points[keep], float(1.0 - keep.mean()))


def _moved(truth: Mesh | np.ndarray, T: np.ndarray) -> Mesh | np.ndarray:
    """Return the truth under a transform [4, 4]."""
    if isinstance(truth, Mesh):
        return Mesh(truth.vertices @ T[:3, :3].T + T[:3, 3], truth.faces)
    return np.asarray(truth, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]
