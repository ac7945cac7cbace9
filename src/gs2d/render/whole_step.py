"""The description of a whole training iteration, for backends that run one in a single call."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.render.types import RasterSettings


class Learned(NamedTuple):
    """State and learning rate of an attribute.

    Attributes
    ----------
    mean, square : Tensor, same shape as the attribute
        Adam's moments, changed in place.
    rate : float
    step : int
        Step number for the bias correction, 1 in the first step.
    trained : Tensor [N] bool or None
        Rows that are False are not written.
    """

    mean: Tensor
    square: Tensor
    rate: float
    step: int
    trained: Tensor | None


class StepNormals(NamedTuple):
    """Normal consistency in the form of the official code.

    Attributes
    ----------
    weight : float
    depth : "mean" or "median"
        Depth from which normals are computed.
    at_camera : bool
        Whether empty pixels lie at the camera centre (``losses.formulas.normals_from_depth``).
    of_object : bool
        Weight pixels by the alpha of the image, or by the rendered alpha if the image has none.
    flat : float
        Factor of the weight where the image has no texture (``losses.formulas.flatness``).
    """

    weight: float
    depth: str
    at_camera: bool
    of_object: bool
    flat: float = 1.0


class StepLosses(NamedTuple):
    """The losses of an iteration.

    Attributes
    ----------
    l1, ssim, l2 : float
        Weights.
    silhouette : float or None
        Weight, for images with alpha; None: no silhouette loss.
    normals : StepNormals or None
    smooth_normals : float
        Weight of normal smoothness; a step has it only beside ``normals``.
    """

    l1: float = 0.0
    ssim: float = 0.0
    l2: float = 0.0
    silhouette: float | None = None
    normals: StepNormals | None = None
    smooth_normals: float = 0.0


@dataclass(frozen=True, eq=False)
class WholeStep:
    """A training iteration; all tensors are on the device of the splats.

    Attributes
    ----------
    splats : Splats
        Changed in place by Adam.
    camera : Camera
        Without learned pose or intrinsics.
    settings : RasterSettings
    photograph : Tensor [H, W, 3 or 4] uint8
        Decoded image; a transparent one is composited over ``background``.
    mask : Tensor [H, W] bool or None
        False = ignore this pixel.
    flatness : Tensor [H, W] uint8 or None
        Of the image, if ``losses.normals.flat`` is not 1.
    valid : int
        Number of valid pixels.
    background : 3 floats
    losses : StepLosses
        Active losses.
    rows : Tensor [N] bool or None
        Splats that are trained; None: all.
    learned : mapping of attribute to Learned
        Attributes that are trained.
    betas : (float, float, float)
        Adam's beta1, beta2 and epsilon.
    gathered : mapping of str to Tensor [N]
        Sums of the densification signal: "signed", "count" and optionally "absolute"; empty: not gathered.
    """

    splats: Splats
    camera: Camera
    settings: RasterSettings
    photograph: Tensor
    mask: Tensor | None
    valid: int
    background: tuple[float, float, float]
    losses: StepLosses
    rows: Tensor | None
    learned: Mapping[str, Learned]
    betas: tuple[float, float, float]
    gathered: Mapping[str, Tensor]
    flatness: Tensor | None = None
