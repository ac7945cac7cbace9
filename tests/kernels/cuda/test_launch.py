"""The launcher on a recording driver: streams, contexts, packing, caching, errors; also with the real bindings."""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import fake_driver
from emulate import Emulator
from fake_driver import FakeDriver, Result
from gs2d.errors import BackendError, ShapeError
from gs2d.kernels.cuda import launch
from gs2d.render.cuda_backend import CudaBackend
from gs2d.render.types import RasterSettings
from render_scenes import IMAGES, contraction, random_camera, random_cotangents, random_splats, requiring_grad


class Numbers(ctypes.Structure):
    _fields_ = (("a", ctypes.c_int64), ("b", ctypes.c_float), ("c", ctypes.c_void_p))


def numbers() -> Numbers:
    return Numbers(7, 0.5, 0xABCDEF)


def test_a_launch_passes_the_structure_as_it_is_on_the_current_stream_in_the_devices_context() -> None:
    driver = FakeDriver(argument_bytes=ctypes.sizeof(Numbers))
    fake_driver.launcher(driver, index=2, stream=0x77).launch("project_splats", 5, 128, numbers())
    (done,) = driver.launches
    assert (done.kernel, done.grid, done.block, done.shared) == ("project_splats", (5, 1, 1), (128, 1, 1), 0)
    assert (done.stream, done.context) == (0x77, 1002)  # the fake context of device 2 is 1002
    assert done.argument == bytes(numbers())


def test_each_launch_uses_the_current_stream() -> None:
    driver, streams = FakeDriver(), [1, 2, 3]
    launcher = launch.GpuLauncher(
        torch.device("cuda", 0),
        driver=driver,
        stream_of=lambda device: streams.pop(0),
        architecture_of=lambda device: "sm_90",
        code_of=lambda name, arch: b"",
    )
    for _ in range(3):
        launcher.launch("project_splats", 1, 128, numbers())
    assert [done.stream for done in driver.launches] == [1, 2, 3]


@pytest.mark.parametrize(
    ("function", "result", "words"),
    [
        ("cuLaunchKernel", Result.CUDA_ERROR_ILLEGAL_ADDRESS, "ILLEGAL"),
        ("cuLaunchKernel", Result.CUDA_ERROR_OUT_OF_MEMORY, "OUT_OF_MEMORY.*--downscale"),
        ("cuLaunchKernel", Result.CUDA_ERROR_SOMETHING_NEW, "SOMETHING_NEW.*nvidia-smi"),
        ("cuLibraryLoadData", Result.CUDA_ERROR_NO_BINARY_FOR_GPU, "NO_BINARY"),
        ("cuLibraryLoadData", Result.CUDA_ERROR_INVALID_IMAGE, "INVALID_IMAGE"),
        ("cuLibraryGetKernel", Result.CUDA_ERROR_NOT_FOUND, "NOT_FOUND"),
    ],
)  # fmt: skip
def test_an_error_of_the_driver_is_one_line_with_its_name_and_a_remedy(
    function: str, result: Result, words: str
) -> None:
    launcher = fake_driver.launcher(FakeDriver(failing={function: result}))
    with pytest.raises(BackendError, match=words) as error:
        launcher.launch("project_splats", 3, 128, numbers())
    assert "\n" not in str(error.value)


def test_tensors_that_are_not_on_a_gpu_are_refused_with_the_way_out() -> None:
    splats = random_splats(np.random.default_rng(0), random_camera(np.random.default_rng(0)), 3)
    with pytest.raises(ShapeError, match="tensors"):
        CudaBackend().rasterize(
            splats.to(dtype=torch.float32), random_camera(np.random.default_rng(0)), RasterSettings(sh_degree=0)
        )


def test_a_scene_through_launcher_and_driver_equals_the_kernels_result(emulator: Emulator) -> None:
    """The whole GPU path except torch's memory and the GPU: pointers reach the kernels through the driver."""
    rng = np.random.default_rng(3)
    camera = random_camera(rng)
    splats = random_splats(rng, camera, 40).to(dtype=torch.float32)
    cotangents = random_cotangents(rng, camera)
    results = []
    for runner in (emulator, fake_driver.launcher(FakeDriver(emulator=emulator))):
        scene = requiring_grad(splats)
        output = CudaBackend(launcher=runner).rasterize(scene, camera, RasterSettings())
        contraction(output, cotangents).backward()
        results.append([getattr(output, name).detach() for name in IMAGES] + [t.grad for _, t in scene.items()])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
    assert any(float(a.abs().sum()) > 0 for a in results[0][len(IMAGES) :])


