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
    """State and learning rate of an attribute."""

    mean: Tensor  # with ``square`` Adam's moments, shaped as the attribute and changed in place
    square: Tensor
    rate: float
    step: int  # number for the bias correction, 1 in the first step
    trained: Tensor | None  # [N] bool; rows that are False are not written


class StepNormals(NamedTuple):
    """Normal consistency in the form of the official code."""

    weight: float
    depth: str  # "mean" or "median": the depth from which normals are computed
    at_camera: bool  # whether empty pixels lie at the camera centre (``losses.formulas.normals_from_depth``)
    of_object: bool  # weight pixels by the alpha of the image, or by the rendered alpha if the image has none
    flat: float = 1.0  # factor of the weight where the image has no texture (``losses.formulas.flatness``)


class StepLosses(NamedTuple):
    """The weights of the losses of an iteration."""

    l1: float = 0.0
    ssim: float = 0.0
    l2: float = 0.0
    silhouette: float | None = None  # for images with alpha; None: no silhouette loss
    normals: StepNormals | None = None
    smooth_normals: float = 0.0  # a step has it only beside ``normals``


@dataclass(frozen=True, eq=False)
class WholeStep:
    """A training iteration; all tensors are on the device of the splats."""

    splats: Splats  # changed in place by Adam
    camera: Camera  # without learned pose or intrinsics
    settings: RasterSettings
    photograph: Tensor  # [H, W, 3 or 4] uint8; a transparent one is composited over ``background``
    mask: Tensor | None  # [H, W] bool, False = ignore this pixel
    valid: int  # number of valid pixels
    background: tuple[float, float, float]
    losses: StepLosses
    rows: Tensor | None  # [N] bool, splats that are trained; None: all
    learned: Mapping[str, Learned]  # attributes that are trained
    betas: tuple[float, float, float]  # Adam's beta1, beta2 and epsilon
    # [N] sums of the densification signal: "signed", "count", optionally "absolute"; empty: not gathered.
    gathered: Mapping[str, Tensor]
    flatness: Tensor | None = None  # [H, W] uint8 of the image, if ``losses.normals.flat`` is not 1
