"""Measure the gain of `--learn intrinsics` on a capture with unknown lens distortion.

::

    python -m benchmarks.wrong_lens CAPTURE FOLDER [--downscale 4] [--scale 0.05] [--recipe 2dgs] [--seeds 0]

CAPTURE has a ``transforms.json`` with distortion coefficients. FOLDER gets a copy of that file without them, links to
the photographs, and the runs; finished runs are not repeated. The table is printed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

BENDS = ("k1", "k2", "k3", "k4", "p1", "p2")
WAYS = {
    "known": (True, ()),
    "known, `--learn poses`": (True, ("--learn", "poses")),
    "known, `--learn intrinsics`": (True, ("--learn", "intrinsics")),
    "none": (False, ()),
    "none, `--learn poses`": (False, ("--learn", "poses")),
    "none, focal length": (False, ("--learn", "intrinsics", "--set", "learned.intrinsics.options.distortion=false")),
    "none, `--learn intrinsics`": (False, ("--learn", "intrinsics")),
}


def without_lens(capture: Path, folder: Path) -> Path:
    """Return a copy of a capture without lens parameters."""
    copy = folder / "without-lens"
    copy.mkdir(parents=True, exist_ok=True)
    data = json.loads((capture / "transforms.json").read_text())
    for entry in (data, *data["frames"]):
        for name in BENDS:
            entry.pop(name, None)
    (copy / "transforms.json").write_text(json.dumps(data))
    for path in capture.iterdir():
        link = copy / path.name
        if path.name != "transforms.json" and not link.is_symlink():
            link.symlink_to(path.resolve())
    return copy


def run(capture: Path, out: Path, words: tuple[str, ...], args: argparse.Namespace, seed: int) -> Mapping[str, Any]:
    """Train and score one run unless it is finished, and return the figures of its last stage."""
    if not (out / "metrics.json").exists() or not (out / "mesh.ply").exists():
        command = ["train", str(capture), "--out", str(out), "--recipe", args.recipe, "--seed", str(seed)]
        command += ["--downscale", str(args.downscale), "--schedule-scale", str(args.scale), "--threads", "1"]
        subprocess.run([sys.executable, "-m", "gs2d", *command, *words, "--overwrite", "--quiet"], check=True)
        subprocess.run([sys.executable, "-m", "gs2d", "evaluate", str(out), "--match", "poses", "--quiet"], check=True)
    return dict(json.loads((out / "metrics.json").read_text())["stages"][-1])


def found(out: Path) -> str:
    """Describe the change of focal length and lens."""
    path = out / "poses.json"
    frames = json.loads(path.read_text())["frames"] if path.exists() else [{}]
    zoom = frames[0].get("zoom")
    if zoom is None:
        return ""
    lens = f", k1 {zoom[3]:+.4f}, k2 {zoom[4]:+.4f}" if len(zoom) > 3 else ""
    return f"x {zoom[0]:.4f}{lens}"


def main(arguments: list[str] | None = None) -> None:
    """Run missing trainings and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--downscale", type=int, default=4)
    parser.add_argument("--scale", type=float, default=0.05)
    parser.add_argument("--recipe", default="2dgs")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    args = parser.parse_args(arguments)
    lensless = without_lens(args.capture, args.folder)
    print("| lens | seed | test, as they are | test, aligned | training views | found |")
    print("|---|---|---|---|---|---|")
    for name, (known, words) in WAYS.items():
        for seed in args.seeds:
            slug = "".join(letter if letter.isalnum() else "-" for letter in name)
            out = args.folder / f"{slug}-{seed}"
            stage = run(args.capture if known else lensless, out, words, args, seed)
            figures = (f"{(stage.get(views) or {}).get('psnr', float('nan')):.2f} dB" for views in VIEWS)
            print(f"| {name} | {seed} | {' | '.join(figures)} | {found(out)} |", flush=True)


VIEWS = ("test", "test_aligned", "train")

if __name__ == "__main__":
    main()
