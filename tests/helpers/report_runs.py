"""Write a small run folder that contains every file a report reads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.contrib.demo.shapes import torus_knot, tube
from gs2d.core.camera import look_at
from gs2d.core.json_files import write_json
from gs2d.core.mesh import Mesh
from gs2d.data.image_files import write_image
from gs2d.io.meshes import write_mesh
from gs2d.meshing.raycast import cast_camera
from gs2d.pipeline.finish.run_images import camera_json
from gs2d.report.color_maps import depth_image, error_image, highlight_image, normal_image

STAGES = (("surface", 3000), ("appearance", 1000), ("refine", 2000))
KNOT = tube(torus_knot(0.6, 0.25, steps=120), 0.16, around=14, closed=True)


def scores(psnr: float) -> dict[str, Any]:
    return {"psnr": psnr, "ssim": 0.8 + psnr / 250, "lpips": None, "lpips_reason": "no weights: use --lpips-weights"}


def stage_entry(index: int) -> dict[str, Any]:
    name, iterations = STAGES[index]
    psnr = (26.5, 26.9, 27.35)[index]
    entry = {"name": name, "iterations": iterations, "seconds": (100.0, 20.0, 45.0)[index]}
    entry |= {"splats": (20000, 20000, 20200)[index], "bytes": (4640000, 4640000, 4686400)[index]}
    entry |= {"peak_memory_bytes": 512_000_000, "test": scores(psnr), "train": scores(psnr + 1)}
    return entry


def definition() -> dict[str, Any]:
    return {
        "format": 2,
        "versions": {"2dgs-r": "0.1.0", "torch": "2.4"},
        "machine": {"processor": "a processor & <its> makers", "cores": 2},
        "created": "2026-01-01T00:00:00+00:00",
        "recipe": {"name": "2dgs-r", "stages": [{"name": name} for name, _ in STAGES]},
        "protocol": {"name": "nerf-synthetic"},
        "scene": {
            "name": "still <life>",
            "path": "capture",
            "format": "blender",
            "train": 40,
            "test": 8,
            "skipped": [],
        },
        "downscale": 1,
        "seed": 7,
        "backend": {"name": "cpu", "details": "AVX2"},
    }


def events() -> list[dict[str, Any]]:
    rng = np.random.default_rng(0)
    lines: list[dict[str, Any]] = [{"kind": "initialised", "splats": 5000, "source": "random", "dropped": 0}]
    offset = 0
    for index, (name, iterations) in enumerate(STAGES):
        if name == "appearance":
            lines.append({"kind": "ranked", "stage": name, "group": "high_error", "count": 200, "fraction": 0.123})
        if name == "refine":
            lines.append({"kind": "cloned", "stage": name, "count": 200, "opacity": "copy", "splats": 20200})
        lines.append({"kind": "stage_started", "stage": name, "iterations": iterations, "splats": 5000})
        for iteration in range(20, iterations + 1, 20):
            t = (offset + iteration) / 6000
            losses = {"l1": 0.05 * np.exp(-2 * t) * rng.uniform(0.7, 1.3), "ssim": 0.02 * np.exp(-t)}
            if name != "appearance":
                losses["normal_consistency"] = 0.004 * rng.uniform(0.9, 1.1)
            line = {
                "kind": "progress",
                "stage": name,
                "iteration": iteration,
                "losses": losses,
                "loss": sum(losses.values()),
            }
            line |= {"splats": int(20000 - 15000 * np.exp(-6 * t)), "mean_opacity": 0.5 + 0.2 * t}
            line |= {"mean_area": 0.002 * np.exp(-2 * t), "total_iteration": offset + iteration}
            if iteration % 100 == 0:
                line["psnr"] = 20 + 7 * (1 - np.exp(-4 * t)) + 0.2 * index
            lines.append(line)
            if name == "surface" and iteration % 1000 == 0:
                pruned = {"pruned_by_opacity": 4, "pruned_large": 1}
                lines.append(
                    {"kind": "densified", "stage": name, "iteration": iteration, "cloned": 10, "split": 20, **pruned}
                )
                lines.append({"kind": "opacity_limited", "stage": name, "iteration": iteration, "reset": True})
        offset += iterations
    lines.append({"kind": "from another planet", "stage": "refine"})
    return lines


def write_renders(folder: Path, width: int, height: int) -> None:
    rng = np.random.default_rng(1)
    views = []
    for k, split in enumerate(("test", "train")):
        eye = np.array([(2.5, -1.5, 2.0), (-2.0, 2.0, 1.5)][k])
        camera = look_at(eye, np.zeros(3), np.array([0, 0, 1.0]), width=width, height=height, fx=1.2 * width)
        hits = cast_camera(KNOT.vertices, KNOT.faces, camera)
        alpha = (hits.face >= 0).astype(np.float32)
        normal = KNOT.normals[KNOT.faces[hits.face, 0]] * alpha[..., None]
        stripes = np.sin(40 * hits.depth)[..., None] * [0.2, 0.15, -0.1] + [0.6, 0.4, 0.3]
        photo = stripes * alpha[..., None] + 1 - alpha[..., None]
        name = f"{split}/r_{k}"
        view = {"name": name, "file": name.replace("/", "__"), "split": split, "depth_limits": [1.5, 4.25]}
        views.append({**view, "camera": camera_json(camera)})
        (folder / "renders" / "photos").mkdir(parents=True, exist_ok=True)
        write_image(folder / "renders" / "photos" / f"{split}__r_{k}.png", photo)
        for index, (stage, _) in enumerate(STAGES):
            color = np.clip(photo + rng.normal(0, 0.06 - 0.02 * index, photo.shape) * alpha[..., None], 0, 1)
            images = {"color": color, "normal": normal_image(normal, alpha)}
            images["depth"] = depth_image(hits.depth, alpha)
            images["error"] = error_image(color, photo)
            if index:
                images["high_error"] = highlight_image(color, alpha * (np.sin(40 * hits.depth) > 0.6))
            (folder / "renders" / stage).mkdir(exist_ok=True)
            for kind, image in images.items():
                write_image(folder / "renders" / stage / f"{split}__r_{k}.{kind}.png", image)
    index = {"views": views, "stages": [name for name, _ in STAGES], "images": ["color", "normal", "depth", "error"]}
    write_json(folder / "renders" / "index.json", index)


def fabricate(folder: Path, *, size: int = 48, height: int | None = None) -> Path:
    """Write a complete run; images are square unless ``height`` is set."""
    folder.mkdir(parents=True)
    write_json(folder / "run.json", definition())
    surface = {
        "chamfer": 0.0123,
        "thresholds": [
            {"threshold": 0.01, "precision": 0.71, "recall": 0.64, "f_score": 0.673},
            {"threshold": 0.02, "precision": 0.91, "recall": 0.84, "f_score": 0.874},
        ],
    }
    write_json(folder / "metrics.json", {"stages": [stage_entry(k) for k in range(3)], "surface": surface})
    (folder / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events()) + '{"kind": "st')
    write_renders(folder, size, height or size)
    colors = np.clip(127 + 120 * KNOT.normals, 0, 255).astype(np.uint8)
    write_mesh(folder / "mesh.ply", Mesh(KNOT.vertices, KNOT.faces.astype(np.int32), colors))
    return folder
