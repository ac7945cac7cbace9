"""A whole iteration of training in one piece: what a backend is told that does it without being asked part by part."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.render.types import RasterSettings

__all__ = ["Learned", "StepLosses", "StepNormals", "WholeStep"]


class Learned(NamedTuple):
    """How an attribute learns.

    Attributes
    ----------
    mean, square : Tensor, like the attribute
        Adam's moments, changed in place.
    rate : float
    step : int
        Of the bias correction, counted from 1 and with this one.
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
        Depth that the normals come from.
    at_camera : bool
        Whether empty pixels lie at the camera's centre (``losses.formulas.normals_from_depth``).
    of_object : bool
        Whether only the object counts: by the image's alpha, else the rendered one.
    """

    weight: float
    depth: str
    at_camera: bool
    of_object: bool


class StepLosses(NamedTuple):
    """The losses of an iteration.

    Attributes
    ----------
    l1, ssim, l2 : float
        Weights.
    silhouette : float or None
        Weight, for images with alpha; None: no such loss.
    normals : StepNormals or None
    """

    l1: float = 0.0
    ssim: float = 0.0
    l2: float = 0.0
    silhouette: float | None = None
    normals: StepNormals | None = None


@dataclass(frozen=True, eq=False)
class WholeStep:
    """An iteration of training; all tensors are on the device of the splats.

    Attributes
    ----------
    splats : Splats
        Changed in place, by Adam.
    camera : Camera
        That learns nothing.
    settings : RasterSettings
    photograph : Tensor [H, W, 3 or 4] uint8
        As it was decoded; alpha over ``background``.
    mask : Tensor [H, W] bool or None
        False = ignore this pixel.
    valid : int
        Pixels that count.
    background : 3 floats
    losses : StepLosses
        Those that are active.
    rows : Tensor [N] bool or None
        The splats of which anything learns; None: all of them.
    learned : mapping of attribute to Learned
    betas : (float, float, float)
        Adam's beta1, beta2 and epsilon.
    gathered : mapping of str to Tensor [N]
        Where the densification signal is added: "signed" and "count", and maybe "absolute"; empty: nowhere.
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
