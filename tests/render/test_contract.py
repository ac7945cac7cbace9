"""The numbered contract of ``gs2d.render.api``, rule by rule, on every backend, with numbers worked by hand.

Unless stated: camera at the origin along +z, 9 x 9 px, focal length 10 px, so that pixel (column 4 + k, row 4) looks
along (k / 10, 0, 1); a splat faces it at z = 2 with scale 0.4, where one pixel is 0.2 wu: u = k / 2, rho3d = k^2 / 4.
"""

from __future__ import annotations

from dataclasses import replace
from math import cos, exp, log, radians, sin, sqrt

import numpy as np
import pytest
import torch
from render_scenes import C0, IMAGES, front_camera, requiring_grad, splat, stack
from torch import Tensor
from torch.testing import assert_close

from gs2d.camera import Camera, look_at
from gs2d.render.api import rasterize, splat_errors
from gs2d.render.backend import Backend
from gs2d.render.types import RasterSettings
from gs2d.splats import Splats

RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
Y_AXIS = (0.0, 1.0, 0.0)  # a turn by d degrees about y: t_u = (cos d, 0, -sin d), t_w = (sin d, 0, cos d)
TOLERANCE = {"rtol": 2e-5, "atol": 2e-6}


def equal(actual: Tensor | float, expected: Tensor | float | list[float]) -> None:
    assert_close(torch.as_tensor(actual).detach().double(), torch.as_tensor(expected).double(), **TOLERANCE)


# 1 ---------------------------------------------------------------------------------------------------------------
def test_01_pixels_are_sampled_at_their_centres(backend: Backend) -> None:
    # The centre projects to (4.5, 4.5), the centre of pixel (4, 4): there alpha = o, k pixels away o exp(-k^2 / 8).
    alpha = rasterize(splat(opacity=0.5), front_camera(), backend=backend).alpha
    equal(alpha[4, 4:8], [0.5 * exp(-k * k / 8) for k in range(4)])
    equal(alpha[4:8, 4], [0.5 * exp(-k * k / 8) for k in range(4)])
    equal(alpha[2, 5], 0.5 * exp(-(2 * 2 + 1 * 1) / 8))


def test_01_the_principal_point_is_general(backend: Backend) -> None:
    # c = (2, 7): half a pixel from the centres of columns 1 and 2 and of rows 6 and 7: k = 1/2 in both directions.
    alpha = rasterize(splat(opacity=0.5), front_camera(cx=2.0, cy=7.0), backend=backend).alpha
    equal(alpha[6:8, 1:3], torch.full((2, 2), 0.5 * exp(-(0.25 + 0.25) / 8)))


def test_01_focal_lengths_of_the_two_axes_are_separate(backend: Backend) -> None:
    # With fy = 20 a pixel is 0.1 wu high: v = k / 4, and rho2d = 2 k^2 is larger: rho = k^2 / 16.
    alpha = rasterize(splat(opacity=0.5), front_camera(fy=20.0), backend=backend).alpha
    equal(alpha[4, 6], 0.5 * exp(-4 / 8))
    equal(alpha[6, 4], 0.5 * exp(-4 / 32))


# 2 ---------------------------------------------------------------------------------------------------------------
def test_02_nearer_splats_are_in_front_whatever_their_row(backend: Backend) -> None:
    far, near = splat((0, 0, 3), color=RED, opacity=0.8), splat((0, 0, 2), color=GREEN, opacity=0.8)
    color = rasterize(stack(far, near), front_camera(), backend=backend).color
    equal(color[4, 4], [0.2 * 0.8, 0.8, 0.0])


def test_02_order_is_by_depth_along_the_axis_not_by_distance(backend: Backend) -> None:
    # The red centre is at depth 2 but distance 2.5; the green one at depth and distance 2.2. Red is in front.
    # Red at pixel (4, 4): u = -1.5 / 3, alpha = 0.5 exp(-1/8).
    red = splat((1.5, 0, 2), scales=(3, 3), color=RED, opacity=0.5)
    green = splat((0, 0, 2.2), color=GREEN, opacity=0.5)
    color = rasterize(stack(green, red), front_camera(), backend=backend).color
    equal(color[4, 4], [0.5 * exp(-1 / 8), 0.5 * (1 - 0.5 * exp(-1 / 8)), 0.0])


