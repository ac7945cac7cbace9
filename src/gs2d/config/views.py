"""What a recipe may learn of photographs and their cameras. Pure Python; never imports torch."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gs2d.config.validate import integer, number, one_of, require


@dataclass(frozen=True)
class Exposure:
    """One affine colour transform for each training photograph, learned with the splats (``training/exposure.py``).

    Attributes
    ----------
    rate, rate_final, decay_steps : float, float, int
        Adam's rate decays log-linearly from ``rate`` to ``rate_final`` over ``decay_steps`` iterations of the run, all
        stages counted; a transform is updated when its photograph has its turn.
    start : int
        Learned when iteration of the run > start: colours need some to leave the grey that random points begin with.
    prior : float
        Weight of the summed squares of what a transform differs from the identity by.
    beta1, beta2, eps : float
        Adam's.
    initial : "identity", "points" or "given"
        What transforms begin as: all the same, or the gains by which the colours of sparse points differ between
        photographs (``training/point_gains.py``), so that no splat ever explains an exposure. "given": the trainer
        is handed transforms that another training found, and they stay as they are.
    """

    rate: float = 0.05
    rate_final: float = 0.001
    decay_steps: int = 30_000
    start: int = 500
    prior: float = 0.001
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15
    initial: str = "identity"

    def rate_at(self, iteration: int) -> float:
        """Rate at an iteration of the run (1-based): log-linear, then constant."""
        return _decayed(self.rate, self.rate_final, iteration / self.decay_steps)


class _OfCameras:
    """What is learned of cameras: its rate. The fields are those of the dataclasses below."""

    rate: float
    rate_final: float
    decay_steps: int
    start: int

    def rate_at(self, iteration: int) -> float:
        """Rate at an iteration of the run (1-based): log-linear, then constant; 0 before the start."""
        return _decayed(self.rate, self.rate_final, iteration / self.decay_steps) if iteration > self.start else 0.0


@dataclass(frozen=True)
class PoseRefinement(_OfCameras):
    """One rigid motion for each training camera, learned with the splats (``training/poses.py``).

    It learns in stages that train the means of all splats: elsewhere nothing could follow.

    Attributes
    ----------
    rate, rate_final, decay_steps : float, float, int
        Adam's rate, in rad and in shares of the scene's extent, decays log-linearly from ``rate`` to ``rate_final``
        over ``decay_steps`` iterations of the run, all stages counted; a camera moves when its photograph has its turn.
        A schedule of a tenth has a tenth of the turns, and 3.2 times the rates (``schedule``).
    start : int
        Learned when iteration of the run > start: before, the splats are no scene that could tell where cameras are.
    beta1, beta2, eps : float
        Adam's. A camera has a turn once an epoch, some hundred in all: a long memory would be that of the start.
    """

    rate: float = 5e-4
    rate_final: float = 5e-6
    decay_steps: int = 30_000
    start: int = 500
    beta1: float = 0.9
    beta2: float = 0.99
    eps: float = 1e-15


@dataclass(frozen=True)
class IntrinsicsRefinement(_OfCameras):
    """Focal length and lens of each camera, learned with the splats and the poses (``training/zooms.py``).

    It learns in the stages in which poses do. Photographs whose files have the same intrinsics share a camera.

    Attributes
    ----------
    rate, rate_final, decay_steps : float, float, int
        Adam's rate, of the logarithm of the focal length, decays log-linearly over ``decay_steps`` iterations of the
        run. A camera that all photographs share moves in every iteration. Grows with shorter schedules, as poses' do.
    start : int
        Learned when iteration of the run > start, as poses.
    principal_point : bool
        Whether the principal point moves, too. A turn of the camera looks nearly the same.
    distortion : bool
        Whether what is left of the lens is learned, too: two radial coefficients, at the same rate, as a share of the
        distance from the picture's middle to its corner. ``--refine-cameras`` learns it.
    beta1, beta2, eps : float
        Adam's.
    """

    rate: float = 1e-4
    rate_final: float = 1e-6
    decay_steps: int = 30_000
    start: int = 500
    principal_point: bool = False
    distortion: bool = False
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15


@dataclass(frozen=True)
class Photometry(_OfCameras):
    """Vignetting and response of each camera, learned with the splats (``training/photometry.py``).

    Photographs whose files have the same intrinsics share a camera. Stands beside ``exposure``, or by itself.

    Attributes
    ----------
    vignetting : bool
        Whether light may fall off towards the corners.
    response : bool
        Whether the curves are learned by which the light of several cameras becomes values: what they differ by.
    rate, rate_final, decay_steps : float, float, int
        Adam's rate decays log-linearly over ``decay_steps`` iterations of the run, all stages counted. A camera that
        all photographs share learns in every iteration. Grows with shorter schedules, as poses' do.
    start : int
        Learned when iteration of the run > start, as exposures.
    prior : float
        Weight of the summed squares of the numbers of a photograph's camera.
    beta1, beta2, eps : float
        Adam's.
    """

    vignetting: bool = True
    response: bool = True
    rate: float = 1e-3
    rate_final: float = 1e-5
    decay_steps: int = 30_000
    start: int = 500
    prior: float = 0.001
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15


def _decayed(first: float, last: float, fraction: float) -> float:
    """Log-linear between the ends of [0, 1]."""
    t = min(max(fraction, 0.0), 1.0)
    return math.exp((1.0 - t) * math.log(first) + t * math.log(last))


def check_exposure(where: str, exposure: Exposure) -> None:
    """Raise RecipeError for numbers that make no exposures."""
    for name in ("rate", "rate_final", "eps"):
        value = number(f"{where}.{name}", getattr(exposure, name), low=0.0)
        require(value > 0, f"{where}.{name} must be positive, got {value} (exposure=null leaves exposures alone)")
    for name in ("prior", "beta1", "beta2"):
        number(f"{where}.{name}", getattr(exposure, name), low=0.0)
    require(max(exposure.beta1, exposure.beta2) < 1, f"{where}.beta1 and {where}.beta2 must be below 1")
    integer(f"{where}.decay_steps", exposure.decay_steps, low=1)
    integer(f"{where}.start", exposure.start, low=0)
    one_of(f"{where}.initial", exposure.initial, ("identity", "points", "given"))


def check_intrinsics(where: str, intrinsics: IntrinsicsRefinement) -> None:
    """Raise RecipeError for numbers that make no focal lengths."""
    for name in ("principal_point", "distortion"):
        value = getattr(intrinsics, name)
        require(isinstance(value, bool), f"{where}.{name} must be true or false, got {value!r}")
    _check_rates(where, intrinsics, "intrinsics=null leaves focal lengths alone", "shares of the focal length")


def check_poses(where: str, poses: PoseRefinement) -> None:
    """Raise RecipeError for numbers that make no poses."""
    _check_rates(where, poses, "poses=null leaves cameras alone", "rad, extents")


def check_photometry(where: str, photometry: Photometry) -> None:
    """Raise RecipeError for numbers that make no vignetting and no response."""
    for name in ("vignetting", "response"):
        value = getattr(photometry, name)
        require(isinstance(value, bool), f"{where}.{name} must be true or false, got {value!r}")
    either = photometry.vignetting or photometry.response
    require(either, f"{where} must learn vignetting, response or both, got neither; photometry=null leaves both alone")
    number(f"{where}.prior", photometry.prior, low=0.0)
    _check_rates(where, photometry, "photometry=null leaves cameras alone", "of the numbers of a camera")


def _check_rates(
    where: str, poses: PoseRefinement | IntrinsicsRefinement | Photometry, without: str, units: str
) -> None:
    for name in ("rate", "rate_final", "eps"):
        value = number(f"{where}.{name}", getattr(poses, name), low=0.0)
        require(value > 0, f"{where}.{name} must be positive, got {value} ({without})")
    for name in ("rate", "rate_final"):
        value = getattr(poses, name)
        require(value <= 1, f"{where}.{name} must be at most 1 ({units}), got {value}")
    for name in ("beta1", "beta2"):
        number(f"{where}.{name}", getattr(poses, name), low=0.0)
    require(max(poses.beta1, poses.beta2) < 1, f"{where}.beta1 and {where}.beta2 must be below 1")
    integer(f"{where}.decay_steps", poses.decay_steps, low=1)
    integer(f"{where}.start", poses.start, low=0)
