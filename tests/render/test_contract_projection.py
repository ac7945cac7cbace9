"""The numbered contract of ``gs2d.render.api``, rules 1 to 6: projection of splats.

Every test runs on every backend. Unless stated: camera at the origin along +z, 9 x 9 px, focal length 10 px, so that
pixel (column 4 + k, row 4) looks along (k / 10, 0, 1); a splat faces it at z = 2 with scale 0.4, where one pixel is
0.2 world units: u = k / 2, rho3d = k^2 / 4.
"""

from __future__ import annotations

from dataclasses import replace
from math import cos, exp, radians, sin, sqrt

import numpy as np
import pytest
import torch

from gs2d.core.camera import look_at
from gs2d.render.api import rasterize, splat_errors
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings
from render_scenes import GREEN, RED, Y_AXIS, equal, front_camera, requiring_grad, splat, stack


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
    # With fy = 20 a pixel is 0.1 world units high: v = k / 4, and rho2d = 2 k^2 is larger: rho = k^2 / 16.
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
    # Rotated 45 degrees about y its plane is x + z = 2. Pixel (5, 4): x = z / 10, so z = 2 / 1.1; its distance from the
    # centre along t_u is sqrt(2) (2 - z), so u = sqrt(2) (2 - z) / s with s = 2.
    out = rasterize(splat(scales=(2, 2), axis=Y_AXIS, degrees=45, opacity=0.5), front_camera(), backend=backend)
    for k in (-4, -1, 1, 4):
        z = 2 / (1 + k / 10)
        u = sqrt(2) * (2 - z) / 2
        equal(out.depth_mean[4, 4 + k], z)
        equal(out.alpha[4, 4 + k], 0.5 * exp(-u * u / 2))


def test_03_the_two_scales_follow_the_two_tangents(backend: Backend) -> None:
    # s_u = 0.8 along x: u = k / 4. s_v = 0.4 along y: v = k / 2. Rotation by 90 degrees about z swaps them.
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
    # A camera at (5, 0, 0) that looks along -x sees a splat at (3, 0, 0) with normal x like the plain scene.
    camera = look_at(np.array([5.0, 0, 0]), np.zeros(3), np.array([0, -1.0, 0]), width=9, height=9, fx=10)
    out = rasterize(splat((3, 0, 0), axis=Y_AXIS, degrees=90), camera, backend=backend)
    plain = rasterize(splat(), front_camera(), backend=backend)
    equal(out.alpha, plain.alpha)
    equal(out.depth_mean, plain.depth_mean)


def test_03_an_edge_on_plane_is_not_hit_and_the_low_pass_filter_decides(backend: Backend) -> None:
    # Rotated 90 degrees, the plane x = 0 contains the camera. rho = rho2d = 2 k^2; alpha = 0.5 exp(-k^2), depth z_c;
    # k = 2: 0.0092 > 1/255; k = 3: 6e-5, nothing.
    out = rasterize(splat(axis=Y_AXIS, degrees=90), front_camera(), backend=backend)
    equal(out.alpha[4, 4:8], [0.5, 0.5 * exp(-1), 0.5 * exp(-4), 0.0])
    equal(out.depth_mean[4, 4:7], [2.0, 2.0, 2.0])


def test_03_a_plane_met_behind_the_camera_is_not_hit(backend: Backend) -> None:
    # Rotated 85 degrees: sin85 x + cos85 (z - 2) = 0, so z (sin85 k/10 + cos85) = 2 cos85.
    # k = -1 hits it behind the camera, where rho3d would be 0.64 < 2: the filter gives exp(-1), z_c. k = 1: z = 0.93.
    s, c = sin(radians(85)), cos(radians(85))
    out = rasterize(splat(scales=(20, 20), axis=Y_AXIS, degrees=85, opacity=0.5), front_camera(), backend=backend)
    equal(out.alpha[4, 3], 0.5 * exp(-1))
    equal(out.depth_mean[4, 3], 2.0)
    z = 2 * c / (0.1 * s + c)
    u = (2 - z) / s / 20  # along t_u = (c, 0, -s)
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
    # Rotated 45 degrees about y, s = 0.02. Pixel (5, 4): z = 2 / 1.1 on the plane, u = 12.9: the filter (rho 2) wins.
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
    edge_on = splat(axis=Y_AXIS, degrees=90)  # no hit: the depth is that of the centre
    out = rasterize(edge_on, front_camera(), RasterSettings(lowpass_depth="plane", near=0.5), backend="reference")
    assert float(out.depth_mean[4, 4]) == pytest.approx(2.0)