def test_02_equal_depths_go_by_row(backend: Backend) -> None:
    one, two = splat(color=RED, opacity=0.6), splat(color=GREEN, opacity=0.6)
    equal(rasterize(stack(one, two), front_camera(), backend=backend).color[4, 4], [0.6, 0.24, 0.0])
    equal(rasterize(stack(two, one), front_camera(), backend=backend).color[4, 4], [0.24, 0.6, 0.0])


# 3 ---------------------------------------------------------------------------------------------------------------
def test_03_a_slanted_splat_is_met_on_its_plane(backend: Backend) -> None:
    # Turned 45 degrees about y its plane is x + z = 2. Pixel (5, 4): x = z / 10, so z = 2 / 1.1; its distance from the
    # centre along t_u is sqrt(2) (2 - z), so u = sqrt(2) (2 - z) / s with s = 2.
    out = rasterize(splat(scales=(2, 2), axis=Y_AXIS, degrees=45, opacity=0.5), front_camera(), backend=backend)
    for k in (-4, -1, 1, 4):
        z = 2 / (1 + k / 10)
        u = sqrt(2) * (2 - z) / 2
        equal(out.depth_mean[4, 4 + k], z)
        equal(out.alpha[4, 4 + k], 0.5 * exp(-u * u / 2))


def test_03_the_two_scales_follow_the_two_tangents(backend: Backend) -> None:
    # s_u = 0.8 along x: u = k / 4. s_v = 0.4 along y: v = k / 2. Turned 90 degrees about z they change places.
    alpha = rasterize(splat(scales=(0.8, 0.4)), front_camera(), backend=backend).alpha
    equal([float(alpha[4, 6]), float(alpha[6, 4])], [0.5 * exp(-0.25 / 2), 0.5 * exp(-1 / 2)])
    turned = rasterize(splat(scales=(0.8, 0.4), degrees=90), front_camera(), backend=backend).alpha
    equal(turned, alpha.T)


def test_03_quaternions_are_normalised(backend: Backend) -> None:
    scene = splat(axis=(1, 2, 3), degrees=50)
    longer = replace(scene, quats=scene.quats * 3)
    equal(
        rasterize(longer, front_camera(), backend=backend).color,
        rasterize(scene, front_camera(), backend=backend).color,
    )


def test_03_the_camera_pose_moves_the_splat_into_its_frame(backend: Backend) -> None:
    # A camera at (5, 0, 0) that looks along -x sees a splat at (3, 0, 0) with normal x as the plain scene.
    camera = look_at(np.array([5.0, 0, 0]), np.zeros(3), np.array([0, -1.0, 0]), width=9, height=9, fx=10)
    out = rasterize(splat((3, 0, 0), axis=Y_AXIS, degrees=90), camera, backend=backend)
    plain = rasterize(splat(), front_camera(), backend=backend)
    equal(out.alpha, plain.alpha)
    equal(out.depth_mean, plain.depth_mean)


def test_03_an_edge_on_plane_is_not_hit_and_the_low_pass_filter_decides(backend: Backend) -> None:
    # Turned 90 degrees, the plane x = 0 holds the camera. rho = rho2d = 2 k^2; alpha = 0.5 exp(-k^2), depth z_c;
    # k = 2: 0.0092 > 1/255; k = 3: 6e-5, nothing.
    out = rasterize(splat(axis=Y_AXIS, degrees=90), front_camera(), backend=backend)
    equal(out.alpha[4, 4:8], [0.5, 0.5 * exp(-1), 0.5 * exp(-4), 0.0])
    equal(out.depth_mean[4, 4:7], [2.0, 2.0, 2.0])


