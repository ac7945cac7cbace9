"""Fixtures for all tests: where the real captures are, and one torch thread."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from gs2d.errors import BackendError
from gs2d.kernels.library import load


@pytest.fixture(scope="session", autouse=True)
def one_torch_thread() -> None:
    """Tests run in parallel processes: one thread each."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of the real captures: $GS2D_TEST_DATA, or ``../shared/data`` beside the repository; else skip."""
    named = os.environ.get("GS2D_TEST_DATA")
    root = Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"
    if not root.is_dir():
        pytest.skip(f"no real captures in {root}; set GS2D_TEST_DATA to their folder")
    return root


@pytest.fixture(scope="session")
def shared(data_root: Path) -> Callable[[str], Path]:
    """``shared("fox_instant_ngp")`` is the folder of one real capture, or the test is skipped."""

    def find(name: str) -> Path:
        folder = data_root / name
        if not folder.exists():
            pytest.skip(f"the capture {name} is not in {data_root}")
        return folder

    return find


@pytest.fixture
def native() -> None:
    """Skip where the native library is not built."""
    try:
        load()
    except BackendError as error:
        pytest.skip(str(error))
