"""Fixtures for all tests: where the real captures are, one torch thread, and what saves minutes of the whole."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from gs2d.errors import BackendError
from gs2d.kernels.library import load
from gs2d.report import plots

CURVES_ARE_LOOKED_AT = ("report", "contrib/lab/test_figures.py")


def pytest_collection_finish() -> None:
    """What collection left is never garbage: each of the collections that training asks for took half a second."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def curves(request: pytest.FixtureRequest) -> Iterator[None]:
    """Draw the curves of a report only where a test looks at them: they are half of the time of a run of seconds."""
    name = request.path.relative_to(Path(__file__).parent).as_posix()
    with pytest.MonkeyPatch.context() as patch:
        if not name.startswith(CURVES_ARE_LOOKED_AT):
            patch.setattr(plots, "_figure", lambda *_, **__: "<svg></svg>")
        yield


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
