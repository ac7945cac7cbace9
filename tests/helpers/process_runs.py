"""Short ``gs2d train`` runs in several processes, started directly or by torchrun."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import together_run
from together import ended, launch

ITERATIONS = 12  # one stage, with densification, in batches of two views
SMALL = (
    *("--recipe", "2dgs", "--quiet", "--threads", "1", "--checkpoint-every", "4", "--set", "init_points=80"),
    *(
        "--set",
        f"surface.iterations={ITERATIONS}",
        "--set",
        "surface.densify.start=2",
        "--set",
        "surface.densify.every=5",
    ),
    *("--set", "surface.densify.stop=11", "--set", "surface.densify.max_splats=120"),
    *("--set", "surface.densify.opacity_cull=0.001", "--set", "surface.densify.scale_cull_start=100000"),
)


def words(capture: Path, out: Path, *more: str) -> list[str]:
    """Return the command line."""
    return ["train", str(capture), "--out", str(out), *SMALL, *more]


def in_processes(size: int, command: Sequence[str], *before: str) -> list[tuple[int, str]]:
    """Run a command in ``size`` processes; return exit code and stderr of each."""
    return ended(launch(size, [together_run.__file__, *before, *command]))


def torchrun(*command: str) -> subprocess.CompletedProcess[str]:
    """Run a command with the real launcher."""
    program = [sys.executable, "-m", "torch.distributed.run", "--standalone", *command]
    own = {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(program, env={**os.environ, **own}, capture_output=True, text=True, check=False)
