"""Run a command in a control group of little memory: ``python small_memory.py BYTES COMMAND ...``; say what it took.

The group lies below that of this process (cgroup v1 or v2, which must be writable: root, mostly) and is removed at the
end. ``python small_memory.py --capture FOLDER`` writes what is trained in it: 24 photographs of 23 megapixels as PNG.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image

COUNT, WIDTH, HEIGHT, FINE = 24, 5888, 3920, 8


def write_photographs(folder: Path) -> None:
    """The ball of ``tiny`` from all around, each of its pixels 8 x 8 of the photograph's, with noise."""
    from tiny import ANGLE, ball_cameras, ball_image

    rng = np.random.default_rng(0)
    focal = 0.5 * WIDTH / np.tan(ANGLE / 2) / FINE
    for split, count, phase in (("train", COUNT, 0.0), ("test", 1, 1.1)):
        (folder / split).mkdir(parents=True)
        frames = []
        for i, square in enumerate(ball_cameras(count, WIDTH // FINE, phase)):
            camera = square.__class__(WIDTH // FINE, HEIGHT // FINE, focal, focal, WIDTH / FINE / 2, HEIGHT / FINE / 2,
                                      square.T_cam_world)  # fmt: skip
            pixels = ball_image(camera)[..., :3].repeat(FINE, axis=0).repeat(FINE, axis=1)
            pixels |= rng.integers(0, 4, (HEIGHT, WIDTH, 1), np.uint8)
            Image.fromarray(pixels).save(folder / split / f"r_{i}.png", compress_level=1)
            pose = np.linalg.inv(camera.T_cam_world) @ np.diag([1.0, -1.0, -1.0, 1.0])
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
        text = json.dumps({"camera_angle_x": ANGLE, "frames": frames})
        (folder / f"transforms_{split}.json").write_text(text)


def group_of(process: str = "self") -> tuple[Path, str, str]:
    """Return the folder of a process's group, and the names of its limit and its peak."""
    for line in Path(f"/proc/{process}/cgroup").read_text().splitlines():
        _, controllers, path = line.split(":", 2)
        if "memory" in controllers.split(","):
            return Path("/sys/fs/cgroup/memory" + path), "memory.limit_in_bytes", "memory.max_usage_in_bytes"
    return Path("/sys/fs/cgroup" + path), "memory.max", "memory.peak"


def main(limit: int, words: list[str]) -> int:
    """Run the command in a group of so many bytes; its exit status."""
    parent, most, peak = group_of()
    group = parent / f"gs2d-{os.getpid()}"
    group.mkdir()
    try:
        (group / most).write_text(str(limit))
        began = time.monotonic()
        done = subprocess.Popen(words, preexec_fn=lambda: (group / "cgroup.procs").write_text(str(os.getpid())))
        status = done.wait()
        used = int((group / peak).read_text())
        print(f"status {status}, {time.monotonic() - began:.0f} s, peak of the group {used / 1e9:.2f} GB", flush=True)
        return status
    finally:
        group.rmdir()


if __name__ == "__main__":
    if sys.argv[1] == "--capture":
        write_photographs(Path(sys.argv[2]))
    else:
        sys.exit(main(int(float(sys.argv[1])), sys.argv[2:]))
