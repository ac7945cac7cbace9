"""Precision, recall and F-score of Tanks and Temples (Knapitsch et al. 2017), in the official steps.

1. The points of the reconstruction are mesh vertices and face centroids, as in the official script. The score
   therefore depends on the triangulation, not on area alone.
2. The initial alignment is the similarity from the capture's camera centres to those of the official log, moved into
   the scan's frame by ``_trans.txt``. It uses our own cameras, as a second trajectory file may be in another frame.
3. Three stages of iterative closest points with scale refine it, with both clouds cut to the crop volume.
4. Both clouds are cut and thinned to tau / 2. Precision and recall are the fractions nearer than tau.

A self-check tests the alignment: a wrong log or transform gives a low score, not an error.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.contrib.lab.alignment import (
    IcpResult,
    RobustFit,
    icp,
    ransac_similarity,
    rotation_degrees,
    uniform_downsample,
    voxel_downsample,
)
from gs2d.contrib.lab.nearest import Cloud
from gs2d.contrib.lab.surface_protocols import TNT_SURFACE, IcpStage, TntSurface
from gs2d.contrib.lab.surface_score import ScoredClouds
from gs2d.core.checks import check_shapes
from gs2d.core.image_arrays import natural_key
from gs2d.core.json_files import read_bytes, read_json
from gs2d.core.mesh import Mesh
from gs2d.core.similarity import apply, similarity_scale
from gs2d.errors import DataError
from gs2d.io.meshes import read_points

# -- the crop volume ---------------------------------------------------------------------------------------------------
_PLANES = {0: (1, 2), 1: (0, 2), 2: (0, 1)}  # axes of the polygon, by extrusion axis
_CHUNK = 1 << 21


@dataclass(frozen=True, eq=False)
class CropVolume:
    """The scored volume, in the frame of the ground truth."""

    axis: int  # 0, 1 or 2: the axis along which the polygon is extruded
    low: float  # range along it, both ends included
    high: float
    polygon: np.ndarray  # [n, 2]: corners in the two other axes, in ascending order of axis; even-odd rule

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return which points [P, 3] lie inside, bool [P]."""
        check_shapes({"points": (points, "P 3")})
        u, v = _PLANES[self.axis]
        inside = (points[:, self.axis] >= self.low) & (points[:, self.axis] <= self.high)
        rows = np.flatnonzero(inside)
        for start in range(0, len(rows), _CHUNK):
            part = rows[start : start + _CHUNK]
            inside[part] = self._in_polygon(points[part, u].astype(np.float64), points[part, v].astype(np.float64))
        return np.asarray(inside)

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Return the points inside."""
        return np.asarray(points[self.contains(points)])

    def _in_polygon(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return whether a ray from (u, v) to u = -infinity crosses an odd number of edges."""
        odd = np.zeros(len(u), bool)
        for (u0, v0), (u1, v1) in zip(self.polygon, np.roll(self.polygon, -1, axis=0), strict=True):
            crosses = (v0 < v) != (v1 < v)
            if not crosses.any():
                continue
            odd[crosses] ^= u0 + (v[crosses] - v0) / (v1 - v0) * (u1 - u0) < u[crosses]
        return odd


