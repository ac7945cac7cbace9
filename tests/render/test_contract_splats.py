"""The numbered contract of ``gs2d.render.api``, rules 13 to 17 and 19: per-splat outputs, and degenerate scenes.

Every test runs on every backend. Unless stated: camera at the origin along +z, 9 x 9 px, focal length 10 px, so that
pixel (column 4 + k, row 4) looks along (k / 10, 0, 1); a splat faces it at z = 2 with scale 0.4, where one pixel is
0.2 world units: u = k / 2, rho3d = k^2 / 4.
"""

from __future__ import annotations

from dataclasses import replace
from math import exp, log, radians, sin, sqrt

import pytest
import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.render.api import rasterize, splat_errors
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings
from render_scenes import IMAGES, Y_AXIS, equal, front_camera, requiring_grad, splat, stack


# 13 --------------------------------------------------------------------------------------------------------------
def signal(backend: Backend, scene: Splats, columns: int, *pixels: tuple[int, int]) -> Tensor:
    """Return the screen-probe gradient of alpha summed over (row, column) pixels; 9 x 11 px, centre pixel (5, 4)."""
    probe = torch.zeros(len(scene), columns, requires_grad=True)
    alpha = rasterize(requiring_grad(scene), front_camera(9, 11), backend=backend, screen_probe=probe).alpha
    sum(alpha[p] for p in pixels).backward()  # type: ignore[union-attr]
    assert probe.grad is not None
    return probe.grad


@pytest.mark.parametrize("columns", [2, 4])
def test_13_the_probe_is_the_gradient_of_the_screen_map_in_official_units(backend: Backend, columns: int) -> None:
    # u = (x z - Tu.z) / (f s): du/dTu.z = -1 / (10 * 0.4) = -1/4. One column right: u = 1/2, dalpha/du = -u alpha.
    # Signal = z_c W/2 * alpha u / 4 = 2 * 4.5 * alpha / 8.
    alpha = 0.5 * exp(-1 / 8)
    equal(signal(backend, splat(), columns, (5, 5))[0, :2], [9 * alpha / 8, 0.0])
    alpha = 0.5 * exp(-4 / 8)  # two rows up: v = -1, signal = -z_c H/2 * alpha / 4
    equal(signal(backend, splat(), columns, (3, 4))[0, :2], [0.0, -11 * alpha / 4])


def test_13_opposite_pixels_cancel_in_the_signed_half_and_add_in_the_absolute_half(backend: Backend) -> None:
    alpha = 0.5 * exp(-1 / 8)
    equal(signal(backend, splat(), 4, (5, 5), (5, 3)), [[0.0, 0.0, 2 * 9 * alpha / 8, 0.0]])


def test_13_the_low_pass_branch_does_not_count(backend: Backend) -> None:
    scene = splat((0.03, 0.02, 2), scales=(1e-3, 1e-3))
    equal(signal(backend, scene, 4, (5, 4), (6, 5)), [[0.0, 0.0, 0.0, 0.0]])


# 14 --------------------------------------------------------------------------------------------------------------
K_HALF = sqrt(2 * log(127.5))  # k of opacity 0.5 = 3.114


def radius(backend: Backend, scene: Splats, camera: Camera) -> float:
    return float(rasterize(scene, camera, backend=backend).radii[0])


def test_14_the_radius_is_half_the_longer_side_of_the_box(backend: Backend) -> None:
    camera = front_camera(33, 33)
    assert radius(backend, splat(), camera) == pytest.approx(K_HALF * 0.4 * 5, rel=1e-4)  # 5 px per world unit at z = 2
    assert radius(backend, splat(scales=(0.1, 0.5)), camera) == pytest.approx(K_HALF * 0.5 * 5, rel=1e-4)


def test_14_the_box_of_a_slanted_splat_bounds_its_perspective_image(backend: Backend) -> None:
    # 45 degrees about y, a = k s sin45: y = f k s sin(phi) / (z_c - a cos(phi)), at most f k s / sqrt(z_c^2 - a^2);
    # x spans a f / (z_c - a) and -a f / (z_c + a), which is smaller.
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
    out.color.sum().backward()
    assert empty.means.grad is not None
    errors = splat_errors(empty, front_camera(7, 5), torch.zeros(5, 7, 3), settings, backend=backend)
    assert errors.shape == (0,)