def test_03_a_plane_met_behind_the_camera_is_not_hit(backend: Backend) -> None:
    # Turned 85 degrees: sin85 x + cos85 (z - 2) = 0, so z (sin85 k/10 + cos85) = 2 cos85.
    # k = -1 meets it behind the camera: the low-pass filter gives exp(-1) at z_c. k = 1: z = 0.9333.
    s, c = sin(radians(85)), cos(radians(85))
    out = rasterize(splat(scales=(5, 5), axis=Y_AXIS, degrees=85, opacity=0.5), front_camera(), backend=backend)
    equal(out.alpha[4, 3], 0.5 * exp(-1))
    equal(out.depth_mean[4, 3], 2.0)
    z = 2 * c / (0.1 * s + c)
    u = (2 - z) / s / 5  # along t_u = (c, 0, -s)
    equal(out.depth_mean[4, 5], z)
    equal(out.alpha[4, 5], 0.5 * exp(-u * u / 2))


# 4 ---------------------------------------------------------------------------------------------------------------
def test_04_a_tiny_splat_is_a_screen_gaussian_around_its_projected_centre(backend: Backend) -> None:
    # Mean (0.3, 0.1, 2) projects to (6, 5), between four pixel centres: rho2d = 2 (1/4 + 1/4) = 1.
    out = rasterize(splat((0.3, 0.1, 2), scales=(1e-4, 1e-4), opacity=0.8), front_camera(), backend=backend)
    equal(out.alpha[4:6, 5:7], torch.full((2, 2), 0.8 * exp(-0.5)))
    equal(out.alpha[4, 7], 0.8 * exp(-(1.5**2 + 0.5**2)))


def test_04_the_filter_width_is_a_setting(backend: Backend) -> None:
    settings = RasterSettings(lowpass_px=1.0)
    alpha = rasterize(splat(scales=(1e-4, 1e-4)), front_camera(), settings, backend=backend).alpha
    equal(alpha[4, 5], 0.5 * exp(-0.5))


def test_04_where_the_filter_wins_the_depth_is_the_centres(backend: Backend) -> None:
    # Turned 45 degrees about y, s = 0.02. Pixel (5, 4): z = 2 / 1.1 on the plane, u = 12.9: the filter (rho 2) wins.
    out = rasterize(splat(scales=(0.02, 0.02), axis=Y_AXIS, degrees=45), front_camera(), backend=backend)
    equal(out.depth_mean[4, 5], 2.0)
    equal(out.alpha[4, 5], 0.5 * exp(-1))


def test_04_the_filter_decides_pair_by_pair(backend: Backend) -> None:
    # s_u = 0.4 along x (rho3d = k^2/4 < 2 k^2), s_v = 0.05 along y (rho3d = 16 k^2 > 2 k^2).
    alpha = rasterize(splat(scales=(0.4, 0.05)), front_camera(), backend=backend).alpha
    equal(alpha[4, 6], 0.5 * exp(-4 / 8))
    equal(alpha[5, 4], 0.5 * exp(-2 / 2))


def test_04_the_ray_plane_depth_is_a_setting_of_the_reference() -> None:
    scene = splat(scales=(0.02, 0.02), axis=Y_AXIS, degrees=45)
    out = rasterize(scene, front_camera(), RasterSettings(lowpass_depth="plane"), backend="reference")
    equal(out.depth_mean[4, 5], 2 / 1.1)
    edge_on = splat(axis=Y_AXIS, degrees=90)  # no hit: the centre's depth remains
    out = rasterize(edge_on, front_camera(), RasterSettings(lowpass_depth="plane", near=0.5), backend="reference")
    assert float(out.depth_mean[4, 4]) == pytest.approx(2.0)


# 5 ---------------------------------------------------------------------------------------------------------------
def test_05_splats_at_or_before_near_are_culled_whole(backend: Backend) -> None:
    settings = RasterSettings(near=1.0)
    for z, drawn in ((-2.0, False), (0.5, False), (1.0, False), (1.001, True)):
        out = rasterize(splat((0, 0, z)), front_camera(), settings, backend=backend)
        assert bool(out.alpha.max() > 0) is drawn
        assert bool(out.radii[0] > 0) is drawn


