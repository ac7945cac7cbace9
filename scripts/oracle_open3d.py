"""Score the seeded scenes of ``tests/helpers/oracle_scenes.py`` with Open3D 0.19.

Provides an independent reference for ``gs2d.evaluation``, which never imports Open3D. Run once, in a separate
environment::

    python -m venv build/oracle && build/oracle/bin/pip install open3d-cpu==0.19.0
    build/oracle/bin/python scripts/oracle_open3d.py > tests/helpers/oracle_open3d.json

Tanks and Temples: Open3D crops, downsamples, runs RANSAC over camera centres and ICP with scale, and computes nearest
distances, with the steps and criteria of the official script. DTU: points are sampled on every triangle, one triangle
at a time, and thinned one by one in a shuffled order; Open3D computes the distances.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import open3d as o3d

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))
from oracle_scenes import OBSERVED_RESOLUTION, TAU, dtu_scene, tnt_scene

registration = o3d.pipelines.registration


def cloud(points: np.ndarray) -> o3d.geometry.PointCloud:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(points, np.float64)))


def crop_volume(data: dict, folder: Path) -> o3d.visualization.SelectionPolygonVolume:
    path = folder / "crop.json"
    path.write_text(json.dumps(data))
    return o3d.visualization.read_selection_polygon_volume(str(path))


def tnt(seed: int, folder: Path) -> dict:
    """Return precision, recall and F-score, with the result of every step."""
    scene = tnt_scene(seed)
    volume = crop_volume(scene.crop, folder)
    source = cloud(np.concatenate([scene.vertices, scene.vertices[scene.faces].mean(axis=1)]))
    target = cloud(scene.scan)
    log = cloud(scene.log[:, :3, 3]).transform(scene.T_truth_log)
    pairs = o3d.utility.Vector2iVector(np.stack([np.arange(len(scene.log))] * 2, axis=1))
    o3d.utility.random.seed(0)
    point_to_point = registration.TransformationEstimationPointToPoint(True)
    cameras = registration.registration_ransac_based_on_correspondence(
        cloud(scene.centers), log, pairs, 0.2, point_to_point, 6,
        criteria=registration.RANSACConvergenceCriteria(100000, 0.999),
    )  # fmt: skip
    fit = point_to_point.compute_transformation(cloud(scene.centers), log, pairs)  # use all pairs: no randomness
    T = np.asarray(fit)
    stages = []
    for voxel, threshold in ((TAU, 80 * TAU), (TAU / 2, 20 * TAU), (None, 2 * TAU)):
        s = volume.crop_point_cloud(cloud(np.asarray(source.points)).transform(T))
        t = volume.crop_point_cloud(target)
        if voxel is not None:
            s, t = s.voxel_down_sample(voxel), t.voxel_down_sample(voxel)
        before = registration.evaluate_registration(s, t, threshold, np.eye(4))
        step = registration.registration_icp(
            s, t, threshold, np.eye(4), point_to_point, registration.ICPConvergenceCriteria(1e-6, 20)
        )
        T = np.asarray(step.transformation) @ T
        stages.append(
            {
                "points": len(s.points), "share_before": before.fitness, "rms_before": before.inlier_rmse,
                "share": step.fitness, "rms": step.inlier_rmse, "T": T.tolist(),
            }
        )  # fmt: skip
    s = volume.crop_point_cloud(cloud(np.asarray(source.points)).transform(T)).voxel_down_sample(TAU / 2)
    t = volume.crop_point_cloud(target).voxel_down_sample(TAU / 2)
    to_truth = np.asarray(s.compute_point_cloud_distance(t))
    to_mesh = np.asarray(t.compute_point_cloud_distance(s))
    precision, recall = float((to_truth < TAU).mean()), float((to_mesh < TAU).mean())
    return {
        "seed": seed, "T_cameras": T_list(cameras.transformation), "T_all_pairs": T_list(fit), "stages": stages,
        "mesh_points": len(to_truth), "truth_points": len(to_mesh), "precision": precision, "recall": recall,
        "f_score": 2 * precision * recall / (precision + recall),
        "accuracy": float(to_truth.mean()), "completeness": float(to_mesh.mean()),
    }  # fmt: skip


def T_list(T: np.ndarray) -> list:
    return np.asarray(T).tolist()


def one_triangle(a: np.ndarray, b: np.ndarray, c: np.ndarray, density: float) -> list[np.ndarray]:
    """Sample one triangle at half steps of a skewed grid."""
    l1, l2, area2 = np.linalg.norm(b - a), np.linalg.norm(c - a), np.linalg.norm(np.cross(b - a, c - a))
    if area2 == 0:
        return []
    step = density * np.sqrt(l1 * l2 / area2)
    n1, n2 = int(l1 // step), int(l2 // step)
    points = []
    for i in range(n1 + 1):
        for j in range(n2 + 1):
            u, v = (i + 0.5) / max(n1, 1e-7), (j + 0.5) / max(n2, 1e-7)
            if u + v < 1:
                points.append(a + u * (b - a) + v * (c - a))
    return points


def dtu(seed: int) -> dict:
    """Return the Chamfer distance of the DTU-like scene, mm."""
    scene, density = dtu_scene(seed), 0.2
    points = [*scene.vertices]
    for face in scene.faces:
        points += one_triangle(*scene.vertices[face], density)
    sampled = np.array(points)
    order = np.random.default_rng(seed).permutation(len(sampled))
    sampled = sampled[order]
    tree = o3d.geometry.KDTreeFlann(cloud(sampled))
    keep = np.ones(len(sampled), bool)
    for i, point in enumerate(sampled):
        if keep[i]:
            _, neighbours, _ = tree.search_radius_vector_3d(point, density)
            keep[np.asarray(neighbours)] = False
            keep[i] = True
    thinned = sampled[keep]
    inside = ((thinned >= scene.bounds[0] - 60) & (thinned < scene.bounds[1] + 120)).all(axis=1)
    thinned = thinned[inside]
    observed = []
    for point in thinned:
        cell = np.around((point - scene.bounds[0]) / OBSERVED_RESOLUTION).astype(int)
        if (cell >= 0).all() and (cell < scene.observed.shape).all() and scene.observed[tuple(cell)]:
            observed.append(point)
    above = scene.scan[scene.scan @ scene.plane[:3] + scene.plane[3] > 0]
    d2s = np.asarray(cloud(np.array(observed)).compute_point_cloud_distance(cloud(scene.scan)))
    s2d = np.asarray(cloud(above).compute_point_cloud_distance(cloud(thinned)))
    accuracy, completeness = float(d2s[d2s < 20].mean()), float(s2d[s2d < 20].mean())
    return {
        "seed": seed, "sampled": len(sampled), "thinned": len(thinned), "observed": len(observed), "above": len(above),
        "accuracy": accuracy, "completeness": completeness, "chamfer": (accuracy + completeness) / 2,
    }  # fmt: skip


def main() -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        figures = {
            "open3d": o3d.__version__,
            "numpy": np.__version__,
            "tau": TAU,
            "tnt": [tnt(seed, Path(folder)) for seed in (0, 1)],
            "dtu": [dtu(seed) for seed in (0, 1)],
        }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
