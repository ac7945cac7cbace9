"""AMD's GPUs: the launcher over a run-time library of the tests' own, the real compilers where they are, and words."""

from __future__ import annotations

import ctypes
import importlib.util
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from emulate import Emulator
from fake_hip import FakeHip
from gs2d.errors import BackendError
from gs2d.kernels.cuda import compile as nvrtc
from gs2d.kernels.cuda import diagnose_amd, hip, hiprtc, launch, readiness
from gs2d.kernels.cuda.diagnose_amd import AmdFacts, describe, missing
from gs2d.kernels.cuda.hip import HipDriver
from gs2d.kernels.cuda.launch import GpuLauncher, Work
from gs2d.render import cuda
from gs2d.render.types import RasterSettings
from render_scenes import IMAGES, contraction, random_camera, random_cotangents, random_splats, requiring_grad

pytestmark = pytest.mark.timeout(280)
ROOT = Path(__file__).resolve().parents[3]


class Numbers(ctypes.Structure):
    _fields_ = (("a", ctypes.c_int64), ("b", ctypes.c_float), ("more", ctypes.c_char * 1024))


def test_a_launch_is_on_the_current_stream_and_on_the_devices_own_which_is_given_back(fake_hip: FakeHip) -> None:
    launcher = fake_hip.launcher(index=2)
    launcher.launch("project_splats", 5, 128, Numbers(77, 0.5))
    launcher.launch("project_splats_vjp", 0, 128, Numbers(78, 0.5))
    launcher.launch("project_splats", 6, 128, Numbers(79, 0.5), 60_000)
    launched = {"call": "launch", "kernel": "project_splats", "block": 128, "stream": 0x77, "device": 2}
    assert fake_hip.said() == [
        {"call": "load", "device": 2},
        {**launched, "grid": 5, "shared": 0, "first": 77},
        {**launched, "grid": 6, "shared": 60_000, "first": 79},
    ]
    assert fake_hip.driver.cuCtxGetCurrent()[1] == 1  # device 0


