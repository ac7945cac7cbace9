"""Inputs and outputs of rasterizers, the same for all backends."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

from torch import Tensor

from gs2d.core.camera import Camera

TRANSMITTANCE = "transmittance"  # the kind of depth that is only rendered on request
NO_LOWPASS = 1e-3  # px; finite, because kernels divide by its square
PLAIN_COLORS = -1  # value of RasterSettings.sh_degree
NEAR_PLANE_POLICIES = ("draw", "cull", "box")  # values of near_plane_policy; the kernels use their index
# Rule 23: splats beyond these limits are culled, since float32 would overflow (core/project.h has the same).
MAX_SIZE = 1e9  # world units: coordinates in the camera frame, scales
MIN_SIZE = 1e-18  # world units: smaller scales count as this
MAX_COLOR = 1e15  # sum of the absolute coefficients of a colour
MIN_QUATERNION = 1e-15  # largest component; below, it counts as a zero quaternion
# Rule 24: a splat that the Mip filter would enlarge by more than this is culled (core/mip_filter.h has the same). With
# an opacity of at most 1e-4 it would not be visible, and edge-on splats have no finite factor.
MAX_WIDENING = 1e4


@dataclass(frozen=True)
class RasterSettings:
    """The constants of the rasterizer. Rules are those of the contract (render/api.py).

    Attributes
    ----------
    near : float
        World units. Splats whose centre is not beyond it are culled; pairs with a smaller depth are skipped.
    far : float
        World units. Used only to map depth for the distortion.
    alpha_min, alpha_max : float
        Pairs below alpha_min are skipped, above alpha_max clamped.
    transmittance_min : float
        A pixel stops before the splat that would reduce its transmittance below this.
    error_cutoff : float
        Footprint of ``splat_errors``: rho <= error_cutoff^2.
    lowpass_px : float
        px. Standard deviation of the screen-space low-pass filter of 2DGS.
    mip_px : float
        px. Standard deviation of the object-space Mip filter, which then replaces that low-pass filter (rule 24). 0:
        the low-pass filter.
    background : tuple of 3 floats
        Background colour in [0, 1]; with ``PLAIN_COLORS`` any finite numbers.
    sh_degree : int
        SH degree to evaluate; higher coefficients are ignored and get zero gradients. With ``PLAIN_COLORS`` (-1)
        ``sh0`` holds plain colours or any three features (rule 11).
    lowpass_depth : str
        Depth of a pair if the low-pass filter determines rho: "center" (depth of the splat centre) or "plane" (the
        ray-plane depth of the current official code; reference backend only).
    near_plane_policy : str
        Handling of splats whose disc of ``error_cutoff`` standard deviations reaches the camera plane (rule 19):
        "draw" like any other, "cull", or "box" (only in the tiles of the official rasterizer's box).
    with_distortion : bool
        If False, a backend may skip that image and return NaN.
    with_transmittance_depth : bool
        Render ``depth_transmittance`` too, with one search along the ray of each pixel (rule 22).
    depth_width_px : float
        px. Half width of the depth interval of a splat's opacity for it, in pixel widths at that depth.
    """

    near: float = 0.2
    far: float = 100.0
    alpha_min: float = 1.0 / 255.0
    alpha_max: float = 0.99
    transmittance_min: float = 1e-4
    error_cutoff: float = 3.0
    lowpass_px: float = math.sqrt(2.0) / 2.0
    mip_px: float = 0.0
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sh_degree: int = 3
    lowpass_depth: str = "center"
    near_plane_policy: str = "draw"
    with_distortion: bool = True
    with_transmittance_depth: bool = field(default=False, metadata={"derived": True})
    depth_width_px: float = 2.0

    def for_depths(self, *kinds: str | None) -> RasterSettings:
        """Return the settings that render these kinds of depth; None is ignored."""
        return replace(self, with_transmittance_depth=self.with_transmittance_depth or TRANSMITTANCE in kinds)

    def constants(self) -> dict[str, Any]:
        """Return the constants by name, for files, without ``with_transmittance_depth``, which losses determine."""
        return {f.name: getattr(self, f.name) for f in fields(self) if not f.metadata.get("derived")}

    @property
    def clamp_px(self) -> float:
        """Standard deviation of the low-pass filter, px; with a Mip filter so small that it covers no pixel centre."""
        return self.lowpass_px if self.mip_px == 0 else NO_LOWPASS

    def depth_width(self, camera: Camera) -> float:
        """Return kappa of rule 22: the half width as a fraction of the depth."""
        return self.depth_width_px / math.sqrt(camera.fx * camera.fy)


class Contributors(NamedTuple):
    """The first K splats that are blended into each of P points of an image, front to back.

    Attributes
    ----------
    ids : Tensor [P, K] int64
        Rows of the splats; -1 where fewer than K contribute, and 0 in the other tensors.
    weights : Tensor [P, K]
        w of rule 7 of the contract (``gs2d.render.api``).
    depth : Tensor [P, K] world units
        Of the intersection; of the centre where the low-pass filter draws the splat.
    normal : Tensor [P, K, 3]
        World frame, unit length, facing the camera.
    uv : Tensor [P, K, 2]
        Intersection in the splat's plane, in standard deviations along its axes (with a Mip filter, the widened ones);
        0 where the low-pass filter draws it.
    """

    ids: Tensor
    weights: Tensor
    depth: Tensor
    normal: Tensor
    uv: Tensor


@dataclass(frozen=True, eq=False)
class Features:
    """Plain channels besides the three of ``sh0``, blended with the same weights."""

    values: Tensor  # [N, F], any sign; dtype and device of the splats
    background: Tensor  # [F]; dtype and device of the splats, without gradient


@dataclass(frozen=True, eq=False)
class RenderOutput:
    """Images of one view, and radii of the splats.

    Attributes
    ----------
    color : Tensor [H, W, 3]
        sum w c + T_final background, not clamped above 1. With further channels [H, W, 3 + F].
    alpha : Tensor [H, W]
        sum w = 1 - T_final.
    normal : Tensor [H, W, 3]
        sum w n, world frame, each n facing the camera; not normalised.
    depth_mean : Tensor [H, W] world units
        sum w z / alpha; 0 where nothing was hit.
    depth_median : Tensor [H, W] world units
        Depth of the last pair whose incoming transmittance exceeds 0.5; 0 where nothing was hit.
    distortion : Tensor [H, W]
        Sum over pairs i > j of w_i w_j (m_i - m_j)^2, m the mapped depth.
    radii : Tensor [N] px
        Half the longer side of each splat's screen box; 0 for splats that touch no pixel.
    depth_transmittance : Tensor [H, W] world units, or None
        Depth at which half of alpha is accumulated, with each splat's opacity spread over a depth interval; 0 where
        nothing was hit. None without ``RasterSettings.with_transmittance_depth``.
    normal_without_pose_grad : Tensor [H, W, 3] or None
        ``normal`` without its pose gradient, for losses that compare normals; None if the pose has no gradient.
    """

    color: Tensor
    alpha: Tensor
    normal: Tensor
    depth_mean: Tensor
    depth_median: Tensor
    distortion: Tensor
    radii: Tensor
    depth_transmittance: Tensor | None = None
    normal_without_pose_grad: Tensor | None = None

    def depth(self, kind: str) -> Tensor:
        """Return the depth image by the name a recipe or protocol uses: "mean", "median" or "transmittance"."""
        if kind == "mean":
            return self.depth_mean
        if kind == "median":
            return self.depth_median
        if kind != TRANSMITTANCE:
            raise ValueError(f"depth must be 'mean', 'median' or 'transmittance', got {kind!r}")
        if self.depth_transmittance is None:
            raise ValueError("no transmittance depth was rendered; rasterize with settings.for_depths('transmittance')")
        return self.depth_transmittance
