"""What a neighbouring photograph says about the surface: patches warped by it must look alike there.

A pixel's depth and normal are a plane; the plane takes the patch around the pixel into the neighbour's photograph by a
homography. The photometric value is 1 - NCC of the two grey patches, the geometric one how far the pixel is from where
it comes back to through the neighbour's own depth. Formulas and gradients: ``docs/math.md``, "Two views". The idea is
that of multi-view stereo and of PGSR (Chen et al. 2024), from the papers.

Plain torch, for any dtype and device; nothing here makes the host wait for the device. A backend may have both losses
as one operation, with the same formulas (``kernels/core/multiview.h``): :meth:`ViewPair.compared`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.config.multiview import MultiView
from gs2d.core.camera import Camera
from gs2d.kernels.native_multiview import Compared

MIN_COSINE = 0.1  # between normal and ray: a plane seen more edge-on than this is no plane to warp by
MIN_SCALE = 0.1  # depth in the neighbour in that here: below, the patch comes too close to the neighbour's camera
MIN_NORMAL = 1e-4  # length of a rendered normal that has a direction

CompareViews = Callable[[Tensor, Tensor, Tensor, Compared], tuple[Tensor, Tensor]]
"""``kernels.native_multiview.compare_views``, or that of another backend."""


@dataclass(frozen=True, eq=False)
class PatchImage:
    """A photograph as patches see it.

    Attributes
    ----------
    grey : Tensor [H, W]
        Mean of the channels, in [0, 1].
    clear : Tensor [H, W] bool
        No pixel of the patch around this one is masked, transparent or outside the image.
    textured : Tensor [H, W] bool
        ``clear``, and grey varies enough over the patch to be recognised.
    """

    grey: Tensor
    clear: Tensor
    textured: Tensor

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        return self.grey.nbytes + self.clear.nbytes + self.textured.nbytes


def prepare_image(image: Tensor, usable: Tensor | None, settings: MultiView) -> PatchImage:
    """Return the patches of a photograph.

    Parameters
    ----------
    image : Tensor [H, W, 3]
        In [0, 1].
    usable : Tensor [H, W] bool or None
        Not masked, and opaque.
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
    centred = (grey - grey.mean())[None, None]  # the square of a mean takes fewer digits then
    mean, square = F.avg_pool2d(centred, side, stride=1), F.avg_pool2d(centred * centred, side, stride=1)
    textured[inner, inner] = (square - mean * mean)[0, 0] > settings.texture**2
    return PatchImage(grey, clear, textured & clear)


@dataclass(frozen=True, eq=False)
class Neighbour:
    """A second view of the surface, and at which pixels of the first one it is asked.

    Attributes
    ----------
    reference, source : PatchImage
        Of the view that is learned from, and of its neighbour.
    camera : Camera
        The neighbour's.
    depth : Tensor [h', w'] world units
        As it is rendered for the neighbour, all of its image in this or a smaller size; 0 where nothing is hit. Never
        gets a gradient.
    draws : Tensor [P]
        Uniform in [0, 1); of P equal shares of the pixels that can be asked, the k-th draw chooses from the k-th.
    settings : MultiView
    """

    reference: PatchImage
    source: PatchImage
    camera: Camera
    depth: Tensor
    draws: Tensor
    settings: MultiView


def _on(array: np.ndarray, like: Tensor) -> Tensor:
    """Return a small array where another tensor is; the host waits for nothing."""
    return torch.as_tensor(array, device="cpu").to(dtype=like.dtype).to(like.device, non_blocking=True)


