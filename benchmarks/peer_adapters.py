"""Adapters for other CPU rasterizers with a common interface: a forward pass, and a backward pass of its result.

This repository contains none of their code: each is loaded from a build or checkout of the user (requirements:
:mod:`benchmarks.peers`).
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.sh import sh_to_rgb
from gs2d.core.splats import Splats

NEAR, ALPHA_MIN, TRANSMITTANCE_MIN = 0.2, 1.0 / 255.0, 1e-4
THIN = 1e-3  # third standard deviation of a splat as a 3D Gaussian, relative to the smaller of its two
CHUNK = 1 << 22  # bounding box pixels per batch
OPENSPLAT_OPERATORS = ("project", "forward", "backward", "pairs")


class Peer(Protocol):
    """Interface of a timed rasterizer."""

    name: str

    def forward(self) -> Any:
        """Render the scene; return the state for :meth:`backward`."""

    def backward(self, rendered: Any) -> None:
        """Compute all gradients that this rasterizer supports."""

    def color(self, rendered: Any) -> Tensor:
        """Return the image [H, W, 3]."""

    def pairs(self, rendered: Any) -> int:
        """Return the number of blended (pixel, splat) pairs."""


def colors_of(splats: Splats, camera: Camera) -> Tensor:
    """Return view-dependent colours [N, 3]."""
    directions = splats.means - torch.as_tensor(camera.center, dtype=splats.dtype)
    directions = directions / directions.norm(dim=1, keepdim=True)
    return sh_to_rgb(splats.sh0, splats.shN, directions, splats.sh_degree)


def in_front(splats: Splats, camera: Camera) -> Splats:
    """Return the splats beyond the near plane: neither of the other CPU rasterizers culls the rest."""
    depth = splats.means @ torch.as_tensor(camera.rotation[2], dtype=splats.dtype)
    return splats.rows(depth + float(camera.T_cam_world[2, 3]) > NEAR)


class OpenSplat:
    """OpenSplat's CPU rasterizer: 3D Gaussians, colour only, one thread. Its projection and SH are not timed."""

    name = "opensplat"

    def __init__(self, library: Path, splats: Splats, camera: Camera) -> None:
        torch.ops.load_library(str(library.resolve()))
        self.operators = torch.ops.opensplat_cpu
        missing = [name for name in OPENSPLAT_OPERATORS if not hasattr(self.operators, name)]
        if missing:
            raise ValueError(f"{library} registers no opensplat_cpu::{missing[0]}; see benchmarks/peers.py")
        splats, self.size = in_front(splats, camera), (camera.height, camera.width)
        scales = torch.cat([splats.scales, THIN * splats.scales.amin(dim=1, keepdim=True)], dim=1)
        view = torch.as_tensor(camera.T_cam_world, dtype=torch.float32)
        w, h, far = camera.width, camera.height, 100.0
        projection = torch.tensor(
            [
                [2 * camera.fx / w, 0, 2 * camera.cx / w - 1, 0],
                [0, 2 * camera.fy / h, 2 * camera.cy / h - 1, 0],
                [0, 0, far / (far - NEAR), -far * NEAR / (far - NEAR)],
                [0, 0, 1, 0],
            ],
            dtype=torch.float32,
        )
        with torch.no_grad():
            xys, _, conics, cov2d, depths = self.operators.project(
                *(splats.means, scales, splats.quats, view, projection @ view),
                *(camera.fx, camera.fy, camera.cx, camera.cy, h, w),
            )
            points = (xys, conics, colors_of(splats, camera), splats.opacities[:, None], torch.zeros(3), cov2d, depths)
        self.inputs = [t.contiguous() for t in points]
        generator = torch.Generator().manual_seed(1)
        self.cotangent, self.no_alpha = torch.randn(h, w, 3, generator=generator), torch.zeros(h, w)

    def forward(self) -> Any:
        """Render; return image, final transmittance and the address of the splat lists by pixel."""
        height, width = self.size
        return self.operators.forward(width, height, *self.inputs)

    def backward(self, rendered: Any) -> None:
        """Compute gradients of centres, conics, colours and opacities; free the lists."""
        _, final, lists = rendered
        self.operators.backward(*self.size, *self.inputs, final, lists, self.cotangent, self.no_alpha)

    def color(self, rendered: Any) -> Tensor:
        """Return the image [H, W, 3]."""
        return torch.as_tensor(rendered[0])

    def pairs(self, rendered: Any) -> int:
        """Return the total length of the splat lists."""
        return int(self.operators.pairs(rendered[2], self.size[0] * self.size[1]))


