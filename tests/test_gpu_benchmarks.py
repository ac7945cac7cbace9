"""The three commands of benchmarks/gpu, gone through without a GPU: emulated kernels, toy sizes."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.gpu import __main__ as command
from benchmarks.gpu import bench as bench_module
from benchmarks.gpu import correctness
from benchmarks.gpu.peers import activated
from benchmarks.gpu.scenes import gpu_scene

from gs2d.kernels.cuda import launch
from gs2d.kernels.cuda.compile import KERNEL, compile_text

ROOT = Path(__file__).resolve().parents[1]
pytestmark = [
    pytest.mark.timeout(280),
    pytest.mark.skipif(shutil.which("g++") is None, reason="no g++ here, which runs the CUDA kernels on the CPU"),
]


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
def test_training_goes_the_whole_way_and_reports_each_stage(tmp_path: Path) -> None:
    (run,) = dry("training", tmp_path).values()
    assert [stage["name"] for stage in run["stages"]] == ["surface", "appearance", "refine"]
    assert run["training_seconds"] <= run["all_seconds"]
    assert all(stage["test"]["psnr"] for stage in run["stages"])


@pytest.mark.slow
def test_correctness_compares_with_the_reference_and_runs_every_kernel(tmp_path: Path) -> None:
    results = dry("correctness", tmp_path)
    assert results["parity"]["images"]["color"]["median"] < 1e-6
    assert results["determinism"]["images_are_the_same_bits"] == dict.fromkeys(results["parity"]["images"], True)
    assert results["memcheck"]["clean"]
    (not_run,) = [line for line in results["memcheck"]["last_lines"] if line.startswith("not run:")]
    wide = {"emit_entries_32", "find_ranges_32"}  # of images with more than 32767 tiles: too long emulated
    assert set(not_run.split()[2:]) == wide
    assert "collected" in results["tests"]["summary"]


def test_parts_can_be_chosen_and_each_is_in_the_file_as_soon_as_it_is_done(tmp_path: Path) -> None:
    assert set(dry("correctness", tmp_path, "--only", "ceil", "register")) == {"ceilings", "registers"}


@pytest.mark.parametrize(
    ("part", "wrong"),
    [({"clean": True, "exit": 0}, 0), ({"skipped": "no tool"}, 0), ({"clean": False}, 1), ({"exit": 1}, 1)],
)
def test_what_is_wrong_on_a_gpu_is_the_exit_status(part: dict[str, Any], wrong: int) -> None:
    assert correctness.wrong({"registers": {"architecture": "sm_90"}, "memcheck": part}) == bool(wrong)
    assert correctness.wrong({"parity": {"failed": "RuntimeError: no"}})


def test_a_failing_part_is_recorded_and_loses_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    def broken() -> dict[str, Any]:
        raise RuntimeError("CUDA error: out of memory\nmore words")

    assert bench_module.attempt("kernels", broken) == {"failed": "RuntimeError: CUDA error: out of memory"}
    assert "kernels: RuntimeError" in capsys.readouterr().err


def test_scene_b_is_more_elongated_and_more_spread_than_scene_a() -> None:
    a, b = (gpu_scene(4000, 64, 48, spread, torch.device("cpu")).splats for spread in "AB")
    assert b.log_scales.std() > 1.5 * a.log_scales.std()
    stretch = [float((s.log_scales[:, 0] - s.log_scales[:, 1]).std()) for s in (a, b)]
    assert stretch[1] > 1.3 * stretch[0]
    assert torch.equal(a.means, b.means)


def test_peers_get_activated_parameters() -> None:
    splats = gpu_scene(40, 64, 48, "A", torch.device("cpu")).splats
    given = activated(dict(splats.items()))
    assert torch.allclose(given["quats"].norm(dim=1), torch.ones(40))
    assert torch.allclose(given["scales"], splats.scales)
    assert given["sh"].shape == (40, 16, 3)
    assert float(given["opacities"].max()) < 1


def test_the_probes_compile_for_the_newest_and_the_oldest_architecture() -> None:
    pytest.importorskip("cuda.bindings", reason="cuda-bindings is not here")
    text = (ROOT / "benchmarks" / "gpu" / "probes.cu").read_text()
    for arch in ("sm_75", "sm_120"):
        usage = compile_text(text, "probes.cu", arch).usage()
        assert set(usage) == set(KERNEL.findall(text)) == {"probe_fma", "probe_shuffle", "probe_exp2", "probe_red"}
        assert all(used.spilled_bytes == 0 for used in usage.values())