def box(low: np.ndarray, high: np.ndarray) -> CropVolume:
    """Return the axis-aligned box between two corners [3]."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return CropVolume(2, float(z0), float(z1), np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], np.float64))


def read_crop(path: Path) -> CropVolume:
    """Read ``SCENE.json`` of Tanks and Temples (Open3D's SelectionPolygonVolume)."""
    data = read_json(path)
    try:
        axis = "XYZ".index(str(data["orthogonal_axis"]).upper())
        low, high = float(data["axis_min"]), float(data["axis_max"])
        corners = np.asarray(data["bounding_polygon"], dtype=np.float64)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(
            f"{path} must hold orthogonal_axis (X, Y or Z), axis_min, axis_max and bounding_polygon, "
            f"got another entry ({error}); copy it again from the ground truth"
        ) from error
    if corners.ndim != 2 or corners.shape[0] < 3 or corners.shape[1] != 3 or not np.isfinite(corners).all():
        raise DataError(f"{path}: bounding_polygon must hold three corners [x, y, z] or more, got {corners.shape}")
    if not low < high:
        raise DataError(f"{path}: axis_min must be below axis_max, got {low:g} and {high:g}")
    return CropVolume(axis, low, high, corners[:, list(_PLANES[axis])])


# -- files -------------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class TntTruth:
    """Ground truth of one scene."""

    scene: str
    points: np.ndarray  # [P, 3]: the laser scan, m
    crop: CropVolume  # in the scan's frame
    T_truth_log: np.ndarray  # [4, 4], ``SCENE_trans.txt``: from the frame of the log to that of the scan
    trajectory: np.ndarray  # [n, 4, 4], ``SCENE_COLMAP_SfM.log``: camera-to-world matrices of all photographs, in order


def read_tnt_truth(scene: str, files: Mapping[str, Path]) -> TntTruth:
    """Read the ground truth of a scene from its four ``files`` (keys as ``tnt_truth_files``), or raise DataError."""
    points = np.asarray(read_points(files["scan"]).points)
    crop = read_crop(files["crop"])
    if not crop.contains(points).any():
        raise DataError(f"{files['crop']} must hold part of the scan {files['scan'].name}, got none; copy both again")
    return TntTruth(scene, points, crop, read_transform(files["transform"]), read_trajectory(files["log"]))


def read_transform(path: Path) -> np.ndarray:
    """Return a 4x4 matrix of numbers in four lines (``SCENE_trans.txt``)."""
    rows = _number_rows(path)
    if len(rows) != 4 or any(len(row) != 4 for row in rows):
        raise DataError(f"{path} must hold four lines of four numbers, got {len(rows)} lines; copy it again")
    T = np.array(rows)
    if not np.isfinite(T).all() or abs(np.linalg.det(T)) < 1e-12:
        raise DataError(f"{path} must hold a finite transform, got {T.round(4).tolist()}; copy it again")
    return T


def read_trajectory(path: Path) -> np.ndarray:
    """Return the camera-to-world matrices [n, 4, 4] of a ``.log`` file: three integers, then a matrix, each."""
    rows = _number_rows(path)
    if not rows or len(rows) % 5 or any(len(row) != (3 if i % 5 == 0 else 4) for i, row in enumerate(rows)):
        raise DataError(
            f"{path} must hold a line of three numbers and four of four for each camera, "
            f"got {len(rows)} lines; copy it again"
        )
    poses = np.array([row for i, row in enumerate(rows) if i % 5], dtype=np.float64).reshape(-1, 4, 4)
    if not np.isfinite(poses).all():
        raise DataError(f"{path} must hold finite cameras, got NaN or infinity; copy it again")
    return poses


def _number_rows(path: Path) -> list[list[float]]:
    try:
        lines = read_bytes(path).decode().splitlines()
        return [[float(word) for word in line.split()] for line in lines if line.strip()]
    except ValueError as error:
        raise DataError(f"{path} must hold numbers only, got: {error}; copy it again") from error


def match_cameras(names: Sequence[str], count: int, where: str = "the log") -> tuple[np.ndarray, np.ndarray]:
    """Match photographs with the ``count`` entries of a log; return both indices [m], [m], or raise DataError.

    Equal numbers are matched in natural order of names (``frame_2`` before ``frame_10``); else by the number in the
    name, starting at 1 (``000001.jpg``) as in Tanks and Temples, or at 0 if that number occurs.
    """
    order = np.array(sorted(range(len(names)), key=lambda i: natural_key(names[i])), np.int64)
    if len(names) == count:
        return order, np.arange(count)
    numbers = [re.search(r"(\d+)\D*$", Path(names[i]).stem) for i in order]
    if not all(numbers):
        raise DataError(f"{where} has {count} cameras, the capture {len(names)}, and their names have no numbers")
    counted = np.array([int(number.group(1)) for number in numbers if number], np.int64)
    first = min(1, int(counted.min()))
    entries = counted - first
    inside = (entries >= 0) & (entries < count)
    if inside.sum() < 3 or len(np.unique(entries)) < len(entries):
        raise DataError(
            f"{where} has {count} cameras, the capture {len(names)}, numbered {counted.min()} to "
            f"{counted.max()}; take the log of the same photographs"
        )
    return order[inside], entries[inside]


# -- the score ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Alignment:
    """The self-check."""

    ok: bool  # whether the alignment passed
    messages: tuple[str, ...]  # warnings, one line each
    cameras: int  # number of cameras matched with the log
    camera_fraction: float  # fraction of these within the threshold of the protocol
    camera_rms: float  # rms distance of these, m
    camera_worst: float  # largest distance of these, m
    scale: float  # final scale from capture to scan
    shift: float | None  # rms distance by which the stages moved the mesh, tau
    shift_scale: float  # change of scale by the stages
    shift_degrees: float  # rotation by the stages
    transform_alone: float | None  # rms error of the mesh with ``_trans.txt`` alone, tau
    # for each stage: ``voxel`` and ``threshold`` (m), ``points``, and the numbers of ``IcpResult``
    stages: tuple[dict[str, Any], ...]
    T_truth_mesh: np.ndarray  # [4, 4]


@dataclass(frozen=True, eq=False)
class TntScore:
    """The score of one scene, in m; None, with ``reason``, if nothing could be measured."""

    tau: float
    precision: float | None
    recall: float | None
    f_score: float
    # mean distance from the reconstruction to the scan; these three are not part of the protocol
    accuracy: float | None
    completeness: float | None  # from the scan to the reconstruction
    chamfer: float | None  # mean of the two
    mesh_points: int  # number of scored points
    truth_points: int
    alignment: Alignment
    clouds: ScoredClouds  # the scored points with their distances
    reason: str | None = None


def evaluate_tnt(
    mesh: Mesh,
    names: Sequence[str],
    centers: np.ndarray,
    truth: TntTruth,
    tau: float,
    *,
    published: np.ndarray | None = None,
    protocol: TntSurface = TNT_SURFACE,
) -> TntScore:
    """Score a mesh in the capture's frame, with threshold ``tau`` (m).

    ``names`` and ``centers`` [n, 3] are those of all photographs of the capture, in its frame. ``published`` [m, 4, 4]
    is the log beside the photographs, which is only compared with the cameras. Raises DataError if the cameras do not
    match the log.
    """
    source = point_set(mesh)
    fit, frame_notes = _camera_fit(names, centers, truth, published, protocol)
    target = truth.crop.apply(truth.points).astype(np.float64)
    T = fit.T_target_source
    reports: list[dict[str, Any]] = []
    for stage in protocol.stages:
        step, report = _stage(source, target, T, truth, stage, tau, protocol)
        T = step.T_target_source @ T
        reports.append(report)
    moved = truth.crop.apply(apply(T, source))
    alignment = _check(fit, T, moved, truth, tau, tuple(reports), frame_notes, protocol)
    return _score(moved, target, tau, alignment, protocol)


def point_set(mesh: Mesh) -> np.ndarray:
    """Return vertices and face centroids [P + F, 3], which the official script compares."""
    vertices = mesh.vertices.astype(np.float64)
    return np.concatenate([vertices, vertices[mesh.faces].mean(axis=1)]) if len(mesh.faces) else vertices


def _camera_fit(
    names: Sequence[str],
    centers: np.ndarray,
    truth: TntTruth,
    published: np.ndarray | None,
    protocol: TntSurface,
) -> tuple[RobustFit, list[str]]:
    """Return the fit from capture to scan by camera centres, and notes on the frames."""
    ours, entries = match_cameras(names, len(truth.trajectory), f"{truth.scene}_COLMAP_SfM.log")
    targets = apply(truth.T_truth_log, truth.trajectory[entries, :3, 3])
    try:
        fit = ransac_similarity(
            centers[ours], targets, threshold=protocol.camera_threshold, sample=protocol.camera_sample, seed=0
        )
    except DataError as error:
        raise DataError(f"{truth.scene}_COLMAP_SfM.log does not fit the capture's cameras: {error}") from error
    notes = []
    if published is not None and len(published) == len(names):
        gap, spread = _frame_gap(names, centers, published), float(np.linalg.norm(np.ptp(centers, axis=0)))
        if gap > 0.01 * spread:
            notes.append(
                f"{truth.scene}_COLMAP_SfM.log beside the photographs is in another frame than their cameras (median "
                f"distance {gap / spread:.0%} of their spread): the cameras were used instead"
            )
    return fit, notes


def _frame_gap(names: Sequence[str], centers: np.ndarray, published: np.ndarray) -> float:
    """Return the median distance of cameras from those of a log, in text order (of logs) or number order."""
    orders = [sorted(range(len(names)), key=key) for key in (lambda i: names[i], lambda i: natural_key(names[i]))]
    return min(float(np.median(np.linalg.norm(published[:, :3, 3] - centers[order], axis=1))) for order in orders)


def _stage(
    source: np.ndarray,
    target: np.ndarray,
    T: np.ndarray,
    truth: TntTruth,
    stage: IcpStage,
    tau: float,
    protocol: TntSurface,
) -> tuple[IcpResult, dict[str, Any]]:
    """Run one stage on the cropped and thinned clouds."""
    moved = truth.crop.apply(apply(T, source))
    if stage.voxel is None:
        thin_source = uniform_downsample(moved, protocol.max_points)
        thin_target = uniform_downsample(target, protocol.max_points)
    else:
        thin_source = voxel_downsample(moved, stage.voxel * tau)
        thin_target = voxel_downsample(target, stage.voxel * tau)
    step = icp(
        thin_source,
        thin_target,
        threshold=stage.threshold * tau,
        iterations=stage.iterations,
        fraction_change=protocol.fraction_change,
        rms_change=protocol.rms_change,
    )
    voxel = None if stage.voxel is None else stage.voxel * tau
    report = {"voxel": voxel, "threshold": stage.threshold * tau, "points": len(thin_source), **vars(step)}
    del report["T_target_source"]
    return step, report


def _check(
    fit: RobustFit,
    T: np.ndarray,
    moved: np.ndarray,
    truth: TntTruth,
    tau: float,
    stages: tuple[dict[str, Any], ...],
    messages: list[str],
    protocol: TntSurface,
) -> Alignment:
    """Return the alignment with the result of its self-check."""
    change = T @ np.linalg.inv(fit.T_target_source)
    shift = _rms_between(moved, np.linalg.inv(change), tau)  # against the start of the stages
    alone = _rms_between(moved, truth.T_truth_log @ np.linalg.inv(T), tau)
    scale = similarity_scale(change)
    log, transform = f"{truth.scene}_COLMAP_SfM.log", f"{truth.scene}_trans.txt"
    wrong = []
    if fit.fraction < protocol.min_camera_fraction:
        wrong.append(
            f"only {fit.fraction:.0%} of the cameras agree with {log} within {protocol.camera_threshold:g} m: "
            "is it the log of these photographs?"
        )
    apart = not stages or stages[0]["fraction"] < protocol.min_fraction
    if apart or shift is None or shift > protocol.max_shift or abs(scale - 1) > protocol.max_scale_change:
        near = stages[0]["fraction"] if stages else 0
        what = (
            f"{near:.0%} of the mesh lies within {protocol.stages[0].threshold:g} tau of the scan, after a shift of "
            f"{'no' if shift is None else f'{shift:.1f}'} tau and a scale of {scale:.4f}"
        )
        trap = (
            f"the cameras fit {log}, the surface does not fit the scan: take {log} and {transform} from the official "
            "ground truth (TNT_GOF has a log of the same name, which for Truck is in another frame)"
        )
        wrong.append(f"{what}; {trap if fit.fraction >= protocol.min_camera_fraction else 'the alignment failed'}")
    elif alone is not None and alone > protocol.max_shift:
        messages = [
            *messages,
            f"the capture is not in the frame of {log} (as Truck of TNT_GOF): {transform} alone would misplace the "
            f"mesh by {alone:.0f} tau; it was aligned by its cameras",
        ]
    return Alignment(
        ok=not wrong,
        messages=(*wrong, *messages),
        cameras=len(fit.inliers),
        camera_fraction=fit.fraction,
        camera_rms=fit.rms,
        camera_worst=fit.worst,
        scale=similarity_scale(T),
        shift=shift,
        shift_scale=scale,
        shift_degrees=rotation_degrees(change),
        transform_alone=alone,
        stages=stages,
        T_truth_mesh=T,
    )


def _rms_between(points: np.ndarray, T: np.ndarray, unit: float) -> float | None:
    """Return the rms distance by which a transform moves points, in units; None without points."""
    if not len(points):
        return None
    few = uniform_downsample(points, 100_000)
    return float(np.sqrt(np.square(apply(T, few) - few).sum(axis=1).mean()) / unit)


def _score(
    moved: np.ndarray,
    target: np.ndarray,
    tau: float,
    alignment: Alignment,
    protocol: TntSurface,
) -> TntScore:
    """Return precision, recall and F-score of the cropped clouds."""
    ours = voxel_downsample(moved, protocol.score_voxel * tau)
    theirs = voxel_downsample(target, protocol.score_voxel * tau)
    if not len(theirs):
        raise DataError("a scan with points inside the crop volume was expected, got none; copy both again")
    if not len(ours):
        clouds = ScoredClouds(ours, np.zeros(0), theirs, np.full(len(theirs), np.inf), tau)
        why = "no part of the mesh lies inside the crop volume"
        return TntScore(tau, None, 0.0, 0.0, None, None, None, 0, len(theirs), alignment, clouds, why)
    accuracy, _ = Cloud(theirs).nearest(ours)
    completeness, _ = Cloud(ours).nearest(theirs)
    accuracy, completeness = accuracy[:, 0], completeness[:, 0]
    precision, recall = float((accuracy < tau).mean()), float((completeness < tau).mean())
    return TntScore(
        tau=tau,
        precision=precision,
        recall=recall,
        f_score=f_score(precision, recall),
        accuracy=float(accuracy.mean()),
        completeness=float(completeness.mean()),
        chamfer=float(accuracy.mean() + completeness.mean()) / 2,
        mesh_points=len(ours),
        truth_points=len(theirs),
        alignment=alignment,
        clouds=ScoredClouds(ours, accuracy, theirs, completeness, tau),
    )


def f_score(precision: float, recall: float) -> float:
    """Return the harmonic mean; 0 if both values are 0."""
    return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0