SCRIPT = """
import ctypes, os, sys
import torch
from gs2d.errors import BackendError
from gs2d.kernels.cuda.launch import GpuLauncher, Work

class Numbers(ctypes.Structure):
    _fields_ = (("a", ctypes.c_int64), ("b", ctypes.c_float))

def make_launcher():
    return GpuLauncher(
        torch.device("cuda", 1), stream_of=lambda d: 0x1234, architecture_of=lambda d: "sm_90",
        code_of=lambda name, arch: b"\\x7fELF" + bytes(100),
    )

def single():
    launcher = make_launcher()
    launcher.launch("project_splats", 5, 128, Numbers(77, 0.5))
    launcher.launch("project_splats", 6, 128, Numbers(78, 0.5))

def repeated():
    launcher = make_launcher()
    first, second = Numbers(77, 0.5), Numbers(78, 0.5)
    works = [Work("project_splats", 5, 128, first), Work("project_splats_vjp", 6, 256, second)]
    for number in range(5):
        second.a = 100 + number
        launcher.run(works)

for name in sys.argv[2:]:
    os.environ["FAKE_CUDA_LOG"] = f"{sys.argv[1]}/{name}"
    os.environ["FAKE_CUDA_FAIL"] = "" if name in ("single", "repeated") else f"{name}:801"
    try:
        single() if name == "single" else repeated()
    except BackendError as error:
        print(error)
"""
WITHOUT_GRAPHS = ("cuGraphCreate", "cuGraphAddKernelNode", "cuGraphInstantiate")  # one failing call per case
Calls = dict[str, list[dict[str, object]]]


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory) -> Calls:
    """Return the calls that a fake libcuda receives through the real bindings, by case; one process runs all cases."""
    pytest.importorskip("cuda.bindings", reason="cuda-bindings is not here")
    if shutil.which("g++") is None or sys.platform != "linux":
        pytest.skip("no g++ on Linux here to build a fake libcuda")
    folder = tmp_path_factory.mktemp("libcuda")
    source = Path(__file__).resolve().parents[2] / "helpers" / "fake_libcuda.cpp"
    library = folder / "libcuda.so.1"
    command = ["g++", "-std=c++17", "-O1", "-fPIC", "-shared", "-Wall", f"-Wl,-soname,{library.name}"]
    subprocess.run([*command, "-o", str(library), str(source)], check=True)
    settings = {**os.environ, "LD_LIBRARY_PATH": str(folder), "FAKE_CUDA_LOG": str(folder / "loading")}
    cases = ("single", "repeated", *WITHOUT_GRAPHS)
    command = [sys.executable, "-c", SCRIPT, str(folder), *cases]
    done = subprocess.run(command, env=settings, check=True, capture_output=True, text=True)
    assert done.stdout == ""
    return {name: [json.loads(line) for line in (folder / name).read_text().splitlines()] for name in cases}


def test_the_real_bindings_pass_on_every_launch(calls: Calls) -> None:
    """Only libcuda is fake: it records the calls, and rejects a launch without a current context."""
    launched = {"call": "launch", "kernel": "project_splats", "block": [128, 1, 1], "stream": 0x1234, "device": 1}
    assert [call for call in calls["single"] if call["call"] != "load"] == [
        {**launched, "grid": [5, 1, 1], "shared": 0, "first": 77},
        {**launched, "grid": [6, 1, 1], "shared": 0, "first": 78},
    ]


def test_the_real_bindings_run_repeated_launches_as_a_graph_and_update_changes(calls: Calls) -> None:
    first = {"kernel": "project_splats", "grid": [5, 1, 1], "block": [128, 1, 1], "first": 77}
    second = {"kernel": "project_splats_vjp", "grid": [6, 1, 1], "block": [256, 1, 1]}
    of_launch = {"call": "launch", "shared": 0, "stream": 0x1234, "device": 1}
    replay = {"call": "replay", "stream": 0x1234}
    assert [call for call in calls["repeated"] if call["call"] != "load"] == [
        {**of_launch, **first},
        {**of_launch, **second, "first": 100},
        {**of_launch, **first},
        {**of_launch, **second, "first": 101},
        {"call": "node", "node": 1, **first},
        {"call": "node", "node": 2, **second, "first": 102},
        replay,
        {"call": "change", "node": 2, **second, "first": 103},
        replay,
        {"call": "change", "node": 2, **second, "first": 104},
        replay,
    ]


@pytest.mark.parametrize("function", WITHOUT_GRAPHS)
def test_a_driver_that_makes_no_graph_launches_one_by_one(calls: Calls, function: str) -> None:
    made = calls[function]
    assert [call["first"] for call in made if call["call"] == "launch"][1::2] == [100, 101, 102, 103, 104]
    assert "replay" not in {call["call"] for call in made}


NEWER = "_accelerator_setAllocatorSettings"  # in later versions of torch


@pytest.mark.parametrize("newer", [True, False])
def test_training_enables_expandable_segments_unless_the_user_configured_the_allocator(
    monkeypatch: pytest.MonkeyPatch, newer: bool
) -> None:
    told: list[str] = []
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.delattr(torch._C, NEWER, raising=False)
    place, name = (torch._C, NEWER) if newer else (torch.cuda.memory, "_set_allocator_settings")
    monkeypatch.setattr(place, name, told.append, raising=False)
    for variable in launch.ALLOCATOR_VARIABLES:
        monkeypatch.delenv(variable, raising=False)
    CudaBackend().for_training()
    assert told == ["expandable_segments:True"]
    monkeypatch.setenv("PYTORCH_ALLOC_CONF", "max_split_size_mb:64")
    CudaBackend().for_training()
    assert len(told) == 1
    monkeypatch.delenv("PYTORCH_ALLOC_CONF")
    monkeypatch.delattr(place, name)
    monkeypatch.delattr(torch.cuda.memory, "_set_allocator_settings", raising=False)
    assert not launch.grow_in_place()
