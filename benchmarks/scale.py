"""Check that peak memory of training, meshing and reporting does not depend on the number of photographs.

::

    python -m benchmarks.scale FOLDER [--photographs 100 400 1600 6400] [--size 96] [--splats 20000] [--memory GIB]

For each number, a flown capture (``benchmarks.flown_capture``) is made if missing. Training starts from ``--splats``
splats on the true surface. The run is then meshed and its report is written. Each step is a separate command. Memory is
the maximum resident sum of a command and its children, sampled fifty times a second. A hundred photographs show less of
the land's edge than thousands, and a larger surface takes more memory. ``--land`` therefore limits the land to the area
flown over, and ``--bbox`` also meshes a region that all captures show. The table is printed; figures are written to
``FOLDER/scale.json``.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.flight import Flight, write_flight
from gs2d.core.splats import Splats
from gs2d.data import load_scene
from gs2d.data.scene import PointCloud
from gs2d.errors import Gs2dError
from gs2d.io.meshes import read_mesh
from gs2d.io.splat_ply import write_splats
from gs2d.training.start.initialize import initial_splats

EVERY = 0.02  # s, sampling interval of memory
ITERATIONS_OF_ALL = 30_000  # of the recipe 2dgs


@dataclass(frozen=True)
class Measured:
    """One command: peak resident memory, MiB, and wall time, s."""

    photographs: int
    command: str
    mib: float
    seconds: float


def resident(process: int) -> int:
    """Return the resident bytes of a process and its children (Linux).

    A forked child that has not yet called exec (it has its parent's command line) shares its parent's pages and is
    skipped.
    """
    try:
        own = int(Path(f"/proc/{process}/statm").read_text().split()[1]) * 4096
        words = Path(f"/proc/{process}/cmdline").read_bytes()
        children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
        programs = [int(c) for c in children if Path(f"/proc/{c}/cmdline").read_bytes() != words]
    except (OSError, IndexError):
        return 0
    return own + sum(map(resident, programs))


def measure(photographs: int, name: str, arguments: list[str], log: Path) -> Measured:
    """Run a gs2d command and measure it.

    Raises
    ------
    RuntimeError
        If the command fails.
    """
    begun, peak = time.perf_counter(), 0
    with log.open("w") as file:
        process = subprocess.Popen([sys.executable, "-m", "gs2d", *arguments], stdout=file, stderr=subprocess.STDOUT)
        try:
            while process.poll() is None:
                peak = max(peak, resident(process.pid))
                time.sleep(EVERY)
        finally:
            process.kill()
            process.wait()
    if process.returncode not in (0, 3):
        raise RuntimeError(f"gs2d {name} of {photographs} photographs failed: {log.read_text()[-500:]}")
    return Measured(photographs, name, peak / 2**20, time.perf_counter() - begun)


def surface_splats(capture: Path, count: int) -> Splats:
    """Sample this many splats on the true surface, uniform by area, for every capture."""
    mesh = read_mesh(capture / "mesh_gt.ply")
    rng = np.random.default_rng(0)
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    face = rng.choice(len(area), size=count, p=area / area.sum())
    u, v = np.sqrt(rng.random((2, count, 1)))
    v = v**2
    places = (1 - u) * a[face] + u * (1 - v) * b[face] + u * v * c[face]
    scene = replace(load_scene(capture), points=PointCloud(places))
    generator = torch.Generator().manual_seed(0)
    found = initial_splats(scene, sh_degree=3, random_points=count, near=0.01, generator=generator, dtype=torch.float32)
    return found.splats


def train_arguments(capture: Path, run: Path, args: argparse.Namespace) -> list[str]:
    """Return the options of a short training with a fixed number of splats."""
    words = ["train", capture, "--out", run, "--overwrite", "--init", capture / "start.ply", "--recipe", "2dgs"]
    words += ["--robust", "off", "--set", "surface.densify=null", "--quiet"]
    words += ["--schedule-scale", args.iterations / ITERATIONS_OF_ALL, "--memory", args.memory]
    words += ["--threads", args.threads]
    return [str(word) for word in words]


def run_one(folder: Path, photographs: int, args: argparse.Namespace) -> list[Measured]:
    """Make a capture, train and mesh."""
    capture, run = folder / f"capture-{photographs}", folder / f"run-{photographs}"
    if not (capture / "sparse/0/cameras.bin").exists():
        flight = Flight(photographs, args.size, args.size * 3 // 4, points=args.splats, side=args.side, land=args.land)
        write_flight(capture, flight)
    if not (capture / "start.ply").exists():
        write_splats(capture / "start.ply", surface_splats(capture, args.splats))
    shutil.rmtree(run, ignore_errors=True)
    limits = ["--memory", str(args.memory), "--quiet"]
    log = folder / f"log-{photographs}.txt"
    found = [
        measure(photographs, "train", train_arguments(capture, run, args), log),
        measure(photographs, "mesh", ["mesh", str(run), "--scene", "--threads", str(args.threads), *limits], log),
    ]
    if args.bbox:
        words = ["mesh", str(run), "--out", str(folder / f"part-{photographs}.ply"), "--threads", str(args.threads)]
        words += ["--bbox", *map(str, args.bbox), *limits]
        found.append(measure(photographs, "mesh of a part", words, log))
    return found


def table(found: list[Measured]) -> str:
    """Return the figures as Markdown, a row per number of photographs."""
    names = list(dict.fromkeys(one.command for one in found))
    lines = ["| photographs | " + " | ".join(f"`{name}`" for name in names) + " |", "|---" * (len(names) + 1) + "|"]
    for count in dict.fromkeys(one.photographs for one in found):
        of = {one.command: one for one in found if one.photographs == count}
        cells = [f"{of[name].mib:.0f} MiB, {of[name].seconds:.0f} s" if name in of else "" for name in names]
        lines.append(f"| {count:,} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Run all measurements; return 2 for user errors, 1 if a command fails."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scale", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--photographs", type=int, nargs="+", default=[100, 400, 1600, 6400])
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument(
        "--side", type=float, default=200.0, help="side of the area flown over, m, for any number of photographs"
    )
    parser.add_argument("--land", type=float, help="side of the land, m, to limit it to the area flown over")
    parser.add_argument("--splats", type=int, default=20_000)
    parser.add_argument("--bbox", type=float, nargs=6, help="also mesh this box, which all captures show equally")
    parser.add_argument("--iterations", type=int, default=150)
    parser.add_argument("--memory", type=float, default=2.0, help="GiB, as in gs2d train")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args(arguments)
    found: list[Measured] = []
    try:
        args.folder.mkdir(parents=True, exist_ok=True)
        for photographs in args.photographs:
            found += run_one(args.folder, photographs, args)
            print(table(found), flush=True)
            (args.folder / "scale.json").write_text(json.dumps([asdict(one) for one in found], indent=1) + "\n")
    except (Gs2dError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
