"""Chamfer distance of DTU (Jensen et al. 2014), in the steps of the Python evaluation that 2DGS uses.

1. The mesh is culled by the silhouettes of all views (widened by 24 px), and scaled to millimetres by scale_mat.
2. It is sampled about every 0.2 mm, and the points are thinned until no two are nearer than 0.2 mm. The official script
   shuffles them with an unseeded generator; ours is seeded, so that scores are reproducible.
3. Reconstruction to scan: points inside the widened bounding box and the observation mask. Scan to reconstruction:
   scanned points above the plane of the table, to the points inside the box (observed or not).
4. Distances of 20 mm and more are dropped; the score is the mean of both means.
"""

from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from gs2d.contrib.lab.nearest import Cloud
from gs2d.contrib.lab.surface_protocols import DTU_SURFACE, DtuSurface
from gs2d.contrib.lab.surface_score import ScoredClouds
from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.core.similarity import apply, similarity_scale
from gs2d.errors import DataError
from gs2d.io.meshes import read_points


# -- files -------------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class DtuTruth:
    """Ground truth of one scan, in mm."""

    scan: int
    points: np.ndarray  # [P, 3]: the structured-light scan (``stlNNN_total.ply``)
    observed: np.ndarray  # [X, Y, Z] bool: cells that the scanner observed (``ObsMaskN_10.mat``)
    bounds: np.ndarray  # [2, 3]: smallest and largest corner of those cells
    resolution: float  # side of a cell, mm
    plane: np.ndarray  # [4]: points with plane . (x, y, z, 1) > 0 are above the table (``PlaneN.mat``)

    def is_observed(self, points: np.ndarray) -> np.ndarray:
        """Return which points [P, 3] lie in an observed cell, bool [P] (nearest cell centre, ties to even)."""
        cell = np.around((points - self.bounds[0]) / self.resolution).astype(np.int64)
        inside = ((cell >= 0) & (cell < self.observed.shape)).all(axis=1)
        inside[inside] = self.observed[tuple(cell[inside].T)]
        return np.asarray(inside)

    def above_plane(self) -> np.ndarray:
        """Return the scanned points above the table."""
        return np.asarray(self.points[self.points @ self.plane[:3] + self.plane[3] > 0])


def read_dtu_truth(scan: int, files: Mapping[str, Path]) -> DtuTruth:
    """Read the ground truth of a scan from its three ``files`` (keys as ``dtu_truth_files``), or raise DataError."""
    mask = _matrices(files["mask"], ("ObsMask", "BB", "Res"))
    observed, bounds = np.asarray(mask["ObsMask"]), np.asarray(mask["BB"], np.float64)
    if observed.ndim != 3 or bounds.shape != (2, 3) or np.asarray(mask["Res"]).size != 1:
        raise DataError(
            f"{files['mask']} must hold ObsMask [X, Y, Z], BB [2, 3] and one Res, got {list(observed.shape)}, "
            f"{list(bounds.shape)} and {np.asarray(mask['Res']).size}; copy it again"
        )
    plane = np.asarray(_matrices(files["plane"], ("P",))["P"], np.float64).ravel()
    if plane.shape != (4,) or not np.isfinite(plane).all():
        raise DataError(f"{files['plane']} must hold four finite numbers P, got {plane.size}; copy it again")
    points = np.asarray(read_points(files["scan"]).points, np.float64)
    if not len(points):
        raise DataError(f"{files['scan']} must hold the scanned points, got none; copy it again")
    resolution = float(np.asarray(mask["Res"]).ravel()[0])
    return DtuTruth(scan, points, observed.astype(bool), bounds, resolution, plane)


# scipy's reader crashes on some damaged files, so it runs in its own process. A value takes at most 8 bytes.
_MATLAB = """
import math, sys, numpy, scipy.io
path, names = sys.argv[1], sys.argv[2:]
if sum(math.prod(shape) for name, shape, _ in scipy.io.whosmat(path) if name in names) > 1 << 29:
    raise ValueError("arrays of more than 500 million values")
data = scipy.io.loadmat(path, variable_names=names)
data = {name: array for name, array in data.items() if getattr(array, "dtype", numpy.dtype("O")).kind in "biuf"}
numpy.savez(sys.stdout.buffer, **data)
"""


