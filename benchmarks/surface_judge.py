"""Score any mesh against a scene of ``benchmarks/surfaces.py``.

Distances are fractions of the diagonal of the subject's bounding box and count at most 10 %. *Visible* is what at least
two training cameras see. The mesh counts inside the bounding box, padded by 10 % of the diagonal; parts of it that lie
on the table or ground around the subject do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gs2d.contrib.lab.surface_score import face_areas, nearest_on_mesh, sample_surface
from gs2d.contrib.lab.visibility import NEAR, shown_points
from gs2d.core.camera import Camera
from gs2d.core.json_files import read_json
from gs2d.core.mesh import Mesh
from gs2d.errors import DataError
from gs2d.io.meshes import read_mesh
from gs2d.meshing.raycast import cast_camera

PHOTOS, SCENE, TRUTH, TRUE_POINTS = "images", "scene.json", "truth/mesh_gt.ply", "truth/points.npz"  # files of a scene
SAMPLES = 60_000  # points by area, and as many by virtual scan, of each surface
FRACTIONS = (0.001, 0.0025, 0.005)  # of the diagonal: thresholds of the F-scores
FAR = 0.01  # of the diagonal: true surface without mesh is a hole, mesh without true surface is excess
PADDING = 0.1  # of the diagonal, around the subject's box; also the largest distance
LEAST_VIEWS = 2
SCAN_CAMERAS = 14  # cameras that decide which part of a mesh is visible


@dataclass(frozen=True)
class SceneFacts:
    """What ``scene.json`` holds.

    Attributes
    ----------
    name : str
    seed, size : int
    subject_faces : int
        The first faces of ``mesh_gt.ply`` are scored; the others are its surroundings.
    train : tuple of int
        Indices of the training views.
    views : tuple of str
        Names of the photographs.
    cameras : tuple of Camera
        True cameras of all photographs.
    """

    name: str
    seed: int
    size: int
    subject_faces: int
    train: tuple[int, ...]
    views: tuple[str, ...]
    cameras: tuple[Camera, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the content of ``scene.json``."""
        first = self.cameras[0]
        return {
            **{"format": 1, "name": self.name, "seed": self.seed, "size": self.size},
            **{"subject_faces": self.subject_faces, "train": list(self.train), "views": list(self.views)},
            "intrinsics": [first.width, first.height, first.fx, first.fy, first.cx, first.cy],
            "T_cam_world": [camera.T_cam_world.tolist() for camera in self.cameras],
        }


@dataclass(frozen=True, eq=False)
class TrueScene:
    """Ground truth of a scene.

    Attributes
    ----------
    facts : SceneFacts
    truth : Mesh
        The subject, then its surroundings.
    points, normals : ndarray [P, 3] float64
        Visible points of the subject, spread by area, with unit normals of their faces.
    scanned : ndarray [Q, 3] float64
        Visible points of the subject, spread as pixels of the training cameras.
    """

    facts: SceneFacts
    truth: Mesh
    points: np.ndarray
    normals: np.ndarray
    scanned: np.ndarray

    @property
    def subject(self) -> Mesh:
        """The subject alone."""
        return Mesh(self.truth.vertices, self.truth.faces[: self.facts.subject_faces])

    @property
    def box(self) -> np.ndarray:
        """Bounding box [2, 3] of the subject, world units."""
        used = self.truth.vertices[np.unique(self.subject.faces)]
        return np.stack([used.min(axis=0), used.max(axis=0)]).astype(np.float64)

    @property
    def training_cameras(self) -> list[Camera]:
        """The true cameras of the training views."""
        return [self.facts.cameras[k] for k in self.facts.train]


def read_scene(folder: Path) -> TrueScene:
    """Read the ground truth of a scene.

    Raises
    ------
    DataError
        If the folder holds no scene.
    """
    if not (folder / SCENE).exists():
        raise DataError(f"{folder} must be a scene of benchmarks.surfaces, but has no {SCENE}; render it first")
    document = read_json(folder / SCENE)
    width, height, fx, fy, cx, cy = document.pop("intrinsics")
    cameras = [Camera(width, height, fx, fy, cx, cy, np.array(T)) for T in document.pop("T_cam_world")]
    del document["format"]
    facts = SceneFacts(
        **{**document, "train": tuple(document["train"]), "views": tuple(document["views"])}, cameras=tuple(cameras)
    )
    with np.load(folder / TRUE_POINTS) as file:
        arrays = {name: file[name].astype(np.float64) for name in ("points", "normals", "scanned")}
    return TrueScene(facts, read_mesh(folder / TRUTH), **arrays)


