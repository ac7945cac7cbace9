"""The numbered contract of ``gs2d.render.api``, rules 7 to 12: pixel values and gradients.

Every test runs on every backend. Unless stated: camera at the origin along +z, 9 x 9 px, focal length 10 px, so that
pixel (column 4 + k, row 4) looks along (k / 10, 0, 1); a splat faces it at z = 2 with scale 0.4, where one pixel is
0.2 world units: u = k / 2, rho3d = k^2 / 4.
"""

from __future__ import annotations

from dataclasses import replace
from math import cos, radians, sin, sqrt

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from gs2d.core.camera import Camera, look_at
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend
from gs2d.render.types import PLAIN_COLORS, RasterSettings
from render_scenes import (
    BLUE,
    C0,
    GREEN,
    IMAGES,
    Y_AXIS,
    contraction,
    equal,
    front_camera,
    random_camera,
    random_cotangents,
    random_splats,
    requiring_grad,
    splat,
    stack,
)


# 7 ---------------------------------------------------------------------------------------------------------------
def test_07_colours_blend_front_to_back_over_the_background(backend: Backend) -> None:
    # w = 0.6 and 0.4 * 0.5 = 0.2; T_final = 0.2.
    scene = stack(splat((0, 0, 2), opacity=0.6, color=(1.0, 0.5, 0.0)), splat((0, 0, 3), opacity=0.5, color=GREEN))
    settings = RasterSettings(background=(0.1, 0.2, 1.0))
    out = rasterize(scene, front_camera(), settings, backend=backend)
    equal(out.color[4, 4], [0.6 + 0.02, 0.3 + 0.2 + 0.04, 0.2])
    equal(out.alpha[4, 4], 0.8)


def test_07_a_pixel_stops_before_the_splat_that_would_make_it_opaque(backend: Backend) -> None:
    # Opacity 0.98: T = 1, 0.02, 0.0004; the third would leave 8e-6 < 1e-4. The fourth (0.1) would leave 3.6e-4, but
    # the pixel has stopped.
    layers = [splat((0, 0, 2 + i), scales=(2, 2), opacity=o, color=BLUE) for i, o in enumerate((0.98, 0.98, 0.98, 0.1))]
    out = rasterize(stack(*layers), front_camera(), backend=backend)
    equal(1 - out.alpha[4, 4], 0.0004)
    equal(out.depth_mean[4, 4], (0.98 * 2 + 0.0196 * 3) / 0.9996)


def test_07_the_stop_is_a_setting(backend: Backend) -> None:
    # T = 1, 0.4, 0.16; the third would leave 0.064 < 0.1.
    layers = [splat((0, 0, 2 + i), scales=(2, 2), opacity=0.6) for i in range(3)]
    out = rasterize(stack(*layers), front_camera(), RasterSettings(transmittance_min=0.1), backend=backend)
    equal(out.alpha[4, 4], 0.84)


# 8 ---------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("degrees", [0, 180])
def test_08_normals_face_the_camera(backend: Backend, degrees: float) -> None:
    # t_w = (0, 0, 1) points away and is flipped; after half a turn about y it is (0, 0, -1) and is kept.
    out = rasterize(splat(axis=Y_AXIS, degrees=degrees, opacity=0.7), front_camera(), backend=backend)
    equal(out.normal[4, 4], [0.0, 0.0, -0.7])


def test_08_normals_are_weighted_sums_and_not_normalised(backend: Backend) -> None:
    # Front: 60 degrees about y, t_w = (0.866, 0, 0.5), flipped to (-0.866, 0, -0.5); behind: (0, 0, -1). w = 0.5, 0.25.
    scene = stack(splat(axis=Y_AXIS, degrees=60), splat((0, 0, 3)))
    normal = rasterize(scene, front_camera(), backend=backend).normal
    equal(normal[4, 4], [-0.5 * sqrt(3) / 2, 0.0, -0.5 * 0.5 - 0.25])