def test_05_pairs_nearer_than_near_are_skipped(backend: Backend) -> None:
    # The plane x + z = 2: depth 2 / (1 + k / 10) = 1.818 at k = 1, 2 at k = 0, 2.22 at k = -1. near = 1.9.
    scene = splat(scales=(2, 2), axis=Y_AXIS, degrees=45)
    out = rasterize(scene, front_camera(), RasterSettings(near=1.9), backend=backend)
    full = rasterize(scene, front_camera(), backend=backend)
    equal(out.alpha[4, 5:], torch.zeros(4))
    equal(out.alpha[4, :5], full.alpha[4, :5])
    assert float(full.alpha[4, 5]) > 0.4


def test_05_a_splat_that_crosses_the_camera_plane_is_drawn_where_it_is_in_front(backend: Backend) -> None:
    # Centre at z = 0.5, turned 85 degrees, s = 3: the disc reaches z = 0.5 - 3 sin85. Focal 100: the ray is k / 100.
    # z = 0.5 cos85 / (sin85 k/100 + cos85): k = -4 gives 0.921, k = 4 gives 0.343.
    s, c = sin(radians(85)), cos(radians(85))
    scene = splat((0, 0, 0.5), scales=(3, 3), axis=Y_AXIS, degrees=85)
    out = rasterize(scene, front_camera(focal=100), backend=backend)
    for k in (-4, -2, 2, 4):
        z = 0.5 * c / (s * k / 100 + c)
        u = (0.5 - z) / s / 3
        equal(out.depth_mean[4, 4 + k], z)
        equal(out.alpha[4, 4 + k], 0.5 * exp(-u * u / 2))
        equal(out.alpha[0, 4 + k], 0.5 * exp(-(u * u + (-0.04 * z / 3) ** 2) / 2))


def test_05_a_crossing_splat_skips_pairs_before_near(backend: Backend) -> None:
    # Focal 10: k = 1 gives z = 0.2333, k = 2 gives 0.152 < 0.2 (the filter does not replace it: rho3d < rho2d).
    scene = splat((0, 0, 0.5), scales=(3, 3), axis=Y_AXIS, degrees=85)
    out = rasterize(scene, front_camera(), backend=backend)
    equal(out.depth_mean[4, 5], 0.5 * cos(radians(85)) / (0.1 * sin(radians(85)) + cos(radians(85))))
    equal(out.alpha[4, 6], 0.0)


# 6 ---------------------------------------------------------------------------------------------------------------
def test_06_the_footprint_ends_where_alpha_is_the_floor(backend: Backend) -> None:
    # 21 px: k up to 10. o = 0.5: 0.5 exp(-k^2 / 8) >= 1/255 up to k = 6 (0.0056); k = 7 gives 0.0011.
    camera = front_camera(21, 21)
    alpha = rasterize(splat(opacity=0.5), camera, backend=backend).alpha
    equal(alpha[10, 16], 0.5 * exp(-36 / 8))
    equal(alpha[10, 17], 0.0)
    # o = 0.1: k^2 <= 8 ln 25.5 = 25.9, so k = 5 is the last.
    alpha = rasterize(splat(opacity=0.1), camera, backend=backend).alpha
    equal(alpha[10, 15], 0.1 * exp(-25 / 8))
    equal(alpha[10, 16], 0.0)


def test_06_the_footprint_is_not_cut_at_three_sigma(backend: Backend) -> None:
    # s = 0.38 and k = 6: u = 3.158, rho = 9.97 > 9, alpha = 0.9 exp(-4.986) = 0.00615 > 1/255.
    alpha = rasterize(splat(scales=(0.38, 0.38), opacity=0.9), front_camera(21, 21), backend=backend).alpha
    equal(alpha[10, 16], 0.9 * exp(-((1.2 / 0.38) ** 2) / 2))


