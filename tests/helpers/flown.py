"""A tiny aerial capture, and options that make `gs2d blocks` take seconds on it."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.flight import Flight, write_flight

from gs2d.contrib.lab.lab_options import BlocksOptions

WORDS = (
    "surface.densify.start=3",
    "surface.densify.stop=14",
    "surface.densify.every=4",
    "surface.densify.reset_every=0",
)


def write_tiny_flight(folder: Path, photographs: int = 12) -> Path:
    """Write 32x24 images that cover 120 m of land."""
    write_flight(folder, Flight(photographs, width=32, height=24, points=400, side=120.0), threads=1)
    return folder


PARTITION = ("partition.min_views=3", "partition.coarse.schedule=0.5")
CHANGES = (*WORDS, "surface.densify.max_splats=600", *PARTITION)


def tiny_blocks(capture: Path, out: Path, **changes: Any) -> BlocksOptions:
    """Return options for 2x2 blocks of 18 iterations each."""
    options = BlocksOptions(
        scene=capture,
        out=out,
        blocks="2x2",
        recipe="2dgs",
        robust="off",
        schedule_scale=0.0006,
        overrides=CHANGES,
        backend="cpu",
        threads=1,
        page=False,
        checkpoint_every=4,
    )
    return replace(options, **changes)


def digest(path: Path) -> str:
    """Return the hash of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