def weights_along_rays(alphas: Tensor, *, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """Compute blending weights and transmittances [M] of samples sorted by ray, front to back, in plain torch.

    The transmittance is the product of (1 - alpha) over the previous samples of the ray. It is computed as a running
    sum of logarithms minus its value at the start of the ray, in float64 because the sum runs over all rays.
    """
    logs = torch.log1p(-alphas.double())
    before = torch.cumsum(logs, 0) - logs
    counts = torch.bincount(ray_indices, minlength=n_rays)
    begin = (torch.cumsum(counts, 0) - counts)[ray_indices]
    transmittance = torch.exp(before - before[begin]).to(alphas.dtype)
    return alphas * transmittance, transmittance


def accumulate_along_rays(weights: Tensor, values: Tensor | None, *, ray_indices: Tensor, n_rays: int) -> Tensor:
    """Return sums of weight times value [n_rays, C] of samples, or of the weights if ``values`` is None."""
    weighted = weights[:, None] if values is None else weights[:, None] * values
    return weighted.new_zeros(n_rays, weighted.shape[1]).index_add(0, ray_indices, weighted)


def load_gsplat(checkout: Path) -> ModuleType:
    """Load gsplat's torch reference for 2DGS without its package's imports; replace two nerfacc functions with ours.

    nerfacc's own scans require CUDA.
    """
    folder = checkout.resolve() / "gsplat"
    if not (folder / "cuda" / "_torch_impl_2dgs.py").exists():
        raise ValueError(f"{checkout} is no checkout of gsplat: there is no gsplat/cuda/_torch_impl_2dgs.py in it")
    for name, path in (("gsplat", folder), ("gsplat.cuda", folder / "cuda")):
        package = ModuleType(name)
        package.__path__ = [str(path)]
        sys.modules[name] = package
    nerfacc: Any = ModuleType("nerfacc")
    nerfacc.render_weight_from_alpha, nerfacc.accumulate_along_rays = weights_along_rays, accumulate_along_rays
    sys.modules["nerfacc"] = nerfacc
    return importlib.import_module("gsplat.cuda._torch_impl_2dgs")


class Gsplat:
    """gsplat's torch reference for 2DGS: projection, intersection and compositing of the pairs passed to it. The pair
    search of gsplat is CUDA code and is not timed.
    """

    name = "gsplat"

    def __init__(self, checkout: Path, splats: Splats, camera: Camera) -> None:
        self.module: Any = load_gsplat(checkout)
        splats, self.camera = in_front(splats, camera), camera
        values = {
            "means": splats.means,
            "quats": splats.quats,
            "scales": torch.cat([splats.scales, torch.ones(len(splats), 1)], dim=1),
            "opacities": splats.opacities,
            "colors": colors_of(splats, camera),
        }
        self.leaves = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
        self.view = torch.as_tensor(camera.T_cam_world, dtype=torch.float32)[None]
        self.K = torch.as_tensor(camera.K, dtype=torch.float32)[None]
        with torch.no_grad():
            self.gaussians, self.pixels = self._visible_pairs()
        self.images = torch.zeros_like(self.pixels)
        generator = torch.Generator().manual_seed(1)
        shapes = ((1, camera.height, camera.width, c) for c in (4, 1, 3))
        self.cotangents = [torch.randn(shape, generator=generator) for shape in shapes]

    def _project(self) -> tuple[Tensor, ...]:
        means, quats, scales = (self.leaves[name] for name in ("means", "quats", "scales"))
        return tuple(
            self.module._fully_fused_projection_2dgs(
                means, quats, scales, self.view, self.K, self.camera.width, self.camera.height, near_plane=NEAR
            )
        )

    def _visible_pairs(self) -> tuple[Tensor, Tensor]:
        """Return splat and pixel indices of visible pairs, sorted by pixel and depth."""
        radii, centers, depths, transforms, _ = (t[0] for t in self._project())
        order = torch.argsort(depths)
        order = order[(radii[order] > 0).all(dim=1)]
        low = (centers[order] - radii[order]).floor().clamp(min=0)
        high = (centers[order] + radii[order]).ceil()
        size = torch.tensor([self.camera.width, self.camera.height])
        low, sides = low.long(), (torch.minimum(high.long(), size) - low.long()).clamp(min=0)
        areas, found = sides.prod(dim=1), []
        ends = torch.cumsum(areas, 0)
        chunk = torch.div(ends, CHUNK, rounding_mode="floor")
        for part in range(int(chunk.max()) + 1):
            rows = (chunk == part).nonzero().squeeze(1)
            of = rows.repeat_interleave(areas[rows])
            inside = torch.arange(len(of)) - (ends[of] - areas[of] - (ends[rows[0]] - areas[rows[0]]))
            x = low[of, 0] + inside % sides[of, 0]
            y = low[of, 1] + torch.div(inside, sides[of, 0], rounding_mode="floor")
            alpha = self._alphas(order[of], x, y, centers, transforms)
            seen = alpha >= ALPHA_MIN
            found.append(torch.stack([of[seen], y[seen] * self.camera.width + x[seen]]))
        nearest, pixels = torch.cat(found, dim=1)
        by_pixel = torch.argsort(pixels, stable=True)  # stable: keeps the depth order
        gaussians, pixels = order[nearest[by_pixel]], pixels[by_pixel]
        alpha = self._alphas(
            gaussians, pixels % self.camera.width, pixels // self.camera.width, centers, transforms
        ).clamp(max=0.99)
        _, before = weights_along_rays(alpha, ray_indices=pixels, n_rays=int(size.prod()))
        reached = before * (1 - alpha) > TRANSMITTANCE_MIN
        return gaussians[reached], pixels[reached]

    def _alphas(self, splats: Tensor, x: Tensor, y: Tensor, centers: Tensor, transforms: Tensor) -> Tensor:
        """Return the opacity of pairs from the definition of a 2D splat (docs/math.md), to select pairs."""
        M = transforms[splats]
        h_u = -M[:, 0] + M[:, 2] * (x + 0.5)[:, None]
        h_v = -M[:, 1] + M[:, 2] * (y + 0.5)[:, None]
        hit = torch.linalg.cross(h_u, h_v)
        rho3d = (hit[:, :2] / hit[:, 2:]).square().sum(dim=1)
        rho2d = 2 * (torch.stack([x + 0.5, y + 0.5], dim=1) - centers[splats]).square().sum(dim=1)
        return self.leaves["opacities"][splats] * torch.exp(-0.5 * torch.fmin(rho3d, rho2d))

    def forward(self) -> Any:
        """Render; return colour with depth [1, H, W, 4], alpha and normals."""
        _, centers, depths, transforms, normals = self._project()
        features = torch.cat([self.leaves["colors"][None], depths[..., None]], dim=-1)
        return self.module.accumulate_2dgs(
            *(centers, transforms, self.leaves["opacities"][None], features, normals),
            *(self.gaussians, self.pixels, self.images, self.camera.width, self.camera.height),
        )

    def backward(self, rendered: Any) -> None:
        """Compute gradients of means, rotations, scales, opacities and colours."""
        torch.autograd.grad(list(rendered), list(self.leaves.values()), self.cotangents)

    def color(self, rendered: Any) -> Tensor:
        """Return the image [H, W, 3]."""
        return torch.as_tensor(rendered[0][0, ..., :3].detach())

    def pairs(self, rendered: Any) -> int:
        """Return the number of pairs passed to it."""
        return len(self.pixels)


PEERS: dict[str, Callable[[Path, Splats, Camera], Peer]] = {"opensplat": OpenSplat, "gsplat": Gsplat}


def difference(a: Tensor, b: Tensor) -> float:
    """Return the mean absolute difference of two images."""
    return float(np.abs(a.detach().numpy() - b.detach().numpy()).mean())