def test_15_pixels_that_no_splat_reaches_are_the_background(backend: Backend) -> None:
    settings = RasterSettings(background=(0.25, 0.5, 0.75))
    behind = requiring_grad(splat((0, 0, -3)))
    out = rasterize(behind, front_camera(40, 40), settings, backend=backend)
    equal(out.color, torch.tensor([0.25, 0.5, 0.75]).expand(40, 40, 3))
    out.color.sum().backward()
    assert all(tensor.grad is not None and bool((tensor.grad == 0).all()) for _, tensor in behind.items())


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
    """Return the number of integer points with i^2 + j^2 <= limit and |i|, |j| <= half."""
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
    # On 5 x 5 px all 25 pixels are inside (k^2 <= 8); a mask of two columns leaves 10.
    image = torch.zeros(5, 5, 3)
    equal(splat_errors(splat(), front_camera(5, 5), image, backend=backend), [25 * 1.75])
    mask = torch.zeros(5, 5, dtype=torch.bool)
    mask[:, :2] = True
    equal(splat_errors(splat(), front_camera(5, 5), image, backend=backend, mask=mask), [10 * 1.75])


def test_17_each_pixel_is_compared_with_its_own_colour(backend: Backend) -> None:
    image = torch.rand(5, 5, 3, generator=torch.Generator().manual_seed(0))
    expected = (torch.tensor([1.0, 0.5, 0.25]) - image).abs().sum()
    equal(splat_errors(splat(), front_camera(5, 5), image, backend=backend), expected[None])


def test_17_hidden_splats_count_without_occlusion(backend: Backend) -> None:
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


# 19 --------------------------------------------------------------------------------------------------------------
CULL = RasterSettings(near_plane_policy="cull")


@pytest.mark.parametrize("opacity", [0.02, 0.9])
def test_19_crossing_splats_are_culled_by_their_3_sigma_disc_if_wanted(backend: Backend, opacity: float) -> None:
    # Rotated 30 degrees about y at z = 2, the disc reaches 3 s_u sin30 in depth at any opacity: s_u = 4/3 is the
    # limit, independent of s_v.
    for s_u, drawn in ((1.32, True), (1.35, False)):
        scene = splat(scales=(s_u, 9), axis=Y_AXIS, degrees=30, opacity=opacity)
        out = rasterize(scene, front_camera(), CULL, backend=backend)
        assert bool(out.alpha.max() > 0) is drawn
        assert bool(out.radii[0] > 0) is drawn
        errors = splat_errors(scene, front_camera(), torch.zeros(9, 9, 3), CULL, backend=backend)
        assert bool(errors[0] > 0) is drawn
        assert float(rasterize(scene, front_camera(), backend=backend).alpha.max()) > 0  # drawn by default


def test_19_the_cutoff_is_that_of_the_errors(backend: Backend) -> None:
    # error_cutoff 1: the limit is s_u sin30 = 2.
    settings = replace(CULL, error_cutoff=1.0)
    for s_u, drawn in ((3.9, True), (4.1, False)):
        scene = splat(scales=(s_u, 0.1), axis=Y_AXIS, degrees=30)
        assert bool(rasterize(scene, front_camera(), settings, backend=backend).radii[0] > 0) is drawn


def test_19_both_axes_reach_together(backend: Backend) -> None:
    # Rotated about the diagonal of its plane by 30 degrees, both axes rise by sin30 / sqrt(2): 3 s sin30 = 2 again.
    for s, drawn in ((1.32, True), (1.35, False)):
        scene = splat(scales=(s, s), axis=(sqrt(0.5), sqrt(0.5), 0.0), degrees=30)
        assert bool(rasterize(scene, front_camera(), CULL, backend=backend).radii[0] > 0) is drawn
    assert 3 * 1.35 * sin(radians(30)) > 2