def test_08_normals_are_in_the_world_frame(backend: Backend) -> None:
    camera = look_at(np.array([5.0, 0, 0]), np.zeros(3), np.array([0, -1.0, 0]), width=9, height=9, fx=10)
    out = rasterize(splat((3, 0, 0), axis=Y_AXIS, degrees=90, opacity=0.7), camera, backend=backend)
    equal(out.normal[4, 4], [0.7, 0.0, 0.0])


def test_08_the_facing_side_is_determined_at_the_splats_centre_for_all_pixels(backend: Backend) -> None:
    # Centre (1, 0, 2), normal t_w = (cos a, 0, -sin a) with <t_w, p> = cos a - 2 sin a: a = 30 degrees: -0.134 < 0, so
    # t_w is kept in every pixel of the splat; with a = 20 degrees +0.256 > 0, and it is flipped.
    for a, sign in ((30, 1.0), (20, -1.0)):
        scene = splat((1, 0, 2), scales=(3, 3), axis=Y_AXIS, degrees=90 + a)  # t_w = (sin(90+a), 0, cos(90+a))
        out = rasterize(scene, front_camera(), backend=backend)
        seen = out.alpha > 0
        unit = (out.normal / out.alpha.clamp(min=1e-9)[..., None])[seen]
        expected = sign * torch.tensor([cos(radians(a)), 0.0, -sin(radians(a))])
        assert len(unit) > 5
        equal(unit, expected.expand_as(unit))


# 9 ---------------------------------------------------------------------------------------------------------------
def test_09_mean_depth_is_divided_by_alpha(backend: Backend) -> None:
    # w = 0.5 at z = 2, 0.25 at z = 4: (1 + 1) / 0.75.
    out = rasterize(stack(splat((0, 0, 2)), splat((0, 0, 4))), front_camera(), backend=backend)
    equal(out.depth_mean[4, 4], 2 / 0.75)


@pytest.mark.parametrize(("opacity", "median"), [(0.6, 2.0), (0.4, 4.0), (0.25, 6.0), (0.1, 6.0)])
def test_09_median_depth_is_that_of_the_last_splat_reached_by_more_than_half_the_light(
    backend: Backend, opacity: float, median: float
) -> None:
    # Incoming T of the three: 0.6: 1, 0.4. 0.4: 1, 0.6, 0.36. 0.25: 1, 0.75, 0.5625. 0.1: all.
    layers = [splat((0, 0, z), opacity=opacity) for z in (2, 4, 6)]
    equal(rasterize(stack(*layers), front_camera(), backend=backend).depth_median[4, 4], median)


def test_09_median_gradient_goes_to_its_own_depth_alone(backend: Backend) -> None:
    scene = requiring_grad(stack(*[splat((0, 0, z), opacity=0.4) for z in (2, 4, 6)]))
    rasterize(scene, front_camera(), backend=backend).depth_median[4, 4].backward()
    equal(scene.means.grad, [[0.0, 0, 0], [0, 0, 1], [0, 0, 0]])
    equal(scene.opacity_logits.grad, [0.0, 0, 0])


def test_09_depths_are_zero_where_nothing_was_hit(backend: Backend) -> None:
    out = rasterize(splat(opacity=0.1), front_camera(21, 21), backend=backend)
    assert float(out.alpha[0, 0]) == float(out.depth_mean[0, 0]) == float(out.depth_median[0, 0]) == 0


# 10 --------------------------------------------------------------------------------------------------------------
def test_10_distortion_sums_squared_differences_of_mapped_depth_over_pairs(backend: Backend) -> None:
    # near 0.2, far 100: m = 100 / 99.8 (1 - 0.2 / z). w = 0.5, 0.25, 0.125.
    out = rasterize(stack(*[splat((0, 0, z)) for z in (2, 4, 8)]), front_camera(), backend=backend)
    m2, m4, m8 = (100 / 99.8 * (1 - 0.2 / z) for z in (2, 4, 8))
    expected = 0.5 * 0.25 * (m2 - m4) ** 2 + 0.5 * 0.125 * (m2 - m8) ** 2 + 0.25 * 0.125 * (m4 - m8) ** 2
    assert float(out.distortion[4, 4]) == pytest.approx(expected, rel=1e-4)