def face_normals(mesh: Mesh) -> np.ndarray:
    """Return unit normals [F, 3] of all faces; 0 for faces without area."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    normals = np.cross(b - a, c - a)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30))


def true_points(
    truth: Mesh, subject_faces: int, views: Sequence[tuple[Camera, np.ndarray]], hit_faces: Sequence[np.ndarray]
) -> dict[str, np.ndarray]:
    """Return ``points``, ``normals`` and ``scanned`` of ``TrueScene`` as float32.

    Parameters
    ----------
    views : sequence of (Camera, ndarray [H, W])
        Training cameras with the depth of the nearest surface, which includes occluders outside ``truth``.
    hit_faces : sequence of ndarray [H, W]
        Faces of these surfaces; those below ``subject_faces`` are the subject's.
    """
    subject = Mesh(truth.vertices, truth.faces[:subject_faces])
    diagonal = float(np.linalg.norm(np.ptp(truth.vertices[np.unique(subject.faces)], axis=0)))
    spread = sample_surface(subject, 4 * SAMPLES)
    normals = face_normals(subject)[spread.faces]
    counts = np.zeros(len(normals), np.int64)
    rng, scanned = np.random.default_rng(5), []
    for (camera, depths), faces in zip(views, hit_faces, strict=True):
        facing = ((camera.center - spread.points) * normals).sum(axis=1) > 0
        counts += facing & shown_points(spread.points, camera, depths, 0.002 * diagonal)
        rows, columns = np.nonzero((faces >= 0) & (faces < subject_faces))
        chosen = rng.random(len(rows)) < SAMPLES / len(views) / max(len(rows), 1)
        scanned.append(unproject(camera, columns[chosen], rows[chosen], depths))
    visible = np.flatnonzero(counts >= LEAST_VIEWS)
    visible = np.sort(rng.permutation(visible)[:SAMPLES])
    found = {"points": spread.points[visible], "normals": normals[visible], "scanned": np.concatenate(scanned)}
    return {name: values.astype(np.float32) for name, values in found.items()}


def unproject(camera: Camera, columns: np.ndarray, rows: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Return world points [n, 3] of pixels of a depth map."""
    at = [(columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy, np.ones(len(rows))]
    local = np.stack(at, axis=1) * depths[rows, columns, None].astype(np.float64)
    return np.asarray(local @ camera.rotation + camera.center)


# -- the score -----------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class MeshScore:
    """Score of a mesh; lengths are percentages of the subject's diagonal.

    Attributes
    ----------
    chamfer : float
        Mean of accuracy and completeness, per cent of the diagonal.
    accuracy, completeness : float
        Mean distance from visible mesh to truth, and from visible truth to mesh, per cent of the diagonal.
    f_area, f_scan : dict of str to float
        F-scores by threshold (per cent of the diagonal), of points spread by area and by pixels.
    normal_error : float or None
        Median angle, degrees, between the normals of the visible truth and of the nearest face within 1 % of it,
        whichever way the face is wound.
    holes, excess : float
        Per cent of the visible truth, and of the visible area of the mesh, that are farther than 1 % of the diagonal
        from the other surface.
    pieces, faces : int
        Connected pieces and faces of the whole mesh.
    """

    chamfer: float
    accuracy: float
    completeness: float
    f_area: dict[str, float]
    f_scan: dict[str, float]
    normal_error: float | None
    holes: float
    excess: float
    pieces: int
    faces: int

    def as_json(self) -> dict[str, Any]:
        """Return the score as JSON values, rounded."""

        def short(value: Any) -> Any:
            if isinstance(value, dict):
                return {name: short(each) for name, each in value.items()}
            return round(value, 4) if isinstance(value, float) else value

        return {name: short(value) for name, value in asdict(self).items()}


def score_mesh(mesh: Mesh, scene: TrueScene) -> MeshScore:
    """Score a mesh in the frame of the capture against the ground truth of its scene."""
    low, high = scene.box
    diagonal = float(np.linalg.norm(high - low))
    low, high = low - PADDING * diagonal, high + PADDING * diagonal
    areas = face_areas(mesh)
    inside = ((mesh.vertices >= low) & (mesh.vertices <= high)).all(axis=1)[mesh.faces].any(axis=1) & (areas > 0)
    near = Mesh(mesh.vertices, mesh.faces[inside])
    by_area, by_scan = _mesh_points(mesh, near, scene, (low, high), diagonal)
    distances = [_to_truth(points, scene, diagonal) for points in (by_area, by_scan)]
    if len(near.faces):
        back, nearest = nearest_on_mesh(scene.points, near)
        scanned = nearest_on_mesh(scene.scanned, near)[0]
        close = back <= FAR * diagonal
        cosine = np.abs((scene.normals * face_normals(near)[nearest]).sum(axis=1))[close]
        normal_error = float(np.degrees(np.arccos(np.median(np.minimum(cosine, 1))))) if close.any() else None
    else:
        back, scanned = (np.full(len(points), np.inf) for points in (scene.points, scene.scanned))
        normal_error = None
    back, scanned = (np.minimum(values / diagonal, PADDING) for values in (back, scanned))
    (by_area_distances, lying), (by_scan_distances, _) = distances
    accuracy = 100 * float(by_area_distances.mean()) if len(by_area_distances) else 100 * PADDING
    completeness = 100 * float(back.mean())
    excess = float((by_area_distances > FAR).sum() / max(len(by_area_distances) + lying, 1))
    return MeshScore(
        chamfer=(accuracy + completeness) / 2,
        accuracy=accuracy,
        completeness=completeness,
        f_area=_f_scores(by_area_distances, back),
        f_scan=_f_scores(by_scan_distances, scanned),
        normal_error=normal_error,
        holes=100 * float((back > FAR).mean()),
        excess=100 * excess,
        pieces=_pieces(mesh),
        faces=len(mesh.faces),
    )


def _mesh_points(
    mesh: Mesh, near: Mesh, scene: TrueScene, box: tuple[np.ndarray, np.ndarray], diagonal: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return visible points of a mesh within a box, spread by area [P, 3] and by pixels [Q, 3]."""
    cameras = scene.training_cameras
    cameras = cameras[:: max(len(cameras) // SCAN_CAMERAS, 1)]
    points = sample_surface(near, SAMPLES, seed=1).points
    points = points[((points >= box[0]) & (points <= box[1])).all(axis=1)]
    seen, scanned = np.zeros(len(points), bool), [np.zeros((0, 3))]
    rng, vertices = np.random.default_rng(6), mesh.vertices.astype(np.float64)
    for camera in cameras:
        depths = cast_camera(vertices, mesh.faces, camera, near=NEAR).depth
        seen |= shown_points(points, camera, depths, 0.002 * diagonal)
        rows, columns = np.nonzero(depths)
        hits = unproject(camera, columns, rows, depths)
        hits = hits[((hits >= box[0]) & (hits <= box[1])).all(axis=1)]
        scanned.append(hits[rng.random(len(hits)) < SAMPLES / len(cameras) / max(len(hits), 1)])
    return points[seen], np.concatenate(scanned)


def _to_truth(points: np.ndarray, scene: TrueScene, diagonal: float) -> tuple[np.ndarray, int]:
    """Return distances of mesh points to the truth, and the number of left out points on the surroundings.

    Distances are fractions of the diagonal. Points within 1 % of the surroundings and nearer to them than to the
    subject are left out.
    """
    if not len(points):
        return np.zeros(0), 0
    distances = nearest_on_mesh(points, scene.subject)[0] / diagonal
    around = Mesh(scene.truth.vertices, scene.truth.faces[scene.facts.subject_faces :])
    lying = np.zeros(len(points), bool)
    if len(around.faces):
        other = nearest_on_mesh(points, around)[0] / diagonal
        lying = (other < distances) & (other <= FAR)
        distances = np.minimum(distances, other)
    return np.minimum(distances[~lying], PADDING), int(lying.sum())


def _f_scores(ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    """Return the F-score at each threshold (Knapitsch et al. 2017)."""
    scores = {}
    for threshold in FRACTIONS:
        precision = float((ours < threshold).mean()) if len(ours) else 0.0
        recall = float((theirs < threshold).mean()) if len(theirs) else 0.0
        scores[f"{100 * threshold:g}"] = 2 * precision * recall / max(precision + recall, 1e-12)
    return scores


def _pieces(mesh: Mesh) -> int:
    """Return the number of connected pieces."""
    if not len(mesh.faces):
        return 0
    used, faces = np.unique(mesh.faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    rows, columns = np.concatenate([faces[:, :2], faces[:, 1:]]).T
    graph = coo_array((np.ones(len(rows), bool), (rows, columns)), shape=(len(used), len(used)))
    return int(connected_components(graph, directed=False)[0])
