"""The benchmark of tile lists, run on a toy capture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.flight import Flight, write_flight
from benchmarks.tile_lists import main

from gs2d.data import load_scene
from gs2d.io.splat_ply import write_splats
from gs2d.render import cuda_works
from render_scenes import random_splats


def test_pieces_shorten_the_work_of_the_busiest_warp(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_flight(tmp_path / "flown", Flight(12, width=32, height=32, points=100, seed=1))
    camera = load_scene(tmp_path / "flown").train[0].camera
    splats = random_splats(np.random.default_rng(2), camera, 400)
    write_splats(tmp_path / "splats.ply", splats)
    monkeypatch.setattr(cuda_works, "SHORTEST_PIECE", 32)
    assert main([str(tmp_path / "splats.ply"), f"{tmp_path / 'flown'}:1", "--views", "1"]) == 0
    rows = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[3:]]
    found = {(row[0], row[1]): [int(cell.replace(",", "")) for cell in row[2:]] for row in rows}
    for kind in ("forward", "backward"):
        whole, pieces = found[kind, "whole"], found[kind, "pieces"]
        assert 0 < pieces[0] < whole[0]
        assert pieces[1] == whole[1]
    assert found["backward", "whole"][1] <= found["forward", "whole"][1]
    assert main([str(tmp_path / "none.ply"), str(tmp_path / "flown")]) == 2
