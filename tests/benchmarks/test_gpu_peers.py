"""The comparison of rasterizers on a capture, without a GPU: stand-ins draw with our reference."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from benchmarks.gpu import __main__ as command
from benchmarks.gpu import beside
from benchmarks.gpu.peers import PEERS

import peer_twins

pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="no g++ here, which runs the CUDA kernels")


def measured(folder: Path, *more: str) -> dict[str, Any]:
    """Results of the command in a folder."""
    out = folder / "gpu_peers.json"
    assert command.main(["peers", "--dry-run", "--out", str(out), "--runs", str(folder / "splats"), *more]) == 0
    results: dict[str, Any] = json.loads(out.read_text())["results"]
    return results


@pytest.fixture
def twins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install the stand-ins for child processes."""
    folder = peer_twins.write_packages(tmp_path / "packages")
    root = Path(beside.__file__).parents[2]
    places = [folder, Path(peer_twins.__file__).parent, root, root / "src"]
    monkeypatch.setenv("PYTHONPATH", ":".join(map(str, places)))


@pytest.mark.slow
@pytest.mark.usefixtures("twins")
def test_all_rasterizers_draw_the_same_splats_of_a_capture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A crash of one is recorded and ends no other; a second call measures only what is missing."""
    monkeypatch.setenv("FASTGS_CRASHES", "1")
    found = measured(tmp_path, "--trainer", "theirs=echo trained on {capture}", "broken=false {out}")
    assert list(found) == ["gs2d", *PEERS, "theirs", "broken"]
    assert "its process ended with 9" in found["fastgs"]["failed"]
    assert found["theirs"]["last_lines"][0].startswith("trained on /")
    assert found["broken"]["exit"] == 1
    ours = found["gs2d"]
    assert ours["training"]["seconds"] > 0
    for name in ("gsplat", "gsplat_3dgs", "official", "faster_gs"):
        for part in ("0.1", "0.5", "1"):
            row = found[name][part]
            assert row["splats"] == ours[part]["splats"]
            assert row["psnr"] == pytest.approx(ours[part]["psnr"], abs=0.02)
            assert row["iteration_ms"]["median"] > 0

    monkeypatch.delenv("FASTGS_CRASHES")
    capsys.readouterr()
    again = measured(tmp_path, "--only", "gs", "--minutes", "5")
    assert again["gsplat"] == found["gsplat"]
    assert again["gs2d"] == ours
    assert again["fastgs"]["1"]["psnr"] == pytest.approx(ours["1"]["psnr"], abs=0.02)
    assert "fastgs: " in capsys.readouterr().out


def test_what_is_not_installed_or_has_no_time_left_is_named(tmp_path: Path) -> None:
    found = measured(tmp_path, "--minutes", "0")
    assert set(found) == {"gs2d", *PEERS}
    assert {row["skipped"] for row in found.values()} == {"out of time (--minutes)"}
    assert "gsplat is not installed here" in measured(tmp_path, "--one", "gsplat_3dgs")["gsplat_3dgs"]["failed"]
