"""The three commands of benchmarks/gpu, gone through without a GPU: emulated kernels, toy sizes."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from benchmarks.gpu import __main__ as command
from benchmarks.gpu import bench as bench_module
from benchmarks.gpu import correctness, kernels
from benchmarks.gpu.peers import activated
from benchmarks.gpu.scenes import gpu_scene

import tiny
from gs2d.kernels.cuda import launch
from gs2d.kernels.cuda.compile import KERNEL, compile_text

ROOT = Path(__file__).resolve().parents[2]
BIN = Path(sys.executable).parent
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
def test_a_real_capture_is_looked_at_in_the_course_of_its_training(tmp_path: Path) -> None:
    capture = tiny.write_capture(tmp_path / "ball")
    (rows,) = dry("real", tmp_path, "--capture", str(capture), "--schedule-scale", "0.0005").values()
    assert rows["size"] == [24, 24]
    parts = [rows[part] for part in ("0.1", "0.5", "0.9")]
    assert [row["iteration"] for row in parts] == [1, 5, 9]
    for row in parts:
        assert row["iteration_ms"] > 0
        assert all(longest <= pairs for longest, pairs in zip(row["longest_list"], row["pairs"], strict=True))


def test_correctness_compares_with_the_reference_and_says_what_each_tool_found(tmp_path: Path) -> None:
    results = dry("correctness", tmp_path)
    assert results["parity"]["images"]["color"]["median"] < 1e-6
    assert results["determinism"]["images_are_the_same_bits"] == dict.fromkeys(results["parity"]["images"], True)
    assert set(results["whole_steps"]["graph"].values()) == {0.0}  # the emulator adds up in one order
    assert results["memcheck"]["clean"]
    assert [line for line in results["memcheck"]["last_lines"] if line.startswith("not run:")]
    assert "collected" in results["tests"]["summary"]


def test_sanitizers_see_every_kernel(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["exercise", "--dry-run"]) == 0
    (not_run,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("not run:")]
    # Of images with more than 32767 tiles, which take too long where they are emulated:
    assert set(not_run.split()[2:]) == {"emit_entries_32", "find_ranges_32", "emit_sorted_32"}


def test_parts_can_be_chosen_and_each_is_in_the_file_as_soon_as_it_is_done(tmp_path: Path) -> None:
    found = dry("correctness", tmp_path, "--only", "ceil", "register")
    assert set(found) == {"ceilings", "registers"}


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


def test_parts_are_not_begun_once_the_time_is_up_and_the_file_says_so(tmp_path: Path) -> None:
    late = {"skipped": "out of time (--minutes)"}
    assert dry("correctness", tmp_path, "--only", "ceil", "parity", "--minutes", "0") == {
        "ceilings": late,
        "parity": late,
    }
    assert dry("kernels", tmp_path, "--minutes", "0") == {"60-32x16-A": {"measure_scene": late, "measure_peers": late}}


def test_a_scene_that_cannot_be_made_loses_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    def too_large(*_: Any) -> Any:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(kernels, "gpu_scene", too_large)
    monkeypatch.setattr(kernels, "installed", lambda name: True)
    seen: list[dict[str, Any]] = []
    found = kernels.run(bench_module.Bench(None, None, True), [], seen.append)  # type: ignore[arg-type]
    why = {"failed": "OutOfMemoryError: CUDA out of memory"}
    assert found == {"60-32x16-A": {"measure_scene": why, "measure_peers": why}}
    assert len(seen) == 2
    assert kernels.table(found) == ["60-32x16-A: iteration ? ms; {}; times faster than gsplat: ?, official: ?"]


def test_a_program_whose_time_is_up_ends_with_its_children_and_keeps_its_words(tmp_path: Path) -> None:
    alive = tmp_path / "alive"
    child = f"import time; time.sleep(2); open({str(alive)!r}, 'w')"
    parent = f"import subprocess, sys; print('begun'); subprocess.run([sys.executable, '-c', {child!r}])"
    done = bench_module.run_program([sys.executable, "-c", parent], seconds=1)
    assert (done.exit, done.lines) == (None, ["begun"])
    time.sleep(1.5)
    assert not alive.exists()
    done = bench_module.run_program([sys.executable, "-c", "import sys; sys.exit('no')"], seconds=60)
    assert (done.exit, done.lines) == (1, ["no"])


PYTEST_SAYS = """
tests/gpu/test_gpu.py::test_every_kernel_loads PASSED                    [ 10%]
tests/gpu/test_gpu.py::test_waits[one-FAILED] FAILED                     [ 20%]
tests/gpu/test_gpu.py::test_two_devices SKIPPED (one GPU)                [ 30%]
tests/gpu/test_gpu.py::test_a PASSED                                     [ 40%]
"""


def test_gpu_tests_are_counted_also_where_their_time_was_up(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = bench_module.Bench(None, None, False)  # type: ignore[arg-type]
    for code, last in ((1, "= 1 failed in 3 s ="), (None, "")):
        lines = [*PYTEST_SAYS.strip().splitlines(), *([last] if last else [])]
        monkeypatch.setattr(correctness, "run_program", lambda *_, **__: bench_module.Finished(code, lines))  # noqa: B023
        found = correctness.gpu_tests(bench)
        assert found["counts"] == {"passed": 2, "failed": 1, "skipped": 1}
        assert found["summary"] == (last or "its time was up")
        assert correctness.wrong({"tests": found})
    assert found["not_passed"] == [PYTEST_SAYS.splitlines()[2]]


def test_without_pytest_or_its_plugin_the_gpu_tests_still_have_an_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = bench_module.Bench(None, None, False)  # type: ignore[arg-type]
    commands: list[list[str]] = []

    def run(command: list[str], **_: Any) -> bench_module.Finished:
        commands.append(command)
        return bench_module.Finished(0, ["1 passed"])

    monkeypatch.setattr(correctness, "run_program", run)
    monkeypatch.setattr(correctness.importlib.util, "find_spec", lambda name: None if name == "pytest_timeout" else 1)
    assert correctness.gpu_tests(bench)["exit"] == 0
    # --timeout, which pyproject.toml gives, is an option of the plugin
    assert any(word.startswith("addopts=-ra") and "--timeout" not in word for word in commands[0])
    monkeypatch.setattr(correctness.importlib.util, "find_spec", lambda name: None)
    assert correctness.gpu_tests(bench) == {"skipped": "pytest is not installed here"}


def test_without_the_sanitizer_its_parts_are_skipped_and_a_toolkits_own_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("CUDA_HOME", str(tmp_path))
    if correctness.sanitizer() is None:  # none in /usr/local/cuda either
        bench = bench_module.Bench(None, None, False)  # type: ignore[arg-type]
        assert "compute-sanitizer" in correctness.sanitize(bench, "memcheck")["skipped"]
    tool = tmp_path / "bin" / "compute-sanitizer"
    tool.parent.mkdir()
    tool.touch(mode=0o755)
    assert correctness.sanitizer() == str(tool)


def test_a_python_that_cannot_run_it_is_told_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command.sys, "version_info", (3, 10, 12))
    assert command.main(["kernels"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: Python 3.11 or newer is needed")
    assert said.count("\n") == 1
    monkeypatch.undo()
    monkeypatch.setattr(command.importlib.util, "find_spec", lambda name: None if name in ("torch", "PIL") else 1)
    assert "lacks torch, PIL" in command.unfit()
    monkeypatch.setattr(command.importlib.util, "find_spec", lambda name: None if name == "gs2d" else 1)
    assert "does not find gs2d" in command.unfit()


def test_without_git_the_commit_is_what_the_environment_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert bench_module.commit().startswith("not known")
    monkeypatch.setenv("GS2D_COMMIT", "abc123")
    assert bench_module.commit() == "abc123"


def lent(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """The script for machines that are lent by the minute, in another folder than the checkout."""
    command = ["bash", str(ROOT / "benchmarks" / "gpu" / "lent.sh"), *arguments]
    settings = {**os.environ, **environment}
    return subprocess.run(command, env=settings, cwd="/", capture_output=True, text=True, timeout=200, check=False)


def test_the_script_for_lent_machines_says_how_to_call_it(tmp_path: Path) -> None:
    for arguments, word in (
        ((), "lent.sh 2 OUT [CAPTURE ...]"),
        (("4", str(tmp_path)), "lent.sh 1 OUT"),
        (("1",), "a folder"),
    ):
        done = lent(*arguments)
        assert done.returncode == 2
        assert word in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(torch.version.cuda is not None, reason="torch is built with CUDA here")
def test_a_python_without_a_gpus_torch_is_not_taken_and_the_reason_is_said(tmp_path: Path) -> None:
    done = lent("2", str(tmp_path), PATH=f"{BIN}:/usr/bin:/bin")
    assert done.returncode == 2
    assert "is built without CUDA" in done.stderr
    assert "error: lent.sh: no Python fits" in done.stderr
