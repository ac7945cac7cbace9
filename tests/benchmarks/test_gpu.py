"""The three commands of benchmarks/gpu, gone through without a GPU: emulated kernels, toy sizes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from benchmarks.gpu import __main__ as command
from benchmarks.kernel_usage import usage_of

from gs2d.kernels.cuda import launch
from gs2d.kernels.cuda.compile import KERNEL, compile_text
from gs2d.render import pair_budget

ROOT = Path(__file__).resolve().parents[2]
pytestmark = [
    pytest.mark.skipif(shutil.which("g++") is None, reason="no g++ here, which runs the CUDA kernels on the CPU"),
]


@pytest.fixture(autouse=True)
def little_room_for_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Round the room for pairs up to 512, not 65,536: the emulator sorts all of it."""
    monkeypatch.setattr(pair_budget, "STEP", 512)


def dry(name: str, folder: Path, *more: str) -> dict[str, Any]:
    """The results of a command."""
    out = folder / "out.json"
    assert command.main([name, "--dry-run", "--out", str(out), *more]) == 0
    document = json.loads(out.read_text())
    assert document["machine"]["dry_run"] is True
    assert not out.with_suffix(".part").exists()
    results: dict[str, Any] = document["results"]
    return results


def test_kernels_are_timed_by_name_beside_whole_iterations_and_the_reason_for_missing_peers(tmp_path: Path) -> None:
    before = launch.launcher_for
    (scene,) = dry("kernels", tmp_path).values()
    assert {"project_splats", "blend_forward_distortion", "blend_vjp_geometry", "splat_errors"} <= set(
        scene["kernels_ms"]
    )
    assert scene["counts"]["visits"] <= scene["counts"]["halves"] <= 2 * scene["counts"]["visits"]
    assert scene["counts"]["visits"] > 0
    assert {"surface", "appearance", "refine"} <= set(scene["iteration"])
    assert {"photometric_vjp", "normal_consistency", "adam_step"} <= set(scene["iteration"]["surface_kernels_ms"])
    for peer in ("gsplat", "official"):
        assert "is not installed here" in scene[peer].get("failed", "") or "skipped" in scene[peer]
    assert launch.launcher_for is before  # the emulator is gone again


@pytest.mark.slow
def test_correctness_compares_with_the_reference_and_says_what_each_tool_found(tmp_path: Path) -> None:
    results = dry("correctness", tmp_path)
    assert results["parity"]["images"]["color"]["median"] < 1e-6
    assert results["determinism"]["images_are_the_same_bits"] == dict.fromkeys(results["parity"]["images"], True)
    assert set(results["whole_steps"]["graph"].values()) == {0.0}  # the emulator adds up in one order
    assert results["memcheck"]["clean"]
    assert [line for line in results["memcheck"]["last_lines"] if line.startswith("not run:")]
    assert "collected" in results["tests"]["summary"]


def test_the_probes_compile_for_the_newest_and_the_oldest_architecture() -> None:
    pytest.importorskip("cuda.bindings", reason="cuda-bindings is not here")
    text = (ROOT / "benchmarks" / "gpu" / "probes.cu").read_text()
    for arch in ("sm_75", "sm_120"):
        usage = usage_of(compile_text(text, "probes.cu", arch))
        assert set(usage) == set(KERNEL.findall(text)) == {"probe_fma", "probe_shuffle", "probe_exp2", "probe_red"}
        assert all(used.spilled_bytes == 0 for used in usage.values())


def test_parts_are_not_begun_once_the_time_is_up_and_the_file_says_so(tmp_path: Path) -> None:
    late = {"skipped": "out of time (--minutes)"}
    assert dry("correctness", tmp_path, "--only", "ceil", "parity", "--minutes", "0") == {
        "ceilings": late,
        "parity": late,
    }
    assert dry("kernels", tmp_path, "--minutes", "0") == {"60-32x16-A": {"measure_scene": late, "measure_peers": late}}
