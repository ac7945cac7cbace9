"""The similarity between a run and the world: from places that both know, robustly; up by the cameras where it must be.

A similarity of all seven parameters needs three places that are not on a line. Its tilt is only as good as the places
are exact and spread: of a capture of ten metres, placed by a phone's receiver, it would be ten degrees off. People (and
gimbals) hold cameras level to a degree: where that is the better knowledge, up is taken from the cameras, and only the
heading, the scale and the shift are fitted.
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

LEVEL = 1.0  # degrees, to which the cameras' horizon is believed
SNAP = 1.5  # degrees, within which up is taken to be an axis of the run
AGREEMENT = 0.3  # length of the mean of the cameras' up vectors, from which they tell what is up
SAMPLES = 500  # random subsets that are tried
WIDE = 2.5  # medians of the residuals, beyond which a place is an outlier: 3.8 standard deviations in space
ROBUST_FROM = 6  # places; fewer cannot outvote a wrong one

Solver = Callable[[np.ndarray, np.ndarray], np.ndarray | None]


@dataclass(frozen=True, eq=False)
class Fit:
    """A similarity that most places agree on.

    Attributes
    ----------
    T : ndarray [4, 4]
        From the run to the places' frame, metres.
    inliers : ndarray [P] bool
    residuals : ndarray [P, 3]
        T source less target; the height's is 0 where nobody knows it.
    tilt : str
        "places": from the fit; "cameras", "given": up was taken from there.
    scale_error, tilt_error : float
        Standard errors: of the scale, relative; of the tilt of a fit of all parameters, degrees.
    """

    T: np.ndarray
    inliers: np.ndarray
    residuals: np.ndarray
    tilt: str
    scale_error: float
    tilt_error: float

    @property
    def scale(self) -> float:
        """Metres for a unit of the run."""
        return similarity_scale(self.T)

    @property
    def rotation(self) -> np.ndarray:
        """Return the rotation [3, 3]."""
        return np.asarray(self.T[:3, :3] / self.scale)


def cameras_up(cameras: Sequence[Camera]) -> np.ndarray | None:
    """Return what is up in a run [3], by how its cameras were held; an axis of the run where that is all but one.

    None where they do not agree on anything.
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
    """Fit a similarity to places, outliers left out.

    Parameters
    ----------
    source, target : ndarray [P, 3]
        Of the run, and metres (z up) less an origin; an unknown height is NaN.
    up : ndarray [3] or None
        What is up in the run, if that is known; used where the places tell it worse.
    tilt : "cameras" or "given"
        Who knows that; what was given is always used.
    robust : bool
        Whether places that do not agree with the others are left out.

    Raises
    ------
    DataError
        Too few places, or places that tell nothing.
    """
    _check_spread(target)
    whole = np.isfinite(target[:, 2])
    full: Fit | None = None
    reason = "places without heights"
    if tilt != "given" and whole.all():
        try:
            full = _fit(source, target, _solve_all, 3, "places", robust)
        except DataError as error:
            reason = str(error)
    if full is not None and (up is None or full.tilt_error < LEVEL):
        return full
    if up is None:
        raise DataError(f"what is up cannot be told ({reason}), and the cameras do not agree on it; give --up X Y Z")
    turn = rotation_to_z(up / np.linalg.norm(up))
    fit = _fit(source @ turn.T, target, _solve_level, 2, tilt, robust)
    T = fit.T.copy()
    T[:3, :3] = T[:3, :3] @ turn
    tilt_error = full.tilt_error if full is not None else math.inf
    return Fit(T, fit.inliers, fit.residuals, tilt, fit.scale_error, tilt_error)


def _check_spread(target: np.ndarray) -> None:
    """Raise for places of which too many are one: phones repeat a position until the receiver has another."""
    different = np.unique(np.round(target[:, :2], 3), axis=0)
    if len(different) < 2:
        raise DataError(
            f"places that differ were expected, all {len(target)} photographs have the same; the receiver had no fix"
        )


def _fit(source: np.ndarray, target: np.ndarray, solve: Solver, least: int, tilt: str, robust: bool) -> Fit:
    """Fit to most places: least median of squares over random subsets, then to all that agree until those stay.

    The threshold is not a number to be guessed: it follows from the median, whatever the receiver was.
    """
    count = len(source)
    if count < least:
        raise DataError(f"{least} places at the least were expected, got {count}")
    T = solve(source, target)
    if T is None:
        raise DataError("places that do not lie on a line were expected")
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
    """Fit scale, heading and shift [4, 4] of a source whose z is up already; heights count where they are known."""
    if len(source) < 2:
        return None
    known = np.isfinite(target[:, 2])
    mean_s, mean_t = source[:, :2].mean(axis=0), target[:, :2].mean(axis=0)
    s, t = source[:, :2] - mean_s, target[:, :2] - mean_t
    turn = complex(np.vdot(s[:, 0] + 1j * s[:, 1], t[:, 0] + 1j * t[:, 1]))
    squares, product = float(np.square(s).sum()), abs(turn)
    up_s = up_t = 0.0
    if known.any():
        up_s, up_t = float(source[known, 2].mean()), float(target[known, 2].mean())
        squares += float(np.square(source[known, 2] - up_s).sum())
        product += float(((source[known, 2] - up_s) * (target[known, 2] - up_t)).sum())
    if not (abs(turn) > 1e-12 * max(squares, 1e-300) and product > 0):
        return None
    scale, cos, sin = product / squares, turn.real / abs(turn), turn.imag / abs(turn)
    T = np.eye(4)
    T[:3, :3] = scale * np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    T[:3, 3] = [*(mean_t - T[:2, :2] @ mean_s), up_t - scale * up_s]
    return T


def _errors(T: np.ndarray, source: np.ndarray, residuals: np.ndarray, least: int) -> tuple[float, float]:
    """Return standard errors: of the scale, relative, and of the tilt, degrees."""
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
