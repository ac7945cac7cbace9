"""Two-view losses on a plane of known depth and normal."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from gs2d.config.multiview import MultiView
from gs2d.core.camera import Camera, look_at
from gs2d.core.transforms import perturb_pose
from gs2d.losses.view_pair import (
    Neighbour,
    ViewPair,
    choose_pixels,
    geometric,
    photometric,
    prepare_image,
)

SETTINGS = MultiView(patches=40, radius=2, texture=0.01, occluded=4.0)
PLANE_NORMAL = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])


def camera_at(*eye: float, **changes: float) -> Camera:
    """Return a camera of 48 x 40 px that looks at the origin, with an off-centre principal point."""
    made = look_at(np.array(eye), np.zeros(3), np.array([0.0, 1.0, 0.0]), width=48, height=40, fx=50.0, fy=47.0)
    return replace(made, **({"cx": 22.5, "cy": 21.0} | changes))


HERE, THERE = camera_at(0.0, 0.1, 2.0), camera_at(0.5, 0.2, 1.9, cx=26.0, cy=18.5, fx=53.0)


def plane_depth(camera: Camera) -> Tensor:
    """Return the depth [H, W] of the plane through the origin."""
    j, i = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(i - camera.cx) / camera.fx, (j - camera.cy) / camera.fy, np.ones_like(i)], axis=-1)
    return torch.as_tensor(-(camera.center @ PLANE_NORMAL) / (rays @ camera.rotation @ PLANE_NORMAL))


def plane_image(camera: Camera) -> Tensor:
    """Return a smooth texture on the plane as seen by the camera [H, W, 3]."""
    j, i = np.mgrid[: camera.height, : camera.width] + 0.5
    z = plane_depth(camera).numpy()
    points = np.stack([(i - camera.cx) / camera.fx * z, (j - camera.cy) / camera.fy * z, z], axis=-1)
    x, y, _ = np.moveaxis((points - camera.T_cam_world[:3, 3]) @ camera.rotation, -1, 0)
    grey = 0.5 + 0.2 * np.sin(9 * x + 4 * y) + 0.2 * np.sin(7 * y - 3 * x * y) + 0.1 * np.sin(17 * x)
    return torch.as_tensor(grey)[..., None].expand(-1, -1, 3)


@dataclass(frozen=True)
class Case:
    """The plane's images for the first view, and the neighbour."""

    depth: Tensor
    normal: Tensor
    neighbour: Neighbour

    def views(self, depth: Tensor | None = None, normal: Tensor | None = None) -> ViewPair:
        depth = self.depth if depth is None else depth
        normal = self.normal if normal is None else normal
        return ViewPair(depth, normal, self.neighbour.reference.textured, HERE, self.neighbour)