def choose_pixels(candidates: Tensor, draws: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels to ask, none twice.

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
        False where there are too few candidates for so many draws.
    """
    ranks_here = candidates.flatten().cumsum(0, dtype=torch.int32)
    count = ranks_here[-1]
    fraction = (torch.arange(len(draws), device=draws.device) + draws.double()) / len(draws)
    rank = torch.minimum((fraction * count).int(), count - 1)  # sorted, so what is there twice is there side by side
    index = torch.searchsorted(ranks_here, rank + 1).clamp(max=candidates.numel() - 1)
    again = torch.zeros_like(rank, dtype=torch.bool)
    again[1:] = rank[1:] == rank[:-1]
    return index, ~again & (count > 0)


@dataclass(frozen=True, eq=False)
class ViewPair:
    """The surface of one view at P pixels, as its neighbour sees it.

    Parameters
    ----------
    depth : Tensor [H, W] world units
    normal : Tensor [H, W, 3]
        World frame, any length.
    candidates : Tensor [H, W] bool
        Pixels that can be asked.
    camera : Camera
    neighbour : Neighbour
    mask : Tensor [H, W] bool, optional
        The pixels that means run over.
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
        """Rotation [3, 3] and translation [3] from this camera to the neighbour's; gradient to a pose that learns."""
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
        """How far each pixel [P] px is from where it comes back to through the neighbour's depth, and whether it does.

        Gradient to ``depth``, by the place in the neighbour's image at which its depth is read.
        """
        rotation, translation = self._motion
        source = self.neighbour.camera
        points = (self._hits[:, None] * self._rays) @ rotation.T + translation
        front = points[:, 2] > MIN_SCALE * self._hits.detach()
        z = torch.where(front, points[:, 2], torch.ones_like(points[:, 2]))
        rays = torch.stack([points[:, 0] / z, points[:, 1] / z, torch.ones_like(z)], dim=1)
        u, v, _ = (rays @ _on(_to_unit(source).T, rays)).unbind(dim=1)
        met = _Sampled.at(self.neighbour.depth, u, v).value
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
        """How much each pixel [P] counts: exp(-error) of its round trip, 0 from the largest error on; no gradient."""
        error, back = (part.detach() for part in self.round_trip)
        counts = back & (error < self.neighbour.settings.occluded)
        return torch.where(counts, torch.exp(-error), torch.zeros_like(error))

    def mean_of(self, values: Tensor, valid: Tensor) -> Tensor:
        """Mean of ``weights * values`` over all pixels, from the P that were asked; 0 where nothing is known."""
        weighted = torch.where(valid & (self.weights > 0), self.weights * values, torch.zeros_like(values))
        return self.mean_of_sum(weighted.sum())

    def mean_of_sum(self, total: Tensor) -> Tensor:
        """Mean over all pixels of what sums up to ``total`` [] over the P that were asked."""
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
        """NCC [P] of the patches here and there, and where it is one; gradient to depth and normal."""
        maps, planar = self._homographies
        reference, source = self.neighbour.reference.grey, self.neighbour.source.grey
        ncc, valid = _PatchSimilarity.apply(maps, reference, source, self._pixels[0], self.neighbour.settings)
        return ncc, valid & planar & self._pixels[1]

    @cached_property
    def _homographies(self) -> tuple[Tensor, Tensor]:
        """For each plane the map from offsets (right, down, 1), px, to the neighbour's image, and whether it is one.

        The maps [P, 3, 3] give homogeneous places.
        """
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
        # A = R + t n^T / (n . X): a ray r of this camera goes to A r of the neighbour's, for every point of the plane.
        K = _on(_to_unit(self.neighbour.camera), self.depth)
        KA = (K @ rotation) + (K @ translation)[:, None] * slope[:, None, :]  # [P, 3, 3]
        by_x, by_y = KA[:, :, 0] / camera.fx, KA[:, :, 1] / camera.fy  # one pixel to the right, down
        return torch.stack([by_x, by_y, (KA * rays[:, None, :]).sum(dim=2)], dim=2), planar


class _PatchSimilarity(torch.autograd.Function):
    """NCC of patches with what homographies make of them, its gradient made on the way forward: a third of the time."""

    @staticmethod
    def forward(
        ctx: Any, maps: Tensor, reference: Tensor, source: Tensor, index: Tensor, settings: MultiView
    ) -> tuple[Tensor, Tensor]:
        """NCC [P] and bool [P] whether there is one, of maps [P, 3, 3], greys [H, W] and [h, w] and pixels [P]."""
        offsets, jumps = _offsets(settings.radius, reference.shape[1], maps)  # [3, S], [S]
        side, least = settings.side, settings.texture**2 * len(jumps)
        around = (index[:, None] + jumps).clamp_(0, reference.numel() - 1)  # for pixels that are not chosen
        mine = torch.take(reference, around)  # [P, S]
        mine -= mine.mean(dim=1, keepdim=True)
        x, y, z = (maps @ offsets).unbind(dim=1)  # [P, S] each
        corners = slice(None, None, side - 1)  # a square stays convex: all of it is where its corners are
        front = (z.unflatten(1, (side, side))[:, corners, corners] > MIN_SCALE).flatten(1).all(dim=1)
        inverse = z.clamp_(min=MIN_SCALE).reciprocal_()
        u, v = x.mul_(inverse), y.mul_(inverse)
        at_u, at_v = (place.unflatten(1, (side, side))[:, corners, corners] for place in (u, v))
        inside = _inside(at_u, at_v, source).flatten(1).all(dim=1)
        theirs, pull = _sample(source, u, v)
        theirs -= theirs.mean(dim=1, keepdim=True)
        squares_mine, squares = (torch.linalg.vector_norm(grey, dim=1).square() for grey in (mine, theirs))
        scale_mine, scale = squares_mine.clamp(min=least).rsqrt(), squares.clamp(min=least / 4).rsqrt()
        ncc = (mine * theirs).sum(dim=1) * scale_mine * scale
        valid = front & inside & (squares_mine > least) & (squares > least / 4)
        by_grey = mine.mul_((scale_mine * scale)[:, None]).sub_(theirs.mul_((ncc * scale.square())[:, None]))
        by_x, by_y = pull(by_grey.mul_(inverse))
        by_z = u.mul_(by_x).addcmul_(v, by_y).neg_()
        ctx.save_for_backward(torch.stack([by @ offsets.T for by in (by_x, by_y, by_z)], dim=1))  # [P, 3, 3]
        ctx.mark_non_differentiable(valid)
        return ncc, valid

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        (by_maps,) = ctx.saved_tensors
        return upstream[:, None, None] * by_maps, None, None, None, None


def _offsets(radius: int, width: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Of the S pixels of a patch: (right, down, 1) [3, S] from its middle, and how far on in the flat image [S]."""
    steps = torch.arange(-radius, radius + 1, device=like.device)
    down, right = steps.repeat_interleave(len(steps)), steps.repeat(len(steps))
    return torch.stack([right, down, torch.ones_like(down)]).to(like.dtype), down * width + right


def photometric(views: ViewPair) -> Tensor:
    """Mean of ``weight * (1 - NCC)``; pixels that cannot be asked or do not count are 0 there."""
    ncc, valid = views.similarity
    return views.mean_of(1 - ncc, valid)


def geometric(views: ViewPair) -> Tensor:
    """Mean of ``weight * error`` of the round trip, px; pixels that cannot be asked or do not count are 0 there."""
    return views.mean_of(*views.round_trip)


def _to_unit(camera: Camera) -> np.ndarray:
    """Intrinsics [3, 3] to places (u, v) for which the image is [-1, 1] x [-1, 1], whatever its size."""
    unit = np.array([[2 / camera.width, 0.0, -1.0], [0.0, 2 / camera.height, -1.0], [0.0, 0.0, 1.0]])
    return np.asarray(unit @ camera.K)


def _inside(u: Tensor, v: Tensor, image: Tensor) -> Tensor:
    """Whether places lie between pixel centres of an image [h, w]."""
    return (u.detach().abs() <= 1 - 1 / image.shape[1]) & (v.detach().abs() <= 1 - 1 / image.shape[0])


@dataclass(frozen=True, eq=False)
class _Sampled:
    """An image [h, w] at places [...], bilinear between pixel centres, where torch's operation is not deterministic.

    Attributes
    ----------
    value : Tensor [...]
    by_u, by_v : Tensor [...]
        Its derivatives.
    """

    value: Tensor
    by_u: Tensor
    by_v: Tensor

    @classmethod
    def at(cls, image: Tensor, u: Tensor, v: Tensor) -> _Sampled:
        """Sample; a gradient of ``value`` goes to the places."""
        height, width = image.shape
        x, y = ((p * (n / 2)).add_((n - 1) / 2).clamp_(0, n - 1) for p, n in ((u, width), (v, height)))
        i, j = x.detach().long().clamp_(max=max(width - 2, 0)), y.detach().long().clamp_(max=max(height - 2, 0))
        x, y, index = x - i, y - j, j * width + i
        right, down = min(1, width - 1), width * min(1, height - 1)
        a, b, c, d = (torch.take(image, index + step) for step in (0, right, down, down + right))
        b -= a
        bend = d.sub_(c).sub_(b)
        by_x, by_y = bend * y + b, bend * x + c.sub_(a)
        return cls(a + x * b + y * by_y, by_x * (width / 2), by_y * (height / 2))


def _sample(image: Tensor, u: Tensor, v: Tensor) -> tuple[Tensor, Callable[[Tensor], tuple[Tensor, Tensor]]]:
    """Return an image [h, w] at places [P, S], and what takes a gradient of that to those of u and v. No autograd.

    On a CPU by torch's own operation, which takes a fifth of the time.
    """
    if image.device.type != "cpu":
        sampled = _Sampled.at(image, u, v)
        return sampled.value, lambda given: (sampled.by_u * given, sampled.by_v * given)
    place, options = torch.stack([u, v], dim=2)[None], (0, 1, False)  # bilinear, border, corners not aligned

    def pull(given: Tensor) -> tuple[Tensor, Tensor]:
        backward = torch.ops.aten.grid_sampler_2d_backward
        by_u, by_v = backward(given[None, None], image[None, None], place, *options, [False, True])[1][0].unbind(dim=2)
        return by_u, by_v

    return torch.grid_sampler_2d(image[None, None], place, *options)[0, 0], pull


def _looked_up(flags: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Return the flag [h, w] of the pixel that holds each place."""
    height, width = flags.shape
    i, j = (((p.detach() + 1) * (n / 2)).clamp(0, n - 1).long() for p, n in ((u, width), (v, height)))
    return flags[j, i]
