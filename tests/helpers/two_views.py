"""Noisy pairs of views of a textured plane, for the multi-view losses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gs2d.config.multiview import MultiView
from gs2d.core.camera import Camera, look_at
from gs2d.core.transforms import perturb_pose
from gs2d.losses.view_pair import Neighbour, ViewPair, geometric, photometric, prepare_image

NORMAL = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])


def camera_at(width: int, height: int, *eye: float) -> Camera:
    """Return a camera that looks at the origin, with an off-centre principal point."""
    focal = 1.1 * width
    made = look_at(
        np.array(eye), np.zeros(3), np.array([0.0, 1.0, 0.0]), width=width, height=height, fx=focal, fy=0.95 * focal
    )
    return replace(made, cx=0.47 * width, cy=0.53 * height)


def plane_depth(camera: Camera) -> Tensor:
    """Return the depth [H, W] of the plane through the origin, float64."""
    j, i = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(i - camera.cx) / camera.fx, (j - camera.cy) / camera.fy, np.ones_like(i)], axis=-1)
    return torch.as_tensor(-(camera.center @ NORMAL) / (rays @ camera.rotation @ NORMAL))


@dataclass(frozen=True, eq=False)
class Scenario:
    """Inputs of the multi-view losses; ``views`` combines them."""

    depth: Tensor
    normal: Tensor
    candidates: Tensor
    camera: Camera
    neighbour: Neighbour
    mask: Tensor | None = None

    def views(self, depth: Tensor, normal: Tensor, motion: Tensor | None = None) -> ViewPair:
        """Return the pair for other leaves; ``motion`` [6] moves the camera and requires a gradient."""
        camera = self.camera if motion is None else perturb_pose(self.camera, motion)
        return ViewPair(depth, normal, self.candidates, camera, self.neighbour, self.mask)

    def double(self) -> Scenario:
        """Return the same values in float64."""
        images = (replace(p, grey=p.grey.double()) for p in (self.neighbour.reference, self.neighbour.source))
        reference, source = images
        neighbour = replace(self.neighbour, reference=reference, source=source, depth=self.neighbour.depth.double())
        return replace(self, depth=self.depth.double(), normal=self.normal.double(), neighbour=neighbour)


def scenario(
    size: tuple[int, int] = (61, 47), *, seed: int = 0, dtype: torch.dtype = torch.float32, masked: bool = False,
    settings: MultiView | None = None, depth_size: tuple[int, int] | None = None,
) -> Scenario:  # fmt: skip
    """Return noisy images and depths with masked pixels, pixels without depth, and edge-on normals.

    ``depth_size`` is the resolution of the neighbour's depth map, by default that of its image.
    """
    settings = settings or MultiView(patches=300, radius=2, texture=0.03, occluded=4.0)
    g = torch.Generator().manual_seed(seed)

    def noise(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    cameras = camera_at(*size, 0.0, 0.1, 2.0), camera_at(size[0] + 5, size[1] - 3, 0.5, 0.2, 1.9)
    images, depths = [], []
    for camera in cameras:
        shape = (camera.height, camera.width)
        j, i = np.mgrid[: camera.height, : camera.width] + 0.5
        z = plane_depth(camera).numpy()
        points = np.stack([(i - camera.cx) / camera.fx * z, (j - camera.cy) / camera.fy * z, z], axis=-1)
        x, y, _ = np.moveaxis((points - camera.T_cam_world[:3, 3]) @ camera.rotation, -1, 0)
        grey = torch.as_tensor(0.5 + 0.2 * np.sin(9 * x + 4 * y) + 0.2 * np.sin(7 * y - 3 * x * y))
        grey += 0.05 * noise(*shape)
        usable = torch.rand(*shape, generator=g) < 0.995
        images.append(prepare_image(grey[..., None].expand(-1, -1, 3).to(dtype), usable, settings))
        depths.append((torch.as_tensor(z) * (1 + 0.004 * noise(*shape))).to(dtype))
    here, there = cameras
    if depth_size is not None:
        depths[1] = plane_depth(there.resized(*depth_size)).to(dtype)
    depths[1] = torch.where(torch.rand(depths[1].shape, generator=g) < 0.02, 0, depths[1])
    normal = (torch.as_tensor(NORMAL) * 0.8 + 0.3 * noise(*depths[0].shape, 3)).to(dtype)
    draws = torch.rand(settings.patches, generator=g, dtype=torch.float64)
    mask = torch.rand(depths[0].shape, generator=g) < 0.9 if masked else None
    candidates = images[0].textured if mask is None else images[0].textured & mask
    return Scenario(depths[0], normal, candidates, here, Neighbour(*images, there, depths[1], draws, settings), mask)


def in_torch(views: ViewPair) -> tuple[Tensor, Tensor]:
    """Compute both losses with the torch formulas."""
    return photometric(views), geometric(views)
