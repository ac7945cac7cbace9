"""Adapters for other installed 2DGS rasterizers, for the same splats, cameras and losses; has no code of theirs."""

from __future__ import annotations

import importlib
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import ATTRIBUTES, Splats
from gs2d.errors import BackendError
from gs2d.losses import formulas as losses_reference

NEAR, FAR = 0.2, 100.0


@dataclass(frozen=True, eq=False)
class PeerImages:
    """Rendered images: colour [H, W, 3]; normal and depth normal [H, W, 3] in one frame; alpha [H, W]."""

    color: Tensor
    normal: Tensor
    depth_normal: Tensor
    alpha: Tensor


@dataclass(frozen=True, eq=False)
class Peer:
    """Rasterizer: maps activated parameters and a camera to images."""

    name: str
    version: str
    render: Callable[[dict[str, Tensor], Camera], PeerImages]


def activated(leaves: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return activated parameters: normalised rotations, exponentiated scales, sigmoid opacities, SH in one tensor."""
    scales = leaves["log_scales"].exp()
    return {
        "means": leaves["means"],
        "quats": torch.nn.functional.normalize(leaves["quats"], dim=1),
        "scales": scales,
        "opacities": leaves["opacity_logits"].sigmoid(),
        "sh": torch.cat([leaves["sh0"], leaves["shN"]], dim=1),
    }


def _module(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except (ImportError, OSError) as error:
        raise BackendError(f"{name} is not installed here ({error})") from error


class _Kept:
    """Cache of per-camera data on the device, filled on first use: other trainers also keep cameras on the device."""

    def __init__(self, make: Callable[[Camera, torch.device], Any]) -> None:
        self._make = make
        self._made: dict[tuple[int, torch.device], tuple[Camera, Any]] = {}

    def of(self, camera: Camera, device: torch.device) -> Any:
        key = (id(camera), device)
        if key not in self._made:
            self._made[key] = camera, self._make(camera, device)  # keep the camera too, so that its id is not reused
        return self._made[key][1]


def _pose(camera: Camera, device: torch.device) -> Tensor:
    return torch.as_tensor(camera.T_cam_world, dtype=torch.float32, device=device)


def build_gsplat() -> None:
    """Compile gsplat's kernels for this GPU only; its wheel does this on first use and takes minutes."""
    major, minor = torch.cuda.get_device_capability()
    os.environ.setdefault(
        "TORCH_CUDA_ARCH_LIST", f"{major}.{minor}"
    )  # all architectures would take three times as long
    _module("gsplat.cuda._backend")


def gsplat() -> Peer:
    """Return gsplat's 2DGS rasterizer, versions 1.4 to 1.6.

    Raises
    ------
    BackendError
        If gsplat is not installed or has no 2DGS.
    """
    module = _module("gsplat")
    if torch.cuda.is_available():
        build_gsplat()
    version = getattr(module, "__version__", "?")
    if not hasattr(module, "rasterization_2dgs"):
        raise BackendError(f"gsplat {version} has no rasterization_2dgs; install gsplat 1.4 or newer")

    def matrices(camera: Camera, device: torch.device) -> dict[str, Tensor]:
        K = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
        return {"viewmats": _pose(camera, device)[None], "Ks": torch.tensor([K], dtype=torch.float32, device=device)}

    kept = _Kept(matrices)

    def render(p: dict[str, Tensor], camera: Camera) -> PeerImages:
        colors, alphas, normals, depth_normals, *_ = module.rasterization_2dgs(
            means=p["means"],
            quats=p["quats"],
            scales=torch.cat([p["scales"], torch.ones_like(p["scales"][:, :1])], dim=1),
            opacities=p["opacities"],
            colors=p["sh"],
            **kept.of(camera, p["means"].device),
            width=camera.width,
            height=camera.height,
            near_plane=NEAR,
            far_plane=FAR,
            sh_degree=math.isqrt(p["sh"].shape[1]) - 1,
            packed=False,
            render_mode="RGB+ED",
        )
        size = (camera.height, camera.width)
        normal, depth_normal = (x.reshape(*size, 3) for x in (normals, depth_normals))
        return PeerImages(colors.reshape(*size, -1)[..., :3], normal, depth_normal, alphas.reshape(size))

    return Peer("gsplat", version, render)


def official() -> Peer:
    """Return the official 2DGS rasterizer (non-commercial licence: for comparison only, built by the user).

    Raises
    ------
    BackendError
        If it is not installed.
    """
    module = _module("diff_surfel_rasterization")

    def settings(camera: Camera, device: torch.device) -> dict[str, Any]:
        tan_x, tan_y = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
        pose = _pose(camera, device)
        projection = torch.zeros(4, 4, device=device)
        projection[0, 0], projection[1, 1] = 1 / tan_x, 1 / tan_y
        projection[2, 2], projection[2, 3], projection[3, 2] = FAR / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR), 1.0
        return {
            "image_height": camera.height,
            "image_width": camera.width,
            "tanfovx": tan_x,
            "tanfovy": tan_y,
            "bg": torch.zeros(3, device=device),
            "scale_modifier": 1.0,
            "viewmatrix": pose.T.contiguous(),
            "projmatrix": (projection @ pose).T.contiguous(),
            "campos": torch.as_tensor(camera.center, dtype=torch.float32, device=device),
            "prefiltered": False,
            "debug": False,
        }

    kept = _Kept(settings)

    def render(p: dict[str, Tensor], camera: Camera) -> PeerImages:
        means = p["means"]
        given = kept.of(camera, means.device)
        degree = math.isqrt(p["sh"].shape[1]) - 1
        chosen = module.GaussianRasterizationSettings(**given, sh_degree=degree)
        color, _, planes = module.GaussianRasterizer(raster_settings=chosen)(
            means3D=means,
            means2D=torch.zeros_like(means, requires_grad=True),
            shs=p["sh"],
            opacities=p["opacities"][:, None],
            scales=p["scales"],
            rotations=p["quats"],
        )
        # Planes: depth sum, alpha, normal (3, camera frame), median depth, distortion.
        alpha, normal = planes[1], planes[2:5].permute(1, 2, 0) @ given["viewmatrix"][:3, :3].T
        depth = torch.nan_to_num(planes[0] / alpha, 0, 0)
        return PeerImages(color.permute(1, 2, 0), normal, losses_reference.normals_from_depth(depth, camera), alpha)

    return Peer("official", "?", render)


