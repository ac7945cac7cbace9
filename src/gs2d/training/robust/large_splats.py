"""Find large splats that are barely visible in the training images.

A splat whose corner explains a few pixels may be as large as a wall. No loss constrains the rest of it, outside of all
images, and a new view may show nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.sh import C0
from gs2d.core.splats import Splats
from gs2d.core.transforms import quats_to_matrices
from gs2d.render.api import rasterize
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings

PLACES = 7
LEAST = 0.05  # a splat stays if an image shows this fraction of its weight
INSIDE = 0.6  # it stays, too, if this fraction of it lies within the union of the images
LARGE = 0.001  # fraction of an image: smaller splats cannot hide much
COVERS = 0.5  # fraction of an image: a splat this large would be a veil before a view beside that camera
LARGEST = 0.12  # largest standard deviation of a splat on a known surface, as a fraction of an image
LARGEST_ANYWHERE = 1.0  # the same for every other splat
PAIRS = 1 << 24  # distances between splats and cameras that are in memory at a time, 64 MB
SIDE = 200  # px, longer side of the images that are rendered


def votes_against_unseen(splats: Splats, cameras: Sequence[Camera], raster: RasterSettings, backend: Backend) -> Tensor:
    """Count the images that speak against large splats that hardly any image shows and that lie mostly outside them.

    The result is [N] int32, 0 for all other splats. A large splat has one vote against it. If it is near cameras and
    would cover their images, each of these cameras is a vote: one distant image that shows a corner of the splat does
    not outweigh them. ``cameras``: cameras of the training images. Small renderings are enough for fractions.
    ``raster``: rasterizer settings of training.
    """
    most = torch.zeros(len(splats), dtype=splats.dtype, device=splats.device)
    large = torch.zeros(len(splats), dtype=torch.bool, device=splats.device)
    covered = torch.zeros(len(splats), dtype=torch.int32, device=splats.device)
    for camera in cameras:
        small = shrunk(camera, SIDE)
        whole = whole_weights(splats, small)
        large |= whole > LARGE * small.width * small.height
        covered += whole > COVERS * small.width * small.height
        most = torch.maximum(most, shown_weights(splats, small, raster, backend) / whole.clamp_min(1e-6))
    unseen = large & (most < LEAST)
    rows = unseen.nonzero().squeeze(1)
    unseen[rows] = inside_fraction(splats.rows(rows), cameras) < INSIDE
    return torch.where(unseen, covered.clamp_min(1), 0)


@torch.no_grad()
def inside_fraction(splats: Splats, cameras: Sequence[Camera]) -> Tensor:
    """Return the fraction of each splat [N] that lies within the union of the images, hidden there or not.

    A splat is tested at ``PLACES`` x ``PLACES`` points that divide its Gaussian evenly.
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


@torch.no_grad()
def largest_log_scales(splats: Splats, cameras: Sequence[Camera]) -> Tensor:
    """Return the logarithm of the largest standard deviation [N, 1] of a splat on a surface with detail.

    It is ``LARGEST`` times the narrower side of an image at the distance of the nearest camera.
    """
    centers = torch.stack([torch.as_tensor(camera.center).to(splats.means) for camera in cameras])
    angle = min(min(camera.width / camera.fx, camera.height / camera.fy) for camera in cameras)
    # Distances by differences are exact far from the origin, and the same for any number of threads.
    near = [
        torch.cdist(part, centers, compute_mode="donot_use_mm_for_euclid_dist").amin(dim=1, keepdim=True)
        for part in splats.means.split(max(1, PAIRS // len(cameras)))
    ]
    return (LARGEST * angle * torch.cat(near)).log()


def shrunk(camera: Camera, side: int) -> Camera:
    """Return a camera whose longer image side has at most ``side`` pixels."""
    factor = min(1.0, side / max(camera.width, camera.height))
    return camera.resized(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))


def shown_weights(splats: Splats, camera: Camera, raster: RasterSettings, backend: Backend) -> Tensor:
    """Return the blending weight [N] px of each splat, summed over an image.

    It is the derivative of the sum of all pixels with respect to the colour of the splat.
    """
    parts = {name: tensor.detach() for name, tensor in splats.items()}
    grey = torch.zeros_like(parts["sh0"]).requires_grad_()
    bare = replace(raster, sh_degree=0, with_distortion=False)
    with torch.enable_grad():
        output = rasterize(Splats(**{**parts, "sh0": grey}), camera, bare, backend=backend)
        (gradient,) = torch.autograd.grad(output.color[..., 0].sum(), grey)
    return gradient[:, 0, 0] / C0


@torch.no_grad()
def whole_weights(splats: Splats, camera: Camera) -> Tensor:
    """Return the weight [N] px of each splat in an unlimited image without other splats.

    It is the integral of the Gaussian over the image plane, to first order; 0 behind the camera.
    """
    pose = torch.as_tensor(camera.T_cam_world, dtype=splats.dtype, device=splats.device)
    local = splats.means @ pose[:3, :3].T + pose[:3, 3]
    normals = quats_to_matrices(splats.quats)[:, :, 2] @ pose[:3, :3].T
    z = local[:, 2].clamp_min(1e-9)
    area = 2 * torch.pi * splats.scales.prod(dim=1) * (local * normals).sum(dim=1).abs() / z  # facing the image plane
    weight = splats.opacities.reshape(-1) * area * (camera.fx * camera.fy) / z.square()
    return torch.where(local[:, 2] > 0, weight, torch.zeros_like(weight))
