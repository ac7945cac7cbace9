"""Diagnosis of an unavailable CUDA backend: causes in the order in which to fix them, with instructions."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import fake_driver
from fake_driver import FakeDriver
from gs2d.errors import BackendError
from gs2d.kernels.cuda import compile as nvrtc
from gs2d.kernels.cuda import diagnose
from gs2d.kernels.cuda.diagnose import Facts, missing
from gs2d.kernels.cuda.driver import own_default_stream
from gs2d.render.backends import backend_report, get_backend

H200 = ("NVIDIA H200", (9, 0))
WORKS = Facts("2.15.0", (13, 0), nvrtc=(13, 0), driver=(13, 2), devices=(H200,))
# Everything is broken; each row of the table fixes one more cause.
BROKEN = Facts(
    "2.15.0+cpu",
    None,
    bindings_error="No module named 'cuda'",
    nvrtc_error="libnvrtc not found",
    driver_error="libcuda not found",
    torch_error="no NVIDIA driver",
    architecture_error="the GPU must have compute capability 7.5 or more (Turing, 2018), got 6.1; use --backend cpu",
    cache_writable=False,
)
MENDING = (
    ({}, "torch 2.15.0+cpu is built without CUDA", "CUDA build of torch"),
    ({"torch_cuda": (11, 8)}, "torch is built for CUDA 11.8, CUDA 12 or newer is needed", "for CUDA 12 or 13"),
    (
        {"torch_cuda": (13, 0)},
        "cuda.bindings is missing (No module named 'cuda')",
        "pip install 'cuda-bindings>=13,<14' 'nvidia-cuda-nvrtc>=13,<14' (the extra cuda13;",
    ),
    ({"bindings_error": ""}, "NVRTC is missing (libnvrtc not found)", "'nvidia-cuda-nvrtc>=13,<14'"),
    ({"nvrtc_error": "", "nvrtc": (13, 0)}, "no NVIDIA driver is installed (libcuda not found)", "NVIDIA's driver"),
    ({"driver_error": "", "driver": (12, 4)}, "driver supports CUDA 12.4, but torch needs CUDA 13.0", "update"),
    ({"torch_cuda": (12, 8)}, "driver supports CUDA 12.4, but NVRTC needs CUDA 13.0", "update"),
    ({"nvrtc": (12, 9)}, "torch sees no CUDA device (no NVIDIA driver)", "CUDA_VISIBLE_DEVICES"),
    ({"devices": (H200,)}, "NVIDIA H200: the GPU must have compute capability 7.5", "--backend cpu"),
)


def test_each_missing_piece_is_named_in_order_with_its_remedy() -> None:
    facts = BROKEN
    for change, reason, remedy in MENDING:
        facts = replace(facts, **change)  # type: ignore[arg-type]
        lacking = missing(facts)
        assert lacking is not None, change
        assert reason in lacking.reason
        assert remedy in lacking.remedy
    assert missing(replace(facts, architecture_error="")) is None


@pytest.mark.parametrize(("value", "refused"), [(None, False), ("0", False), ("1", True)])
def test_bindings_that_mean_another_default_stream_than_torch_are_refused(
    value: str | None, refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Kernels would run concurrently with torch's sorts: occasional wrong images, and no error."""
    name = "CUDA_PYTHON_CUDA_PER_THREAD_DEFAULT_STREAM"
    monkeypatch.setenv(name, value) if value else monkeypatch.delenv(name, raising=False)
    assert own_default_stream() == refused
    lacking = missing(replace(WORKS, own_default_stream=own_default_stream()))
    assert (lacking is not None) == refused
    if lacking is not None:
        assert (lacking.reason.startswith(name), lacking.remedy) == (True, "unset it")
        with pytest.raises(BackendError, match=f"{name} is set.*unset it"):
            fake_driver.launcher(FakeDriver())
    else:
        fake_driver.launcher(FakeDriver())


@pytest.mark.skipif(torch.version.cuda is not None, reason="torch is built with CUDA here")
def test_facts_are_gathered_to_the_end_whatever_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """A CUDA build of torch without driver or device: every field is filled in."""
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    facts = diagnose.gather()
    assert facts.torch_cuda == (13, 0)
    assert facts.devices == ()
    assert bool(facts.driver_error) or bool(facts.bindings_error)
    lacking = missing(facts)
    assert lacking is not None
    with pytest.raises(BackendError, match="backend 'cuda' cannot run"):
        get_backend("cuda")
    status = next(status for status in backend_report() if status.name == "cuda")
    assert (status.reason, status.remedy) == (lacking.reason, lacking.remedy)
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
