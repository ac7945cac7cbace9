"""Choose a lens model: plausibility of the parameters, and reprojection errors of held-out observations.

Runs in the worker, on pycolmap objects. Focal lengths stay equal along both axes: if all cameras are level, a vertical
stretch of the images and one of the scene are indistinguishable, also in held-out errors.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gs2d.sfm.panoramas import PANORAMA

MODELS = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")  # by increasing number of parameters
BENT = {  # fisheye model with the same number of parameters
    "SIMPLE_PINHOLE": "SIMPLE_FISHEYE",
    "SIMPLE_RADIAL": "SIMPLE_RADIAL_FISHEYE",
    "RADIAL": "RADIAL_FISHEYE",
    "OPENCV": "OPENCV_FISHEYE",
}
_FREE = dict(zip(MODELS, (1, 2, 3, 5), strict=True))
PARAMETERS = _FREE | {BENT[model]: number for model, number in _FREE.items()}  # number of free parameters
START = "SIMPLE_RADIAL"  # model with which images are placed before lenses are compared
CIRCLE, NAME, ASKED = "circle", "name", "asked"  # hints at a fisheye before images are placed
DOUBT = "doubt"  # hint from a model that was placed with another lens
_WHY = {
    CIRCLE: "round images",
    NAME: "name of the camera or lens",
    ASKED: "--camera-model",
    DOUBT: "other lenses did not fit",
}
ENOUGH = 8  # images of one camera, for models with more parameters than ``START``
WORTH = 0.01  # relative decrease of the held-out error that each further parameter must achieve
HELD_OUT = 0.2  # fraction of the long tracks that lose one observation
LONG = 4  # observations of a track from which one can be held out
FARTHEST = 4.0  # px; COLMAP's limit: a larger error is a wrong match
NARROWEST = 1.5  # degrees between the rays to a point; COLMAP's limit
MAX_IMAGES = 100  # for the comparison; more images take longer and do not change the result
_AHEAD = 1.55  # rad; nearly 90 degrees from the axis
ITERATIONS = 30  # of the bundle adjustment: it starts close to the solution


@dataclass(frozen=True)
class Believable:
    """Limits of plausible lens parameters.

    Attributes
    ----------
    aspect : float
        |fx / fy - 1|. Pixels are square; scanning and resizing change this by less than 2 %.
    focal : (float, float)
        Focal length as a fraction of the longer side: a field of view of 118 to 6 degrees.
    focal_bent : (float, float)
        The same for fisheyes; the lower limit is 250 degrees in the height of a 16:9 image.
    centre : float
        Distance of the principal point from the image centre, as a fraction of the size.
    bend : float
        Relative displacement of the farthest corner; action cameras reach 0.4.
    tangential : float
        |p1| and |p2|; phones have up to 0.003.
    """

    aspect: float = 0.02
    focal: tuple[float, float] = (0.3, 10.0)
    focal_bent: tuple[float, float] = (0.125, 10.0)
    centre: float = 0.1
    bend: float = 0.5
    tangential: float = 0.01


def doubts(camera: Any, limits: Believable = Believable()) -> list[str]:
    """Return why a lens is implausible, one phrase per reason; empty for a plausible lens.

    Parameters
    ----------
    camera : pycolmap.Camera
    """
    if camera.model.name == PANORAMA:
        return []
    width, height = camera.width, camera.height
    fx, fy = camera.focal_length_x, camera.focal_length_y
    if not np.isfinite(camera.params).all() or min(fx, fy) <= 0:
        return ["invalid parameters"]
    reasons = []
    if abs(fx / fy - 1) > limits.aspect:
        reasons.append(f"fx / fy is {fx / fy:.3f}, but pixels are square")
    focal = camera.mean_focal_length() / max(width, height)
    least, most = limits.focal_bent if is_bent(camera) else limits.focal
    if not least <= focal <= most:
        reasons.append(f"the focal length is {focal:.2f} of the longer side")
    off = max(abs(camera.principal_point_x / width - 0.5), abs(camera.principal_point_y / height - 0.5))
    if off > limits.centre:
        reasons.append(f"the principal point is {100 * off:.0f} % of the size off the image centre")
    return reasons + _implausible_distortion(camera, limits)


def _implausible_distortion(camera: Any, limits: Believable) -> list[str]:
    """Return what is implausible in the distortion: tangential, not monotonic within the image, or too strong."""
    reasons = []
    name = camera.model.name
    if name == "OPENCV" and max(map(abs, camera.params[6:8])) > limits.tangential:
        p = max(camera.params[6:8], key=abs)
        reasons.append(f"the tangential distortion is {p:.4f}")
    ideal, distorted = _radii_to_corner(camera)
    if not (np.diff(distorted) > 0).all():
        reasons.append("the distortion is not monotonic within the image")
    elif name != "FOV" and abs(bend := float(distorted[-1] / ideal[-1]) - 1) > limits.bend:
        reasons.append(f"the distortion moves the corner by {100 * bend:.0f} %")
    return reasons


def corner_bend(camera: Any) -> float:
    """Return the relative outward displacement of the farthest corner; NaN if it does not project."""
    ideal, distorted = _radii_to_corner(camera)
    return float(distorted[-1] / ideal[-1]) - 1


def _radii_to_corner(camera: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return radii [50] from the axis to the farthest corner in px / f, without and with distortion.

    For a fisheye the first are angles. They end below 90 degrees, beyond which COLMAP does not project.
    """
    center = np.array([camera.principal_point_x, camera.principal_point_y])
    corners = np.array([[x, y] for x in (0, camera.width) for y in (0, camera.height)], dtype=float) - center
    corner = corners[np.argmax((corners**2).sum(axis=1))] / (camera.focal_length_x, camera.focal_length_y)
    reach = float(np.linalg.norm(corner))
    if is_bent(camera):
        reach = min(reach, _AHEAD)
    ideal = np.linspace(0.02, 1, 50) * reach
    to_side, ahead = (np.sin(ideal), np.cos(ideal)) if is_bent(camera) else (ideal, np.ones(50))
    rays = np.hstack([to_side[:, None] * corner / np.linalg.norm(corner), ahead[:, None]])
    pixels = np.asarray([np.full(2, np.nan) if p is None else p for p in map(camera.img_from_cam, rays)])
    return ideal, np.linalg.norm((pixels - center) / (camera.focal_length_x, camera.focal_length_y), axis=1)


