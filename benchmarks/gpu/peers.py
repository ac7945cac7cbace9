"""Adapters for other installed rasterizers, for the same splats, cameras and losses; has no code of theirs.

Those for 3D Gaussians (3DGS) get the same splats as 3D Gaussians with a third scale, draw colour alone, and train
without the normal loss.
"""

from __future__ import annotations

import importlib
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import ATTRIBUTES, Splats
from gs2d.errors import BackendError
from gs2d.losses import formulas as losses_reference

NEAR, FAR = 0.2, 100.0
THICKNESS = 1e-3  # third scale of a splat as a 3D Gaussian, relative to the smaller of its two
FASTGS_BOX = 0.5  # FastGS's default for the size of the boxes that select tiles (``mult``)


@dataclass(frozen=True, eq=False)
class PeerImages:
    """Rendered images: colour [H, W, 3]; of 2DGS also normal and depth normal [H, W, 3] in one frame, alpha [H, W]."""

    color: Tensor
    normal: Tensor | None = None
    depth_normal: Tensor | None = None
    alpha: Tensor | None = None

    def mean(self) -> Tensor:
        """Return the sum of the means of colour and normal, to have gradients of all parameters."""
        return self.color.mean() if self.normal is None else self.color.mean() + self.normal.mean()


@dataclass(frozen=True, eq=False)
class Peer:
    """Rasterizer: maps parameters before their activation and a camera to images."""

    name: str
    version: str
    render: Callable[[dict[str, Tensor], Camera], PeerImages]
    solid: bool = False  # draws 3D Gaussians: ``log_scales`` has three columns
    adam: Callable[..., torch.optim.Optimizer] | None = None  # its own optimizer, of groups of one tensor each


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


def _intrinsics(camera: Camera, device: torch.device) -> dict[str, Tensor]:
    """Return pose and intrinsics as gsplat takes them."""
    K = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    return {"viewmats": _pose(camera, device)[None], "Ks": torch.tensor([K], dtype=torch.float32, device=device)}


def _inria_settings(camera: Camera, device: torch.device) -> dict[str, Any]:
    """Return the settings that the official rasterizer and those derived from it have in common."""
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


def build_gsplat() -> None:
    """Compile gsplat's kernels for this GPU only; its wheel does this on first use and takes minutes."""
    major, minor = torch.cuda.get_device_capability()
    os.environ.setdefault(
        "TORCH_CUDA_ARCH_LIST", f"{major}.{minor}"
    )  # all architectures would take three times as long
    _module("gsplat.cuda._backend")


def _gsplat(function: str) -> tuple[Any, str]:
    """Return a function of gsplat and its version; BackendError if gsplat is not installed or lacks the function."""
    module = _module("gsplat")
    if torch.cuda.is_available():
        build_gsplat()
    version = getattr(module, "__version__", "?")
    if not hasattr(module, function):
        raise BackendError(f"gsplat {version} has no {function}; install gsplat 1.4 or newer")
    return getattr(module, function), version