# 5 ---------------------------------------------------------------------------------------------------------------
def test_05_splats_at_or_before_near_are_culled(backend: Backend) -> None:
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
    # Centre at z = 0.5, rotated 85 degrees, s = 3: the disc reaches z = 0.5 - 3 sin85. Focal 100: the ray is k / 100.
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
    # d alpha / d logit = o (1 - o), as if alpha were not clamped. o = sigmoid(logit) in float32.
    o = torch.sigmoid(scene.opacity_logits.detach().double())
    equal(scene.opacity_logits.grad, o * (1 - o))


# 24 --------------------------------------------------------------------------------------------------------------
def test_24_the_mip_filter_widens_a_splat_and_keeps_its_integral(backend: Backend) -> None:
    # Standard deviations of 2 px on the screen become sqrt(4 + 1) px; the opacity is multiplied by 4/5.
    alpha = rasterize(splat(), front_camera(), RasterSettings(mip_px=1.0), backend=backend).alpha
    equal(alpha[4, 4:8], [0.5 * 4 / 5 * exp(-k * k / 10) for k in range(4)])
    # 0.25 px along y becomes sqrt(1 + 1/16) px.
    alpha = rasterize(splat(scales=(0.4, 0.05)), front_camera(), RasterSettings(mip_px=1.0), backend=backend).alpha
    loss = sqrt(4 / 5) * sqrt(1 / 17)
    equal(alpha[4:6, 4], [0.5 * loss, 0.5 * loss * exp(-8 / 17)])
    sums = [
        float(rasterize(splat(scales=(0.3, 0.2)), front_camera(41, 41), settings, backend=backend).alpha.sum())
        for settings in (RasterSettings(alpha_min=1e-5), RasterSettings(alpha_min=1e-5, mip_px=2.0))
    ]
    assert sums[0] == pytest.approx(sums[1], rel=1e-3)


def test_24_the_mip_filter_keeps_the_plane_and_replaces_the_low_pass_filter(backend: Backend) -> None:
    # Rotated 45 degrees about y: 0.0707 px along x, 0.1 px along y. Pixel (5, 4) hits u = 12.86, z = 2 / 1.1.
    scene = splat(scales=(0.02, 0.02), opacity=0.9, axis=Y_AXIS, degrees=45)
    settings = RasterSettings(mip_px=0.3, alpha_min=1e-4)
    l11, l22 = sqrt(1 + 0.3**2 / 0.005), sqrt(1 + 0.3**2 / 0.01)
    out = rasterize(scene, front_camera(), settings, backend=backend)
    u = (2 / 1.1 * 0.1) / cos(radians(45)) / 0.02
    equal(out.depth_mean[4, 5], 2 / 1.1)
    equal(out.alpha[4, 4:6], [0.9 / (l11 * l22), 0.9 / (l11 * l22) * exp(-0.5 * (u / l11) ** 2)])


def test_24_the_filtered_opacity_culls_and_so_does_a_filter_that_is_too_wide(backend: Backend) -> None:
    # 0.05 px: the opacity is divided by 1 + (0.5 / 0.05)^2 = 101, to 0.0049 or 0.0030; 1/255 = 0.0039.
    tiny, settings = (0.01, 0.01), RasterSettings(mip_px=0.5)
    alphas = [
        rasterize(splat(scales=tiny, opacity=opacity), front_camera(), settings, backend=backend).alpha
        for opacity in (0.5, 0.3)
    ]
    equal(alphas[0][4, 4], 0.5 / 101)
    equal(alphas[1], torch.zeros(9, 9))
    # In splat errors the opacity culls nothing: 0.005 px is enlarged by 2501 and counts, 0.0005 px by 250,001.
    image = torch.zeros(9, 9, 3)
    settings = RasterSettings(mip_px=0.25)
    scene = stack(*(splat(scales=(size, size)) for size in (0.001, 0.0001)))
    errors = splat_errors(scene, front_camera(), image, settings, backend=backend)
    assert errors[0] > 0
    assert errors[1] == 0
