"""What the CUDA tests share: the emulator with all kernels, and the rasterizer tests' scenes on the path."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "render"))  # render_scenes

import emulate
import kernel_cases


@pytest.fixture(scope="session")
def emulator(tmp_path_factory: pytest.TempPathFactory) -> emulate.Emulator:
    """A launcher that runs the package's kernels on the CPU."""
    return emulate.Emulator(tmp_path_factory.mktemp("kernels"))


@pytest.fixture(scope="session")
def clear_cases() -> list[kernel_cases.Case]:
    """Small scenes in which no decision is within 1e-4 of its threshold."""
    return kernel_cases.cases_with_margins()
