"""Rule 20 of the contract: the gradient of a camera's pose, on every backend.

Expected values come from autograd through the reference, whose formulas also accept a camera made of tensors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from gs2d.config.recipe import LossTerm
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.core.transforms import perturb_pose
from gs2d.errors import ShapeError
from gs2d.losses.base import LossView, compute_losses
from gs2d.losses.formulas import normal_consistency
from gs2d.render import pose_gradient as camera_gradient
from gs2d.render.api import rasterize, splat_errors
from gs2d.render.backends import Backend
from gs2d.render.reference_backend import PLAIN
from gs2d.render.types import RasterSettings, RenderOutput
from render_scenes import (
    IMAGES,
    contraction,
    random_camera,
    random_cotangents,
    random_splats,
    repeatable,
    requiring_grad,
    splat,
)

SMOOTH = ("plain", "opaque", "huge")  # kinds of splats without nearby threshold decisions


def scene(seed: int, count: int = 12, dtype: torch.dtype = torch.float64) -> tuple[Splats, Camera, dict[str, Tensor]]:
    rng = np.random.default_rng(seed)
    camera = random_camera(rng)
    return random_splats(rng, camera, count).to(dtype=dtype), camera, random_cotangents(rng, camera)


def learning(camera: Camera) -> tuple[Camera, Tensor]:
    """Return the same camera, and a pose that requires a gradient."""
    pose = torch.tensor(camera.T_cam_world, requires_grad=True)
    return replace(camera, T_cam_world=pose), pose


def live(camera: Camera) -> tuple[Any, Tensor]:
    """Return a camera made of tensors for the reference, and its pose."""
    T = torch.tensor(camera.T_cam_world, requires_grad=True)
    facts = {f.name: getattr(camera, f.name) for f in fields(camera) if f.name not in ("T_cam_world", "pose")}
    R, t = T[:3, :3], T[:3, 3]
    return SimpleNamespace(**facts, T_cam_world=T, rotation=R, center=-R.T @ t), T


def along_motions(gradient: Tensor | None, camera: Camera) -> Tensor:
    """Project the gradient on six motions in the camera's frame: three rotations, three translations [6]."""
    assert gradient is not None
    at_rest = torch.zeros(6, dtype=torch.float64)

    def placed(motion: Tensor) -> Tensor:
        pose = perturb_pose(camera, motion).pose
        assert pose is not None
        return pose

    changes = torch.autograd.functional.jacobian(placed, at_rest)  # [4, 4, 6]
    return torch.einsum("ij,ijk->k", gradient.double(), changes)


