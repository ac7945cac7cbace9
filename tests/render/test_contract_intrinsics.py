"""Rule 21 of the contract: the gradient of focal lengths and principal point, on every backend."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.errors import ShapeError
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings
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


def scene(seed: int, kinds: tuple[str, ...] = SMOOTH) -> tuple[Splats, Camera, dict[str, Tensor]]:
    rng = np.random.default_rng(seed)
    camera = random_camera(rng)
    return random_splats(rng, camera, 12, kinds), camera, random_cotangents(rng, camera)


def learning(camera: Camera, dtype: torch.dtype = torch.float64) -> tuple[Camera, Tensor]:
    """Return the same camera, rounded to ``dtype``, and intrinsics that require a gradient."""
    intrinsics = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=dtype, requires_grad=True)
    fx, fy, cx, cy = intrinsics.tolist()
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, intrinsics=intrinsics), intrinsics


def gradient(splats: Splats, camera: Camera, cotangents: dict[str, Tensor], backend: Backend | str) -> Tensor:
    lens, intrinsics = learning(camera)
    contraction(rasterize(splats, lens, backend=backend), cotangents).backward()
    assert intrinsics.grad is not None
    return intrinsics.grad


@pytest.mark.parametrize("image", IMAGES)
def test_21_the_gradient_agrees_with_finite_differences(image: str) -> None:
    splats, camera, cotangents = scene(3)
    cotangents = {image: cotangents[image]}
    found, step = gradient(splats, camera, cotangents, "reference"), 1e-5
    for k, name in enumerate(("fx", "fy", "cx", "cy")):
        ends = [
            float(
                contraction(
                    rasterize(splats, replace(camera, **{name: getattr(camera, name) + end}), backend="reference"),
                    cotangents,
                )
            )
            for end in (step, -step)
        ]
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(float(found[k]), rel=1e-5, abs=1e-6)
    if image != "alpha":
        assert found.abs().min() > 1e-6


@pytest.mark.parametrize("image", IMAGES)
def test_21_each_image_tells_every_backend_how_it_changes_with_the_intrinsics(backend: Backend, image: str) -> None:
    splats, camera, cotangents = scene(3)
    cotangents = {image: cotangents[image]}
    expected = gradient(splats, camera, cotangents, "reference")
    found = gradient(splats.to(torch.float32), camera, cotangents, backend)
    assert_close(found, expected, rtol=2e-3, atol=2e-4 * float(expected.abs().max()))


@pytest.mark.parametrize("seed", range(3))
def test_21_awkward_splats_agree_with_the_reference(backend: Backend, seed: int) -> None:
    splats, camera, cotangents = scene(seed, ("plain", "edge_on", "tiny", "crossing", "twins", "behind"))
    expected = gradient(splats, camera, {"color": cotangents["color"]}, "reference")
    found = gradient(splats.to(torch.float32), camera, {"color": cotangents["color"]}, backend)
    assert_close(found, expected, rtol=1e-2, atol=2e-3 * float(expected.abs().max()))


def test_21_a_splat_that_moves_with_the_principal_point_is_worked_out_by_hand(backend: Backend) -> None:
    """The spot of a small round splat at (x, y, z) moves by dcx + x/z dfx, and so does the image's first moment.

    The tolerance covers the rim where alpha falls below alpha_min, 1/40 of the mass.
    """
    one = splat(mean=(0.5, -0.25, 5.0), scales=(0.3, 0.3), opacity=0.9, color=(1.0, 1.0, 1.0))
    camera = Camera(80, 80, 60.0, 60.0, 40.0, 40.0, np.eye(4))
    lens, intrinsics = learning(camera)
    output = rasterize(one, lens, backend=backend)
    x = torch.arange(80) + 0.5
    mass = output.alpha.detach().sum()
    (output.alpha * (x - 46.0)).sum().backward()
    assert intrinsics.grad is not None
    assert_close(intrinsics.grad[2], mass.double(), rtol=4e-2, atol=0.0)
    assert_close(intrinsics.grad[0], 0.1 * mass.double(), rtol=4e-2, atol=0.0)
    assert_close(intrinsics.grad[[1, 3]].abs() < 1e-2 * mass, torch.tensor([True, True]))


def test_21_images_and_all_other_gradients_keep_their_bits(backend: Backend) -> None:
    splats, camera, cotangents = scene(2)
    splats, camera = splats.to(torch.float32), replace(camera, T_cam_world=torch.tensor(camera.T_cam_world))
    found = []
    for lens in (camera, learning(camera)[0]):
        pose = torch.tensor(camera.T_cam_world, requires_grad=True)
        leaves, probe = requiring_grad(splats), torch.zeros(len(splats), 4, requires_grad=True)
        with repeatable(backend):
            output = rasterize(leaves, replace(lens, T_cam_world=pose), backend=backend, screen_probe=probe)
            contraction(output, cotangents).backward()
        grads = [t.grad for _, t in leaves.items()] + [probe.grad, pose.grad]
        found.append([getattr(output, name) for name in IMAGES] + grads)
    for before, after in zip(*found, strict=True):
        assert torch.equal(before, after)


def test_21_the_intrinsics_learn_where_nothing_else_does(backend: Backend) -> None:
    splats, camera, cotangents = scene(1)
    lens, intrinsics = learning(camera, torch.float32)
    contraction(rasterize(splats.to(torch.float32), lens, backend=backend), cotangents).backward()
    assert intrinsics.grad is not None
    assert intrinsics.grad.dtype == torch.float32
    assert bool((intrinsics.grad != 0).all())


def test_21_splats_that_are_not_finite_do_not_count(backend: Backend) -> None:
    splats, camera, cotangents = scene(1)
    splats = splats.to(torch.float32)
    expected = gradient(splats.rows(torch.arange(1, 12)), camera, cotangents, backend)
    splats.means[0] = torch.nan
    assert_close(gradient(splats, camera, cotangents, backend), expected, rtol=1e-5, atol=1e-6)


def test_21_where_nothing_is_seen_the_gradient_is_zero(backend: Backend) -> None:
    _, camera, cotangents = scene(0)
    for splats in (splat().rows(torch.arange(0)), splat(mean=(1e3, 0, -5))):
        assert not gradient(splats, camera, cotangents, backend).any()


def test_21_gradient_rows_are_refused(backend: Backend) -> None:
    splats, camera, _ = scene(0)
    splats, rows = splats.to(torch.float32), torch.ones(12, dtype=torch.bool)
    with pytest.raises(ShapeError, match="gradient_rows"):
        rasterize(splats, learning(camera)[0], backend=backend, gradient_rows=rows)
    with torch.no_grad():
        rasterize(splats, learning(camera)[0], backend=backend, gradient_rows=rows)


def test_20_21_the_bits_do_not_depend_on_the_number_of_threads(cpu: Backend) -> None:
    rng = np.random.default_rng(0)
    camera, found, before = random_camera(rng), [], torch.get_num_threads()
    splats = random_splats(rng, camera, 5000, ("tiny",)).to(torch.float32)
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            lens, intrinsics = learning(camera)
            pose = torch.tensor(camera.T_cam_world, requires_grad=True)
            output = rasterize(splats, replace(lens, T_cam_world=pose), backend=cpu)
            (output.color.square().mean() + output.normal[..., 0].mean()).backward()
            found.append([intrinsics.grad, pose.grad])
    finally:
        torch.set_num_threads(before)
    for first, *others in zip(*found, strict=True):
        assert first is not None
        assert first.any()
        assert all(torch.equal(first, other) for other in others)


def test_21_intrinsics_that_moved_on_without_their_camera_are_refused(cpu: Backend) -> None:
    splats, camera, _ = scene(0)
    lens, intrinsics = learning(camera)
    with torch.no_grad():
        intrinsics[0] += 1.0  # like an optimizer step
    with pytest.raises(ShapeError, match="camera"):
        rasterize(splats.to(torch.float32), lens, backend=cpu)
    with pytest.raises(ShapeError, match="must be a tensor"):
        replace(camera, intrinsics=intrinsics)


def test_21_a_camera_of_another_size_learns_the_same_intrinsics(cpu: Backend) -> None:
    splats, camera, _ = scene(0)
    lens, intrinsics = learning(replace(camera, width=20, height=16), torch.float32)
    for other, factor in ((lens.downscaled(2), 0.5), (lens.resized(30, 24), 1.5)):
        intrinsics.grad = None
        rasterize(splats.to(torch.float32), other, RasterSettings(), backend=cpu).color.sum().backward()
        scaled, of_scaled = learning(replace(other, intrinsics=None), torch.float32)
        rasterize(splats.to(torch.float32), scaled, backend=cpu).color.sum().backward()
        assert of_scaled.grad is not None
        assert_close(intrinsics.grad, factor * of_scaled.grad)
