"""Real captures as workloads: read from finished runs, skipped with a reason, compared at equal visible pairs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmarks import real
from benchmarks.room_capture import room_splats, write_room_capture

from gs2d.io.splat_ply import write_splats
from gs2d.kernels.library import available_variants

pytestmark = pytest.mark.skipif(not available_variants(), reason="the native library was not built")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on a small capture, as far as a workload reads it."""
    folder = tmp_path_factory.mktemp("real")
    write_room_capture(folder / "capture", views=5, size=(192, 128), splats=3000, points=400)
    run = folder / "run"
    run.mkdir()
    write_splats(run / "splats.ply", room_splats(1500, 3)[0])
    scene = {"name": "capture", "path": str(folder / "capture")}
    (run / "run.json").write_text(json.dumps({"scene": scene, "downscale": 2, "title": "den"}))
    return run


def test_iterations_are_compared_at_equal_visible_pairs(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(real, "BENCH_SPLATS", 700)
    out = tmp_path / "real.json"
    assert real.main(["--out", str(out), "--runs", str(finished), str(tmp_path / "no"), "--rounds", "2"]) == 0
    document = json.loads(out.read_text())
    assert list(document["skipped"]) == ["no"]
    (row,) = document["rows"]
    assert set(row["rooms"]) == {"1500", "700"}
    for room in row["rooms"].values():
        assert room["visible_pairs"] == pytest.approx(row["visible_pairs"], rel=0.08)  # pictures of whole pixels
    assert list(row["stages"]) == list(real.STAGES)
    for stage in row["stages"].values():
        assert set(stage["ratio"]) == {"1500", "700"}
        assert min(stage["cpu_ms"].values()) > 0