def test_06_splats_below_the_floor_are_culled(backend: Backend) -> None:
    out = rasterize(splat(opacity=0.0039), front_camera(), backend=backend)  # 1/255 = 0.003922
    equal(out.alpha, torch.zeros(9, 9))
    equal(out.radii, [0.0])


def test_06_the_floor_is_a_setting(backend: Backend) -> None:
    settings = RasterSettings(alpha_min=0.2)
    alpha = rasterize(splat(opacity=0.5), front_camera(), settings, backend=backend).alpha
    equal(alpha[4, 4:8], [0.5, 0.5 * exp(-1 / 8), 0.5 * exp(-4 / 8), 0.0])  # 0.303, then 0.162


def test_06_alpha_is_limited_and_the_limit_passes_gradients(backend: Backend) -> None:
    scene = requiring_grad(splat(opacity=0.999))
    out = rasterize(scene, front_camera(), backend=backend)
    equal(out.alpha[4, 4], 0.99)
    out.alpha[4, 4].backward()
    # d alpha / d logit = o (1 - o), as if there were no limit. o = sigmoid(logit) in float32.
    o = torch.sigmoid(scene.opacity_logits.detach().double())
    equal(scene.opacity_logits.grad, o * (1 - o))


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
    # t_w = (0, 0, 1) points away and is turned; after half a turn about y it is (0, 0, -1) and stays.
    out = rasterize(splat(axis=Y_AXIS, degrees=degrees, opacity=0.7), front_camera(), backend=backend)
    equal(out.normal[4, 4], [0.0, 0.0, -0.7])


def test_08_normals_are_weighted_sums_and_not_normalised(backend: Backend) -> None:
    # Front: 60 degrees about y, t_w = (0.866, 0, 0.5), turned to (-0.866, 0, -0.5); behind it (0, 0, -1). w = 0.5, 0.25.
    scene = stack(splat(axis=Y_AXIS, degrees=60), splat((0, 0, 3)))
    normal = rasterize(scene, front_camera(), backend=backend).normal
    equal(normal[4, 4], [-0.5 * sqrt(3) / 2, 0.0, -0.5 * 0.5 - 0.25])


def test_08_normals_are_in_the_world_frame(backend: Backend) -> None:
    camera = look_at(np.array([5.0, 0, 0]), np.zeros(3), np.array([0, -1.0, 0]), width=9, height=9, fx=10)
    out = rasterize(splat((3, 0, 0), axis=Y_AXIS, degrees=90, opacity=0.7), camera, backend=backend)
    equal(out.normal[4, 4], [0.7, 0.0, 0.0])


def test_08_the_side_is_judged_at_the_splats_centre_for_all_its_pixels(backend: Backend) -> None:
    # Centre (1, 0, 2), normal t_w = (cos a, 0, -sin a) with <t_w, p> = cos a - 2 sin a: a = 30 degrees: -0.134 < 0, so
    # t_w stays, in every pixel that the splat touches; with a = 20 degrees +0.256 > 0, and it turns.
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
    # D = w1 w2 d^2 with w1 = a1, w2 = (1 - a1) a2, d = m2 - m1. dD/da1 = (1 - 2 a1) a2 d^2 = 0 at a1 = 1/2, so a1 = 0.3.
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


def test_11_only_the_asked_degree_is_evaluated(backend: Backend) -> None:
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


# 13 --------------------------------------------------------------------------------------------------------------
def signal(backend: Backend, scene: Splats, columns: int, *pixels: tuple[int, int]) -> Tensor:
    """Gradient of the screen probe for the sum of alpha over (row, column) pixels."""
    probe = torch.zeros(len(scene), columns, requires_grad=True)
    alpha = rasterize(requiring_grad(scene), front_camera(), backend=backend, screen_probe=probe).alpha
    sum(alpha[p] for p in pixels).backward()  # type: ignore[union-attr]
    assert probe.grad is not None
    return probe.grad


