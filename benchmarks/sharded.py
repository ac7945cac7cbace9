"""Memory of each process, and what they send each other, where a scene's splats are sharded over several.

::

    python -m benchmarks.sharded FOLDER [--splats 400000] [--processes 1 2 4] [--photographs 100] [--iterations 12]

A flown capture (``benchmarks.flown_capture``; made where it is not there) is trained on from so many splats on its
true surface, of which no photograph shows more than a small part, with one densification in the middle. With one
process that is a training as ever; with more, once with all splats in each, and once sharded. Each process reports
what it has resident during iterations beyond what it had before there were splats, as the largest figure that Linux
saw, and the bytes that it gave to others for views. The table goes to standard output, figures to
``FOLDER/sharded.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gs2d.config.presets import two_dgs
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import GradDensify, Recipe
from gs2d.core.splats import Splats
from gs2d.data import load_scene
from gs2d.pipeline.processes import connected
from gs2d.synthetic.flight import Flight, write_flight
from gs2d.training.parallel import OneProcess
from gs2d.training.shards import Shards
from gs2d.training.trainer import Trainer

MIB = 2**20
KINDS = ("replicated", "sharded")


class Counting(Shards):
    """Shards that count the bytes that this process gives to others for views: records, and what comes back."""

    given = 0

    def exchanged(self, sent: Tensor, to: Sequence[int], of: Sequence[int]) -> Tensor:
        """Count, and exchange."""
        row = sent[:1].numel() * sent.element_size()
        self.given += row * (sum(to) - to[self.place.rank])
        return super().exchanged(sent, to, of)

    def settle(self, *given: Any) -> None:
        """Exchange rows, which does not count."""
        before = self.given
        super().settle(*given)
        self.given = before


def resident(peak: bool = False) -> int:
    """Bytes that this process has in memory, or has had at most since the last ``forget_peak`` (Linux)."""
    name = "VmHWM:" if peak else "VmRSS:"
    (line,) = [x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith(name)]
    return int(line.split()[1]) * 1024


def forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def recipe(iterations: int) -> Recipe:
    """2DGS with one densification in the middle, from which few splats come."""
    first = two_dgs().stages[0]
    densify = GradDensify(every=max(1, iterations // 2), start=1, stop=iterations, reset_every=0, grad_threshold=1.0)
    return Recipe("sharded", (replace(first, iterations=iterations, densify=densify, sh_interval=1),))


def scattered(folder: Path, count: int) -> Splats:
    """So many splats on the true surface, of about the size that leaves no holes."""
    from gs2d.io.meshes import read_mesh

    mesh = read_mesh(folder / "mesh_gt.ply")
    generator = torch.Generator().manual_seed(0)
    corners = torch.from_numpy(mesh.vertices[mesh.faces]).float()  # [F, 3, 3]
    areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1) / 2
    faces = torch.multinomial(areas, count, replacement=True, generator=generator)
    weights = torch.distributions.Exponential(1.0).sample((count, 3))
    weights = weights / weights.sum(dim=1, keepdim=True)
    size = float((areas.sum() / count).sqrt())
    return Splats(
        means=(corners[faces] * weights[:, :, None]).sum(dim=1),
        quats=torch.randn(count, 4, generator=generator),
        log_scales=torch.full((count, 2), size).log(),
        opacity_logits=torch.full((count,), -1.0),
        sh0=torch.randn(count, 1, 3, generator=generator),
        shN=0.1 * torch.randn(count, 15, 3, generator=generator),
    )


def work(folder: Path, kind: str, splats: int, iterations: int, out: Path) -> None:
    """Train in this process, alone or with others, and write what it took."""
    torch.set_num_threads(1)
    with connected("cpu") as found:
        scene = load_scene(folder)
        together: OneProcess = Counting(found.place) if kind == "sharded" else found
        before = resident()
        init = scattered(folder, splats) if found.leads else None
        trainer = Trainer(
            scene, recipe(iterations), GENERIC, backend="cpu", init=init, processes=together, target_bytes=0
        )
        trainer._stop_telling()
        del init
        trainer.enter(0)
        forget_peak()
        begun, given = time.process_time(), getattr(together, "given", 0)
        while trainer.state.step < iterations:
            trainer.step()
        facts = {
            "rank": found.place.rank,
            "mib": (resident(peak=True) - before) / MIB,
            "cpu_seconds_a_view": (time.process_time() - begun) / iterations,
            "mib_given_a_view": (getattr(together, "given", 0) - given) / iterations / MIB,
            "splats": trainer.state.count,
        }
        (out / f"{kind}.{found.place.size}.{found.place.rank}.json").write_text(json.dumps(facts))


def launched(words: Sequence[str], size: int) -> None:
    """Run this program in so many processes that find each other."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    processes = []
    for rank in range(size):
        said = {"RANK": rank, "WORLD_SIZE": size, "LOCAL_RANK": rank, "LOCAL_WORLD_SIZE": size, "MASTER_PORT": port}
        place = {name: str(value) for name, value in said.items()} if size > 1 else {}
        environment = {**os.environ, "MASTER_ADDR": "127.0.0.1", "OMP_NUM_THREADS": "1", **place}
        processes.append(subprocess.Popen([sys.executable, "-m", "benchmarks.sharded", *words], env=environment))
    if any([process.wait() for process in processes]):
        raise SystemExit(2)


def main() -> None:
    """Make the capture, measure, print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sharded", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--splats", type=int, default=400_000)
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--photographs", type=int, default=100)
    parser.add_argument("--size", type=int, default=160, help="px")
    parser.add_argument("--iterations", type=int, default=12, help="of the schedule: views")
    parser.add_argument("--work", choices=KINDS, help="be one of the processes")
    args = parser.parse_args()
    if args.work:
        work(args.folder / "capture", args.work, args.splats, args.iterations, args.folder)
        return
    if not (args.folder / "capture" / "mesh_gt.ply").exists():
        flight = Flight(args.photographs, width=args.size, height=args.size * 3 // 4, points=2000)
        write_flight(args.folder / "capture", flight, threads=1)
    rows = []
    for size in args.processes:
        for kind in KINDS if size > 1 else KINDS[:1]:
            words = [str(args.folder), "--splats", args.splats, "--iterations", args.iterations, "--work", kind]
            launched(list(map(str, words)), size)
            found = [json.loads((args.folder / f"{kind}.{size}.{r}.json").read_text()) for r in range(size)]
            rows.append({"processes": size, "kind": kind, "ranks": found})
    (args.folder / "sharded.json").write_text(json.dumps({"splats": args.splats, "rows": rows}, indent=1) + "\n")
    print("| processes | splats in each | MiB of each | MiB given a view, of each | CPU s a view, in all |")
    print("|---|---|---|---|---|")
    for row in rows:
        ranks, size = row["ranks"], row["processes"]
        each = ", ".join(f"{one['mib']:,.0f}" for one in ranks)
        given = max(one["mib_given_a_view"] for one in ranks)
        kept = "a part" if row["kind"] == "sharded" else "all"
        seconds = sum(one["cpu_seconds_a_view"] for one in ranks)
        print(f"| {size} | {kept} | {each} | {given:.2f} | {seconds:.2f} |")


if __name__ == "__main__":
    main()
