"""The numbered contract of ``gs2d.render.api``, rule 22: depth from continuous transmittance, on every backend.

Camera at the origin along +z, 9 x 9 px, focal length 10 px; with ``depth_width_px`` = 1, kappa = 0.1. Pixel (4, 4)
looks along the axis, through the centres of splats at (0, 0, z) that face it. F(x) = (2 + 3x - x^3) / 4 is inverted
by hand, by iterating x = (4F - 2 + x^3) / 3.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.errors import BackendError, ShapeError
from gs2d.kernels.library import load
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend
from gs2d.render.cpu_backend import CpuBackend
from gs2d.render.reference_backend import PLAIN
from gs2d.render.tensor_api import CameraTensors, SplatTensors, rasterize_2dgs
from gs2d.render.types import RasterSettings
from render_scenes import (
    Y_AXIS,
    equal,
    front_camera,
    random_camera,
    random_splats,
    repeatable,
    requiring_grad,
    splat,
    stack,
)

SETTINGS = RasterSettings(with_transmittance_depth=True, depth_width_px=1.0)
GEOMETRY = ("means", "quats", "log_scales", "opacity_logits")


def depth_of(scene: Splats, backend: Backend, settings: RasterSettings = SETTINGS) -> Tensor:
    return rasterize(scene, front_camera(), settings, backend=backend).depth("transmittance")


def facing(z: float, opacity: float) -> Splats:
    """Return a wide splat perpendicular to the axis."""
    return splat((0, 0, z), scales=(4, 4), opacity=opacity)


# values ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("opacity", [0.05, 0.5, 0.999])
def test_22_a_single_splat_of_any_opacity_has_its_own_depth(backend: Backend, opacity: float) -> None:
    # Half of alpha lies before z where F = 1/2, at x = 0.
    equal(depth_of(facing(2.0, opacity), backend)[4, 4], 2.0)


def test_22_a_slanted_splat_has_the_depth_of_its_plane(backend: Backend) -> None:
    out = rasterize(splat(scales=(2, 2), axis=Y_AXIS, degrees=50), front_camera(), SETTINGS, backend=backend)
    assert float(out.depth_mean.max() - out.depth_mean[out.depth_mean > 0].min()) > 0.5
    equal(out.depth("transmittance"), out.depth_mean)


def test_22_coincident_splats_hide_half_of_what_they_hide_before_their_middle(backend: Backend) -> None:
    # alpha = 0.75; (1 - F/2)^2 = 0.625, F = 0.418861, x = -0.108612, z = 2 (1 - 0.0108612).
    equal(depth_of(stack(facing(2, 0.5), facing(2, 0.5)), backend)[4, 4], 1.9782776)


def test_22_the_half_may_lie_in_the_front_layer(backend: Backend) -> None:
    # alpha = 0.6 + 0.4 * 0.5 = 0.8; 0.6 F = 0.4, F = 2/3, x = 0.226074, z = 2 (1 + 0.0226074).
    equal(depth_of(stack(facing(2, 0.6), facing(5, 0.5)), backend)[4, 4], 2.0452148)


def test_22_the_half_may_lie_in_the_layer_behind(backend: Backend) -> None:
    # alpha = 0.3 + 0.7 * 0.9 = 0.93; 0.7 (1 - 0.9 F) = 0.535, F = 0.261905, x = -0.329370, z = 5 (1 - 0.0329370).
    equal(depth_of(stack(facing(2, 0.3), facing(5, 0.9)), backend)[4, 4], 4.8353150)


def test_22_the_width_is_a_setting_and_goes_with_the_focal_length(backend: Backend) -> None:
    # As above, with kappa = 3 / 10 and 1 / 30.
    scene = stack(facing(2, 0.5), facing(2, 0.5))
    equal(depth_of(scene, backend, replace(SETTINGS, depth_width_px=3.0))[4, 4], 2 * (1 - 0.0325836))
    out = rasterize(scene, front_camera(focal=30.0), SETTINGS, backend=backend)
    equal(out.depth("transmittance")[4, 4], 2 * (1 - 0.00362040))


def test_22_the_order_of_blending_does_not_matter(backend: Backend) -> None:
    # Two slanted splats cross: beside the centre the second in blending order is in front of the first.
    first = splat((0, 0, 2.0), scales=(2, 2), axis=Y_AXIS, degrees=40, opacity=0.6)
    second = splat((0, 0, 2.0), scales=(2, 2), axis=Y_AXIS, degrees=-40, opacity=0.7)
    either = [stack(first, second), stack(second, first)]  # equal centres: the row index decides the order (rule 2)
    depths = [depth_of(scene, backend) for scene in either]
    medians = [rasterize(scene, front_camera(), SETTINGS, backend=backend).depth_median for scene in either]
    equal(depths[0], depths[1])
    assert float((medians[0] - medians[1]).abs().max()) > 0.3


def test_22_splats_behind_the_stop_do_not_count(backend: Backend) -> None:
    # Opacity 0.98 twice leaves T = 0.0004, the third stops the pixel (rule 7): alpha = 0.9996, 0.98 F = 0.4998,
    # F = 0.51, x = 0.013334, z = 2 (1 + 0.0013334).
    layers = [facing(2 + i, 0.98) for i in range(3)]
    found = depth_of(stack(*layers, facing(6, 0.1)), backend)
    equal(found[4, 4], 2.0026668)
    assert torch.equal(found[4, 4], depth_of(stack(*layers[:2]), backend)[4, 4])


def test_22_it_is_0_where_nothing_was_blended(backend: Backend) -> None:
    out = rasterize(splat(scales=(0.05, 0.05)), front_camera(), SETTINGS, backend=backend)
    assert bool((out.depth("transmittance")[out.alpha == 0] == 0).all())
    assert int((out.alpha == 0).sum()) > 40
    assert bool((depth_of(splat().rows(torch.zeros(0, dtype=torch.int64)), backend) == 0).all())


# gradients ---------------------------------------------------------------------------------------------------------
def test_22_the_gradient_reaches_every_splat_of_the_pixel(backend: Backend) -> None:
    scene = requiring_grad(stack(facing(2.0, 0.4), facing(2.05, 0.5), facing(2.1, 0.6), facing(9.0, 0.9)))
    depth = depth_of(scene, backend)[4, 4]
    depth.backward()
    assert scene.means.grad is not None
    assert scene.opacity_logits.grad is not None
    by_z = scene.means.grad[:, 2]
    assert bool((by_z[:3] > 0.1).all())
    assert float(by_z[3]) == 0  # beyond the width
    equal((by_z * scene.means[:, 2]).sum(), depth)  # scaling all depths scales z
    # A splat in front pulls the depth forward as its opacity grows; any splat behind pushes it back.
    assert float(scene.opacity_logits.grad[0]) < 0 < float(scene.opacity_logits.grad[3])


def test_22_between_two_surfaces_the_gradient_is_limited(backend: Backend) -> None:
    # alpha = 0.4975 + 0.5025 * 0.99 = 0.994975: half of it is 0.4974875, all but 0.0025 % of the first layer. There
    # F' = 0.0086 and -dT/dz = 0.0043 / (kappa z): the gradient takes 0.05 alpha / (kappa z), kappa = 0.1.
    scene = requiring_grad(stack(facing(2.0, 0.4975), facing(6.0, 0.99)))
    depth = depth_of(scene, backend)[4, 4]
    depth.backward()
    assert scene.opacity_logits.grad is not None
    slope = 0.05 * 0.994975 / (0.1 * float(depth.detach()))
    # d logit of 0.4975: alpha (1 - alpha) = 0.24999; of T(z): -F, of A / 2: 0.5 * 0.01.
    assert float(scene.opacity_logits.grad[0]) == pytest.approx(-0.24999 * (0.999975 - 0.005) / slope, rel=1e-3)


def test_22_gradients_are_those_of_finite_differences() -> None:
    for seed in (3, 8):
        rng = np.random.default_rng(seed)
        camera = random_camera(rng).resized(8, 8)
        scene = random_splats(rng, camera, 12, ("plain", "opaque", "huge", "twins"))
        cotangent = torch.tensor(rng.normal(size=(8, 8)))

        def loss(splats: Splats, camera: Camera = camera, cotangent: Tensor = cotangent) -> Tensor:
            depth = PLAIN.rasterize(splats, camera, SETTINGS).depth("transmittance")
            return (cotangent * depth).sum() + (depth * depth).sum()

        leaves = requiring_grad(scene)
        loss(leaves).backward()
        for name in GEOMETRY:
            tensor, step = getattr(scene, name), 1e-6
            direction = torch.tensor(rng.normal(size=tensor.shape))
            ahead, behind = (float(loss(replace(scene, **{name: tensor + s * direction}))) for s in (step, -step))
            found = float((getattr(leaves, name).grad * direction).sum())
            assert found == pytest.approx((ahead - behind) / (2 * step), rel=1e-5, abs=1e-6), (seed, name)


def random_cases(count: int) -> Iterator[tuple[int, Splats, Camera]]:
    for seed in range(count):
        rng = np.random.default_rng(seed)
        camera = random_camera(rng)
        yield seed, random_splats(rng, camera, int(rng.integers(1, 40))).to(dtype=torch.float32), camera


def gradients(output_depth: Tensor, distortion: Tensor, leaves: Splats, valid: Tensor, seed: int) -> dict[str, Tensor]:
    """Return gradients for random cotangents; every second seed includes the distortion."""
    rng = np.random.default_rng(seed)
    of_depth, of_distortion = (torch.tensor(rng.normal(size=valid.shape)) for _ in range(2))
    loss = (output_depth.double() * of_depth * valid).sum() + seed % 2 * (distortion.double() * of_distortion).sum()
    loss.backward()
    return {name: getattr(leaves, name).grad.double() for name in GEOMETRY}


def test_22_values_and_gradients_agree_with_the_reference(backend: Backend) -> None:
    errors, found = [], []
    for seed, splats, camera in random_cases(12 if backend.name == "cuda" else 25):
        if backend.name == "reference":
            splats = splats.to(dtype=torch.float32)
        low, high = requiring_grad(splats), requiring_grad(splats.to(dtype=torch.float64))
        a = rasterize(low, camera, SETTINGS, backend=backend)
        b = PLAIN.rasterize(high, camera, SETTINGS)
        depth = b.depth("transmittance")
        error = (a.depth("transmittance").double() - depth).abs() / depth.clamp(min=0.1)
        errors.append(error.detach().flatten())
        valid = error.detach() < 1e-4
        expected = gradients(depth, b.distortion, high, valid, seed)
        for name, gradient in gradients(a.depth("transmittance"), a.distortion, low, valid, seed).items():
            if float(expected[name].norm()) > 1e-3:
                found.append(float((gradient - expected[name]).norm() / expected[name].norm()))
    merged = torch.cat(errors).numpy()
    assert np.quantile(merged, 0.5) < 2e-6
    assert np.quantile(merged, 0.999) < 2e-4
    assert np.median(found) < 2e-4
    assert np.quantile(found, 0.95) < 5e-3


def test_22_the_double_kernels_agree_with_the_reference_to_the_last_digits() -> None:
    try:
        library = load("f64")
    except BackendError as error:
        pytest.skip(str(error))
    for seed, splats, camera in random_cases(6):
        low, high = (requiring_grad(splats.to(dtype=torch.float64)) for _ in range(2))
        a, b = CpuBackend(library).rasterize(low, camera, SETTINGS), PLAIN.rasterize(high, camera, SETTINGS)
        depth = b.depth("transmittance")
        torch.testing.assert_close(a.depth("transmittance"), depth, rtol=1e-11, atol=1e-12)
        everywhere = torch.ones_like(depth, dtype=torch.bool)
        expected = gradients(depth, b.distortion, high, everywhere, seed)
        for name, gradient in gradients(a.depth("transmittance"), a.distortion, low, everywhere, seed).items():
            assert float((gradient - expected[name]).norm()) <= 1e-6 * float(expected[name].norm()) + 1e-9, (seed, name)


def test_22_the_rows_that_learn_get_the_same_bits(backend: Backend) -> None:
    camera = front_camera(20, 20, 20.0)
    scene = random_splats(np.random.default_rng(2), camera, 30, ("plain", "huge")).to(dtype=torch.float32)
    rows = torch.arange(30) % 3 == 0
    found = []
    for chosen in (None, rows):
        leaves = requiring_grad(scene)
        with repeatable(backend):
            out = rasterize(leaves, camera, SETTINGS, backend=backend, gradient_rows=chosen)
            out.depth("transmittance").sum().backward()
        assert leaves.means.grad is not None
        found.append(leaves.means.grad)
    assert torch.equal(found[0][rows], found[1][rows])
    assert bool((found[1][~rows] == 0).all())
    assert bool((found[0][~rows] != 0).any())


# requested outputs ---------------------------------------------------------------------------------------------------
def test_22_without_the_setting_there_is_none_and_all_else_is_the_same(backend: Backend) -> None:
    scene = random_splats(np.random.default_rng(1), front_camera(), 20).to(dtype=torch.float32)
    without = rasterize(scene, front_camera(), RasterSettings(), backend=backend)
    within = rasterize(scene, front_camera(), RasterSettings().for_depths(None, "transmittance"), backend=backend)
    assert without.depth_transmittance is None
    with pytest.raises(ValueError, match="transmittance"):
        without.depth("transmittance")
    for name, image in vars(without).items():
        assert image is None or torch.equal(image, getattr(within, name)), name


@pytest.mark.parametrize("width", [0.0, -1.0, float("nan"), 5.0])
def test_22_a_width_that_is_none_is_refused(width: float) -> None:
    with pytest.raises(ShapeError, match=r"RasterSettings\.depth_width_px"):
        rasterize(splat(), front_camera(), replace(SETTINGS, depth_width_px=width), backend="reference")


def test_22_bare_tensors_refuse_it() -> None:
    s = splat()
    splats = SplatTensors(s.means, s.quats, s.scales, s.opacities, torch.ones(1, 3))
    cameras = CameraTensors(torch.eye(4)[None], torch.eye(3)[None], 8, 8)
    with pytest.raises(ShapeError, match="no depth by transmittance"):
        rasterize_2dgs(splats, cameras, settings=SETTINGS, backend="reference")
