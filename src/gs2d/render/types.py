"""What goes into and comes out of a rasterizer, whatever the backend."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import Any

from torch import Tensor

from gs2d.core.camera import Camera

TRANSMITTANCE = "transmittance"  # the kind of depth that is rendered only where it is asked for
PLAIN_COLORS = -1  # of RasterSettings.sh_degree
NEAR_PLANE_POLICIES = (
    "draw",
    "cull",
    "box",
)  # the values of RasterSettings.near_plane_policy; the kernels know them by their place
# Rule 23: splats beyond these are culled, as float32 could not hold what is worked out (core/project.h has the same).
MAX_SIZE = 1e9  # world units: coordinates in the camera frame, scales
MIN_SIZE = 1e-18  # world units: smaller scales count as this
MAX_COLOR = 1e15  # sum of the absolute coefficients of a colour
MIN_QUATERNION = 1e-15  # largest component; less is a zero quaternion


@dataclass(frozen=True)
class RasterSettings:
    """Every constant the rasterizer uses. The numbers in brackets are rules of the contract (render/api.py).

    Attributes
    ----------
    near : float
        World units. Splats whose centre is at or before it are culled; pairs with a smaller depth are skipped.
    far : float
        World units. Only maps depth for the distortion.
    alpha_min, alpha_max : float
        Pairs below alpha_min are skipped, above alpha_max clamped.
    transmittance_min : float
        A pixel stops before the splat that would bring its transmittance below this.
    error_cutoff : float
        Footprint of ``splat_errors``: rho <= error_cutoff^2.
    lowpass_px : float
        px. Standard deviation of the screen-space low-pass filter.
    background : tuple of 3 floats
        Colour behind everything, in [0, 1]; with ``PLAIN_COLORS`` any finite numbers.
    sh_degree : int
        SH degree that is evaluated (coefficients above it are ignored and get zero gradient). ``PLAIN_COLORS`` (-1):
        ``sh0`` holds the colours, or any three features, as they are (rule 11).
    lowpass_depth : str
        Depth of a pair where the low-pass filter wins: "center" (the splat centre's), or "plane" (the ray-plane depth
        of the current official code; reference backend only).
    near_plane_policy : str
        Splats whose disc of ``error_cutoff`` standard deviations reaches the camera plane: "draw" like any other, or
        "cull", or "box": only in the tiles of the official rasterizer's box, which has no meaning for them (rule 19).
    with_distortion : bool
        False = nobody looks at that image: a backend may leave it out (NaN) where that saves work.
    with_transmittance_depth : bool
        True = ``depth_transmittance`` is wanted too: one search along the ray of each pixel (rule 22).
    depth_width_px : float
        px. Half of the depth over which a splat's opacity is spread for it, as seen from the camera: so many times the
        width of a pixel there.
    """

    near: float = 0.2
    far: float = 100.0
    alpha_min: float = 1.0 / 255.0
    alpha_max: float = 0.99
    transmittance_min: float = 1e-4
    error_cutoff: float = 3.0
    lowpass_px: float = math.sqrt(2.0) / 2.0
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sh_degree: int = 3
    lowpass_depth: str = "center"
    near_plane_policy: str = "draw"
    with_distortion: bool = True
    with_transmittance_depth: bool = field(default=False, metadata={"derived": True})
    depth_width_px: float = 2.0

    def for_depths(self, *kinds: str | None) -> RasterSettings:
        """Return the settings that render these kinds of depth; None: no particular one."""
        return replace(self, with_transmittance_depth=self.with_transmittance_depth or TRANSMITTANCE in kinds)

    def facts(self) -> dict[str, Any]:
        """Return the constants by name, as they are written down.

        Without which depths are rendered, which protocol and losses say.
        """
        return {f.name: getattr(self, f.name) for f in fields(self) if not f.metadata.get("derived")}

    def depth_width(self, camera: Camera) -> float:
        """Return kappa of rule 22: the half width as a fraction of the depth."""
        return self.depth_width_px / math.sqrt(camera.fx * camera.fy)


@dataclass(frozen=True, eq=False)
class Features:
    """Plain channels besides the three of ``sh0``, blended with the same weights.

    Attributes
    ----------
    values : Tensor [N, F]
        Of any sign; dtype and device of the splats.
    background : Tensor [F]
        Behind everything; dtype and device of the splats, without gradient.
    """

    values: Tensor
    background: Tensor


@dataclass(frozen=True, eq=False)
class RenderOutput:
    """Images and per-splat facts of one view.

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
        Depth before which half of alpha lies, each splat's opacity spread over a little depth; 0 where nothing was hit.
        None without ``RasterSettings.with_transmittance_depth``.
    normal_without_pose_grad : Tensor [H, W, 3] or None
        Where a camera learns: ``normal`` as if the world turned with the camera. For losses that compare normals.
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
