"""Compare image patches of two views of the same surface.

The depth and the normal of a pixel define a plane. Its homography maps the patch around the pixel into the image of a
neighbouring view. The photometric loss is 1 - NCC of the two grey patches. The geometric loss is the distance in pixels
between a pixel and its round trip through the depth map of the neighbour. Formulas and gradients: ``docs/math.md``,
"Two views". The idea is from multi-view stereo and PGSR (Chen et al. 2024).

Plain torch, for any dtype and device; the host never waits for the device. A backend may have both losses as one
operation with the same formulas (``kernels/core/multiview.h``): :meth:`ViewPair.compared`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gs2d.config.multiview import MultiView
from gs2d.core.camera import Camera
from gs2d.kernels.native_multiview import Compared

MIN_COSINE = 0.1  # between normal and ray: a plane at a more grazing angle is not warped
MIN_SCALE = 0.1  # depth in the neighbour relative to that here: below, the patch is too close to the neighbour's camera
MIN_NORMAL = 1e-4  # shortest rendered normal that has a direction

CompareViews = Callable[[Tensor, Tensor, Tensor, Compared], tuple[Tensor, Tensor]]
"""``kernels.native_multiview.compare_views``, or that of another backend."""


@dataclass(frozen=True, eq=False)
class PatchImage:
    """An image prepared for patch comparison.

    Attributes
    ----------
    grey : Tensor [H, W]
        Mean of the channels, in [0, 1].
    clear : Tensor [H, W] bool
        No pixel of the patch around this one is masked, transparent or outside the image.
    textured : Tensor [H, W] bool
        ``clear``, and grey varies enough over the patch.
    """

    grey: Tensor
    clear: Tensor
    textured: Tensor

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        return self.grey.nbytes + self.clear.nbytes + self.textured.nbytes


def prepare_image(image: Tensor, usable: Tensor | None, settings: MultiView) -> PatchImage:
    """Prepare an image for patch comparison.

    Parameters
    ----------
    image : Tensor [H, W, 3]
        In [0, 1].
    usable : Tensor [H, W] bool or None
        Pixels that are not masked, and opaque.
    settings : MultiView
    """
    grey, side = image.mean(dim=2), settings.side
    height, width = grey.shape
    clear = torch.zeros(height, width, dtype=torch.bool, device=grey.device)
    textured = clear.clone()
    if min(height, width) < side:
        return PatchImage(grey, clear, textured)
    inner = slice(settings.radius, -settings.radius)
    if usable is None:
        clear[inner, inner] = True
    else:
        blocked = (~usable).to(grey.dtype)[None, None]
        clear[inner, inner] = F.max_pool2d(blocked, side, stride=1)[0, 0] == 0
    centred = (grey - grey.mean())[None, None]  # a small mean keeps digits in the difference of squares
    mean, square = F.avg_pool2d(centred, side, stride=1), F.avg_pool2d(centred * centred, side, stride=1)
    textured[inner, inner] = (square - mean * mean)[0, 0] > settings.texture**2
    return PatchImage(grey, clear, textured & clear)


@dataclass(frozen=True, eq=False)
class Neighbour:
    """A second view of the surface, and which pixels of the first view are compared with it.

    Attributes
    ----------
    reference, source : PatchImage
        Images of the view that is trained on, and of its neighbour.
    camera : Camera
        The neighbour's camera.
    depth : Tensor [h', w'] world units
        Depth map rendered for the neighbour at its size or smaller; 0 where nothing is hit. Never gets a gradient.
    draws : Tensor [P]
        Uniform in [0, 1). The candidate pixels are divided into P equal parts; the k-th draw chooses from the k-th.
    settings : MultiView
    """

    reference: PatchImage
    source: PatchImage
    camera: Camera
    depth: Tensor
    draws: Tensor
    settings: MultiView


def choose_pixels(candidates: Tensor, draws: Tensor) -> tuple[Tensor, Tensor]:
    """Choose pixels to compare, none twice.

    Parameters
    ----------
    candidates : Tensor [H, W] bool
    draws : Tensor [P]
        Uniform in [0, 1).

    Returns
    -------
    index : Tensor [P] int64
        Into the flat image.
    chosen : Tensor [P] bool
        False for surplus draws, if there are fewer candidates than draws.
    """
    ranks_here = candidates.flatten().cumsum(0, dtype=torch.int32)
    count = ranks_here[-1]
    fraction = (torch.arange(len(draws), device=draws.device) + draws.double()) / len(draws)
    rank = torch.minimum((fraction * count).int(), count - 1)  # ascending, so duplicates are adjacent
    index = torch.searchsorted(ranks_here, rank + 1).clamp(max=candidates.numel() - 1)
    again = torch.zeros_like(rank, dtype=torch.bool)
    again[1:] = rank[1:] == rank[:-1]
    return index, ~again & (count > 0)


@dataclass(frozen=True, eq=False)
class ViewPair:
    """The surface of one view at P pixels, compared with its neighbour.

    Parameters
    ----------
    depth : Tensor [H, W] world units
    normal : Tensor [H, W, 3]
        World frame, any length.
    candidates : Tensor [H, W] bool
        Pixels that may be compared.
    camera : Camera
    neighbour : Neighbour
    mask : Tensor [H, W] bool, optional
        Pixels that means run over.
    """

    depth: Tensor
    normal: Tensor
    candidates: Tensor
    camera: Camera
    neighbour: Neighbour
    mask: Tensor | None = None

    @cached_property
    def _pixels(self) -> tuple[Tensor, Tensor]:
        return choose_pixels(self.candidates, self.neighbour.draws)

    @cached_property
    def _rays(self) -> Tensor:
        """Rays [P, 3] through the chosen pixel centres, with z = 1."""
        index, camera, width = self._pixels[0], self.camera, self.camera.width
        x = (index % width).to(self.depth.dtype) + 0.5
        y = index.div(width, rounding_mode="floor").to(self.depth.dtype) + 0.5
        return torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], dim=1)

    @cached_property
    def _hits(self) -> Tensor:
        """Depths [P] of the chosen pixels; 1 where none is chosen."""
        index, chosen = self._pixels
        depth = self.depth.flatten().index_select(0, index)
        return torch.where(chosen, depth, torch.ones_like(depth))

    @cached_property
    def _motion(self) -> tuple[Tensor, Tensor]:
        """Rotation [3, 3] and translation [3] from this camera to the neighbour's, differentiable in a learned pose."""
        source, pose = self.neighbour.camera.T_cam_world, self.camera.pose
        if pose is None:
            T = source @ np.linalg.inv(self.camera.T_cam_world)
            return _on(T[:3, :3], self.depth), _on(T[:3, 3], self.depth)
        rotation = _on(source[:3, :3], pose) @ pose[:3, :3].T
        translation = _on(source[:3, 3], pose) - rotation @ pose[:3, 3]
        return rotation.to(self.depth), translation.to(self.depth)

    @cached_property
    def _rotation(self) -> Tensor:
        """Rotation [3, 3] from the world to this camera."""
        pose = self.camera.pose
        return _on(self.camera.rotation, self.depth) if pose is None else pose[:3, :3].to(self.depth)

    @cached_property
    def round_trip(self) -> tuple[Tensor, Tensor]:
        """Distance [P] px of each pixel from its round trip through the neighbour's depth, and whether it has one.

        The gradient goes to ``depth``, through the position at which the neighbour's depth is sampled.
        """
        rotation, translation = self._motion
        source = self.neighbour.camera
        points = (self._hits[:, None] * self._rays) @ rotation.T + translation
        front = points[:, 2] > MIN_SCALE * self._hits.detach()
        z = torch.where(front, points[:, 2], torch.ones_like(points[:, 2]))
        rays = torch.stack([points[:, 0] / z, points[:, 1] / z, torch.ones_like(z)], dim=1)
        u, v, _ = (rays @ _on(_to_unit(source).T, rays)).unbind(dim=1)
        met = sample(self.neighbour.depth, u, v)
        seen = front & (met > 0) & _inside(u, v, self.neighbour.depth) & _looked_up(self.neighbour.source.clear, u, v)
        back = (met[:, None] * rays - translation) @ rotation
        behind = back[:, 2] <= 0
        scale = torch.where(behind, torch.ones_like(met), back[:, 2])
        camera = self.camera
        dx = camera.fx * (back[:, 0] / scale - self._rays[:, 0])
        dy = camera.fy * (back[:, 1] / scale - self._rays[:, 1])
        return (dx.square() + dy.square() + 1e-12).sqrt(), seen & ~behind & self._pixels[1]

    @cached_property
    def weights(self) -> Tensor:
        """Weight [P] of each pixel: exp(-error) of its round trip, 0 above ``settings.occluded``; no gradient."""
        error, back = (part.detach() for part in self.round_trip)
        counts = back & (error < self.neighbour.settings.occluded)
        return torch.where(counts, torch.exp(-error), torch.zeros_like(error))

    def mean_of(self, values: Tensor, valid: Tensor) -> Tensor:
        """Estimate the mean of ``weights * values`` over all pixels from the compared ones; invalid ones count 0."""
        weighted = torch.where(valid & (self.weights > 0), self.weights * values, torch.zeros_like(values))
        return self.mean_of_sum(weighted.sum())

    def mean_of_sum(self, total: Tensor) -> Tensor:
        """Estimate the mean over all pixels from the sum ``total`` [] over the compared ones."""
        pixels = self.depth.numel() if self.mask is None else self.mask.sum().clamp(min=1)
        fraction = self.candidates.sum() / pixels
        return total / self._pixels[1].sum().clamp(min=1) * fraction

    def compared(self, compare: CompareViews) -> tuple[Tensor, Tensor]:
        """Return :func:`photometric` and :func:`geometric` by the operation of a backend."""
        index, chosen = self._pixels
        reference, source = self.neighbour.reference, self.neighbour.source
        cameras, settings = (self.camera, self.neighbour.camera), self.neighbour.settings
        given = Compared(
            index, chosen, reference.grey, source.grey, source.clear, self.neighbour.depth, *cameras, settings
        )
        (rotation, translation), world = self._motion, self._rotation
        motion = torch.cat([rotation.flatten(), translation, world.flatten()])
        photometric, geometric = compare(self.depth, self.normal, motion, given)
        return self.mean_of_sum(photometric), self.mean_of_sum(geometric)

    @cached_property
    def similarity(self) -> tuple[Tensor, Tensor]:
        """NCC [P] of each patch and its warp into the neighbour, and whether it is valid."""
        maps, planar = self._homographies
        settings, index = self.neighbour.settings, self._pixels[0]
        reference, source = self.neighbour.reference.grey, self.neighbour.source.grey
        offsets, jumps = _offsets(settings.radius, reference.shape[1], maps)
        around = (index[:, None] + jumps).clamp(0, reference.numel() - 1)  # clamps only pixels that are not chosen
        mine = torch.take(reference, around)  # [P, S]
        mine = mine - mine.mean(dim=1, keepdim=True)
        x, y, z = (maps @ offsets).unbind(dim=1)  # [P, S] each
        scale = z.clamp(min=MIN_SCALE)
        u, v = x / scale, y / scale
        whole = ((z > MIN_SCALE) & _inside(u, v, source)).all(dim=1)
        theirs = sample(source, u, v)
        theirs = theirs - theirs.mean(dim=1, keepdim=True)
        least = settings.texture**2 * len(jumps)
        squares_mine, squares = mine.square().sum(dim=1), theirs.square().sum(dim=1)
        ncc = (mine * theirs).sum(dim=1) * squares_mine.clamp(min=least).rsqrt() * squares.clamp(min=least / 4).rsqrt()
        valid = whole & (squares_mine > least) & (squares > least / 4)
        return ncc, valid & planar & self._pixels[1]

    @cached_property
    def _homographies(self) -> tuple[Tensor, Tensor]:
        """Maps [P, 3, 3] from pixel offsets (dx, dy, 1) to homogeneous neighbour positions, and their validity."""
        rotation, translation = self._motion
        camera, rays = self.camera, self._rays
        index, chosen = self._pixels
        normal = self.normal.reshape(-1, 3).index_select(0, index)
        normal = torch.where(chosen[:, None], normal, torch.zeros_like(normal)) @ self._rotation.T
        length = normal.square().sum(dim=1)
        along = (normal * rays).sum(dim=1)  # negative: normals face the camera
        steep = along.square() > MIN_COSINE**2 * length * rays.square().sum(dim=1)
        planar = steep & (along < 0) & (length > MIN_NORMAL**2)
        offset = torch.where(planar, self._hits * along, torch.ones_like(along))
        slope = torch.where(planar[:, None], normal, torch.zeros_like(normal)) / offset[:, None]
        # A = R + t n^T / (n . X) maps a ray r of this camera to A r in the neighbour, for every point of the plane.
        K = _on(_to_unit(self.neighbour.camera), self.depth)
        KA = (K @ rotation) + (K @ translation)[:, None] * slope[:, None, :]  # [P, 3, 3]
        by_x, by_y = KA[:, :, 0] / camera.fx, KA[:, :, 1] / camera.fy  # one pixel to the right, down
        return torch.stack([by_x, by_y, (KA * rays[:, None, :]).sum(dim=2)], dim=2), planar