def is_bent(camera: Any) -> bool:
    """Whether a camera is a fisheye."""
    return "FISHEYE" in camera.model.name


@dataclass(frozen=True)
class Trial:
    """Result of one lens model.

    Attributes
    ----------
    model : str
    error : float, px
        Mean reprojection error of the held-out observations, each clipped to ``FARTHEST``.
    doubts : tuple of str
        Reasons why a camera is implausible.
    cameras : dict of int to list of float
        Parameters by camera id.
    models : dict of int to str
        COLMAP model of each camera. Cameras with few images keep ``START``.
    """

    model: str
    error: float
    doubts: tuple[str, ...]
    cameras: Mapping[int, list[float]]
    models: Mapping[int, str]


def choose(trials: Sequence[Trial]) -> Trial:
    """Return the plausible model with the lowest held-out error, with a penalty of ``WORTH`` per parameter.

    If no model is plausible, all of them are compared.
    """
    plausible = [trial for trial in trials if not trial.doubts] or list(trials)
    return min(plausible, key=lambda trial: trial.error * (1 + WORTH * PARAMETERS[trial.model]))


def lens_line(lens: Mapping[str, Any]) -> str:
    """Summarize the choice of the lens, with the reasons; empty if there was none.

    Parameters
    ----------
    lens : mapping
        ``lens`` of poses.json: ``chosen``, ``asked`` or None, ``trials`` with ``model``, ``error_px``, ``doubts``, and
        ``fisheyes``, the result for each camera that was tested for a fisheye (``as_fisheye``).
    """
    bent = "; ".join(map(_fisheye_line, lens.get("fisheyes", [])))
    trials = lens.get("trials", [])
    if not trials:
        return f"lens: {bent}" if bent else ""
    error = {trial["model"]: trial["error_px"] for trial in trials}
    others = ", ".join(f"{model} {error[model]:.3f}" for model in error if model != lens["chosen"])
    result = f"{lens['chosen']}, {error[lens['chosen']]:.3f} px on held-out observations; {others}"
    doubted = [f"{trial['model']}: {', '.join(trial['doubts'])}" for trial in trials if trial["doubts"]]
    doubted_line = f"; implausible: {'; '.join(doubted)}" if doubted else ""
    bent = f"; {bent}" if bent else ""
    return f"lens: {result}{doubted_line}; each parameter must reduce the error by {100 * WORTH:.0f} %{bent}"


def _fisheye_line(row: Mapping[str, Any]) -> str:
    """Summarize the result for one camera that was tested for a fisheye."""
    taken = "taken as fisheye" if row["params"] else "not taken as fisheye in spite of the hint"
    line = f"{row['photographs']} photographs {taken} ({_WHY[row['why']]})"
    if row["bent"] is None:
        return f"{line}, too few matches for a test"
    shares = f"{100 * row['bent']:.1f} % of matches agree with a fisheye of f = {row['probed']:.0f} px"
    return f"{line}: {shares}, {100 * row['plain']:.1f} % with a pinhole"