@pytest.mark.parametrize("columns", [2, 4])
def test_13_the_probe_is_the_gradient_of_the_screen_map_in_official_units(backend: Backend, columns: int) -> None:
    # u = (x z - Tu.z) / (f s): du/dTu.z = -1 / (10 * 0.4) = -1/4. Pixel (5, 4): u = 1/2, dalpha/du = -u alpha.
    # Signal = z_c W/2 * alpha u / 4 = 2 * 4.5 * alpha / 8.
    alpha = 0.5 * exp(-1 / 8)
    equal(signal(backend, splat(), columns, (4, 5))[0, :2], [9 * alpha / 8, 0.0])
    alpha = 0.5 * exp(-4 / 8)  # two rows up: v = -1, signal = -9 * alpha / 4
    equal(signal(backend, splat(), columns, (2, 4))[0, :2], [0.0, -9 * alpha / 4])


def test_13_opposite_pixels_cancel_in_the_signed_half_and_add_in_the_absolute_half(backend: Backend) -> None:
    alpha = 0.5 * exp(-1 / 8)
    equal(signal(backend, splat(), 4, (4, 5), (4, 3)), [[0.0, 0.0, 2 * 9 * alpha / 8, 0.0]])


def test_13_the_low_pass_branch_does_not_count(backend: Backend) -> None:
    scene = splat((0.03, 0.02, 2), scales=(1e-3, 1e-3))
    equal(signal(backend, scene, 4, (4, 4), (5, 5)), [[0.0, 0.0, 0.0, 0.0]])


# 14 --------------------------------------------------------------------------------------------------------------
K_HALF = sqrt(2 * log(127.5))  # k of opacity 0.5 = 3.114


def radius(backend: Backend, scene: Splats, camera: Camera) -> float:
    return float(rasterize(scene, camera, backend=backend).radii[0])


def test_14_the_radius_is_half_the_longer_side_of_the_box(backend: Backend) -> None:
    camera = front_camera(33, 33)
    assert radius(backend, splat(), camera) == pytest.approx(K_HALF * 0.4 * 5, rel=1e-4)  # 5 px per wu at z = 2
    assert radius(backend, splat(scales=(0.1, 0.5)), camera) == pytest.approx(K_HALF * 0.5 * 5, rel=1e-4)


def test_14_the_box_of_a_slanted_splat_bounds_its_perspective_image(backend: Backend) -> None:
    # 45 degrees about y, a = k s sin45: y = f k s sin(phi) / (z_c - a cos(phi)), at most f k s / sqrt(z_c^2 - a^2);
    # x spans a f / (z_c - a) and -a f / (z_c + a), which is less.
    k_s = K_HALF * 0.4
    expected = 10 * k_s / sqrt(4 - k_s**2 / 2)
    camera = front_camera(33, 33)
    assert radius(backend, splat(axis=Y_AXIS, degrees=45), camera) == pytest.approx(expected, rel=1e-4)


def test_14_the_low_pass_disc_belongs_to_the_box(backend: Backend) -> None:
    scene = splat(scales=(1e-4, 1e-4))
    assert radius(backend, scene, front_camera(33, 33)) == pytest.approx(K_HALF * sqrt(0.5), rel=1e-4)


def test_14_the_box_is_clipped_to_the_image(backend: Backend) -> None:
    assert radius(backend, splat(), front_camera(9, 9)) == pytest.approx(4.5, rel=1e-5)
    # Centre on the left edge: x side k s f / z from the edge, y side the low-pass disc (2 * 2.2): half the x side.
    scene = splat(scales=(0.4, 0.05))
    assert radius(backend, scene, front_camera(33, 33, cx=0.0)) == pytest.approx(K_HALF * 0.4 * 5 / 2, rel=1e-4)


def test_14_a_disc_that_reaches_the_camera_plane_has_the_whole_image(backend: Backend) -> None:
    scene = splat((0, 0, 0.5), scales=(3, 3), axis=Y_AXIS, degrees=85)
    assert radius(backend, scene, front_camera(9, 15)) == 7.5


