"""Fixtures for all tests: the folder of the real captures, one torch thread, and shortcuts that save minutes."""

from __future__ import annotations

import functools
import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch

from gs2d.contrib.demo import demo_capture
from gs2d.contrib.demo.shapes import Patch
from gs2d.errors import BackendError
from gs2d.kernels.library import load
from gs2d.report import first_screen, plots

PICTURES_MATTER = ("report", "contrib/lab/test_figures.py")
DEMO_IS_TESTED = ("contrib/demo",)


def pytest_collection_finish() -> None:
    """Freeze what collection left, so that the garbage collections of each run do not visit it."""
    gc.collect()
    gc.freeze()


def _tests_of(request: pytest.FixtureRequest, folders: tuple[str, ...]) -> bool:
    return request.path.relative_to(Path(__file__).parent).as_posix().startswith(folders)


@pytest.fixture(scope="module", autouse=True)
def cheap_reports(request: pytest.FixtureRequest) -> Iterator[None]:
    """Draw the curves and the mesh of a report only where a test looks at them: half of the time of a tiny run."""
    with pytest.MonkeyPatch.context() as patch:
        if not _tests_of(request, PICTURES_MATTER):
            patch.setattr(plots, "_figure", lambda *_, **__: "<svg></svg>")
            patch.setattr(first_screen, "mesh_view", lambda *_: "no mesh")
        yield


_light: dict[Patch, demo_capture.BakedLight] = {}
_demo_scene = functools.cache(demo_capture.build_scene)


@pytest.fixture(scope="module", autouse=True)
def cheap_demo_captures(request: pytest.FixtureRequest) -> Iterator[None]:
    """Bake the light of the demo scene once per process: 4 s. Its own tests bake it each time."""
    bake = demo_capture.bake

    def baked(surface: Patch, *, threads: int) -> demo_capture.BakedLight:
        if surface not in _light:
            _light[surface] = bake(surface, threads=threads)
        return _light[surface]

    with pytest.MonkeyPatch.context() as patch:
        if not _tests_of(request, DEMO_IS_TESTED):
            patch.setattr(demo_capture, "build_scene", _demo_scene)
            patch.setattr(demo_capture, "bake", baked)
        yield


@pytest.fixture(scope="session", autouse=True)
def one_torch_thread() -> None:
    """Use one thread: tests run in parallel processes."""
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