def test_10_one_layer_has_no_distortion(backend: Backend) -> None:
    out = rasterize(splat(axis=Y_AXIS, degrees=45), front_camera(), backend=backend)
    assert float(out.distortion.abs().max()) < 1e-8


def test_10_distortion_gradients_reach_weights_and_depths(backend: Backend) -> None:
    # D = w1 w2 d^2, w1 = a1, w2 = (1 - a1) a2, d = m2 - m1. dD/da1 = (1 - 2 a1) a2 d^2, 0 at a1 = 1/2, so a1 = 0.3.
    # dD/dz2 = 2 w1 w2 d m'(z2), m'(z) = far near / (far - near) / z^2.
    scene = requiring_grad(stack(splat((0, 0, 2), opacity=0.3), splat((0, 0, 4), opacity=0.5)))
    rasterize(scene, front_camera(), backend=backend).distortion[4, 4].backward()
    c = 100 * 0.2 / 99.8
    d = c * (1 / 2 - 1 / 4)
    assert scene.means.grad is not None
    assert scene.opacity_logits.grad is not None
    assert float(scene.opacity_logits.grad[0]) == pytest.approx((1 - 0.6) * 0.5 * d * d * 0.3 * 0.7, rel=1e-3)
    assert float(scene.means.grad[1, 2]) == pytest.approx(2 * 0.3 * 0.35 * d * c / 16, rel=1e-3)
    assert float(scene.means.grad[0, 2]) == pytest.approx(-2 * 0.3 * 0.35 * d * c / 4, rel=1e-3)


# 11 --------------------------------------------------------------------------------------------------------------
def test_11_colour_is_seen_along_the_direction_from_the_camera_centre(backend: Backend) -> None:
    # Camera at (0, 0, -1), splat at (0.6, 0, -0.2): direction (0.6, 0, 0.8). Degree 1: Y = C1 (-y, z, -x).
    C1 = sqrt(3 / (4 * np.pi))
    T = np.eye(4)
    T[2, 3] = 1.0
    camera = Camera(9, 9, 10.0, 10.0, -3.0, 4.5, T)  # projects to x = 10 * 0.75 - 3 = 4.5
    scene = splat((0.6, 0, -0.2), color=(0.5, 0.5, 0.5), opacity=0.5)
    scene = replace(scene, shN=torch.tensor([[[0.3, 0, 0], [0, 0.3, 0], [0, 0, 0.3]]]))
    color = rasterize(scene, camera, backend=backend).color
    equal(color[4, 4] / 0.5, [0.5, 0.5 + C1 * 0.8 * 0.3, 0.5 - C1 * 0.6 * 0.3])


def test_11_only_the_requested_degree_is_evaluated(backend: Backend) -> None:
    scene = requiring_grad(replace(splat(), shN=torch.full((1, 15, 3), 0.2)))
    out = rasterize(scene, front_camera(), RasterSettings(sh_degree=1), backend=backend)
    # Along z only the coefficient of C1 z contributes.
    equal(out.color[4, 4, 0], 0.5 * (1.0 + 0.2 * sqrt(3 / (4 * np.pi))))
    out.color.sum().backward()
    assert scene.shN.grad is not None
    assert bool((scene.shN.grad[:, 3:] == 0).all())
    assert float(scene.shN.grad[0, 1, 0]) > 0


def test_11_clamped_channels_are_zero_with_zero_gradient_and_bright_ones_are_kept(backend: Backend) -> None:
    scene = requiring_grad(splat(color=(-0.2, 1.5, 0.5), opacity=0.5))
    out = rasterize(scene, front_camera(), backend=backend)
    equal(out.color[4, 4], [0.0, 0.75, 0.25])
    out.color.sum().backward()
    assert scene.sh0.grad is not None
    assert float(scene.sh0.grad[0, 0, 0]) == 0
    # d color / d sh0 = C0 sum of w over the image.
    equal(scene.sh0.grad[0, 0, 1:], (C0 * out.alpha.detach().sum()).expand(2))