def test_14_splats_without_a_pixel_have_radius_zero(backend: Backend) -> None:
    assert radius(backend, splat((9, 0, 2)), front_camera()) == 0
    # o = 1.05 / 255: k = 0.312, disc 0.22 px, centred on the corner of four pixels.
    scene = splat(scales=(1e-4, 1e-4), opacity=1.05 / 255)
    assert radius(backend, scene, front_camera(cx=4.0, cy=4.0)) == 0
    assert radius(backend, scene, front_camera(cx=4.4, cy=4.4)) > 0


# 15 --------------------------------------------------------------------------------------------------------------
def test_15_an_empty_scene_is_the_background(backend: Backend) -> None:
    empty = requiring_grad(splat().rows(torch.zeros(1, dtype=torch.bool)))
    settings = RasterSettings(background=(0.25, 0.5, 0.75))
    out = rasterize(empty, front_camera(7, 5), settings, backend=backend)
    equal(out.color, torch.tensor([0.25, 0.5, 0.75]).expand(5, 7, 3))
    for name in IMAGES[1:]:
        assert bool((getattr(out, name) == 0).all()), name
    assert out.radii.shape == (0,)
    errors = splat_errors(empty, front_camera(7, 5), torch.zeros(5, 7, 3), settings, backend=backend)
    assert errors.shape == (0,)


def test_15_pixels_that_no_splat_reaches_are_the_background(backend: Backend) -> None:
    settings = RasterSettings(background=(0.25, 0.5, 0.75))
    out = rasterize(splat((0, 0, -3)), front_camera(40, 40), settings, backend=backend)
    equal(out.color, torch.tensor([0.25, 0.5, 0.75]).expand(40, 40, 3))


# 16 --------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "opacity_logits", "sh0", "shN"])
def test_16_a_splat_that_is_not_finite_is_culled(backend: Backend, name: str, bad: float) -> None:
    good = replace(splat(axis=Y_AXIS, degrees=20), shN=torch.full((1, 3, 3), 0.1))
    broken = replace(good, **{name: getattr(good, name).clone()})
    getattr(broken, name).view(-1)[-1] = bad
    check_culled(backend, good, broken)


def test_16_a_zero_quaternion_is_culled(backend: Backend) -> None:
    check_culled(backend, splat(), replace(splat(), quats=torch.zeros(1, 4)))


def check_culled(backend: Backend, good: Splats, broken: Splats) -> None:
    scene = requiring_grad(stack(broken, good))
    probe = torch.zeros(2, 4, requires_grad=True)
    out = rasterize(scene, front_camera(), backend=backend, screen_probe=probe)
    alone = rasterize(good, front_camera(), backend=backend)
    for image in IMAGES:
        assert torch.equal(getattr(out, image), getattr(alone, image)), image
    assert float(out.radii[0]) == 0
    assert float(out.radii[1]) > 0
    sum(getattr(out, image).sum() for image in IMAGES).backward()  # type: ignore[union-attr]
    for attribute, tensor in [*scene.items(), ("probe", probe)]:
        assert tensor.grad is not None
        assert bool((tensor.grad[0] == 0).all()), attribute
        assert bool(tensor.grad[1].isfinite().all()), attribute
    errors = splat_errors(scene.detach(), front_camera(), torch.zeros(9, 9, 3), backend=backend)
    assert float(errors[0]) == 0
    assert float(errors[1]) > 0


def test_16_coefficients_above_the_evaluated_degree_do_not_matter(backend: Backend) -> None:
    scene = replace(splat(), shN=torch.full((1, 3, 3), float("nan")))
    out = rasterize(scene, front_camera(), RasterSettings(sh_degree=0), backend=backend)
    equal(out.alpha[4, 4], 0.5)


# 17 --------------------------------------------------------------------------------------------------------------
def lattice(limit: float, half: int) -> int:
    """Number of integer points with i^2 + j^2 <= limit and |i|, |j| <= half."""
    return sum(i * i + j * j <= limit for i in range(-half, half + 1) for j in range(-half, half + 1))


