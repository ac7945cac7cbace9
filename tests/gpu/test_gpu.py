"""Tests that need a real GPU: streams, devices, synchronisation, memory, determinism, training."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from torch import Tensor

import train_toys
from emulate import Emulator
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.errors import BackendError, ShapeError
from gs2d.kernels.cuda import launch
from gs2d.kernels.cuda.compile import compile_source, cubin, source_names
from gs2d.render.api import rasterize, splat_errors
from gs2d.render.backends import Backend, backend_report, get_backend
from gs2d.render.cuda_backend import CudaBackend
from gs2d.render.types import RasterSettings, RenderOutput
from gs2d.training import events
from gs2d.training.targets import DeviceTargets
from render_scenes import IMAGES, contraction, random_camera, random_cotangents, random_splats

pytestmark = pytest.mark.gpu
SETTINGS = RasterSettings(background=(0.2, 0.5, 0.9))


def scene(count: int = 3000, size: tuple[int, int] = (150, 110), seed: int = 5) -> tuple[Splats, Camera]:
    """Return a scene with many tiles and layers, in host memory."""
    rng = np.random.default_rng(seed)
    camera = random_camera(rng).resized(*size)
    splats = random_splats(rng, camera, count)
    splats.log_scales -= 1
    return splats.to(dtype=torch.float32), camera


def differentiate(splats: Splats, camera: Camera, device: torch.device) -> tuple[RenderOutput, dict[str, Tensor]]:
    """Return images, and gradients of all parameters for fixed cotangents."""
    leaves = Splats(**{k: t.detach().to(device).requires_grad_() for k, t in splats.items()})
    probe = torch.zeros(len(splats), 4, device=device, requires_grad=True)
    output = rasterize(leaves, camera, SETTINGS, backend="cuda", screen_probe=probe)
    cotangents = {k: v.to(device) for k, v in random_cotangents(np.random.default_rng(1), camera).items()}
    contraction(output, cotangents).backward()
    grads = {k: t.grad for k, t in leaves.items()} | {"probe": probe.grad}
    return output, {k: g for k, g in grads.items() if g is not None}


def test_the_report_and_auto_agree(gpu: Backend) -> None:
    status = next(status for status in backend_report() if status.name == "cuda")
    assert status.available
    assert torch.cuda.get_device_name() in status.details
    assert get_backend("auto").name == "cuda"


def test_every_kernel_loads(gpu: Backend) -> None:
    device = torch.device("cuda", torch.cuda.current_device())
    launcher = launch.launcher_for(device)
    assert isinstance(launcher, launch.GpuLauncher)
    assert all(cubin(name, launcher.architecture).code.startswith(b"\x7fELF") for name in source_names())
    with launcher._in_context():
        for name in launcher._source_of:
            launcher._load(name)


def test_the_gpu_gives_what_the_emulator_gives(gpu: Backend) -> None:
    """Images differ only by approximate instructions and flipped decisions."""
    splats, camera = scene(300, (70, 45))
    low = CudaBackend(launcher=Emulator()).rasterize(splats, camera, SETTINGS)
    high = rasterize(splats.to("cuda"), camera, SETTINGS, backend="cuda")
    for name in ("color", "alpha", "normal"):
        difference = (getattr(low, name) - getattr(high, name).cpu()).abs()
        assert float(difference.median()) < 1e-6, name
        assert float((difference > 2 / 255).float().mean()) < 1e-3, name


def test_images_are_the_same_bits_each_time_and_gradients_within_rounding(gpu: Backend) -> None:
    splats, camera = scene()
    (a, grads_a), (b, grads_b) = (differentiate(splats, camera, torch.device("cuda")) for _ in range(2))
    for name in (*IMAGES, "radii"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name
    for name, grad in grads_a.items():
        assert float((grad - grads_b[name]).norm()) <= 1e-5 * float(grad.norm()), name


def test_errors_of_splats_are_the_same_bits_each_time(gpu: Backend) -> None:
    splats, camera = scene()
    image = torch.rand(camera.height, camera.width, 3, device="cuda")
    a, b = (splat_errors(splats.to("cuda"), camera, image, SETTINGS, backend="cuda") for _ in range(2))
    assert torch.equal(a, b)
    assert float(a.sum()) > 0


def test_deterministic_gradients_are_the_same_bits_each_time(gpu: Backend) -> None:
    splats, camera = scene()
    torch.use_deterministic_algorithms(True)
    try:
        (_, a), (_, b) = (differentiate(splats, camera, torch.device("cuda")) for _ in range(2))
    finally:
        torch.use_deterministic_algorithms(False)
    assert len(a) == 7
    assert all(torch.equal(grad, b[name]) for name, grad in a.items())


def test_ptx_for_devices_to_come_is_translated_by_the_driver(gpu: Backend) -> None:
    """Simulates a device unknown to NVRTC; images must agree up to rounding."""
    splats, camera = scene()
    device = torch.device("cuda", torch.cuda.current_device())
    valid = launch.launcher_for(device)
    assert isinstance(valid, launch.GpuLauncher)
    later = launch.GpuLauncher(
        device,
        architecture_of=lambda _: valid.architecture.replace("sm_", "compute_"),
        code_of=lambda name, arch: compile_source(name, arch).code,
    )
    try:
        found = CudaBackend(launcher=later).rasterize(splats.to(device), camera, SETTINGS)
    except BackendError as error:
        if "UNSUPPORTED_PTX" in str(error):
            pytest.skip("the driver is older than NVRTC")
        raise
    expected = CudaBackend(launcher=valid).rasterize(splats.to(device), camera, SETTINGS)
    assert float((found.color - expected.color).abs().median()) < 1e-6


def test_work_is_queued_on_the_current_stream(gpu: Backend) -> None:
    """Kernels read data that an earlier, still queued operation of the same stream writes."""
    splats, camera = scene()
    there = splats.to("cuda")
    expected = rasterize(there, camera, SETTINGS, backend="cuda").color
    late = Splats(**{name: torch.zeros_like(tensor) for name, tensor in there.items()})
    torch.cuda.synchronize()
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        torch.cuda._sleep(200_000_000)  # clock cycles
        for name, tensor in there.items():
            getattr(late, name).copy_(tensor)
        results = [rasterize(late, camera, SETTINGS, backend="cuda").color for _ in range(8)]
    stream.synchronize()
    assert all(torch.equal(result, expected) for result in results)
    with torch.cuda.stream(stream):
        _, grads = differentiate(splats, camera, torch.device("cuda"))
    stream.synchronize()
    _, plain = differentiate(splats, camera, torch.device("cuda"))
    for name, grad in plain.items():
        assert float((grad - grads[name]).norm()) <= 1e-5 * float(grad.norm()), name


def test_a_thread_of_its_own_needs_no_preparation(gpu: Backend) -> None:
    import threading

    splats, camera = scene()
    there = splats.to("cuda")
    expected = rasterize(there, camera, SETTINGS, backend="cuda").color
    found: list[Tensor] = []
    thread = threading.Thread(target=lambda: found.append(rasterize(there, camera, SETTINGS, backend="cuda").color))
    thread.start()
    thread.join()
    assert torch.equal(found[0], expected)


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="one GPU or none here")
def test_every_device_renders_its_own_tensors_whatever_is_current(gpu: Backend) -> None:
    splats, camera = scene()
    results = [differentiate(splats, camera, torch.device("cuda", i)) for i in range(2)]
    assert results[1][0].color.device.index == 1
    assert torch.allclose(results[0][0].color.cpu(), results[1][0].color.cpu(), atol=1e-4)
    mixed = splats.to("cuda:0")
    mixed.quats = mixed.quats.to("cuda:1")
    with pytest.raises(ShapeError, match="quats must be on cuda:0 like means, got cuda:1"):
        rasterize(mixed, camera, SETTINGS, backend="cuda")


@contextmanager
def no_waiting(allowed: int) -> Iterator[None]:
    """Count the synchronising operations that torch reports."""
    torch.cuda.synchronize()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            yield
        finally:
            torch.cuda.set_sync_debug_mode("default")
    is_async = [w for w in said if "synchronizing CUDA operation" in str(w.message)]  # not: "is a prototype"
    assert len(is_async) <= allowed, [f"{w.filename}:{w.lineno} {w.message}" for w in is_async]


@pytest.mark.parametrize("stage", [0, 1, 2])
def test_an_iteration_waits_for_nothing_once_it_knows_how_many_pairs_to_expect(gpu: Backend, stage: int) -> None:
    from dataclasses import replace

    from gs2d.config.protocols import GENERIC
    from gs2d.training.trainer import Trainer, TrainerOptions

    recipe = train_toys.short()
    quiet = tuple(replace(s, densify=None, iterations=100) for s in recipe.stages)
    trainer = Trainer(
        train_toys.make_scene(),
        replace(recipe, stages=quiet),
        GENERIC,
        backend=gpu,
        options=TrainerOptions(progress_every=999),
    )
    for index in range(stage + 1):
        trainer.enter(index)
    for _ in range(8):  # every image is uploaded
        trainer.step()
    with no_waiting(allowed=0):
        for _ in range(5):
            trainer.step()


def test_three_stages_train_on_the_gpu_like_on_the_cpu(gpu: Backend) -> None:
    toy, recipe = train_toys.make_scene(), train_toys.short()
    (trainer, on_gpu), (plain, on_cpu) = (
        train_toys.train(toy, recipe, backend=backend) for backend in (gpu, get_backend("reference"))
    )
    assert trainer.splats.device.type == "cuda"
    losses = [[e.loss for e in r.events if isinstance(e, events.Progress)] for r in (on_gpu, on_cpu)]
    assert losses[0] == pytest.approx(losses[1], rel=0.02)
    assert abs(len(trainer.splats) - len(plain.splats)) <= 2
    saved = trainer.state.state_dict()
    assert saved["splats"]["means"].device.type == "cpu"


def test_what_was_trained_on_the_gpu_goes_on_on_the_cpu_and_back(gpu: Backend) -> None:
    from gs2d.config.protocols import GENERIC
    from gs2d.training.state import TrainState
    from gs2d.training.trainer import Trainer, TrainerOptions

    toy, recipe = train_toys.make_scene(), train_toys.short()
    state, devices = None, []
    for backend in (gpu, get_backend("reference"), gpu):
        trainer = Trainer(toy, recipe, GENERIC, backend=backend, state=state, options=TrainerOptions(progress_every=1))
        if state is None:
            trainer.enter(0)
        trainer.step()
        devices.append(trainer.splats.device.type)
        state = TrainState.from_state_dict(trainer.state.state_dict())
    assert devices == ["cuda", "cpu", "cuda"]
    assert state is not None
    assert state.step == 3


def test_photographs_in_pinned_memory_are_those_on_the_device(gpu: Backend) -> None:
    views, device = train_toys.make_scene().train, torch.device("cuda", torch.cuda.current_device())
    kept, pinned = (
        DeviceTargets(views, (0.2, 0.5, 0.9), use_masks=True, device=device, limit_bytes=n) for n in (1 << 30, 0)
    )
    for _ in range(2):
        for index in range(len(views)):
            assert torch.equal(kept[index].image, pinned[index].image)
    assert all(image.image.is_pinned() for image in pinned._cached.values())
    assert all(image.image.is_cuda for image in kept._cached.values())
    assert len(pinned._cached) == len(kept._cached) == len(views)


def test_peak_memory_is_bounded_by_what_is_documented(gpu: Backend) -> None:
    """docs/kernels.md: 1.2 kB per splat and 200 bytes per pixel beside parameters; here 20k splats at 400 x 400."""
    splats, camera = scene(20_000, (400, 400))
    differentiate(splats, camera, torch.device("cuda"))
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    differentiate(splats, camera, torch.device("cuda"))
    torch.cuda.synchronize()
    assert torch.cuda.max_memory_allocated() - before < 20_000 * 4096 + 160_000 * 512 + (64 << 20)
