"""Diagnosis of an unavailable CUDA backend: causes in the order in which to fix them, with instructions."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

import fake_driver
from fake_driver import FakeDriver
from gs2d.errors import BackendError
from gs2d.kernels.cuda import compile as nvrtc
from gs2d.kernels.cuda import diagnose
from gs2d.kernels.cuda.driver import own_default_stream
from gs2d.render.backends import backend_report, get_backend

DIAGNOSE = "gs2d.kernels.cuda.diagnose"
H200 = [("NVIDIA H200", (9, 0))]


def says(answer: object) -> Callable[..., object]:
    """Return a function with this answer; an error is raised."""

    def function(*_: object) -> object:
        if isinstance(answer, Exception):
            raise answer
        return answer

    return function


# Everything is broken; each row of the table fixes one more cause.
BROKEN = {
    "torch.version.cuda": None,
    f"{DIAGNOSE}.load_driver": says(BackendError("the Python package cuda.bindings is missing (no module); x")),
    f"{DIAGNOSE}.nvrtc.nvrtc_version": says(BackendError("the CUDA compiler NVRTC is missing (no library); x")),
    f"{DIAGNOSE}.driver_version": says(BackendError("no NVIDIA driver is installed (no libcuda); install NVIDIA's")),
    f"{DIAGNOSE}.torch.cuda.is_available": says(False),
    f"{DIAGNOSE}.nvrtc.architecture_for": says(BackendError("the GPU is too old; use --backend cpu")),
    f"{DIAGNOSE}.own_default_stream": says(False),
}
MENDING = (
    ({}, "torch .* is built without CUDA; .*CUDA build of torch"),
    ({"torch.version.cuda": "11.8"}, "torch is built for CUDA 11.8, CUDA 12 or newer is needed; .*for CUDA 12 or 13"),
    (
        {"torch.version.cuda": "13.0"},
        r"cuda.bindings is missing \(no module\); pip install 'cuda-bindings>=13,<14' .*\(the extra cuda13;",
    ),
    ({f"{DIAGNOSE}.load_driver": says(None)}, r"NVRTC is missing \(no library\); .*'nvidia-cuda-nvrtc>=13,<14'"),
    ({f"{DIAGNOSE}.nvrtc.nvrtc_version": says((13, 0))}, "no NVIDIA driver is installed"),
    ({f"{DIAGNOSE}.driver_version": says((12, 4))}, "driver supports CUDA 12.4, but torch needs CUDA 13.0; update"),
    ({"torch.version.cuda": "12.8"}, "driver supports CUDA 12.4, but NVRTC needs CUDA 13.0; update"),
    ({f"{DIAGNOSE}.nvrtc.nvrtc_version": says((12, 9))}, "torch sees no CUDA device.*; .*CUDA_VISIBLE_DEVICES"),
    ({f"{DIAGNOSE}.visible_devices": says(H200)}, "NVIDIA H200: the GPU is too old; use --backend cpu"),
)


def test_each_missing_piece_is_named_in_order_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    for place, value in BROKEN.items():
        monkeypatch.setattr(place, value)
    for change, line in MENDING:
        for place, value in change.items():
            monkeypatch.setattr(place, value)
        with pytest.raises(BackendError, match=line):
            diagnose.machine()
    monkeypatch.setattr(f"{DIAGNOSE}.nvrtc.architecture_for", says("sm_90"))
    assert diagnose.machine().startswith("NVIDIA H200 (sm_90); driver CUDA 12.4, NVRTC 12.9")
    monkeypatch.setattr(f"{DIAGNOSE}.own_default_stream", says(True))
    with pytest.raises(BackendError, match=r"CUDA_PYTHON_CUDA_PER_THREAD_DEFAULT_STREAM is set.*; unset it"):
        diagnose.machine()


@pytest.mark.parametrize(("value", "refused"), [(None, False), ("0", False), ("1", True)])
def test_bindings_that_mean_another_default_stream_than_torch_are_refused(
    value: str | None, refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kernels would run concurrently with torch's sorts: occasional wrong images, and no error."""
    name = "CUDA_PYTHON_CUDA_PER_THREAD_DEFAULT_STREAM"
    monkeypatch.setenv(name, value) if value else monkeypatch.delenv(name, raising=False)
    assert own_default_stream() == refused
    if refused:
        with pytest.raises(BackendError, match=f"{name} is set.*unset it"):
            fake_driver.launcher(FakeDriver())
    else:
        fake_driver.launcher(FakeDriver())


@pytest.mark.skipif(torch.version.cuda is not None, reason="torch is built with CUDA here")
def test_the_backend_and_its_status_name_the_obstacle(monkeypatch: pytest.MonkeyPatch) -> None:
    """A CUDA build of torch without driver or device."""
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    with pytest.raises(BackendError) as caught:
        get_backend("cuda")
    status = next(status for status in backend_report() if status.name == "cuda")
    assert str(caught.value) == f"{status.reason}; {status.remedy}"
    assert "\n" not in status.reason


class Compiler:
    """NVRTC as used for the choice of an architecture."""

    known: tuple[int, ...] = (75, 80, 86, 87, 90, 100, 103, 110, 120)

    class nvrtcResult:
        NVRTC_SUCCESS = 0

    @classmethod
    def nvrtcGetSupportedArchs(cls) -> tuple[int, list[int]]:
        return 0, list(cls.known)


def test_a_device_newer_than_the_compiler_takes_the_newest_code_of_its_major_version(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(nvrtc, "_nvrtc", lambda: Compiler)
    assert nvrtc.architecture_for((9, 0)) == "sm_90"
    assert nvrtc.architecture_for((12, 1)) == "sm_120"
    assert nvrtc.architecture_for((7, 5)) == "sm_75"
    with pytest.raises(BackendError, match="Turing"):
        nvrtc.architecture_for((7, 0))


def test_code_for_a_processor_with_a_cpu_on_its_chip_is_for_that_one_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """NVRTC 12.8 supports 10.0 and 10.1 (Thor): a B300 (10.3) runs code for 10.0 but not for 10.1."""
    monkeypatch.setattr(nvrtc, "_nvrtc", lambda: Compiler)
    monkeypatch.setattr(Compiler, "known", (75, 80, 86, 87, 90, 100, 101, 120))
    assert nvrtc.architecture_for((10, 3)) == "sm_100"
    assert nvrtc.architecture_for((10, 1)) == "sm_101"
    assert nvrtc.architecture_for((8, 9)) == "sm_86"
    assert nvrtc.architecture_for((8, 7)) == "sm_87"


def test_a_device_of_an_unknown_major_version_gets_ptx_of_the_newest_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nvrtc, "_nvrtc", lambda: Compiler)
    assert nvrtc.architecture_for((13, 0)) == "compute_120"
    monkeypatch.setattr(Compiler, "known", (90, 100))
    with pytest.raises(BackendError, match="sm_90"):
        nvrtc.architecture_for((8, 0))