def test_launches_that_come_again_are_a_graph_where_one_is_asked_for(
    fake_hip: FakeHip, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers = Numbers(1, 0.5)
    works = [Work("project_splats", 5, 128, Numbers(7, 0.5)), Work("project_splats_vjp", 6, 256, numbers)]
    for chosen, kinds in ((None, {"load": 2, "launch": 10}), ("graph", {"load": 2, "launch": 4})):
        fake_hip.library.fake_hip_forget()
        if chosen:
            monkeypatch.setenv(launch.STEP_VARIABLE, chosen)
            kinds |= {"node": 2, "change": 2, "replay": 3}
        launcher = fake_hip.launcher()
        for number in range(5):
            numbers.a = number
            launcher.run(works)
        assert Counter(line["call"] for line in fake_hip.said()) == kinds


@pytest.mark.parametrize("trouble", ["hipGraphAddKernelNode", "hipGraphInstantiate", "old"])
def test_where_no_graph_is_made_kernels_are_launched(
    fake_hip: FakeHip, monkeypatch: pytest.MonkeyPatch, trouble: str
) -> None:
    monkeypatch.setenv(launch.STEP_VARIABLE, "graph")
    if trouble == "old":
        fake_hip.library.fake_hip_version(50221153)
    else:
        fake_hip.library.fake_hip_fail(trouble.encode(), 801)
    launcher = fake_hip.launcher()
    for _ in range(5):
        launcher.run([Work("project_splats", 5, 128, Numbers(7, 0.5))])
    calls = Counter(line["call"] for line in fake_hip.said())
    assert calls["launch"] == 5
    assert calls["replay"] == 0
    assert fake_hip.driver.cuDriverGetVersion()[1] == (5020 if trouble == "old" else 6020)


@pytest.mark.parametrize(
    ("function", "code", "words"),
    [
        ("hipModuleLaunchKernel", 700, r"launch of project_splats \(3 blocks of 128\) \(hipErrorIllegalAddress.*again"),
        ("hipModuleLaunchKernel", 2, "hipErrorOutOfMemory.*--downscale"),
        ("hipModuleLaunchKernel", 9, "hipErrorUnknown.*rocminfo"),
        ("hipModuleLoadData", 209, r"hipModuleLoadData \(hipErrorNoBinaryForGpu\); install the torch build"),
        ("hipModuleGetFunction", 500, "hipModuleGetFunction.*hipErrorNotFound.*install gs2d again"),
        ("hipSetDevice", 100, "hipSetDevice.*hipErrorNoDevice.*HIP_VISIBLE_DEVICES"),
    ],
)
def test_an_error_is_one_line_with_its_name_and_a_remedy(
    fake_hip: FakeHip, function: str, code: int, words: str
) -> None:
    fake_hip.library.fake_hip_fail(function.encode(), code)
    with pytest.raises(BackendError, match=f"AMD's run-time library failed in .*{words}") as error:
        fake_hip.launcher().launch("project_splats", 3, 128, Numbers(7, 0.5))
    assert "\n" not in str(error.value)


def test_a_device_that_is_not_there_and_too_many_threads_are_refused(fake_hip: FakeHip) -> None:
    with pytest.raises(BackendError, match="hipErrorInvalidDevice"):
        fake_hip.launcher(index=7)
    assert fake_hip.driver.cuCtxGetCurrent()[1] == 1
    with pytest.raises(BackendError, match=r"needs 33554432 blocks of 128, expected at most 4294967295 threads"):
        fake_hip.launcher().launch("project_splats", 1 << 25, 128, Numbers(7, 0.5))


def test_a_library_without_a_function_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(BackendError, match="libamdhip64 has no function hipInit .*torch's build for ROCm"):
        HipDriver(ctypes.CDLL(None))


def test_a_scene_by_way_of_hip_in_waves_of_64_is_what_warps_make_of_it(fake_hip: FakeHip, emulator: Emulator) -> None:
    fake_hip.run_by(Emulator(wave=64))
    rng = np.random.default_rng(3)
    camera = random_camera(rng)
    splats = random_splats(rng, camera, 40).to(dtype=torch.float32)
    cotangents = random_cotangents(rng, camera)
    results = []
    for runner in (emulator, fake_hip.launcher()):
        scene = requiring_grad(splats)
        output = cuda.rasterize_with(runner, scene, camera, RasterSettings())
        contraction(output, cotangents).backward()
        results.append([getattr(output, name).detach() for name in IMAGES] + [t.grad for _, t in scene.items()])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
    assert any(float(a.abs().sum()) > 0 for a in results[0][len(IMAGES) :])


def test_torch_built_for_rocm_gets_this_launcher(fake_hip: FakeHip, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.version, "hip", "6.2.41133")
    monkeypatch.setattr(launch, "load_hip", lambda: fake_hip.driver)
    named = SimpleNamespace(gcnArchName="gfx942:sramecc+:xnack-")
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: named)
    launch._of_device.cache_clear()
    try:
        made = launch.launcher_for(torch.device("cuda", 1))
    finally:
        launch._of_device.cache_clear()
    assert isinstance(made, GpuLauncher)
    assert made.architecture == "gfx942"


# -- what compiles -----------------------------------------------------------------------------------------------------
def test_waves_are_those_of_the_architecture_and_others_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    waves = {"gfx906": 64, "gfx90a": 64, "gfx942": 64, "gfx1030": 32, "gfx1100": 32, "gfx1201": 32}
    assert {arch: hiprtc.wave_of(arch) for arch in waves} == waves
    for given in ("gfx803", "", "gfx11-generic"):
        named = SimpleNamespace(gcnArchName=given)
        monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device, named=named: named)
        with pytest.raises(BackendError, match="must be a gfx9 or newer of AMD's, got"):
            hiprtc.architecture_of(torch.device("cuda", 0))


