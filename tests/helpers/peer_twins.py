"""Stand-ins for other rasterizers: packages with their interfaces that draw with our reference."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings, RenderOutput


def drawn(
    size: tuple[int, int],
    pose: Tensor,
    K: Any,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Any,
) -> RenderOutput:
    """Draw activated parameters for an image of ``size`` (width, height)."""
    camera = Camera(size[0], size[1], *(float(each) for each in K), pose.double().cpu().numpy())
    splats = Splats(means, quats, scales[:, :2].log(), opacities.reshape(-1).logit(), sh[0], sh[1])
    return rasterize(splats, camera, RasterSettings(near=0.2), backend="reference")


def of_gsplat(k: dict[str, Any]) -> RenderOutput:
    """Draw with the arguments of gsplat."""
    K, sh = k["Ks"][0], k["colors"]
    assert k["sh_degree"] == 3
    assert k["scales"].shape[1] == 3
    size, intrinsics = (k["width"], k["height"]), (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    rest = (k["means"], k["quats"], k["scales"], k["opacities"], (sh[:, :1], sh[:, 1:]))
    return drawn(size, k["viewmats"][0], intrinsics, *rest)


def of_inria(settings: Any, k: dict[str, Any]) -> RenderOutput:
    """Draw with the arguments of the official rasterizers, whose principal point is the middle of the image."""
    width, height, pose = settings.image_width, settings.image_height, settings.viewmatrix.T
    fx, fy = width / (2 * settings.tanfovx), height / (2 * settings.tanfovy)
    centre = torch.from_numpy(np.array([0.0, 0.0, 0.0, 1.0])).float()
    np.testing.assert_allclose((pose @ torch.cat([settings.campos, centre[3:]]))[:3], centre[:3], atol=1e-5)
    clip = torch.tensor([0.3, -0.2, 2.0, 1.0]) @ torch.linalg.inv(pose).T @ settings.projmatrix
    np.testing.assert_allclose(clip[:2] / clip[3] * 2.0, (0.3 / settings.tanfovx, -0.2 / settings.tanfovy), rtol=1e-4)
    sh = (k["dc"], k["shs"]) if "dc" in k else (k["shs"][:, :1], k["shs"][:, 1:])
    rest = (k["means3D"], k["rotations"], k["scales"], k["opacities"], sh)
    return drawn((width, height), pose, (fx, fy, width / 2, height / 2), *rest)


SETTINGS = """
from collections import namedtuple
from peer_twins import drawn, of_gsplat, of_inria
import os, torch

INRIA = ("image_height image_width tanfovx tanfovy bg scale_modifier viewmatrix projmatrix sh_degree campos "
         "prefiltered debug ")
"""
PACKAGES = {
    "gsplat/__init__.py": """
__version__ = "1.6.0"
def rasterization_2dgs(**k):
    out = of_gsplat(k)
    return (out.color[None], out.alpha[None, ..., None], out.normal[None], out.normal[None], None, None, {})
def rasterization(**k):
    assert (k["scales"][:, 2] < 2e-3 * k["scales"][:, :2].amin(1)).all()  # thin
    return of_gsplat(k).color[None], None, {}
""",
    "diff_surfel_rasterization.py": """
GaussianRasterizationSettings = namedtuple("GaussianRasterizationSettings", INRIA)
class GaussianRasterizer:
    def __init__(self, raster_settings):
        self.settings = raster_settings
    def __call__(self, **k):
        out = of_inria(self.settings, k)
        planes = [out.depth_mean * out.alpha, out.alpha, *out.normal.unbind(2), out.depth_median, out.distortion]
        return out.color.permute(2, 0, 1), None, torch.stack(planes)
""",
    "diff_gaussian_rasterization_fastgs.py": """
GaussianRasterizationSettings = namedtuple("GaussianRasterizationSettings", INRIA + "mult get_flag metric_map")
class GaussianRasterizer:
    def __init__(self, raster_settings):
        self.settings = raster_settings
    def __call__(self, **k):
        if os.environ.get("FASTGS_CRASHES"):
            os._exit(9)
        return of_inria(self.settings, k).color.permute(2, 0, 1), None, None
""",
    "FasterGSCudaBackend/torch_bindings/__init__.py": """
RasterizerSettings = namedtuple("RasterizerSettings", "w2c cam_position bg_color active_sh_bases width height focal_x "
    "focal_y center_x center_y near_plane far_plane proper_antialiasing")
class FusedAdam(torch.optim.Adam):
    def step(self):
        assert all(len(group["params"]) == 1 for group in self.param_groups)
        super().step()
def diff_rasterize(means, scales, rotations, opacities, sh_coefficients_0, sh_coefficients_rest, densification_info,
                   rasterizer_settings):
    s, sh = rasterizer_settings, (sh_coefficients_0, sh_coefficients_rest)
    assert s.active_sh_bases == 16 and opacities.shape[1] == 1
    K = s.focal_x, s.focal_y, s.center_x, s.center_y
    out = drawn((s.width, s.height), s.w2c, K, means, rotations, scales.exp(), opacities.sigmoid(), sh)
    return out.color.permute(2, 0, 1)
""",
}


def write_packages(folder: Path) -> Path:
    """Write the packages into a folder for the Python path."""
    for name, text in PACKAGES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(SETTINGS + text)
    return folder
