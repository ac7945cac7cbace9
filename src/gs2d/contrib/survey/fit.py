"""Robust fit of the similarity between a run and the world from corresponding positions.

A similarity of seven parameters needs three positions that are not on a line. Its tilt depends on the accuracy and
spread of the positions: a phone's GPS over ten metres gives errors of ten degrees, while cameras are level to about a
degree. If the cameras are more accurate, they determine up, and only heading, scale and translation are fitted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.similarity import rotation_to_z, similarity_scale, umeyama
from gs2d.core.transforms import up_direction
from gs2d.errors import DataError

LEVEL = 1.0  # degrees, assumed accuracy of the horizon of the cameras
SNAP = 1.5  # degrees, within which up is rounded to an axis of the run
AGREEMENT = 0.3  # smallest length of the mean up vector of the cameras
SAMPLES = 500  # random subsets
WIDE = 2.5  # residual of an outlier, relative to the median: 3.8 standard deviations in 3D
ROBUST_FROM = 6  # smallest number of positions for outlier removal

Solver = Callable[[np.ndarray, np.ndarray], np.ndarray | None]


@dataclass(frozen=True, eq=False)
class Fit:
    """A similarity that most positions agree with."""

    T: np.ndarray  # [4, 4]: from the run to the frame of the positions, metres
    inliers: np.ndarray  # [P] bool
    residuals: np.ndarray  # [P, 3]: T source minus target; 0 for an unknown height
    tilt: str  # source of up: "places" (the fit), "cameras" or "given"
    scale_error: float  # relative standard error of the scale
    tilt_error: float  # standard error of the tilt in a fit of all parameters, degrees

    @property
    def scale(self) -> float:
        """Metres per unit of the run."""
        return similarity_scale(self.T)

    @property
    def rotation(self) -> np.ndarray:
        """Rotation [3, 3]."""
        return np.asarray(self.T[:3, :3] / self.scale)


def cameras_up(cameras: Sequence[Camera]) -> np.ndarray | None:
    """Return the up direction [3] of a run from the orientation of its cameras, rounded to an axis if it is close.

    None if the cameras do not agree.
    """
    if not cameras:
        return None
    mean = -np.mean([camera.rotation[1] for camera in cameras], axis=0)
    if np.linalg.norm(mean) < AGREEMENT:
        return None
    up = up_direction(cameras)
    axis = np.zeros(3)
    axis[np.abs(up).argmax()] = np.sign(up[np.abs(up).argmax()])
    return axis if up @ axis > math.cos(math.radians(SNAP)) else up


def fit_places(
    source: np.ndarray, target: np.ndarray, up: np.ndarray | None, *, tilt: str = "cameras", robust: bool = True
) -> Fit:
    """Fit a similarity to positions, without outliers if ``robust``.

    ``source`` and ``target`` [P, 3] are positions in the run, and in metres (z up) relative to an origin; an unknown
    height is NaN. ``up`` [3], the up direction of the run, is used if the positions are less accurate; with ``tilt``
    "given", rather than "cameras", it is always used. Raises DataError if there are too few positions, or they do not
    determine the fit.
    """
    _check_spread(target)
    whole = np.isfinite(target[:, 2])
    full: Fit | None = None
    reason = "positions without heights"
    if tilt != "given" and whole.all():
        try:
            full = _fit(source, target, _solve_all, 3, "places", robust)
        except DataError as error:
            reason = str(error)
    if full is not None and (up is None or full.tilt_error < LEVEL):
        return full
    if up is None:
        raise DataError(f"up is not determined ({reason}), and the cameras do not agree; use --set up=X,Y,Z")
    turn = rotation_to_z(up / np.linalg.norm(up))
    fit = _fit(source @ turn.T, target, _solve_level, 2, tilt, robust)
    T = fit.T.copy()
    T[:3, :3] = T[:3, :3] @ turn
    tilt_error = full.tilt_error if full is not None else math.inf
    return Fit(T, fit.inliers, fit.residuals, tilt, fit.scale_error, tilt_error)


def _check_spread(target: np.ndarray) -> None:
    """Raise DataError if all positions are equal, as without a GPS fix."""
    different = np.unique(np.round(target[:, :2], 3), axis=0)
    if len(different) < 2:
        raise DataError(f"all {len(target)} photographs have the same position; the receiver had no fix")


def _fit(source: np.ndarray, target: np.ndarray, solve: Solver, least: int, tilt: str, robust: bool) -> Fit:
    """Fit by least median of squares over random subsets, then to all inliers until they no longer change.

    The threshold of inliers follows from the median residual.
    """
    count = len(source)
    if count < least:
        raise DataError(f"at least {least} positions are needed, got {count}")
    T = solve(source, target)
    if T is None:
        raise DataError("all positions are on a line")
    inliers = np.ones(count, bool)
    if robust and count >= ROBUST_FROM:
        size, rng = min(max(least, 4), count), np.random.default_rng(0)
        best = float(np.median(_distances(T, source, target)))
        for _ in range(SAMPLES):
            rows = rng.choice(count, size, replace=False)
            tried = solve(source[rows], target[rows])
            if tried is not None and (median := float(np.median(_distances(tried, source, target)))) < best:
                best, T = median, tried
        T, inliers = _refined(T, source, target, solve)
    residuals = _residuals(T, source, target)
    return Fit(T, inliers, residuals, tilt, *_errors(T, source[inliers], residuals[inliers], least))


def _refined(T: np.ndarray, source: np.ndarray, target: np.ndarray, solve: Solver) -> tuple[np.ndarray, np.ndarray]:
    inliers = np.zeros(len(source), bool)
    for _ in range(20):
        distances = _distances(T, source, target)
        again = distances <= max(WIDE * float(np.median(distances)), 1e-9)
        fitted = solve(source[again], target[again])
        if (again == inliers).all() or fitted is None:
            break
        T, inliers = fitted, again
    return T, inliers


def _residuals(T: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.nan_to_num(source @ T[:3, :3].T + T[:3, 3] - target)


def _distances(T: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(_residuals(T, source, target), axis=1))


def _solve_all(source: np.ndarray, target: np.ndarray) -> np.ndarray | None:
    try:
        return umeyama(source, target)
    except DataError:
        return None


def _solve_level(source: np.ndarray, target: np.ndarray) -> np.ndarray | None:
    """Fit scale, heading and translation [4, 4] of a source with z up; unknown heights are ignored."""
    if len(source) < 2:
        return None
    has_height = np.isfinite(target[:, 2])
    mean_s, mean_t = source[:, :2].mean(axis=0), target[:, :2].mean(axis=0)
    s, t = source[:, :2] - mean_s, target[:, :2] - mean_t
    turn = complex(np.vdot(s[:, 0] + 1j * s[:, 1], t[:, 0] + 1j * t[:, 1]))
    squares, product = float(np.square(s).sum()), abs(turn)
    up_s = up_t = 0.0
    if has_height.any():
        up_s, up_t = float(source[has_height, 2].mean()), float(target[has_height, 2].mean())
        squares += float(np.square(source[has_height, 2] - up_s).sum())
        product += float(((source[has_height, 2] - up_s) * (target[has_height, 2] - up_t)).sum())
    if not (abs(turn) > 1e-12 * max(squares, 1e-300) and product > 0):
        return None
    scale, cos, sin = product / squares, turn.real / abs(turn), turn.imag / abs(turn)
    T = np.eye(4)
    T[:3, :3] = scale * np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    T[:3, 3] = [*(mean_t - T[:2, :2] @ mean_s), up_t - scale * up_s]
    return T


def _errors(T: np.ndarray, source: np.ndarray, residuals: np.ndarray, least: int) -> tuple[float, float]:
    """Return the relative standard error of the scale, and that of the tilt, degrees."""
    parameters = 7 if least == 3 else 5
    spare = 3 * len(source) - parameters
    if spare <= 0:
        return math.inf, math.inf
    sigma = math.sqrt(float(np.square(residuals).sum()) / spare)
    scale = similarity_scale(T)
    local = scale * (source - source.mean(axis=0))
    size = math.sqrt(float(np.square(local).sum()))
    level = local @ (T[:3, :3] / scale).T
    width = math.sqrt(max(float(np.linalg.eigvalsh(level[:, :2].T @ level[:, :2])[0]), 0.0))
    return sigma / max(size, 1e-12), math.degrees(math.atan2(sigma, width))