def test_11_plain_colours_are_drawn_as_they_are_whatever_their_sign(backend: Backend) -> None:
    one = splat(scales=(50.0, 50.0), opacity=0.5)
    one.sh0 = torch.tensor([[[-3.0, 0.0, 70.25]]])
    settings = RasterSettings(sh_degree=PLAIN_COLORS, background=(-1.0, 2.0, 0.0))
    out = rasterize(one, front_camera(), settings, backend=backend)
    alpha = out.alpha[4, 4]
    expected = alpha * torch.tensor([-3.0, 0.0, 70.25]) + (1 - alpha) * torch.tensor([-1.0, 2.0, 0.0])
    equal(out.color[4, 4], expected)


def test_11_plain_colours_get_the_gradient_of_their_weights_and_the_harmonics_none(backend: Backend) -> None:
    rng = np.random.default_rng(5)
    camera = random_camera(rng)
    splats = random_splats(rng, camera, 12, ("plain", "huge"))
    settings = RasterSettings(sh_degree=PLAIN_COLORS)
    cotangents = random_cotangents(rng, camera)
    judge, leaves = requiring_grad(splats), requiring_grad(splats.to(torch.float32))
    contraction(rasterize(judge, camera, settings, backend="reference"), cotangents).backward()
    contraction(rasterize(leaves, camera, settings, backend=backend), cotangents).backward()
    for (name, tensor), (_, expected) in zip(leaves.items(), judge.items(), strict=True):
        if name == "shN":
            assert tensor.grad is None or not tensor.grad.any()
            continue
        assert tensor.grad is not None
        assert expected.grad is not None
        assert_close(tensor.grad.double(), expected.grad, rtol=2e-3, atol=2e-4 * float(expected.grad.abs().max()))


def test_11_plain_colours_carry_gradients_where_nothing_else_learns(backend: Backend) -> None:
    rng = np.random.default_rng(6)
    camera = random_camera(rng)
    splats = random_splats(rng, camera, 12, ("plain", "huge")).to(torch.float32)
    settings, found = RasterSettings(sh_degree=PLAIN_COLORS), []
    for all_learn in (False, True):
        leaves = requiring_grad(splats) if all_learn else splats.clone()
        leaves.sh0.requires_grad_()
        rasterize(leaves, camera, settings, backend=backend).color.square().sum().backward()
        found.append(leaves.sh0.grad)
    assert found[0] is not None
    assert found[0].any()
    assert_close(*found, rtol=1e-5, atol=1e-6)


# 12 --------------------------------------------------------------------------------------------------------------
def test_12_every_parameter_receives_a_gradient(backend: Backend) -> None:
    scene = splat((0.03, -0.05, 2), axis=(1, 2, 3), degrees=40)
    scene = requiring_grad(replace(scene, shN=torch.full((1, 15, 3), 0.05)))
    out = rasterize(scene, front_camera(), backend=backend)
    assert not out.radii.requires_grad
    weights = torch.linspace(0, 1, 81).reshape(9, 9)
    (out.color.sum(dim=2) * weights).sum().backward()
    for name, tensor in scene.items():
        assert tensor.grad is not None, name
        assert float(tensor.grad.abs().max()) > 1e-6, name


def test_12_without_gradients_the_images_are_the_same(backend: Backend) -> None:
    scene = requiring_grad(splat(axis=Y_AXIS, degrees=30))
    out = rasterize(scene, front_camera(), backend=backend)
    with torch.no_grad():
        plain = rasterize(scene, front_camera(), backend=backend)
    assert out.color.requires_grad
    assert not plain.color.requires_grad
    for name in IMAGES:
        assert torch.equal(getattr(out, name), getattr(plain, name)), name