def test_a_code_object_is_kept_by_everything_that_it_depends_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    compiled: list[tuple[str, str]] = []

    def compile_it(name: str, arch: str) -> tuple[bytes, str]:
        compiled.append((name, arch))
        return f"{name} for {arch}".encode(), ""

    monkeypatch.setattr(hiprtc, "compile_source", compile_it)
    monkeypatch.setattr(hiprtc, "shipped_objects", lambda: None)
    for _ in range(2):
        assert hiprtc.code_object("cuda/emit.cu", "gfx942", tmp_path) == b"cuda/emit.cu for gfx942"
        assert hiprtc.code_object("cuda/emit.cu", "gfx1100", tmp_path) == b"cuda/emit.cu for gfx1100"
    assert len(compiled) == 2
    whole = {**nvrtc.sources(), "cuda/amd.h": "another"}
    monkeypatch.setattr(hiprtc, "sources", lambda: whole)
    hiprtc.code_object("cuda/emit.cu", "gfx942", tmp_path)
    assert len(compiled) == 3
    assert len(list(tmp_path.iterdir())) == 3


@pytest.fixture(scope="session")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("build_code_objects", ROOT / "scripts" / "build_code_objects.py")
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = made  # dataclasses look there
    spec.loader.exec_module(made)
    return made


def clang_of(script: ModuleType) -> str:
    try:
        return str(script.find_clang())
    except BackendError as error:
        pytest.skip(str(error))


ALL = [pytest.param(name, marks=[] if name == "cuda/sort.cu" else pytest.mark.slow) for name in nvrtc.source_names()]


@pytest.mark.parametrize("arch", hiprtc.AMD_SHIPPED)
@pytest.mark.parametrize("name", ALL)
def test_clang_compiles_every_source_without_a_spill_or_a_warning(script: ModuleType, name: str, arch: str) -> None:
    code, usage = script.compile_source(clang_of(script), name, arch)
    assert code.startswith(b"\x7fELF")
    assert set(usage) == set(nvrtc.KERNEL.findall(nvrtc.sources()[name]))
    assert all(one.scratch_bytes == 0 for one in usage.values()), usage


@pytest.mark.parametrize("arch", ["gfx90a", "gfx1030"])
@pytest.mark.parametrize("name", ALL)
def test_hiprtc_itself_compiles_every_source(name: str, arch: str) -> None:
    """Of any version that is here; old ones know these two."""
    try:
        hiprtc.ready_compiler()
    except BackendError as error:
        pytest.skip(str(error))
    code, _ = hiprtc.compile_source(name, arch)
    assert code.startswith(b"\x7fELF")
    assert all(kernel.encode() in code for kernel in nvrtc.KERNEL.findall(nvrtc.sources()[name]))


