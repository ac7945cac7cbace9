"""Which splats a camera could see at all: a cheap test before a view is rendered somewhere else."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.render.types import RasterSettings

SLACK = 1e-3  # of a reach, and of a depth: far more than float32 is off by
ROUNDING = 1e-6  # of where the camera is: places are rounded to it


@torch.no_grad()
def may_be_seen(splats: Splats, camera: Camera, settings: RasterSettings) -> Tensor:
    """Find the splats [N] bool that a camera could see; of all others the radius is 0, and no pixel changes.

    A ball around the centre holds the disc that any opacity lets one see (rule 6 of :mod:`gs2d.render.api`), and that
    of splat errors (17). It must reach each of the four planes through the borders of the picture, which are moved out
    by the low-pass disc (14), or the plane of the camera, where the box is the whole picture. (5: what is nearer than
    ``near`` is culled whole.)
    """
    farthest = max(math.sqrt(-2 * math.log(settings.alpha_min)), settings.error_cutoff)
    pose = torch.as_tensor(camera.T_cam_world).detach().to(splats.means)
    center = torch.as_tensor(camera.center).to(splats.means)
    x, y, z = ((splats.means - center) @ pose[:3, :3].T).unbind(dim=1)
    off = SLACK * z.abs() + ROUNDING * center.abs().max()
    reach = farthest * splats.log_scales.amax(dim=1).exp() * (1 + SLACK) + off
    margin = farthest * settings.lowpass_px + 1.0  # px
    inside = torch.ones_like(z, dtype=torch.bool)
    for across, focal, middle, size in (
        (x, camera.fx, camera.cx, camera.width),
        (y, camera.fy, camera.cy, camera.height),
    ):
        for sign, offset in ((1.0, middle + margin), (-1.0, size - middle + margin)):
            inside &= (sign * focal * across + offset * z) / math.hypot(focal, offset) >= -reach
    return (z + off > settings.near) & (inside | (z <= reach))