def try_lenses(pycolmap: Any, piece: Any, *, seed: int, threads: int, on_done: Callable[[int], None]) -> list[Trial]:
    """Adjust copies of a model with each of ``MODELS`` without some observations, and measure the error of these.

    All have one focal length. OPENCV keeps that of RADIAL, because COLMAP cannot keep two focal lengths equal. Cameras
    that were placed as fisheyes get the fisheye model with the same number of parameters.

    Parameters
    ----------
    piece : pycolmap.Reconstruction
        Placed with ``START`` or its fisheye.
    on_done : function of an int
        Called with the number of finished models.
    """
    base = _subset(pycolmap, piece)
    held = _hold_out(base, seed)
    before = _lenses(base)
    images = Counter(image.camera_id for image in piece.images.values() if image.has_pose)
    bent = {number for number, camera in piece.cameras.items() if is_bent(camera)}
    trials = []
    for done, model in enumerate(MODELS, start=1):
        copy = pycolmap.Reconstruction(base)
        for number in before:
            rich = images[number] >= ENOUGH or PARAMETERS[model] <= PARAMETERS[START]
            kind = model if rich else START
            _set_model(pycolmap, copy.camera(number), BENT[kind] if number in bent else kind, before[number])
        _adjust(pycolmap, copy, tied=model == "OPENCV", threads=threads)
        reasons = sorted({doubt for camera in copy.cameras.values() for doubt in doubts(camera)})
        numbers = {number: [float(p) for p in camera.params] for number, camera in copy.cameras.items()}
        kinds = {number: camera.model.name for number, camera in copy.cameras.items()}
        name = BENT[model] if before.keys() == bent else model
        trials.append(Trial(name, _error(copy, held), tuple(reasons), numbers, kinds))
        if model == "RADIAL":
            before = _lenses(copy)
        on_done(done)
    return trials


def apply(pycolmap: Any, piece: Any, trial: Trial, *, threads: int) -> None:
    """Set the cameras of a model to those of a trial, adjust it, and remove outliers as COLMAP's mapping does."""
    for number, params in trial.cameras.items():
        camera = piece.camera(number)
        _replace(pycolmap, camera, trial.models[number], params)
    _adjust(pycolmap, piece, tied=has_two_focal_lengths(trial.model), threads=threads)
    pycolmap.ObservationManager(piece).filter_all_points3D(FARTHEST, NARROWEST)
    piece.update_point_3d_errors()


def has_two_focal_lengths(model: str) -> bool:
    """Whether a camera model has fx and fy, which COLMAP cannot keep equal."""
    return model in ("OPENCV", BENT["OPENCV"])


def _subset(pycolmap: Any, piece: Any) -> Any:
    """Return a copy of a model with at most ``MAX_IMAGES``, consecutive by name."""
    copy = pycolmap.Reconstruction(piece)
    placed = sorted((image for image in copy.images.values() if image.has_pose), key=lambda image: image.name)
    first = max((len(placed) - MAX_IMAGES) // 2, 0)
    for image in placed[:first] + placed[first + MAX_IMAGES :]:
        copy.deregister_frame(image.frame_id)
    return copy


def _hold_out(piece: Any, seed: int) -> list[tuple[int, int, np.ndarray]]:
    """Remove observations from a model; returns point id, image id and pixel of each."""
    rng = np.random.Generator(np.random.Philox(key=seed))
    points = [number for number in sorted(piece.point3D_ids()) if piece.point3D(number).track.length() >= LONG]
    chosen = rng.permutation(len(points))[: max(1, int(HELD_OUT * len(points)))]
    held = []
    for number in (points[i] for i in np.sort(chosen)):
        elements = piece.point3D(number).track.elements
        one = elements[int(rng.integers(len(elements)))]
        image, index = one.image_id, one.point2D_idx
        held.append((number, image, np.array(piece.image(image).points2D[index].xy)))
        piece.delete_observation(image, index)
    return held


def _error(piece: Any, held: Sequence[tuple[int, int, np.ndarray]]) -> float:
    errors = []
    for number, image, seen in held:
        at = piece.image(image).project_point(piece.point3D(number).xyz)
        errors.append(FARTHEST if at is None else min(FARTHEST, float(np.linalg.norm(at - seen))))
    return float(np.mean(errors)) if errors else FARTHEST


def _plain(camera: Any) -> tuple[float, float, float, list[float]]:
    """Return focal length, principal point, and distortion."""
    extra = [float(camera.params[i]) for i in camera.extra_params_idxs()]
    return camera.mean_focal_length(), camera.principal_point_x, camera.principal_point_y, extra


def _lenses(piece: Any) -> dict[int, tuple[float, float, float, list[float]]]:
    """Return the parameters of each camera except panoramas."""
    return {number: _plain(camera) for number, camera in piece.cameras.items() if camera.model.name != PANORAMA}


def _set_model(pycolmap: Any, camera: Any, model: str, plain: tuple[float, float, float, list[float]]) -> None:
    """Convert a camera to another model, with nearly the same projection."""
    f, cx, cy, extra = plain
    focal = (f, f) if has_two_focal_lengths(model) else (f,)
    distortion = [*extra, 0.0, 0.0, 0.0, 0.0][: PARAMETERS[model] - 1]
    _replace(pycolmap, camera, model, [*focal, cx, cy, *distortion])


def _replace(pycolmap: Any, camera: Any, model: str, params: Sequence[float]) -> None:
    camera.model = getattr(pycolmap.CameraModelId, model)
    camera.params = list(params)


def _adjust(pycolmap: Any, piece: Any, *, tied: bool, threads: int) -> None:
    """Run bundle adjustment. ``tied`` keeps the focal lengths, because COLMAP cannot keep two of them equal."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = not tied
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = ITERATIONS
    options.ceres.solver_options.function_tolerance = 1e-6
    pycolmap.bundle_adjustment(piece, options)