def gsplat() -> Peer:
    """Return gsplat's 2DGS rasterizer, versions 1.4 to 1.6; BackendError if it is not installed."""
    draw, version = _gsplat("rasterization_2dgs")
    kept = _Kept(_intrinsics)

    def render(leaves: dict[str, Tensor], camera: Camera) -> PeerImages:
        p = activated(leaves)
        colors, alphas, normals, depth_normals, *_ = draw(
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


def gsplat_3dgs() -> Peer:
    """Return gsplat's 3DGS rasterizer, versions 1.4 to 1.6; BackendError if it is not installed."""
    draw, version = _gsplat("rasterization")
    kept = _Kept(_intrinsics)

    def render(leaves: dict[str, Tensor], camera: Camera) -> PeerImages:
        p = activated(leaves)
        colors, *_ = draw(
            **{name: p[name] for name in ("means", "quats", "scales", "opacities")},
            colors=p["sh"],
            **kept.of(camera, p["means"].device),
            width=camera.width,
            height=camera.height,
            near_plane=NEAR,
            far_plane=FAR,
            sh_degree=math.isqrt(p["sh"].shape[1]) - 1,
            packed=False,
        )
        return PeerImages(colors.reshape(camera.height, camera.width, 3))

    return Peer("gsplat_3dgs", version, render, solid=True)


def official() -> Peer:
    """Return the official 2DGS rasterizer (non-commercial licence: for comparison only, built by the user).

    Raises
    ------
    BackendError
        If it is not installed.
    """
    module = _module("diff_surfel_rasterization")
    kept = _Kept(_inria_settings)

    def render(leaves: dict[str, Tensor], camera: Camera) -> PeerImages:
        p = activated(leaves)
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


def fastgs() -> Peer:
    """Return FastGS's rasterizer (2026; non-commercial licence: for comparison only, built by the user).

    Raises
    ------
    BackendError
        If it is not installed.
    """
    module = _module("diff_gaussian_rasterization_fastgs")

    def settings(camera: Camera, device: torch.device) -> dict[str, Any]:
        unused = torch.zeros(camera.height * camera.width, dtype=torch.int, device=device)
        return _inria_settings(camera, device) | {"mult": FASTGS_BOX, "get_flag": None, "metric_map": unused}

    kept = _Kept(settings)

    def render(leaves: dict[str, Tensor], camera: Camera) -> PeerImages:
        p = activated(leaves)
        means, degree = p["means"], math.isqrt(p["sh"].shape[1]) - 1
        chosen = module.GaussianRasterizationSettings(**kept.of(camera, means.device), sh_degree=degree)
        color, *_ = module.GaussianRasterizer(raster_settings=chosen)(
            means3D=means,
            means2D=means.new_zeros(len(means), 4, requires_grad=True),
            dc=leaves["sh0"],
            shs=leaves["shN"],
            opacities=p["opacities"][:, None],
            scales=p["scales"],
            rotations=p["quats"],
        )
        return PeerImages(color.permute(1, 2, 0))

    return Peer("fastgs", "?", render, solid=True)


def faster_gs() -> Peer:
    """Return Faster-GS's rasterizer and its Adam (2026, FasterGSCudaBackend, built by the user).

    Raises
    ------
    BackendError
        If it is not installed.
    """
    module = _module("FasterGSCudaBackend.torch_bindings")

    def settings(camera: Camera, device: torch.device) -> dict[str, Any]:
        return {
            "w2c": _pose(camera, device),
            "cam_position": torch.as_tensor(camera.center, dtype=torch.float32, device=device),
            "bg_color": torch.zeros(3, device=device),
            "width": camera.width,
            "height": camera.height,
            **{f"focal_{axis}": getattr(camera, f"f{axis}") for axis in "xy"},
            **{f"center_{axis}": getattr(camera, f"c{axis}") for axis in "xy"},
            "near_plane": NEAR,
            "far_plane": FAR,
            "proper_antialiasing": False,
        }

    kept = _Kept(settings)

    def render(leaves: dict[str, Tensor], camera: Camera) -> PeerImages:
        means = leaves["means"]
        image = module.diff_rasterize(
            means=means,
            scales=leaves["log_scales"],
            rotations=leaves["quats"],
            opacities=leaves["opacity_logits"][:, None],
            sh_coefficients_0=leaves["sh0"],
            sh_coefficients_rest=leaves["shN"],
            densification_info=means.new_empty(0),
            rasterizer_settings=module.RasterizerSettings(
                **kept.of(camera, means.device), active_sh_bases=1 + leaves["shN"].shape[1]
            ),
        )
        return PeerImages(image.permute(1, 2, 0))

    return Peer("faster_gs", "?", render, solid=True, adam=module.FusedAdam)


PEERS: dict[str, Callable[[], Peer]] = {
    function.__name__: function for function in (gsplat, gsplat_3dgs, official, fastgs, faster_gs)
}


class PeerIteration:
    """Training iteration around another rasterizer: activations, torch losses, backward, fused Adam.

    Uses its own Adam if it has one, else torch's, and the fused SSIM of the package ``fused_ssim`` if installed, as
    these trainers do; otherwise the reference SSIM.
    """

    def __init__(self, peer: Peer, splats: Splats, targets: list[Tensor]) -> None:
        self._peer, self._targets = peer, targets
        self.leaves = {name: getattr(splats, name).detach().clone().requires_grad_() for name in ATTRIBUTES}
        if peer.solid:
            scales = splats.log_scales.detach()
            third = scales.amin(dim=1, keepdim=True) + math.log(THICKNESS)
            self.leaves["log_scales"] = torch.cat([scales, third], dim=1).requires_grad_()
        groups = [{"params": [leaf]} for leaf in self.leaves.values()]
        make = peer.adam or partial(torch.optim.Adam, fused=splats.device.type == "cuda")
        self._adam = make(groups, lr=1e-4, eps=1e-15)
        try:
            self._fused_ssim: Any = importlib.import_module("fused_ssim").fused_ssim
        except (ImportError, OSError):
            self._fused_ssim = None
        self.ssim = "reference losses, torch" if self._fused_ssim is None else "fused_ssim"

    def forward(self, camera: Camera) -> PeerImages:
        """Render images with their graph."""
        return self._peer.render(self.leaves, camera)

    def loss(self, images: PeerImages, index: int) -> Tensor:
        """Return 0.8 L1 + 0.2 (1 - SSIM), of 2DGS + 0.05 normal consistency."""
        target = self._targets[index]
        if self._fused_ssim is None:
            ssim = losses_reference.ssim(images.color, target)
        else:
            ssim = self._fused_ssim(images.color.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None])
        l1 = (images.color - target).abs().mean()
        loss = 0.8 * l1 + 0.2 * (1 - ssim)
        if images.normal is None or images.depth_normal is None or images.alpha is None:
            return loss
        agreement = (images.normal * images.depth_normal).sum(dim=-1) * images.alpha.detach()
        return loss + 0.05 * (1 - agreement).mean()

    def step(self, camera: Camera, index: int) -> None:
        """Run one iteration."""
        self._adam.zero_grad(set_to_none=True)
        self.loss(self.forward(camera), index).backward()
        self._adam.step()