def photometric(views: ViewPair) -> Tensor:
    """Return the mean of ``weight * (1 - NCC)``; pixels that are not compared count 0."""
    ncc, valid = views.similarity
    return views.mean_of(1 - ncc, valid)


def geometric(views: ViewPair) -> Tensor:
    """Return the mean of ``weight * error`` of the round trip, px; pixels that are not compared count 0."""
    return views.mean_of(*views.round_trip)


def sample(image: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Sample an image [h, w] bilinearly at positions [...] in [-1, 1], differentiable in the positions."""
    grid = torch.stack([u.reshape(-1), v.reshape(-1)], dim=1)[None, None]
    values = F.grid_sample(image[None, None], grid, mode="bilinear", padding_mode="border", align_corners=False)
    return values.reshape(u.shape)


def _offsets(radius: int, width: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return pixel offsets of a patch: (dx, dy, 1) [3, S] from its centre, and the same in the flattened image [S]."""
    steps = torch.arange(-radius, radius + 1, device=like.device)
    down, right = steps.repeat_interleave(len(steps)), steps.repeat(len(steps))
    return torch.stack([right, down, torch.ones_like(down)]).to(like.dtype), down * width + right


def _on(array: np.ndarray, like: Tensor) -> Tensor:
    """Return a small array with the dtype and device of ``like``, without waiting for the device."""
    return torch.as_tensor(array, device="cpu").to(dtype=like.dtype).to(like.device, non_blocking=True)


def _to_unit(camera: Camera) -> np.ndarray:
    """Return intrinsics [3, 3] for positions (u, v) that span the image by [-1, 1] x [-1, 1]."""
    unit = np.array([[2 / camera.width, 0.0, -1.0], [0.0, 2 / camera.height, -1.0], [0.0, 0.0, 1.0]])
    return np.asarray(unit @ camera.K)


def _inside(u: Tensor, v: Tensor, image: Tensor) -> Tensor:
    """Return which positions lie between pixel centres of an image [h, w]."""
    return (u.detach().abs() <= 1 - 1 / image.shape[1]) & (v.detach().abs() <= 1 - 1 / image.shape[0])


def _looked_up(flags: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Return the flags [h, w] of the pixels at the positions."""
    height, width = flags.shape
    i, j = (((p.detach() + 1) * (n / 2)).clamp(0, n - 1).long() for p, n in ((u, width), (v, height)))
    return flags[j, i]
