"""A whole iteration of training in one piece: what a backend is told that does it without being asked part by part."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.render.types import RasterSettings

__all__ = ["Learned", "WholeStep"]


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


@dataclass(frozen=True, eq=False)
class WholeStep:
    """An iteration with the losses that every backend has fused; all tensors are on the device of the splats.

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
    weights : mapping of kind to float
        Of "l1", "ssim", "l2", "normal_consistency" and, of photographs with alpha, "silhouette": those that are active.
    depth : "mean" or "median"
        That normals come from, and ``at_camera``: see ``LossTerm.edges``.
    at_camera : bool
    of_object : bool
        Whether normals are asked for on the object alone: by the photograph's alpha, else the rendered one.
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
    weights: Mapping[str, float]
    depth: str
    at_camera: bool
    of_object: bool
    rows: Tensor | None
    learned: Mapping[str, Learned]
    betas: tuple[float, float, float]
    gathered: Mapping[str, Tensor]
