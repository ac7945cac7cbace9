"""Rule 25 of the contract: cameras with any ray per pixel, on every backend that has them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from gs2d.config.recipe import LossTerm
from gs2d.core.camera import Camera
from gs2d.errors import BackendError, ShapeError
from gs2d.losses.base import LossView, compute_losses
from gs2d.losses.formulas import normals_from_depth
from gs2d.meshing.depth_maps import RenderedView, depth_map
from gs2d.render.api import first_contributors, rasterize, splat_errors
from gs2d.render.backends import Backend
from gs2d.render.rays import MAX_DENSITY, ray_map
from gs2d.render.tensor_api import CameraTensors, SplatTensors, rasterize_2dgs
from gs2d.render.types import RasterSettings
from ray_cameras import directions, pinhole_rays, ray_camera, splats_around
from render_scenes import equal, front_camera, requiring_grad, splat, stack


@pytest.fixture(params=["reference", "cpu"])
def backend(request: pytest.FixtureRequest, backend_named) -> Backend:  # type: ignore[no-untyped-def]
    """Return each backend with rays."""
    return backend_named(request.param)  # type: ignore[no-any-return]


def with_pinhole_rays(camera: Camera) -> Camera:
    return replace(camera, rays=ray_map(pinhole_rays(camera)).float())


def test_25_the_rays_of_a_pinhole_draw_its_image_with_distances_as_depths(backend: Backend) -> None:
    # Splats one behind the other, so that both orders are the same, large enough for the plane to decide.
    scene = stack(*(splat((0.1 * i, 0, 2 + i), (0.9, 0.5), degrees=30 * i, axis=(1, 2, 0)) for i in range(3)))
    camera = front_camera()
    cameras, settings = (camera, with_pinhole_rays(camera)), RasterSettings(lowpass_px=0.05)
    own, other = (rasterize(scene, each, settings, backend=backend) for each in cameras)
    for name in ("color", "alpha", "normal"):
        equal(getattr(other, name), getattr(own, name))
    equal(other.depth_median, own.depth_median * pinhole_rays(camera).norm(dim=2))


def test_25_the_mip_filter_has_the_width_of_a_pixel_on_the_axis(backend: Backend) -> None:
    # Near the axis an angle is a pixel offset, and an edge-on or a small splat has the same image.
    scene = stack(splat((0, 0, 4), (0.02, 0.05), degrees=60, axis=(1, 2, 0)), splat((0, 0, 5), (1e-3, 0.4)))
    camera, settings = replace(front_camera(), fx=60.0, fy=60.0), RasterSettings(mip_px=0.7)
    cameras = (camera, with_pinhole_rays(camera))
    own, other = (rasterize(scene, each, settings, backend=backend).alpha for each in cameras)
    assert own[4, 4] > 0.05
    assert (own - other).abs().max() < 0.01 * own.max()


def test_25_a_panorama_sees_splats_on_all_sides(backend: Backend) -> None:
    camera = ray_camera("panorama", torch.float32, 41, 21)
    behind, right = splat((0, 0, -2)), splat((3, 0, 0), (0.9, 0.9), axis=(0, 1, 0), degrees=90)
    above = splat((0, -2, 0), axis=(1, 0, 0), degrees=90)
    out = rasterize(stack(behind, right, above), camera, backend=backend)
    assert out.radii.min() > 0
    for column, row, depth in ((0, 10, 2.0), (40, 10, 2.0), (30, 10, 3.0), (7, 0, 2.0), (33, 0, 2.0)):
        assert out.depth_median[row, column] == pytest.approx(depth, rel=0.02)
    assert out.alpha[10, 20] == 0  # nothing in front


def test_25_the_low_pass_disc_has_the_pixels_own_size(backend: Backend) -> None:
    # A tiny splat in the direction of pixel (6, 4): rho2d there is 0, and one pixel aside 1 / lowpass_px^2 = 2, since
    # distances are in pixels of that solid angle (square up to the second order here).
    camera = with_pinhole_rays(front_camera(focal=100.0))
    out = rasterize(splat((0.04, 0, 2), (1e-6, 1e-6)), camera, backend=backend)
    equal(out.alpha[4, 6], 0.5)
    assert out.alpha[4, 5].item() == pytest.approx(0.5 * math.exp(-1), rel=1e-3)
    equal(out.depth_median[4, 5], math.hypot(0.04, 2))


def test_25_pixels_without_a_ray_show_the_background(backend: Backend) -> None:
    rays = pinhole_rays(front_camera())
    rays[4, 4], rays[4, 5] = 0, torch.nan
    camera = replace(front_camera(), rays=ray_map(rays).float())
    leaf = requiring_grad(splat())
    out = rasterize(leaf, camera, RasterSettings(background=(0.1, 0.2, 0.3)), backend=backend)
    equal(out.color[4, 4:6], [[0.1, 0.2, 0.3]] * 2)
    assert out.alpha[4, 6] > 0.1
    assert not out.depth_mean[4, 4:6].any()
    (out.color.sum() + out.depth_mean.sum()).backward()
    assert all(leaf_.grad is None or leaf_.grad.isfinite().all() for _, leaf_ in leaf.items())


def test_25_radii_are_those_of_the_sphere_within_the_cone_of_all_rays(backend: Backend) -> None:
    camera = with_pinhole_rays(front_camera())
    k = math.sqrt(2 * math.log(0.5 * 255))
    angle = math.asin(k * 0.25 / 2)
    radii = rasterize(stack(splat(scales=(0.25, 0.05)), splat((0, 0, -2))), camera, backend=backend).radii
    equal(radii, [10 * 2 * math.sin(angle / 2), 0.0])


def test_25_what_a_camera_with_rays_lacks_is_refused(backend: Backend) -> None:
    camera, scene = with_pinhole_rays(front_camera()), splat()
    rays = ray_map(pinhole_rays(camera))
    with pytest.raises(ShapeError, match="camera with rays has no camera plane"):
        rasterize(scene, camera, RasterSettings(near_plane_policy="cull"), backend=backend)
    with pytest.raises(ShapeError, match="rays must be torch.float32"):
        rasterize(scene, replace(camera, rays=rays), backend=backend)
    with pytest.raises(ShapeError, match="rays"):
        splat_errors(scene, replace(camera, rays=rays[:, 1:].float()), torch.zeros(9, 9, 3), backend=backend)
    with pytest.raises(ShapeError, match="points of a pinhole image"):
        first_contributors(scene, camera, torch.zeros(1, 2))
    with pytest.raises(ShapeError, match="rays has one size"):
        camera.downscaled(2)
    with pytest.raises(ShapeError, match="no pinhole projection"):
        camera.project(torch.zeros(1, 3).numpy())
    with pytest.raises(ShapeError, match="depth maps of pinhole cameras"):
        depth_map(RenderedView(camera, torch.zeros(9, 9)))


def test_25_rays_that_no_ray_map_made_are_refused(backend: Backend) -> None:
    camera, made = front_camera(), ray_map(pinhole_rays(front_camera())).float()
    nan, negative, hidden = (made.clone() for _ in range(3))
    nan[2, 3, 0], negative[2, 3, 3] = torch.nan, -1
    hidden[2, 3, :3] = 0  # with the density of a pixel that has a ray
    for rays in (nan, negative, hidden, made * 2, made.transpose(0, 1)):
        with pytest.raises(ShapeError, match="make them with gs2d.render.rays.ray_map"):
            rasterize(splat(), replace(camera, rays=rays), backend=backend)
    with pytest.raises(ShapeError, match=r"ray_map, must be \[9, 9, 4\], got \[9, 9, 3\]"):
        rasterize(splat(), replace(camera, rays=pinhole_rays(camera).float()), backend=backend)
    for wrong in (torch.ones(9, 9), torch.ones(9, 9, 3, dtype=torch.int32)):
        with pytest.raises(ShapeError, match="rays must be"):
            ray_map(wrong)


def test_25_losses_take_normals_from_the_distances_of_rays(backend: Backend) -> None:
    camera = front_camera(focal=100.0)
    z = torch.full((9, 9), 2.0) + 0.01 * torch.arange(9)
    distances, with_rays = z * pinhole_rays(camera).norm(dim=2).float(), with_pinhole_rays(camera)
    found, expected = normals_from_depth(distances, with_rays), normals_from_depth(z, camera)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-4)
    values = []
    for kind in (camera, with_rays):
        output = rasterize(splat((0, 0, 2), (0.9, 0.5), degrees=30), kind, backend=backend)
        view, term = LossView(torch.zeros(9, 9, 3), kind), LossTerm("normal_consistency", 1.0)
        values += compute_losses(output, view, [term], backend=backend).values()
    equal(values[1], values[0].item())


def test_25_other_backends_refuse_rays(backend_named) -> None:  # type: ignore[no-untyped-def]
    camera, rays = with_pinhole_rays(front_camera()), ray_map(pinhole_rays(front_camera())).float().requires_grad_()
    with pytest.raises(BackendError, match="pinhole cameras only, got rays"):
        rasterize(splat(), camera, backend=backend_named("emulated"))
    with pytest.raises(BackendError, match="no gradients of rays"):
        rasterize(splat(), replace(camera, rays=rays), backend=backend_named("cpu"))


def test_25_rays_have_gradients_on_the_reference() -> None:
    rays = pinhole_rays(front_camera(4, 3, 4.0))
    scene = splat((0.1, 0, 2), (0.8, 0.6), dtype=torch.float64, degrees=20, axis=(1, 1, 0))

    def images(rays: torch.Tensor) -> tuple[torch.Tensor, ...]:
        out = rasterize(scene, replace(front_camera(4, 3, 4.0), rays=ray_map(rays)), backend="reference")
        return out.color, out.depth_mean

    assert torch.autograd.gradcheck(images, rays.requires_grad_(), atol=1e-6)


def test_25_the_sizes_of_all_pixels_of_a_panorama_add_up_to_the_sphere() -> None:
    density = ray_map(directions("panorama", 80, 40))[..., 3]
    assert (1 / density).sum().item() == pytest.approx(4 * math.pi, rel=2e-3)
    alone = torch.tensor([[[0.0, 0.0, 1.0]]], dtype=torch.float64)
    assert ray_map(alone).tolist() == [[[0, 0, 0, MAX_DENSITY]]]  # without neighbours
    of_camera = pinhole_rays(front_camera(focal=100.0))
    torch.testing.assert_close(ray_map(of_camera[4:5]), ray_map(of_camera)[4:5], rtol=3e-3, atol=0)  # square


def test_25_the_tensor_interface_takes_directions_of_any_length() -> None:
    scene = splats_around(0, 40)
    tensors = SplatTensors(
        scene.means, scene.quats, scene.log_scales.exp(), scene.opacity_logits.sigmoid(), torch.rand(40, 5).double()
    )
    camera = ray_camera("fisheye", width=20, height=16)
    rays = directions("fisheye", 20, 16) * 3
    Ks = torch.tensor([[[40.0, 0, 10], [0, 40.0, 8], [0, 0, 1]]]).double()
    cameras = CameraTensors(torch.eye(4)[None].double(), Ks, 20, 16)
    out = rasterize_2dgs(tensors, cameras, rays=rays[None], backend="reference")
    equal(out.alphas[0, ..., 0], rasterize(scene, camera, backend="reference").alpha)
    with pytest.raises(ShapeError, match="rays"):
        rasterize_2dgs(tensors, cameras, rays=rays[:5], backend="reference")
