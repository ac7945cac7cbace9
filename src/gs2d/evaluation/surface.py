"""How near a reconstructed mesh is to the truth, over the surface that the cameras can see.

The protocol (ours; docs/decisions.md, Evaluation):

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
from typing import TypeVar

import numpy as np

from gs2d.config.surface_protocols import VISIBLE_SURFACE
from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.errors import DataError
from gs2d.evaluation.alignment import similarity_scale
from gs2d.evaluation.distance import distances_to_mesh, distances_to_points, sample_surface
from gs2d.evaluation.surface_clouds import ScoredClouds
from gs2d.evaluation.visibility import frustum_counts, visible_counts

_T = TypeVar("_T")
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
        The points that counted with their distances, in the mesh's frame and units; tau is the headline threshold.
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
        clouds=ScoredClouds(
            ours.points, accuracy / scale, theirs.points, completeness / scale, headline(tau, thresholds) / scale
        ),
    )


def headline(rows: Sequence[_T], thresholds: Sequence[float] | None) -> _T:
    """Return what stands at the headline threshold: the protocol's, or the middle one of those that were asked for."""
    return rows[len(rows) // 2 if thresholds else VISIBLE_SURFACE.headline]


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
