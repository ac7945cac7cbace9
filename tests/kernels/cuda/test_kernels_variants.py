"""Variants of the CUDA passes, emulated: only colours, some rows, no distortion, deterministic sums."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from emulate import Emulator
from gs2d.core.camera import Camera
from gs2d.core.splats import ATTRIBUTES, Splats
from gs2d.render import cuda_passes
from gs2d.render.cuda_backend import CudaBackend
from gs2d.render.reference_backend import PLAIN
from gs2d.render.types import PLAIN_COLORS, Features
from kernel_cases import SETTINGS, Case, crossing_tiles, double, many_tiles
from render_scenes import IMAGES, contraction, front_camera, random_cotangents, requiring_grad, splat, stack

COLORS = ("sh0", "shN")


class Recording:
    """Runs kernels and records their names."""

    def __init__(self, emulator: Emulator) -> None:
        self.emulator, self.names = emulator, list[str]()

    def launch(self, name: str, blocks: int, threads: int, arguments: ctypes.Structure) -> None:
        self.names.append(name)
        self.emulator.launch(name, blocks, threads, arguments)


def gradients(
    launcher: Any,
    case: Case,
    cotangents: Mapping[str, Tensor],
    *,
    trained: tuple[str, ...] = ATTRIBUTES,
    columns: int = 0,
    **options: Any,
) -> dict[str, Tensor]:
    """Return gradients of the trained attributes, and of the probe if it has ``columns``."""
    scene = Splats(**{name: t.clone().requires_grad_(name in trained) for name, t in case.splats.items()})
    probe = torch.zeros(len(scene), columns, requires_grad=True) if columns else None
    rows, distortion = options.pop("gradient_rows", None), options.pop("distortion", True)
    settings = replace(SETTINGS, sh_degree=3 if scene.shN.shape[1] else 0, with_distortion=distortion)
    output = CudaBackend(launcher=launcher, **options).rasterize(scene, case.camera, settings, probe, rows)
    contraction(output, dict(cotangents)).backward()
    found = {name: tensor.grad for name, tensor in scene.items() if name in trained}
    if probe is not None:
        found["probe"] = probe.grad
    return {name: grad for name, grad in found.items() if grad is not None}


def some_rows(count: int, seed: int) -> Tensor:
    return torch.rand(count, generator=torch.Generator().manual_seed(seed)) < 0.4


def color_cotangent(case: Case) -> dict[str, Tensor]:
    return {"color": random_cotangents(np.random.default_rng(case.seed), case.camera)["color"]}


def relative_error(found: Tensor, expected: Tensor) -> float:
    return float((found.double() - expected).norm() / expected.norm().clamp(min=1e-30))


def test_gradients_of_colours_alone_agree_with_the_reference(emulator: Emulator, clear_cases: list[Case]) -> None:
    launcher = Recording(emulator)
    errors = []
    for case in clear_cases[:8]:
        cotangents = color_cotangent(case)
        found = gradients(launcher, case, cotangents, trained=COLORS)
        scene = requiring_grad(double(case.splats))
        contraction(PLAIN.rasterize(scene, case.camera, SETTINGS), cotangents).backward()
        for name in COLORS:
            expected = getattr(scene, name).grad
            if expected is not None and float(expected.norm()) > 1e-3:
                errors.append(relative_error(found[name], expected))
    assert {"blend_vjp_learning", "project_colors_vjp"} <= set(launcher.names)
    assert not any(name.startswith(("blend_vjp_color", "project_splats_vjp")) for name in launcher.names)
    assert len(errors) >= 10
    assert np.median(errors) < 1e-5
    assert max(errors) < 2e-3


def test_deterministic_gradients_of_features_do_not_depend_on_order_or_culling(
    emulator: Emulator,
) -> None:
    case = many_tiles()
    settings = replace(SETTINGS, sh_degree=PLAIN_COLORS)
    numbers = torch.randn(len(case.splats), 37, generator=torch.Generator().manual_seed(1))

    def gradients_of(rasterize: Any, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
        scene = requiring_grad(case.splats.to(dtype=dtype))
        values = numbers.to(dtype, copy=True).requires_grad_()
        probe = torch.zeros(len(scene), 4, dtype=dtype, requires_grad=True)
        features = Features(values, numbers[0].to(dtype))
        rasterize(scene, case.camera, settings, features, probe).color.square().sum().backward()
        tensors = {**dict(scene.items()), "values": values, "probe": probe}
        return {name: tensor.grad for name, tensor in tensors.items() if tensor.grad is not None}

    first, second = (
        gradients_of(CudaBackend(launcher=launcher, deterministic=True, exact_masks=exact).rasterize_features)
        for launcher, exact in ((emulator, True), (replace(emulator, seed=1), False))
    )
    expected = gradients_of(PLAIN.rasterize_features, torch.float64)
    assert {"values", "probe", "means", "sh0"} <= first.keys()
    for name, gradient in first.items():
        assert torch.equal(gradient, second[name]), name
        assert relative_error(gradient, expected.get(name, torch.zeros(()))) < 1e-3, name


@pytest.mark.parametrize("trained", [COLORS, ("sh0",), ("shN",), ATTRIBUTES])
def test_rows_that_learn_have_the_gradients_they_have_anyway_and_all_others_zero(
    emulator: Emulator, trained: tuple[str, ...]
) -> None:
    """Bit-identical, with deterministic sums."""
    case = many_tiles()
    rows = some_rows(len(case.splats), 2)
    cotangents = (
        color_cotangent(case) if trained != ATTRIBUTES else random_cotangents(np.random.default_rng(3), case.camera)
    )
    columns = 4 if trained == ATTRIBUTES else 0
    whole, part = (
        gradients(emulator, case, cotangents, trained=trained, columns=columns, deterministic=True, gradient_rows=r)
        for r in (None, rows)
    )
    assert whole.keys() == part.keys() == {*trained, *(["probe"] if columns else [])}
    for name in whole:
        assert torch.equal(part[name][rows], whole[name][rows]), name
        assert not part[name][~rows].any(), name
        assert bool(whole[name][~rows].any()), name


def test_a_warp_stops_behind_the_last_splat_that_learns(emulator: Emulator) -> None:
    """100 faint layers; the last trained splat is in the first, the second, or no chunk of 32."""
    layers = stack(*(splat((0.0, 0.0, 2.0 + 0.01 * i), (3.0, 3.0), 0.02, (i % 3 / 2, 0.5, 0.2)) for i in range(100)))
    case = Case(0, layers, front_camera(9, 5))
    cotangents = color_cotangent(case)
    whole = gradients(emulator, case, cotangents, trained=("sh0",))["sh0"]
    for last in (0, 31, 32, 50, None):
        rows = torch.zeros(100, dtype=torch.bool)
        if last is not None:
            rows[last] = True
        found = gradients(emulator, case, cotangents, trained=("sh0",), gradient_rows=rows)["sh0"]
        assert torch.equal(found[rows], whole[rows])
        assert not found[~rows].any()


@pytest.mark.parametrize("trained", [ATTRIBUTES, COLORS])
def test_deterministic_gradients_do_not_depend_on_order_or_culling(
    emulator: Emulator, trained: tuple[str, ...]
) -> None:
    case = many_tiles()
    cotangents = random_cotangents(np.random.default_rng(1), case.camera)
    columns = 4 if trained == ATTRIBUTES else 0
    options: dict[str, Any] = {"trained": trained, "columns": columns, "deterministic": True}
    usual = gradients(emulator, case, cotangents, **options)
    downwards = gradients(replace(emulator, descending=True), case, cotangents, **options)
    shuffled = gradients(replace(emulator, seed=1), case, cotangents, **options)
    everywhere = gradients(emulator, case, cotangents, **options, exact_masks=False)
    atomic = gradients(emulator, case, cotangents, trained=trained, columns=columns)
    for name, grad in usual.items():
        assert torch.equal(grad, downwards[name]), name
        assert torch.equal(grad, shuffled[name]), name
        assert torch.equal(grad, everywhere[name]), name
        assert float((grad - atomic[name]).norm()) <= 3e-5 * float(grad.norm()), name  # 1.1e-5: quats


@pytest.mark.parametrize("seed", range(3))
def test_culling_splats_without_an_ellipse_changes_no_bit(emulator: Emulator, seed: int) -> None:
    """Splats that reach the camera plane: tiles that they cannot touch are not even candidates."""
    case = crossing_tiles(seed)
    view = cuda_passes.view_of(case.camera, SETTINGS)
    parameters = {name: tensor.contiguous() for name, tensor in case.splats.items()}
    culled, full = (cuda_passes.forward(emulator, view, parameters, exact=exact) for exact in (True, False))
    for name in IMAGES:
        assert torch.equal(culled.images[name], full.images[name]), name
    assert torch.equal(culled.radii, full.radii)
    assert len(culled.permutation) < 0.9 * len(full.permutation)
    cotangents = random_cotangents(np.random.default_rng(seed), case.camera)
    a, b = (
        gradients(emulator, case, cotangents, columns=4, deterministic=True, exact_masks=exact)
        for exact in (True, False)
    )
    for name, gradient in b.items():
        assert torch.equal(a[name], gradient), name
    near_plane_policy = full.radii == 45
    assert int((b["sh0"][near_plane_policy] != 0).any(2).sum()) > 5


def test_without_distortion_the_other_images_and_gradients_keep_every_bit(emulator: Emulator) -> None:
    case = many_tiles()
    full = CudaBackend(launcher=emulator).rasterize(case.splats, case.camera, SETTINGS)
    part = CudaBackend(launcher=emulator).rasterize(case.splats, case.camera, replace(SETTINGS, with_distortion=False))
    assert bool(part.distortion.isnan().all())  # reveals accidental use
    for name in ("color", "alpha", "normal", "depth_mean", "depth_median", "radii"):
        assert torch.equal(getattr(full, name), getattr(part, name)), name
    cotangents = random_cotangents(np.random.default_rng(1), case.camera)
    del cotangents["distortion"]
    a, b = (gradients(emulator, case, cotangents, distortion=d, deterministic=True) for d in (True, False))
    assert all(torch.equal(a[name], b[name]) for name in ATTRIBUTES)


class FewBlocks(Recording):
    """Runs only the first blocks of the blend kernels, which have the longest lists."""

    def launch(self, name: str, blocks: int, threads: int, arguments: ctypes.Structure) -> None:
        super().launch(name, min(blocks, 3) if name.startswith("blend") else blocks, threads, arguments)


def test_tiles_beyond_32767_are_blended_as_any_other(emulator: Emulator) -> None:
    """3200 x 3200 px are 40000 tiles. Compares the last tile with a camera that sees only this tile."""
    camera = front_camera(3200, 3200, 1600.0)
    near = Camera(16, 16, camera.fx, camera.fy, camera.cx - 3184, camera.cy - 3184, camera.T_cam_world)
    x, y = (3192.0 - 1600.0) / 800, (3192.0 - 1600.0) / 800  # px at depth 2
    scene = stack(splat((x, y, 2.0), (2e-3, 1e-3), 0.7, (0.9, 0.2, 0.1)), splat((x, y - 1e-3, 2.01), (2e-3, 2e-3), 0.8))
    settings = replace(SETTINGS, sh_degree=0)
    parameters = dict(scene.items())
    g_color = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))
    found: list[tuple[Tensor, Tensor]] = []
    for cam in (camera, near):
        frame = cuda_passes.forward(FewBlocks(emulator), cuda_passes.view_of(cam, settings), parameters)
        upstream: dict[str, Tensor | None] = dict.fromkeys((*cuda_passes.IMAGES, "depth_transmittance"))
        upstream["color"] = torch.zeros(cam.height, cam.width, 3)
        upstream["color"][-16:, -16:] = g_color
        means = torch.empty_like(scene.means)
        wanted = {**dict.fromkeys((*ATTRIBUTES, "probe")), "means": means}
        cuda_passes.backward(FewBlocks(emulator), frame, parameters, upstream, wanted)
        found.append((frame.images["color"][-16:, -16:], means))
    (far_color, far_means), (near_color, near_means) = found
    assert float((near_color - torch.tensor(SETTINGS.background)).abs().max()) > 0.3
    assert float((far_color - near_color).abs().max()) < 1e-3  # float32 resolution at 3200 px: 2e-4 px
    assert relative_error(far_means, near_means.double()) < 1e-2