def straight(splats: Splats, camera: Camera, settings: RasterSettings, cotangents: dict[str, Tensor]) -> Tensor:
    """Return the gradient of the six motions [6] by autograd."""
    lens, pose = live(camera)
    contraction(PLAIN.rasterize(splats, lens, settings), cotangents).backward()
    return along_motions(pose.grad, camera)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_20_the_reference_has_the_gradient_of_autograd(seed: int, degree: int) -> None:
    splats, camera, cotangents = scene(seed)
    settings = RasterSettings(sh_degree=degree)
    lens, pose = learning(camera)
    contraction(rasterize(splats, lens, settings, backend="reference"), cotangents).backward()
    expected = straight(splats, camera, settings, cotangents)
    assert expected.abs().max() > 1
    assert_close(along_motions(pose.grad, camera), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("image", IMAGES)
def test_20_each_image_tells_every_backend_how_it_changes_with_the_camera(backend: Backend, image: str) -> None:
    rng = np.random.default_rng(3)
    camera = random_camera(rng)
    splats = random_splats(rng, camera, 12, SMOOTH)
    cotangents = {image: random_cotangents(rng, camera)[image]}
    expected = straight(splats, camera, RasterSettings(), cotangents)
    lens, pose = learning(camera)
    contraction(rasterize(splats.to(dtype=torch.float32), lens, backend=backend), cotangents).backward()
    found = along_motions(pose.grad, camera)
    assert expected.abs().max() > 1e-3
    assert_close(found, expected, rtol=2e-3, atol=2e-4 * float(expected.abs().max()))


def test_20_the_camera_learns_where_nothing_else_does(backend: Backend) -> None:
    splats, camera, cotangents = scene(1, dtype=torch.float32)
    lens, pose = learning(camera)
    contraction(rasterize(splats, lens, backend=backend), cotangents).backward()
    assert pose.grad is not None
    assert bool((pose.grad[:3] != 0).any())
    assert not pose.grad[3].any()
    assert all(tensor.grad is None for _, tensor in splats.items())


def test_20_images_and_all_other_gradients_keep_their_bits(backend: Backend) -> None:
    splats, camera, cotangents = scene(2, dtype=torch.float32)
    found = []
    for lens in (camera, learning(camera)[0]):
        leaves, probe = requiring_grad(splats), torch.zeros(len(splats), 4, requires_grad=True)
        with repeatable(backend):
            output = rasterize(leaves, lens, backend=backend, screen_probe=probe)
            contraction(output, cotangents).backward()
        found.append([getattr(output, name) for name in IMAGES] + [t.grad for _, t in leaves.items()] + [probe.grad])
    for before, after in zip(*found, strict=True):
        assert torch.equal(before, after)


def test_20_a_camera_without_a_pose_costs_nothing(cpu: Backend, monkeypatch: pytest.MonkeyPatch) -> None:
    splats, camera, _ = scene(0, dtype=torch.float32)
    monkeypatch.setattr("gs2d.render.api.attach_pose_grad", None)  # would raise
    rasterize(requiring_grad(splats), camera, backend=cpu).color.sum().backward()
    with torch.no_grad():
        rasterize(splats, learning(camera)[0], backend=cpu)
    with pytest.raises(TypeError):
        rasterize(splats, learning(camera)[0], backend=cpu)


def test_20_gradient_rows_are_refused(backend: Backend) -> None:
    splats, camera, _ = scene(0, dtype=torch.float32)
    rows = torch.ones(len(splats), dtype=torch.bool)
    with pytest.raises(ShapeError, match="gradient_rows must be None if the camera has gradients"):
        rasterize(splats, learning(camera)[0], backend=backend, gradient_rows=rows)
    with torch.no_grad():
        rasterize(splats, learning(camera)[0], backend=backend, gradient_rows=rows)


@pytest.mark.parametrize("attribute", ["means", "quats", "sh0", "shN", "log_scales"])
def test_20_splats_that_are_not_finite_do_not_count(backend: Backend, attribute: str) -> None:
    splats, camera, cotangents = scene(1, dtype=torch.float32)
    lens, pose = learning(camera)
    contraction(rasterize(splats.rows(torch.arange(1, 12)), lens, backend=backend), cotangents).backward()
    getattr(splats, attribute)[0] = torch.nan
    broken, other = learning(camera)
    contraction(rasterize(splats, broken, backend=backend), cotangents).backward()
    assert pose.grad is not None
    assert other.grad is not None
    assert_close(other.grad, pose.grad, rtol=1e-4, atol=1e-4 * float(pose.grad.abs().max()))


def test_20_where_nothing_is_seen_the_gradient_is_zero(backend: Backend) -> None:
    _, camera, cotangents = scene(0)
    for splats in (splat(mean=(0, 0, 0)).rows(torch.arange(0)), splat(mean=(1e3, 0, -5))):
        lens, pose = learning(camera)
        contraction(rasterize(splats, lens, backend=backend), cotangents).backward()
        assert pose.grad is not None
        assert not pose.grad.any()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_20_the_native_sums_are_those_of_torch(cpu: Backend, monkeypatch: pytest.MonkeyPatch, degree: int) -> None:
    rng = np.random.default_rng(4)
    camera = random_camera(rng)
    splats = random_splats(rng, camera, 3001).to(
        dtype=torch.float32
    )  # three chunks, the last not a multiple of a vector
    cotangents, found = random_cotangents(rng, camera), []
    for natively in (True, False):
        if not natively:
            monkeypatch.setattr(camera_gradient, "library_for", lambda _: None)
        lens, pose = learning(camera)
        output = rasterize(splats, lens, RasterSettings(sh_degree=degree), backend=cpu)
        contraction(output, cotangents).backward()
        found.append(along_motions(pose.grad, camera))
    assert_close(*found, rtol=1e-4, atol=1e-4 * float(found[1].abs().max()))


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("kind", ["normal_consistency", "normal_consistency_per_splat"])
def test_20_normal_consistency_lets_both_normals_rotate_with_the_camera(kind: str, masked: bool) -> None:
    rng = np.random.default_rng(3)
    camera = random_camera(rng)
    splats = random_splats(rng, camera, 12, SMOOTH)
    mask = torch.tensor(rng.random((camera.height, camera.width)) < 0.8) if masked else None
    lens, expected = live(camera)
    output = PLAIN.rasterize(splats, lens, RasterSettings())
    images = output.normal, output.depth_mean, output.alpha
    normal_consistency(*images, lens, mask, per_splat=kind == "normal_consistency_per_splat").backward()

    def found(change: Any = lambda output: output) -> Tensor:
        lens, pose = learning(camera)
        output = change(rasterize(splats, lens, backend="reference"))
        target = torch.zeros_like(output.color)
        view = LossView(target, lens, mask)
        compute_losses(output, view, (LossTerm(kind, 1.0),), backend="reference")[kind].backward()
        return along_motions(pose.grad, camera)

    assert_close(found(), along_motions(expected.grad, camera), rtol=1e-9, atol=1e-12)

    def copied(output: RenderOutput) -> RenderOutput:  # simulates modified normals
        return replace(output, normal=output.normal * 1)

    assert_close(found(copied), along_motions(expected.grad, camera), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("drawing", [rasterize, splat_errors], ids=["rasterize", "splat_errors"])
def test_20_a_pose_that_moved_on_without_its_camera_is_refused(cpu: Backend, drawing: Callable[..., object]) -> None:
    splats, camera, _ = scene(0)
    lens, pose = learning(camera)
    with torch.no_grad():
        pose[0, 3] += 0.1  # like an optimizer step
    image = [torch.zeros(camera.height, camera.width, 3)] if drawing is splat_errors else []
    with pytest.raises(ShapeError, match="create a camera with the new pose"):
        drawing(splats.to(dtype=torch.float32), lens, *image, backend=cpu)
    drawing(splats.to(dtype=torch.float32), replace(lens, T_cam_world=pose), *image, backend=cpu)
