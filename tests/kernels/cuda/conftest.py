"""What the CUDA tests share: the emulator with all kernels, and the rasterizer tests' scenes on the path."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import emulate
import fake_gpu
import fake_hip as fake_hip_module
import kernel_cases
from fake_hip import FakeHip
from gs2d.kernels.cuda import launch


@pytest.fixture(scope="session", params=[0, pytest.param(64, marks=pytest.mark.slow)], ids=["warps", "waves"])
def emulator(request: pytest.FixtureRequest) -> emulate.Emulator:
    """A launcher that runs the package's kernels on the CPU: in warps, and as AMD's GPUs do in waves of 64."""
    return emulate.Emulator(wave=request.param)


@pytest.fixture(scope="session")
def clear_cases() -> list[kernel_cases.Case]:
    """Small scenes in which no decision is within 1e-4 of its threshold."""
    return kernel_cases.cases_with_margins()


@pytest.fixture(scope="session")
def guard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a torch without CUDA needs to know of its devices: for processes of tests, because it stays."""
    root = Path(torch.__file__).parent
    if torch.version.cuda is not None:
        pytest.skip("torch is built with CUDA here: tests/gpu")
    if shutil.which("g++") is None or not (root / "include" / "c10").is_dir():
        pytest.skip("no g++ here, or this torch has no headers")
    library = tmp_path_factory.mktemp("guard") / "guard.so"
    source = library.with_suffix(".cpp")
    source.write_text(fake_gpu.GUARD)
    command = ["g++", "-std=c++20", "-O0", "-fPIC", "-shared", "-w", f"-I{root / 'include'}", str(source)]
    subprocess.run([*command, "-o", str(library), f"-L{root / 'lib'}", "-lc10"], check=True, timeout=90)
    return library


@pytest.fixture(scope="session")
def _hip(tmp_path_factory: pytest.TempPathFactory) -> FakeHip:
    return fake_hip_module.build(tmp_path_factory.mktemp("hip"))


@pytest.fixture
def fake_hip(_hip: FakeHip, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeHip]:
    """AMD's run-time library, as new."""
    monkeypatch.delenv(launch.STEP_VARIABLE, raising=False)
    _hip.library.fake_hip_forget()
    yield _hip
    _hip.run_by(None)
    errors, _hip.errors = _hip.errors, []
    assert not errors
