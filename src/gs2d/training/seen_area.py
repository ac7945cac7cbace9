"""How much of each splat the training photographs show, and the splats of which they show next to nothing.

A splat whose corner explains a hundred pixels may be as large as a wall: no loss asks what the rest of it, outside of
all pictures, looks like, and a new view between two photographs may show nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gs2d.config.robust import SeenArea
from gs2d.core.camera import Camera
from gs2d.core.sh import C0
from gs2d.core.splats import Splats
from gs2d.core.transforms import quats_to_matrices
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend
from gs2d.render.culling import may_be_seen
from gs2d.render.types import RasterSettings

PLACES = 7


def mostly_unseen(
    splats: Splats, cameras: Sequence[Camera], settings: SeenArea, raster: RasterSettings, backend: Backend
) -> Tensor:
    """Find large splats of which no photograph shows more than a small fraction, and which lie outside of most.

    Parameters
    ----------
    cameras : sequence of Camera
        Of the training photographs. Small pictures of them are looked at: fractions do not need more.
    raster : RasterSettings
        Of training.

    Returns
    -------
    Tensor [N] bool
    """
    views = [shrunk(camera, settings.side) for camera in cameras]
    rows = _large(splats, views, settings.size).nonzero().squeeze(1)
    large = splats.rows(rows)
    most = torch.zeros(len(rows), dtype=splats.dtype, device=splats.device)
    for camera in views:
        asked = most < settings.least
        if bool((asked & may_be_seen(large, camera, raster)).any()):  # the picture decides of one more
            shown = shown_weights(splats, camera, raster, backend)[rows]
            most = torch.maximum(most, shown / whole_weights(large, camera).clamp_min(1e-6))
    rows = rows[most < settings.least]
    found = torch.zeros(len(splats), dtype=torch.bool, device=splats.device)
    found[rows] = inside_fraction(splats.rows(rows), cameras) < settings.inside
    return found


@torch.no_grad()
def _large(splats: Splats, cameras: Sequence[Camera], size: float) -> Tensor:
    """Find the splats [N] bool that would cover more than this part of any picture."""
    normals, areas = _normals_and_areas(splats)
    found = torch.zeros(len(splats), dtype=torch.bool, device=splats.device)
    for camera in cameras:
        found |= _whole_weights(splats.means, normals, areas, camera) > size * camera.width * camera.height
    return found


@torch.no_grad()
def inside_fraction(splats: Splats, cameras: Sequence[Camera]) -> Tensor:
    """Return how much of each splat [N] lies within the pictures, all together, hidden there or not.

    Looked at are ``PLACES`` x ``PLACES`` places that divide its Gaussian evenly.
    """
    normal = torch.distributions.Normal(splats.means.new_zeros(()), splats.means.new_ones(()))
    steps = normal.icdf((torch.arange(PLACES, device=splats.device).to(splats.dtype) + 0.5) / PLACES)
    axes = quats_to_matrices(splats.quats)[:, :, :2].transpose(1, 2) * splats.scales[:, :, None]  # [N, 2, 3]
    places = splats.means[:, None] + torch.cartesian_prod(steps, steps) @ axes  # [N, P, 3]
    inside = torch.zeros(places.shape[:2], dtype=torch.bool, device=splats.device)
    for camera in cameras:
        pose = torch.as_tensor(camera.T_cam_world, dtype=splats.dtype, device=splats.device)
        x, y, z = (places @ pose[:3, :3].T + pose[:3, 3]).unbind(dim=-1)
        column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside |= (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return inside.to(splats.dtype).mean(dim=1)


def shrunk(camera: Camera, side: int) -> Camera:
    """Return a camera whose picture has a longer side of at most so many pixels."""
    factor = min(1.0, side / max(camera.width, camera.height))
    return camera.resized(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))


def shown_weights(splats: Splats, camera: Camera, raster: RasterSettings, backend: Backend) -> Tensor:
    """Return the blending weight [N] px of each splat, summed over a picture.

    It is the derivative of the sum of all pixels with respect to the splat's colour.
    """
    parts = {name: tensor.detach() for name, tensor in splats.items()}
    grey = torch.zeros_like(parts["sh0"]).requires_grad_()
    bare = replace(raster, sh_degree=0, with_distortion=False)
    with torch.enable_grad():
        output = rasterize(Splats(**{**parts, "sh0": grey}), camera, bare, backend=backend)
        (found,) = torch.autograd.grad(output.color[..., 0].sum(), grey)
    return found[:, 0, 0] / C0


@torch.no_grad()
def whole_weights(splats: Splats, camera: Camera) -> Tensor:
    """Return the weight [N] px that each splat would have in a picture without borders and without other splats.

    The integral of its Gaussian over the image plane, to first order; 0 behind the camera.
    """
    return _whole_weights(splats.means, *_normals_and_areas(splats), camera)


def _normals_and_areas(splats: Splats) -> tuple[Tensor, Tensor]:
    """Return normals [N, 3], and the integral [N] of each Gaussian over its plane times its opacity."""
    area = 2 * torch.pi * splats.scales.prod(dim=1)
    return quats_to_matrices(splats.quats)[:, :, 2], splats.opacities.reshape(-1) * area


def _whole_weights(means: Tensor, normals: Tensor, areas: Tensor, camera: Camera) -> Tensor:
    pose = torch.as_tensor(camera.T_cam_world, dtype=means.dtype, device=means.device)
    seen = means @ pose[:3, :3].T + pose[:3, 3]
    z = seen[:, 2].clamp_min(1e-9)
    facing = areas * (seen * (normals @ pose[:3, :3].T)).sum(dim=1).abs() / z  # the image plane
    weight = facing * (camera.fx * camera.fy) / z.square()
    return torch.where(seen[:, 2] > 0, weight, torch.zeros_like(weight))
