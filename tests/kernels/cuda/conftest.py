"""Fixtures of the CUDA tests: scenes with a margin, and a device guard for torch without CUDA."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import fake_gpu
import kernel_cases
from gs2d.render import pair_budget


@pytest.fixture(scope="session", autouse=True)
def little_room_for_pairs() -> Iterator[None]:
    """Round the pair capacity up to 512 instead of 65,536: the emulator sorts all of it, which dominates run time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pair_budget, "STEP", 512)
        yield


@pytest.fixture(scope="session")
def clear_cases() -> list[kernel_cases.Case]:
    """Return small scenes in which no decision is within 1e-4 of its threshold."""
    return kernel_cases.cases_with_margins()


@pytest.fixture(scope="session")
def guard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the device guard that torch without CUDA lacks; it stays loaded, so use it only in subprocesses."""
    root = Path(torch.__file__).parent
    if torch.version.cuda is not None:
        pytest.skip("torch is built with CUDA here: tests/gpu")
    if shutil.which("g++") is None or not (root / "include" / "c10").is_dir():
        pytest.skip("no g++ here, or this torch has no headers")
    library = tmp_path_factory.mktemp("guard") / "guard.so"
    source = library.with_suffix(".cpp")
    source.write_text(fake_gpu.GUARD)
    command = ["g++", "-std=c++20", "-O0", "-fPIC", "-shared", "-w", f"-I{root / 'include'}", str(source)]
    subprocess.run([*command, "-o", str(library), f"-L{root / 'lib'}", "-lc10"], check=True)
    return library