def test_19_culled_splats_change_nothing_and_have_no_gradients(backend: Backend) -> None:
    plain, near_plane_policy = splat(opacity=0.6), splat((0, 0, 0.5), scales=(3, 3), axis=Y_AXIS, degrees=85)
    both = requiring_grad(stack(near_plane_policy, plain))
    out = rasterize(both, front_camera(), CULL, backend=backend)
    alone = rasterize(plain, front_camera(), CULL, backend=backend)
    for name in IMAGES:
        assert torch.equal(getattr(out, name), getattr(alone, name)), name
    (out.color.sum() + out.normal.sum() + out.depth_mean.sum()).backward()
    for name, tensor in both.items():
        assert tensor.grad is not None
        assert bool((tensor.grad[0] == 0).all()), name
    assert both.means.grad is not None
    assert bool((both.means.grad[1] != 0).any())


BOX = RasterSettings(near_plane_policy="box")


def slanted(backend: Backend, camera: Camera, settings: RasterSettings) -> tuple[Tensor, float, float]:
    """Return alpha image, radius and error of a splat rotated 60 degrees about y, s_u = 1: to z = 2 - 3 sin60."""
    scene = splat(scales=(1, 0.1), axis=Y_AXIS, degrees=60, opacity=0.9)
    out = rasterize(scene, camera, settings, backend=backend)
    errors = splat_errors(scene, camera, torch.zeros(camera.height, camera.width, 3), settings, backend=backend)
    return out.alpha, float(out.radii[0]), float(errors[0])


def test_19_a_box_is_the_tiles_of_the_official_square(backend: Backend) -> None:
    # 64 x 48 px, focal length 32: xu = 32 cos60 = 16, a.z = -sin60, yv = 3.2. <Tw, Tw> = 9 * 3/4 - 4 = 2.75, so
    # e_x = -9 * 16 sin60 / 2.75 = -45.35 and |e_x^2 - 9 * 16^2 / 2.75|^1/2 = 34.91, up to 35: the square reaches from
    # column 32 - 45.35 - 0.5 - 35 < 0 to 21.15, which touches the tiles of columns 0 to 31, and all rows.
    # The splat is visible right of u = -3: x = 32 - 32 * 1.5 / 4.6 = 21.6.
    camera = front_camera(64, 48, 32.0)
    drawn, _, all_errors = slanted(backend, camera, RasterSettings())
    boxed, radius, errors = slanted(backend, camera, BOX)
    assert bool((drawn[:, 32:] > 0).any())
    assert bool((boxed[:, 32:] == 0).all())
    assert bool((boxed[24, 24:32] > 0).all())
    assert torch.equal(boxed[:, :32], drawn[:, :32])
    assert radius == 24.0  # half of 48 rows
    assert 0 < errors < all_errors


def test_19_a_box_beside_the_image_culls(backend: Backend) -> None:
    # The principal point 22 columns further left: the square ends at column -0.85 (with 15 px to the next tile: 14.15).
    alpha, radius, errors = slanted(backend, front_camera(64, 48, 32.0, cx=10.0), BOX)
    assert float(alpha.max()) == radius == errors == 0.0


def test_19_the_square_is_at_least_that_of_the_low_pass_filter_and_clipped_to_the_image(backend: Backend) -> None:
    # Edge-on, along x = 0: xu = xv = 0, so e_x = 0 and the half width is that of 0.01; y: yv = 0 as well, only
    # a.z = -1 counts. 3 lowpass_px = 2.1, up to 3: columns 10 - 0.5 - 3 = 6.5 to 12.5, the tiles of columns 0 to 15.
    scene = splat(scales=(1, 1e-4), axis=Y_AXIS, degrees=90, opacity=0.9)
    radii = rasterize(scene, front_camera(40, 12, 32.0, cx=10.0), BOX, backend=backend).radii
    assert float(radii[0]) == 8.0  # 16 columns, 12 rows


def test_19_splats_that_do_not_reach_the_camera_plane_are_drawn_as_ever(backend: Backend) -> None:
    scene = stack(splat(), splat((0.2, 0, 1.5), scales=(0.4, 9), axis=Y_AXIS, degrees=50))
    out, plain = (rasterize(scene, front_camera(), s, backend=backend) for s in (BOX, RasterSettings()))
    for name in (*IMAGES, "radii"):
        assert torch.equal(getattr(out, name), getattr(plain, name)), name