def _matrices(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Return the variables ``names`` of a MATLAB file (version 5, as DTU has them)."""
    if not path.is_file():
        raise DataError(f"{path} must be a MATLAB file, got nothing; copy it again")
    done = subprocess.run([sys.executable, "-P", "-c", _MATLAB, str(path), *names], capture_output=True)
    if done.returncode:
        why = (done.stderr.decode(errors="replace").splitlines() or ["a file that its reader crashes on"])[-1]
        raise DataError(f"{path} must be a MATLAB 5 file, got: {why}; copy it again")
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as content:
        missing = [name for name in names if name not in content]
        if missing:
            raise DataError(f"{path} must hold {', '.join(names)}; {', '.join(missing)} is missing; copy it again")
        return {name: content[name] for name in names}


# -- the score ---------------------------------------------------------------------------------------------------------
GREEN_WITHIN = 1.0  # mm, in the coloured clouds only: DTU has no threshold
_SLAB = 400_000  # points thinned at a time
_TRIANGLES = 200_000  # triangles sampled at a time


@dataclass(frozen=True, eq=False)
class ViewSilhouette:
    """A camera in the frame of the scene, and the silhouette of the object, bool [H, W]."""

    camera: Camera
    mask: np.ndarray


@dataclass(frozen=True, eq=False)
class DtuScore:
    """The score of one scan, mm; None, with ``reason``, if nothing could be measured."""

    accuracy: float | None  # mean distance from the reconstruction to the scan (d2s)
    completeness: float | None  # from the scan to the reconstruction (s2d)
    chamfer: float | None  # the mean of both
    mesh_points: int  # number of compared points
    truth_points: int
    dropped_mesh: float  # fraction at ``max_distance`` or more
    dropped_truth: float
    culled: float  # fraction of the vertices outside a silhouette
    ok: bool  # self-check: whether reconstruction and scan coincide
    messages: tuple[str, ...]  # warnings, one line each
    clouds: ScoredClouds
    reason: str | None = None


def evaluate_dtu(
    mesh: Mesh,
    silhouettes: Sequence[ViewSilhouette],
    T_metric_scene: np.ndarray,
    truth: DtuTruth,
    *,
    protocol: DtuSurface = DTU_SURFACE,
) -> DtuScore:
    """Score a mesh in the frame of the scene; ``T_metric_scene`` [4, 4], the scale_mat, maps the scene to mm.

    The mesh is culled by the ``silhouettes`` of all views; (): nothing is culled.
    """
    similarity_scale(T_metric_scene, "T_metric_scene")
    keep = inside_silhouettes(mesh.vertices.astype(np.float64), silhouettes, protocol)
    culled = Mesh(apply(T_metric_scene, mesh.vertices), mesh.faces[keep[mesh.faces].all(axis=1)])
    used = keep if len(silhouettes) else np.ones(len(keep), bool)
    low, high = truth.bounds[0] - protocol.margin_low, truth.bounds[1] + protocol.margin_high
    points = mesh_points(_touching(culled, low, high), protocol.density, vertices=culled.vertices[used])
    points = thin(points, protocol.density)
    points = points[((points >= low) & (points < high)).all(axis=1)]
    return _score(points, truth, float(1 - used.mean()) if len(used) else 0.0, protocol)


def _touching(mesh: Mesh, low: np.ndarray, high: np.ndarray) -> Mesh:
    """Return the faces whose bounding boxes touch a box; the others need no samples."""
    corners = mesh.vertices[mesh.faces]
    touch = (corners.max(axis=1) >= low).all(axis=1) & (corners.min(axis=1) < high).all(axis=1)
    return Mesh(mesh.vertices, mesh.faces[touch])


def _score(points: np.ndarray, truth: DtuTruth, culled: float, protocol: DtuSurface) -> DtuScore:
    """Return the score of distances between the thinned points inside the box and the scan."""
    observed = points[truth.is_observed(points)]
    above = truth.above_plane()
    limit = protocol.max_distance
    if not len(observed) or not len(above):
        whose = "of the mesh lies inside the observed part of the scan"
        if not len(above):
            whose = "of the scan is above the plane"
        clouds = ScoredClouds(points, np.full(len(points), np.inf), above, np.full(len(above), np.inf), GREEN_WITHIN)
        why = f"nothing {whose}"
        message = f"{why}: was the mesh made from this scan, and is scale_mat the one of its cameras?"
        if culled == 1:
            message = "every corner of the mesh lies outside some silhouette: are the masks those of these views?"
        counts = (len(observed), len(above))
        return DtuScore(None, None, None, *counts, 1.0, 1.0, culled, False, (message,), clouds, why)
    d2s = Cloud(truth.points).nearest(observed, limit=limit)[0][:, 0]
    s2d = Cloud(points).nearest(above, limit=limit)[0][:, 0]
    clouds = ScoredClouds(observed, d2s, above, s2d, GREEN_WITHIN)
    near, back = np.isfinite(d2s), np.isfinite(s2d)
    dropped = (float(1 - near.mean()), float(1 - back.mean()))
    messages = []
    if min(near.mean(), back.mean()) < protocol.min_fraction:
        messages.append(
            f"{near.mean():.0%} of the mesh lies within {limit:g} mm of the scan and {back.mean():.0%} of the scan "
            "within it of the mesh: is scale_mat the one of these cameras, and the scan of this scene?"
        )
    if not (near.any() and back.any()):
        why = f"mesh and scan are {limit:g} mm apart everywhere"
        counts = (len(observed), len(above))
        return DtuScore(None, None, None, *counts, *dropped, culled, False, tuple(messages), clouds, why)
    accuracy, completeness = float(d2s[near].mean()), float(s2d[back].mean())
    return DtuScore(
        accuracy,
        completeness,
        (accuracy + completeness) / 2,
        len(observed),
        len(above),
        *dropped,
        culled,
        not messages,
        tuple(messages),
        clouds,
    )


def inside_silhouettes(
    vertices: np.ndarray, silhouettes: Sequence[ViewSilhouette], protocol: DtuSurface = DTU_SURFACE
) -> np.ndarray:
    """Return which vertices [P, 3] are inside the widened silhouette, or outside the image, in every view; bool [P]."""
    keep = np.ones(len(vertices), bool)
    for view in silhouettes:
        height, width = view.mask.shape
        camera = view.camera.resized(width, height)
        radius = protocol.dilation * width / protocol.dilation_width
        wide = distance_transform_edt(~view.mask) <= radius if view.mask.any() else view.mask
        rows = np.flatnonzero(keep)
        pixels, depth = camera.project(vertices[rows])
        in_image = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
        at = np.floor(pixels[in_image]).astype(np.int64)
        outside = np.zeros(len(rows), bool)
        outside[in_image] = ~wide[at[:, 1], at[:, 0]]
        keep[rows[outside]] = False
    return keep


def mesh_points(mesh: Mesh, density: float, *, vertices: np.ndarray | None = None) -> np.ndarray:
    """Return points [P, 3] on a mesh: a skew grid on each triangle, about one per density^2, and the vertices.

    A triangle with edges of length l1, l2 from its first corner and twice the area a2 gets a grid of floor(l1 / t) by
    floor(l2 / t) steps, t = density sqrt(l1 l2 / a2), of which the points at half steps inside the triangle count.
    """
    parts = [np.asarray(mesh.vertices if vertices is None else vertices, np.float64)]
    for start in range(0, len(mesh.faces), _TRIANGLES):
        corners = mesh.vertices.astype(np.float64)[mesh.faces[start : start + _TRIANGLES]]
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = np.linalg.norm(np.cross(a, b), axis=1)
        solid = area > 0
        a, b, origin, area = a[solid], b[solid], corners[solid, 0], area[solid]
        l1, l2 = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
        step = density * np.sqrt(l1 * l2 / area)
        n1, n2 = np.floor(l1 / step).astype(np.int64), np.floor(l2 / step).astype(np.int64)
        order = np.lexsort((n2, n1))
        edges = np.flatnonzero(np.diff(n1[order]) | np.diff(n2[order])) + 1
        for rows in np.split(order, edges):  # all triangles with the same grid at once
            grid = _half_steps(int(n1[rows[0]]), int(n2[rows[0]])) if len(rows) else np.zeros((0, 2))
            if len(grid):
                on = a[rows, None] * grid[:, :1] + b[rows, None] * grid[:, 1:] + origin[rows, None]
                parts.append(on.reshape(-1, 3))
    return np.concatenate(parts)


def _half_steps(n1: int, n2: int) -> np.ndarray:
    """Return barycentric (u, v) of the half steps of a grid inside the triangle u + v < 1."""
    u, v = np.meshgrid((np.arange(n1 + 1) + 0.5) / max(n1, 1e-7), (np.arange(n2 + 1) + 0.5) / max(n2, 1e-7))
    return np.stack([u, v], axis=-1).reshape(-1, 2)[(u + v < 1).ravel()]


def thin(points: np.ndarray, radius: float, *, seed: int = 0, slab_size: int = _SLAB) -> np.ndarray:
    """Thin points to a minimum distance ``radius``; every dropped point is within it of a selected one.

    Points are selected greedily: slab by slab along the longest axis, in an order shuffled from the seed within a slab.
    Within a slab, all points that precede their neighbours are selected at once, repeatedly, which gives the same set.
    """
    if not len(points):
        return points
    axis = int(np.ptp(points, axis=0).argmax())
    points = points[np.argsort(points[:, axis], kind="stable")]
    rng = np.random.default_rng(seed)
    thinned: list[np.ndarray] = []
    for start in range(0, len(points), slab_size):
        slab = points[start : start + slab_size]
        reach = slab[0, axis] - radius
        slab = slab[rng.permutation(len(slab))]
        near = [part[part[:, axis] >= reach] for part in thinned if part[:, axis].max() >= reach]
        if near:  # points of earlier slabs that reach into this one
            gap, _ = cKDTree(np.concatenate(near)).query(slab, distance_upper_bound=np.nextafter(radius, np.inf))
            slab = slab[~(gap <= radius)]
        if len(slab):
            thinned.append(slab[_first_of_neighbours(slab, radius)])
    return np.concatenate(thinned)


def _first_of_neighbours(points: np.ndarray, radius: float) -> np.ndarray:
    """Return the mask [P] of the points that a greedy choice in their order selects."""
    selected = np.zeros(len(points), bool)
    if not len(points):
        return selected
    open_ = np.ones(len(points), bool)
    pairs = cKDTree(points).query_pairs(radius, output_type="ndarray")  # i < j in each
    while True:
        later = np.zeros(len(points), bool)
        later[pairs[:, 1]] = True
        chosen = open_ & ~later
        selected |= chosen
        if not len(pairs):
            return selected
        gone = chosen.copy()
        gone[pairs[chosen[pairs[:, 0]], 1]] = True
        open_ &= ~gone
        pairs = pairs[open_[pairs].all(axis=1)]
