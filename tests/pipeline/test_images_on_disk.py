"""Images that do not fit into memory: they are read from a temporary file, with the same results."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from benchmarks.flight import Flight, write_flight

from gs2d.config.presets import get_recipe
from gs2d.config.protocols import GENERIC
from gs2d.config.schedule import scale_schedule
from gs2d.data import load_scene
from gs2d.training.trainer import Trainer

FLIGHT = Flight(12, width=64, height=48, points=6000, seed=1)
COARSE = replace(GENERIC, fusion=replace(GENERIC.fusion, voxel=3.0, truncation=15.0))  # m; fusion is not tested


@pytest.mark.parametrize("recipe", ["2dgs-r", "best"])
def test_images_in_a_file_give_the_same_splats(tmp_path: Path, recipe: str) -> None:
    write_flight(tmp_path / "capture", FLIGHT)
    whole = load_scene(tmp_path / "capture", test_every=0)
    small = load_scene(tmp_path / "capture", test_every=0, cache_bytes=3 * 64 * 48 * 3)
    assert (whole.ahead, small.ahead) == (0, 8)
    short = scale_schedule(get_recipe(recipe), 0.0005)
    found = [Trainer(scene, short, COARSE, backend="auto").run() for scene in (small, whole)]
    for (name, one), (_, other) in zip(found[0].items(), found[1].items(), strict=True):
        assert torch.equal(one, other), name
    assert small.train[0].cache.nbytes <= 3 * 64 * 48 * 3