PEERS: dict[str, Callable[[], Peer]] = {"gsplat": gsplat, "official": official}


class PeerIteration:
    """Training iteration around another rasterizer: activations, torch losses, backward, torch's fused Adam.

    Uses the fused SSIM of the package ``fused_ssim`` if installed, as these trainers do; otherwise the reference SSIM.
    """

    def __init__(self, peer: Peer, splats: Splats, targets: list[Tensor]) -> None:
        self._peer, self._targets = peer, targets
        self.leaves = {name: getattr(splats, name).detach().clone().requires_grad_() for name in ATTRIBUTES}
        fused = next(iter(self.leaves.values())).device.type == "cuda"
        self._adam = torch.optim.Adam(list(self.leaves.values()), lr=1e-4, eps=1e-15, fused=fused)
        try:
            self._fused_ssim: Any = importlib.import_module("fused_ssim").fused_ssim
        except (ImportError, OSError):
            self._fused_ssim = None
        self.ssim = "reference losses, torch" if self._fused_ssim is None else "fused_ssim"

    def forward(self, camera: Camera) -> PeerImages:
        """Render images with their graph."""
        return self._peer.render(activated(self.leaves), camera)

    def loss(self, images: PeerImages, index: int) -> Tensor:
        """Return 0.8 L1 + 0.2 (1 - SSIM) + 0.05 normal consistency."""
        target = self._targets[index]
        if self._fused_ssim is None:
            ssim = losses_reference.ssim(images.color, target)
        else:
            ssim = self._fused_ssim(images.color.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None])
        l1 = (images.color - target).abs().mean()
        agreement = (images.normal * images.depth_normal).sum(dim=-1) * images.alpha.detach()
        return 0.8 * l1 + 0.2 * (1 - ssim) + 0.05 * (1 - agreement).mean()

    def step(self, camera: Camera, index: int) -> None:
        """Run one iteration."""
        self._adam.zero_grad(set_to_none=True)
        self.loss(self.forward(camera), index).backward()
        self._adam.step()
