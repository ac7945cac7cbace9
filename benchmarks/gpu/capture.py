"""Make a synthetic capture on the benchmark machine: images of the room from a hundred poses around it.

Other people's photographs cannot be copied to every GPU machine. The quality on this capture is not representative of
real scenes, but the times are.
"""

from __future__ import annotations

import json
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from benchmarks.gpu.bench import Bench
from benchmarks.workload import room
from gs2d.core.camera import Camera, look_at
from gs2d.render.cuda_backend import CudaBackend
from gs2d.render.types import RasterSettings

SYNTHETIC = "synthetic"
TEACHER, SIDE, TRAIN, TEST = 300_000, 800, 100, 20
TOY = (60, 24, 4, 1)
FOV = math.radians(60)
NEVER_BELOW, RADIUS = (
    0.35,
    4.2,
)  # camera height above the floor and distance from the centre, world units


def poses(count: int, side: int, phase: float) -> list[Camera]:
    """Return cameras on arcs in front of the spheres, at alternating heights, all facing the centre."""
    focal = 0.5 * side / math.tan(0.5 * FOV)
    found = []
    for k in range(count):
        angle = math.radians(-65 + 130 * ((k + phase) / count))
        height = -(NEVER_BELOW + 1.6 * ((k * 0.618 + phase) % 1))
        eye = np.array([RADIUS * math.sin(angle), height, -RADIUS * math.cos(angle)])
        middle, up = np.array([0.0, -0.4, 0.0]), np.array([0.0, -1.0, 0.0])
        found.append(look_at(eye, middle, up, width=side, height=side, fx=focal))
    return found


def write_capture(bench: Bench, folder: Path) -> Path:
    """Render the teacher, write the capture in the NeRF-Synthetic layout, and return its folder."""
    count, side, train, test = TOY if bench.dry else (TEACHER, SIDE, TRAIN, TEST)
    teacher, settings = room(count).to(bench.device), RasterSettings(background=(1.0, 1.0, 1.0))
    with ThreadPoolExecutor(8) as pool:
        for split, number, phase in (("train", train, 0.0), ("test", test, 0.5)):
            (folder / split).mkdir(parents=True, exist_ok=True)
            frames: list[dict[str, Any]] = []
            for k, camera in enumerate(poses(number, side, phase)):
                with torch.no_grad():
                    output = CudaBackend(launcher=bench.launcher).rasterize(teacher, camera, settings)
                pixels = (output.color.clamp(0, 1) * 255).round().byte().cpu().numpy()
                path = folder / split / f"r_{k}.png"
                pool.submit(Image.fromarray(pixels).save, path, compress_level=1)
                blender = np.linalg.inv(camera.T_cam_world) @ np.diag([1.0, -1.0, -1.0, 1.0])
                frames.append({"file_path": f"./{split}/r_{k}", "transform_matrix": blender.tolist()})
            document = {"camera_angle_x": FOV, "frames": frames}
            (folder / f"transforms_{split}.json").write_text(json.dumps(document))
    return folder