def test_code_objects_of_the_package_come_first(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    clang = clang_of(script)
    assert script.build(tmp_path, clang, ("gfx942",), ("cuda/slots.cu", "cuda/order.cu")) > 0
    take = hiprtc.shipped.__wrapped__
    monkeypatch.setattr(
        hiprtc, "shipped", lambda version, digest, folder, *names: take(version, digest, tmp_path, *names)
    )

    def refuse(name: str, arch: str) -> tuple[bytes, str]:
        raise BackendError("nothing is compiled")

    monkeypatch.setattr(hiprtc, "compile_source", refuse)
    assert hiprtc.code_object("cuda/slots.cu", "gfx942", tmp_path / "cache").startswith(b"\x7fELF")
    for name, arch in (("cuda/slots.cu", "gfx90a"), ("cuda/sort.cu", "gfx942")):
        with pytest.raises(BackendError, match="nothing is compiled"):
            hiprtc.code_object(name, arch, tmp_path / "cache")
    monkeypatch.setattr(hiprtc, "sources", lambda: {**nvrtc.sources(), "cuda/amd.h": "edited"})
    assert hiprtc.shipped_objects() is None


def test_a_compiler_that_is_not_here_or_refuses_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere(stem: str, function: str = "") -> ctypes.CDLL:
        raise OSError(f"{stem}.so: no such file")

    hiprtc.ready_compiler.cache_clear()
    monkeypatch.setattr(hiprtc, "find_library", nowhere)
    with pytest.raises(BackendError, match=r"hiprtc is not here \(libhiprtc.so: no such file\); install torch's build"):
        hiprtc.ready_compiler()
    monkeypatch.undo()
    try:
        hiprtc.ready_compiler()
    except BackendError as error:
        pytest.skip(str(error))
    monkeypatch.setattr(hiprtc, "prepared", lambda name: "this is not C++;")
    with pytest.raises(BackendError, match=r"AMD's compiler refused cuda/slots.cu for gfx90a: .*error"):
        hiprtc.compile_source("cuda/slots.cu", "gfx90a")


# -- words -------------------------------------------------------------------------------------------------------------
WORKS = AmdFacts("2.9.0+rocm6.4", (6, 4), hip=(6, 4), devices=("AMD Instinct MI300X",), arch="gfx942")
BROKEN = AmdFacts(
    "2.1.0+rocm5.6",
    (5, 6),
    hip_error="libamdhip64.so: cannot open",
    compiler_error="libhiprtc.so: cannot open",
    torch_error="No HIP GPUs are available",
    architecture_error="the GPU must be a gfx9 or newer of AMD's, got gfx803; use --backend cpu",
)
MENDING = (
    ({}, "torch is built for ROCm 5.6, ROCm 6 or newer is needed", "a torch build for ROCm 6 or 7"),
    ({"torch_hip": (6, 4)}, "run-time library cannot be used (libamdhip64.so: cannot open)", "rocminfo"),
    ({"hip_error": "", "hip": (6, 4)}, "torch sees no AMD GPU (No HIP GPUs are available)", "HIP_VISIBLE_DEVICES"),
    ({"devices": ("Radeon RX 580",)}, "Radeon RX 580: the GPU must be a gfx9 or newer", "--backend cpu"),
    ({"architecture_error": ""}, "hiprtc is not here (libhiprtc.so: cannot open)", "torch's build for ROCm"),
)


def test_each_missing_piece_is_named_in_order_with_its_remedy() -> None:
    facts = BROKEN
    for change, reason, remedy in MENDING:
        facts = replace(facts, **change)  # type: ignore[arg-type]
        found = missing(facts)
        assert found is not None
        assert reason in found.reason
        assert remedy in found.remedy
    assert missing(replace(facts, shipped=True)) is None
    assert missing(replace(facts, compiler_error="")) is None
    assert missing(WORKS) is None


def test_the_line_about_a_machine_says_that_nobody_has_tried_it() -> None:
    line = describe(WORKS)
    assert line.startswith(
        "AMD Instinct MI300X (the first: gfx942); ROCm 6.4, hiprtc; compiled and emulated, never yet"
    )
    assert "compiled at every start" in describe(replace(WORKS, cache=None, cache_writable=False))
    assert "kernels of the package" in describe(replace(WORKS, shipped=True))


def test_the_doctor_asks_about_amd_where_torch_is_built_for_rocm(
    fake_hip: FakeHip, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.version, "hip", "6.2.41133")
    monkeypatch.setattr(diagnose_amd, "load_hip", lambda: fake_hip.driver)
    monkeypatch.setattr(hiprtc, "ready_compiler", lambda: None)
    lacking, words = readiness.report()
    assert lacking is not None
    assert lacking.reason.startswith("torch sees no AMD GPU")
    assert words == ""
    named: Callable[[object], object] = lambda device: SimpleNamespace(gcnArchName="gfx1100")  # noqa: E731
    monkeypatch.setattr(torch.cuda, "get_device_properties", named)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(diagnose_amd, "seen_devices", lambda: ((("Radeon RX 7900 XTX", (11, 0)),), ""))
    lacking, words = readiness.report()
    assert lacking is None
    assert words.startswith("Radeon RX 7900 XTX (the first: gfx1100); ROCm 6.2")


def test_the_run_time_library_of_this_process_is_taken_before_any_other(fake_hip: FakeHip) -> None:
    """It has been loaded by its path; a second copy would know other devices."""
    assert fake_hip.library._name in map(str, hip._loaded("libamdhip64"))
    with pytest.raises(OSError):
        hip.find_library("libsomething-that-is-nowhere")