@pytest.mark.parametrize("opacity", [0.9, 0.5, 0.001])
def test_17_errors_sum_over_the_footprint_and_ignore_opacity(backend: Backend, opacity: float) -> None:
    # Cutoff 2.9: rho = k^2 / 4 <= 8.41, k^2 <= 33.64. |c - image| = 0.9 + 0.3 + 0.05.
    image = torch.tensor([0.1, 0.2, 0.3]).expand(17, 17, 3).contiguous()
    settings = RasterSettings(error_cutoff=2.9)
    errors = splat_errors(splat(opacity=opacity), front_camera(17, 17), image, settings, backend=backend)
    equal(errors, [lattice(33.64, 8) * (0.9 + 0.3 + 0.05)])


def test_17_the_default_cutoff_is_three_and_the_low_pass_disc_counts(backend: Backend) -> None:
    # A tiny splat: rho2d = 2 k^2 <= 9 holds for k^2 = 0, 1, 2, 4: 1 + 4 + 4 + 4 pixels.
    errors = splat_errors(splat(scales=(1e-4, 1e-4)), front_camera(), torch.zeros(9, 9, 3), backend=backend)
    equal(errors, [13 * 1.75])


def test_17_pixels_outside_the_image_or_masked_out_do_not_count(backend: Backend) -> None:
    # On 5 x 5 px all 25 pixels are inside (k^2 <= 8); a mask that keeps two columns leaves 10.
    image = torch.zeros(5, 5, 3)
    equal(splat_errors(splat(), front_camera(5, 5), image, backend=backend), [25 * 1.75])
    mask = torch.zeros(5, 5, dtype=torch.bool)
    mask[:, :2] = True
    equal(splat_errors(splat(), front_camera(5, 5), image, backend=backend, mask=mask), [10 * 1.75])


def test_17_each_pixel_is_compared_with_its_own_colour(backend: Backend) -> None:
    image = torch.rand(5, 5, 3, generator=torch.Generator().manual_seed(0))
    expected = (torch.tensor([1.0, 0.5, 0.25]) - image).abs().sum()
    equal(splat_errors(splat(), front_camera(5, 5), image, backend=backend), expected[None])


def test_17_hidden_splats_count_unless_occlusion_is_asked_for(backend: Backend) -> None:
    # T after 0.98, 0.98, 0.98: the pixel stops before the third. The fourth is hidden; scale 9: flat over 5 x 5 px.
    layers = [splat((0, 0, 2 + i), scales=(9, 9), opacity=o) for i, o in enumerate((0.98, 0.98, 0.98, 0.1))]
    camera, image = front_camera(5, 5), torch.zeros(5, 5, 3)
    plain = splat_errors(stack(*layers), camera, image, backend=backend)
    equal(plain, [25 * 1.75] * 4)
    seen = splat_errors(stack(*layers), camera, image, backend=backend, occlusion=True)
    equal(seen, [25 * 1.75, 25 * 1.75, 0.0, 0.0])


def test_17_with_occlusion_a_transparent_splat_still_counts_where_the_pixel_is_live(backend: Backend) -> None:
    scene = stack(splat((0, 0, 2), scales=(9, 9), opacity=0.9), splat((0, 0, 3), scales=(9, 9), opacity=0.001))
    errors = splat_errors(scene, front_camera(5, 5), torch.zeros(5, 5, 3), backend=backend, occlusion=True)
    equal(errors, [25 * 1.75] * 2)


def test_17_near_culls_errors_by_splat_and_by_pair(backend: Backend) -> None:
    # The plane x + z = 2, near 1.9: columns k >= 1 are skipped (5 of 9 remain).
    slanted = splat(scales=(5, 5), axis=Y_AXIS, degrees=45)
    scene = stack(slanted, splat((0, 0, 1.5)))
    errors = splat_errors(scene, front_camera(), torch.zeros(9, 9, 3), RasterSettings(near=1.9), backend=backend)
    equal(errors, [9 * 5 * 1.75, 0.0])
    assert not errors.requires_grad