@pytest.fixture(scope="module")
def case() -> Case:
    images = [prepare_image(plane_image(camera), None, SETTINGS) for camera in (HERE, THERE)]
    draws = torch.rand(SETTINGS.patches, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    neighbour = Neighbour(*images, THERE, plane_depth(THERE), draws, SETTINGS)
    normal = torch.as_tensor(PLANE_NORMAL).expand(HERE.height, HERE.width, 3)
    return Case(plane_depth(HERE), normal, neighbour)


def test_at_the_true_plane_patches_and_round_trips_agree(case: Case) -> None:
    views = case.views()
    ncc, valid = views.similarity
    error, back = views.round_trip
    assert valid.sum() > 25
    assert float(ncc[valid].min()) > 0.99  # the rest is bilinear sampling of a curved texture
    assert float(error[back].max()) < 1e-2  # and of a depth that is not linear in the pixel
    assert float(photometric(views)) < 0.003
    assert float(geometric(views)) < 0.003


@pytest.mark.parametrize("offset", [-0.02, 0.02])
def test_the_gradient_points_to_the_true_depth(case: Case, offset: float) -> None:
    for loss in (photometric, geometric):
        depth = (case.depth + offset).requires_grad_()
        loss(case.views(depth)).backward()
        assert depth.grad is not None
        touched = depth.grad[depth.grad != 0]
        right = (touched.sign() == np.sign(offset)).double().mean()  # gradient descent moves towards the plane
        assert float(right) > 0.9, (loss.__name__, float(right))


def test_the_gradient_points_to_the_true_normal(case: Case) -> None:
    tilt = torch.tensor([0.5, 0.3, 0.0], dtype=torch.float64)  # a small tilt hardly moves a patch of 5 px
    normal = (case.normal + tilt).clone().requires_grad_()
    photometric(case.views(normal=normal)).backward()
    assert normal.grad is not None
    touched = normal.grad.any(dim=2)
    right = (normal.grad * (normal.detach() - case.normal)).sum(dim=2)[touched] > 0
    assert touched.sum() > 25
    assert float(right.double().mean()) > 0.9


def test_gradients_are_those_of_finite_differences(case: Case) -> None:
    index, chosen = choose_pixels(case.neighbour.reference.textured, case.neighbour.draws)
    g = torch.Generator().manual_seed(1)
    d = case.depth.flatten()[index] + 0.01 * torch.randn(len(index), generator=g, dtype=torch.float64)
    n = case.normal.reshape(-1, 3)[index] * 0.8 + 0.05 * torch.randn(len(index), 3, generator=g, dtype=torch.float64)
    assert chosen.all()

    def values(d: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
        depth = case.depth.flatten().index_put((index,), d).view_as(case.depth)
        normal = case.normal.reshape(-1, 3).index_put((index,), n).view_as(case.normal)
        views = case.views(depth, normal)
        views.__dict__["weights"] = weights
        return photometric(views), geometric(views)

    weights = torch.rand(len(index), generator=g, dtype=torch.float64)  # weights are constants: they have no gradient
    assert torch.autograd.gradcheck(values, (d.requires_grad_(), n.requires_grad_()), eps=1e-7, atol=1e-6)


def test_the_mean_does_not_depend_on_the_number_of_patches(case: Case) -> None:
    depth = case.depth + 0.02
    everything = replace(case.neighbour, draws=torch.full((2000,), 0.5, dtype=torch.float64))
    views = ViewPair(depth, case.normal, everything.reference.textured, HERE, everything)
    whole, count = photometric(views), views.depth.numel()
    ncc, valid = views.similarity
    assert whole.item() == pytest.approx(((1 - ncc) * views.weights)[valid].sum().item() / count)
    half = torch.arange(count).view(depth.shape) % 2 == 0
    masked = ViewPair(depth, case.normal, everything.reference.textured & half, HERE, everything, half)
    assert photometric(masked).item() == pytest.approx(whole.item(), rel=0.05)  # half of the sum and half of the pixels
    g = torch.Generator().manual_seed(0)
    few = [replace(everything, draws=torch.rand(60, generator=g, dtype=torch.float64)) for _ in range(20)]
    sampled = [photometric(ViewPair(depth, case.normal, everything.reference.textured, HERE, n)).item() for n in few]
    assert float(np.mean(sampled)) == pytest.approx(whole.item(), rel=0.1)


def test_the_gradient_of_a_learned_pose_is_that_of_finite_differences(case: Case) -> None:
    start = torch.tensor([0.01, -0.02, 0.015, 0.02, 0.01, -0.02], dtype=torch.float64)

    def values(motion: Tensor) -> tuple[Tensor, Tensor]:
        views = ViewPair(
            case.depth, case.normal, case.neighbour.reference.textured, perturb_pose(HERE, motion), case.neighbour
        )
        views.__dict__["weights"] = torch.ones(SETTINGS.patches, dtype=torch.float64)
        return photometric(views), geometric(views)

    assert torch.autograd.gradcheck(values, (start.requires_grad_(),), eps=1e-7, atol=1e-6)
    still = ViewPair(case.depth, case.normal, case.neighbour.reference.textured, HERE, case.neighbour)
    held = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    learning = ViewPair(
        case.depth, case.normal, case.neighbour.reference.textured, perturb_pose(HERE, held), case.neighbour
    )
    torch.testing.assert_close(photometric(learning), photometric(still))


def test_values_and_gradients_have_the_same_bits_for_any_number_of_threads() -> None:
    g = torch.Generator().manual_seed(3)
    settings, size = MultiView(patches=3000, occluded=100.0), 120
    reference, source = (
        replace(c, width=size, height=size, fx=150.0, fy=150.0, cx=60.0, cy=60.0) for c in (HERE, THERE)
    )
    images = [prepare_image(torch.rand(size, size, 3, generator=g), None, settings) for _ in range(2)]
    normal = torch.as_tensor(PLANE_NORMAL).float() + 0.05 * torch.randn(size, size, 3, generator=g)
    depth = plane_depth(reference).float() * (1 + 0.01 * torch.rand(size, size, generator=g))
    neighbour = Neighbour(*images, source, plane_depth(source).float(), torch.rand(3000, generator=g), settings)
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            leaves = depth.clone().requires_grad_(), normal.clone().requires_grad_()
            views = ViewPair(*leaves, images[0].textured, reference, neighbour)
            loss = photometric(views) + geometric(views)
            found.append([loss.detach(), *torch.autograd.grad(loss, leaves)])
    finally:
        torch.set_num_threads(before)
    assert (found[0][1] != 0).sum() > 2000
    for others in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], others, strict=True))
