"""The numbered contract of ``gs2d.render.api``, rule 23: limits of float32, on every backend.

Expected values come from the float64 reference on the same float32 inputs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gs2d.core.camera import Camera, look_at
from gs2d.core.splats import ATTRIBUTES, Splats
from gs2d.render.api import rasterize, splat_errors
from gs2d.render.backends import Backend
from gs2d.render.reference_backend import PLAIN
from gs2d.render.types import MAX_COLOR, MAX_SIZE, MIN_QUATERNION, RasterSettings
from render_scenes import IMAGES, Y_AXIS, equal, front_camera, requiring_grad, splat, stack

EDGES = (0.0, 1e-45, 1e-30, 1e-8, 1e5, 1e8, 1e10, 1e18, 1e19, 1e30, 3.4e38)
SETTINGS = RasterSettings(background=(0.1, 0.2, 0.3), sh_degree=1)


def scene() -> Splats:
    """Return a slanted splat to modify, with a plain one behind it; off-centre, so that no pixel is on its edge."""
    front = splat((0.1, -0.05, 2.0), axis=Y_AXIS, degrees=25)
    return replace(stack(front, splat((0.003, -0.002, 3.0))), shN=torch.full((2, 3, 3), 0.1))


def edge_camera(change: str) -> Camera:
    if change == "plain":
        return front_camera(9, 7)
    return look_at(np.array([0.3, -0.4, -0.2]), np.array([0.0, 0, 2]), np.array([0, 1.0, 0]), width=9, height=7, fx=6)


def assert_like_reference(backend: Backend, splats: Splats, camera: Camera, label: object) -> None:
    double = splats.to(dtype=torch.float64)
    low = rasterize(splats, camera, SETTINGS, backend=backend)
    high = PLAIN.rasterize(double, camera, SETTINGS)
    for name in IMAGES:
        a, b = getattr(low, name).double(), getattr(high, name)
        size = b.abs().clamp(min=1) if name in ("color", "depth_mean", "depth_median") else torch.ones_like(b)
        assert bool((((a - b).abs() / size) <= 2e-3).all()), (name, label, float((a - b).abs().max()))
    assert bool(((low.radii.double() - high.radii).abs() <= 1e-2 * (1 + high.radii)).all()), ("radii", label)
    image = torch.zeros(camera.height, camera.width, 3)
    errors = splat_errors(splats, camera, image, SETTINGS, backend=backend).double()
    expected = PLAIN.splat_errors(double, camera, image.double(), SETTINGS)
    assert bool(((errors - expected).abs() <= 2e-3 * (1 + expected)).all()), ("errors", label, errors, expected)


@pytest.mark.parametrize(
    ("name", "change"),
    [("means", "plain"), *((name, "turned") for name in ("means", "quats", "log_scales", "opacity_logits", "sh0"))],
)
def test_23_every_finite_parameter_is_drawn_alike(backend: Backend, name: str, change: str) -> None:
    camera = edge_camera(change)
    for column in range(min(getattr(scene(), name)[0].numel(), 1 if name == "sh0" else 4)):
        for edge in (*EDGES, *(-edge for edge in EDGES)):
            altered = replace(scene(), **{name: getattr(scene(), name).clone()})
            getattr(altered, name)[0].view(-1)[column] = edge
            assert_like_reference(backend, altered, camera, (name, column, edge))


def test_23_a_far_centre_does_not_cover_the_image(backend: Backend) -> None:
    for far in (1e10, 1e18, 1e20, 1e30, 3e38):
        for mean in ((0.0, far, 0.0), (0.0, 0.0, far), (far, far, far), (0.0, far, 2.0)):
            out = rasterize(splat(mean), edge_camera("turned"), backend=backend)
            assert float(out.alpha.max()) == 0, mean
            assert float(out.radii.max()) == 0, mean


@pytest.mark.parametrize("size", [1e-14, 1e-8, 1e10, 1e18, 1e30, 1e38])
def test_23_a_quaternion_of_any_length_is_its_direction(backend: Backend, size: float) -> None:
    unit = torch.tensor([[0.9, -0.2, 0.5, 0.3]])
    cotangent = torch.randn(9, 9, generator=torch.Generator().manual_seed(1))

    def drawn(quats: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        splats = requiring_grad(replace(splat(), quats=quats))
        out = rasterize(splats, front_camera(), backend=backend)
        ((out.depth_mean + out.normal.sum(dim=2)) * cotangent).sum().backward()
        assert splats.quats.grad is not None
        return out.color.detach(), splats.quats.grad.double()

    color, grad = drawn(unit)
    same, small = drawn(unit * size)
    equal(same, color)
    if size < 1e30:  # representable in float32
        torch.testing.assert_close(small * size, grad, rtol=1e-4, atol=1e-5)
    assert bool(small.isfinite().all())


def test_23_the_limits_are_where_the_rule_has_them(backend: Backend) -> None:
    def seen(change: dict[str, torch.Tensor]) -> bool:
        return bool(rasterize(replace(splat(), **change), front_camera(), backend=backend).alpha.max() > 0)

    log = float(np.log(MAX_SIZE))
    assert seen({"log_scales": torch.full((1, 2), log - 0.01)})
    assert not seen({"log_scales": torch.full((1, 2), log + 0.01)})
    assert seen({"means": torch.tensor([[0, 0, 0.99 * MAX_SIZE]])})
    assert not seen({"means": torch.tensor([[0, 0, 1.01 * MAX_SIZE]])})
    assert seen({"quats": torch.tensor([[1.01 * MIN_QUATERNION, 0, 0, 0]])})
    assert not seen({"quats": torch.tensor([[0.99 * MIN_QUATERNION, 0, 0, 0]])})
    assert seen({"sh0": torch.full((1, 1, 3), 0.33 * MAX_COLOR)})
    assert not seen({"sh0": torch.full((1, 1, 3), 0.34 * MAX_COLOR)})


def test_23_culled_splats_have_no_gradient_and_do_not_affect_others(backend: Backend) -> None:
    for name, value in (("means", 1e20), ("log_scales", 60.0), ("sh0", 1e30), ("quats", 1e-30)):
        broken = replace(splat(), **{name: torch.full_like(getattr(splat(), name), value)})
        both = requiring_grad(stack(broken, splat((0, 0, 3.0))))
        out = rasterize(both, front_camera(), backend=backend)
        alone = rasterize(splat((0, 0, 3.0)), front_camera(), backend=backend)
        sum(getattr(out, image).sum() for image in IMAGES).backward()  # type: ignore[union-attr]
        for image in IMAGES:
            assert torch.equal(getattr(out, image), getattr(alone, image)), (name, image)
        for attribute in ATTRIBUTES:
            grad = getattr(both, attribute).grad
            assert bool((grad[0] == 0).all()), (name, attribute)
            assert bool(grad[1].isfinite().all()), (name, attribute)
