"""Which lens the photographs support: what a lens can be like, and what observations that were held out say.

It runs in the worker, on COLMAP's own objects, and needs numpy only. Focal lengths stay equal along both axes: where
all cameras are level, as around a bust on its plinth, a picture stretched upwards and a scene stretched upwards look
the same, and no error, held out or not, tells them apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gs2d.sfm.panoramas import PANORAMA

MODELS = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")  # of ordinary lenses, the fewest parameters first
BENT = {  # the fisheye of as many
    "SIMPLE_PINHOLE": "SIMPLE_FISHEYE",
    "SIMPLE_RADIAL": "SIMPLE_RADIAL_FISHEYE",
    "RADIAL": "RADIAL_FISHEYE",
    "OPENCV": "OPENCV_FISHEYE",
}
_LEARNT = dict(zip(MODELS, (1, 2, 3, 5), strict=True))
PARAMETERS = _LEARNT | {BENT[model]: number for model, number in _LEARNT.items()}  # that are learnt
START = "SIMPLE_RADIAL"  # what cameras are placed with before lenses are compared
CIRCLE, NAME, ASKED = "circle", "name", "asked"  # what tells of a fisheye before a photograph has a place
DOUBT = "doubt"  # and of a camera that was placed as another lens
_WHY = {
    CIRCLE: "they are round",
    NAME: "their camera or lens is called so",
    ASKED: "--camera-model says so",
    DOUBT: "other lenses left a doubt",
}
ENOUGH = 8  # photographs of one camera that tell more than its focal length and one distortion
WORTH = 0.01  # of the held-out error, that each further parameter must save to be there
HELD_OUT = 0.2  # of the points that are long enough lose one observation each
LONG = 4  # observations of a point, of which one can be held out
FARTHEST = 4.0  # px; COLMAP's own limit: an error beyond it is a wrong match
NARROWEST = 1.5  # degrees between the rays to a point; COLMAP's own limit
MAX_PHOTOGRAPHS = 100  # that are compared on: more cost time and change nothing
_AHEAD = 1.55  # rad; nearly 90 degrees from the axis
ITERATIONS = 30  # of a bundle adjustment that compares: it starts from cameras that fit


@dataclass(frozen=True)
class Believable:
    """What a lens and its sensor can be like.

    Attributes
    ----------
    aspect : float
        |fx / fy - 1|: pixels of photographs are square; 2 % is more than scanning and resizing make.
    focal : (float, float)
        Of the longer side: from 118 degrees, which no lens without fisheye has, to 6 degrees.
    focal_bent : (float, float)
        Likewise, of a fisheye: from a circle of 250 degrees in the height of a 16:9 picture.
    centre : float
        Of the size: how far the principal point may be from the middle.
    bend : float
        How far the farthest corner may be moved, of its distance: action cameras reach 0.4.
    tangential : float
        |p1|, |p2|: how far lens elements are off their axis; phones have up to 0.003.
    """

    aspect: float = 0.02
    focal: tuple[float, float] = (0.3, 10.0)
    focal_bent: tuple[float, float] = (0.125, 10.0)
    centre: float = 0.1
    bend: float = 0.5
    tangential: float = 0.01


def doubts(camera: Any, limits: Believable = Believable()) -> list[str]:
    """Return why a lens is implausible, one phrase each; nothing for a lens that can be.

    Parameters
    ----------
    camera : pycolmap.Camera
    """
    if camera.model.name == PANORAMA:
        return []
    width, height = camera.width, camera.height
    fx, fy = camera.focal_length_x, camera.focal_length_y
    if not np.isfinite(camera.params).all() or min(fx, fy) <= 0:
        return ["its parameters are no numbers of a lens"]
    found = []
    if abs(fx / fy - 1) > limits.aspect:
        found.append(f"fx / fy is {fx / fy:.3f}, where pixels are square")
    focal = camera.mean_focal_length() / max(width, height)
    least, most = limits.focal_bent if is_bent(camera) else limits.focal
    if not least <= focal <= most:
        found.append(f"its focal length is {focal:.2f} of the longer side")
    off = max(abs(camera.principal_point_x / width - 0.5), abs(camera.principal_point_y / height - 0.5))
    if off > limits.centre:
        found.append(f"its principal point is {100 * off:.0f} % of the size off the middle")
    return found + _bends(camera, limits)


def _bends(camera: Any, limits: Believable) -> list[str]:
    """Return what is implausible in the distortion: tangential, folding back within the picture, or too strong."""
    found = []
    name = camera.model.name
    if name == "OPENCV" and max(map(abs, camera.params[6:8])) > limits.tangential:
        p = max(camera.params[6:8], key=abs)
        found.append(f"its tangential distortion is {p:.4f}")
    ideal, seen = _along_corner(camera)
    if not (np.diff(seen) > 0).all():
        found.append("its distortion folds the picture back before the corner")
    elif name != "FOV" and abs(bend := float(seen[-1] / ideal[-1]) - 1) > limits.bend:
        found.append(f"its distortion moves the corner by {100 * bend:.0f} %")
    return found


def corner_bend(camera: Any) -> float:
    """Return how far distortion moves the farthest corner outwards, of its distance; NaN where it shows nothing."""
    ideal, seen = _along_corner(camera)
    return float(seen[-1] / ideal[-1]) - 1


def _along_corner(camera: Any) -> tuple[np.ndarray, np.ndarray]:
    """Distances [50] from the axis to the farthest corner, px / f: without distortion, and with it.

    Of a fisheye the first are angles, and end short of 90 degrees, beyond which COLMAP projects nothing.
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
    seen = np.asarray([np.full(2, np.nan) if p is None else p for p in map(camera.img_from_cam, rays)])
    return ideal, np.linalg.norm((seen - center) / (camera.focal_length_x, camera.focal_length_y), axis=1)


def is_bent(camera: Any) -> bool:
    """Whether a camera is a fisheye."""
    return "FISHEYE" in camera.model.name


@dataclass(frozen=True)
class Trial:
    """A lens model that was tried.

    Attributes
    ----------
    model : str
    error : float
        px; mean of the observations that were held out, each counted as ``FARTHEST`` at most.
    doubts : tuple of str
        Of all its cameras.
    cameras : dict of int to list of float
        Parameters by the number of the camera.
    models : dict of int to str
        COLMAP model of each camera: with few photographs it is a simpler one.
    """

    model: str
    error: float
    doubts: tuple[str, ...]
    cameras: Mapping[int, list[float]]
    models: Mapping[int, str]


def choose(trials: Sequence[Trial]) -> Trial:
    """Return the plausible model with the least held-out error, where each parameter costs ``WORTH`` of it.

    Where no lens is plausible, all of them are compared.
    """
    plausible = [trial for trial in trials if not trial.doubts] or list(trials)
    return min(plausible, key=lambda trial: trial.error * (1 + WORTH * PARAMETERS[trial.model]))


def lens_line(lens: Mapping[str, Any]) -> str:
    """Return what was decided about the lens, and why, for people; empty where nothing was compared.

    Parameters
    ----------
    lens : mapping
        ``lens`` of poses.json: ``chosen``, ``asked`` or None, ``trials`` with ``model``, ``error_px``, ``doubts``, and
        ``fisheyes``, what was found of each camera that could be one (``as_fisheye``).
    """
    bent = "; ".join(map(_fisheye_line, lens.get("fisheyes", [])))
    trials = lens.get("trials", [])
    if not trials:
        return f"lens: {bent}" if bent else ""
    error = {trial["model"]: trial["error_px"] for trial in trials}
    others = ", ".join(f"{model} {error[model]:.3f}" for model in error if model != lens["chosen"])
    found = f"{lens['chosen']} {error[lens['chosen']]:.3f} px on observations held out; {others}"
    doubted = [f"{trial['model']}: {', '.join(trial['doubts'])}" for trial in trials if trial["doubts"]]
    doubted_line = f"; doubted: {'; '.join(doubted)}" if doubted else ""
    if lens.get("asked"):
        return f"the lens that was asked for is doubtful (--camera-model auto would compare): {found}{doubted_line}"
    bent = f"; {bent}" if bent else ""
    return f"lens: {found}{doubted_line}; each further parameter must save {100 * WORTH:.0f} %{bent}"


def _fisheye_line(row: Mapping[str, Any]) -> str:
    """Return what was found of one camera that could be a fisheye."""
    taken = "are taken for a fisheye's" if row["params"] else "are not taken for a fisheye's, though"
    line = f"{row['photographs']} photographs {taken} ({_WHY[row['why']]})"
    if row["bent"] is None:
        return f"{line}, too few of which match to tell"
    shares = f"{100 * row['bent']:.1f} % of matches agree through one of {row['probed']:.0f} px"
    return f"{line}: {shares}, {100 * row['plain']:.1f} % through a pinhole"


def try_lenses(
    pycolmap: Any, piece: Any, *, asked: str | None = None, seed: int, threads: int, on_done: Callable[[int], None]
) -> list[Trial]:
    """Adjust copies of a model with each lens, without some observations, and measure these.

    All have one focal length; OPENCV takes that of RADIAL and keeps it, as two could not be kept equal otherwise.
    A camera that was placed as a fisheye is compared as the fisheyes of as many parameters.

    Parameters
    ----------
    piece : pycolmap.Reconstruction
        Placed with ``START``, or with the model that was asked for.
    asked : str or None
        It is tried as it is, with two focal lengths if it has two, beside the simpler ones.
    on_done : function of the number of lenses that were tried
    """
    base = _part(pycolmap, piece)
    held = _hold_out(base, seed)
    before = _lenses(base)
    images = _images(piece)
    bent = {number for number, camera in piece.cameras.items() if is_bent(camera)}
    trials = []
    for done, model in enumerate(models_to_try(asked), start=1):
        copy = pycolmap.Reconstruction(base)
        for number in before if model != asked else ():
            rich = images.get(number, 0) >= ENOUGH or PARAMETERS.get(model, 0) <= PARAMETERS[START]
            kind = model if rich else START
            _set_model(pycolmap, copy.camera(number), BENT[kind] if number in bent else kind, before[number])
        adjust(pycolmap, copy, tied=model == "OPENCV" and model != asked, threads=threads)
        found = sorted({doubt for camera in copy.cameras.values() for doubt in doubts(camera)})
        numbers = {number: [float(p) for p in camera.params] for number, camera in copy.cameras.items()}
        kinds = {number: camera.model.name for number, camera in copy.cameras.items()}
        name = BENT[model] if before.keys() == bent else model
        trials.append(Trial(name, _error(copy, held), tuple(found), numbers, kinds))
        if model == "RADIAL":
            before = _lenses(copy)
        on_done(done)
    return trials


def models_to_try(asked: str | None) -> list[str]:
    """Return the models to compare: all, or those that are simpler than the one that was asked for, and that."""
    if asked is None:
        return list(MODELS)
    return [model for model in MODELS if model not in ("OPENCV", asked)] + [asked]


def is_tied(model: str) -> bool:
    """Whether a lens that was chosen has two focal lengths, which are kept equal."""
    return model in ("OPENCV", BENT["OPENCV"])


def apply(pycolmap: Any, piece: Any, trial: Trial, *, threads: int) -> None:
    """Give a model the cameras of a trial and adjust all of it."""
    for number, params in trial.cameras.items():
        camera = piece.camera(number)
        _replace(pycolmap, camera, trial.models[number], params)
    adjust(pycolmap, piece, tied=is_tied(trial.model), threads=threads)
    drop_outliers(pycolmap, piece)


def drop_outliers(pycolmap: Any, piece: Any) -> None:
    """Take out points and observations that COLMAP's own mapping would not keep."""
    pycolmap.ObservationManager(piece).filter_all_points3D(FARTHEST, NARROWEST)
    piece.update_point_3d_errors()


def _part(pycolmap: Any, piece: Any) -> Any:
    """Return a copy of a model with at most ``MAX_PHOTOGRAPHS``, which follow each other by name."""
    copy = pycolmap.Reconstruction(piece)
    placed = sorted((image for image in copy.images.values() if image.has_pose), key=lambda image: image.name)
    first = (len(placed) - MAX_PHOTOGRAPHS) // 2
    for image in placed[: max(first, 0)] + placed[max(first, 0) + MAX_PHOTOGRAPHS :]:
        copy.deregister_frame(image.frame_id)
    return copy


def _images(piece: Any) -> dict[int, int]:
    counts: dict[int, int] = {}
    for image in piece.images.values():
        if image.has_pose:
            counts[image.camera_id] = counts.get(image.camera_id, 0) + 1
    return counts


def _hold_out(piece: Any, seed: int) -> list[tuple[int, int, np.ndarray]]:
    """Take observations out of a model: (point, image, position in it, px) of each."""
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
    """Focal length, principal point, and distortion."""
    extra = [float(camera.params[i]) for i in camera.extra_params_idxs()]
    return camera.mean_focal_length(), camera.principal_point_x, camera.principal_point_y, extra


def _lenses(piece: Any) -> dict[int, tuple[float, float, float, list[float]]]:
    """Return what is known of each camera that has a lens to be compared: all but panoramas."""
    return {number: _plain(camera) for number, camera in piece.cameras.items() if camera.model.name != PANORAMA}


def _set_model(pycolmap: Any, camera: Any, model: str, plain: tuple[float, float, float, list[float]]) -> None:
    """Make a camera one of another model, that shows nearly the same."""
    f, cx, cy, extra = plain
    two = (f, f) if is_tied(model) else (f,)
    room = PARAMETERS[model] - 1  # for distortion
    _replace(pycolmap, camera, model, [*two, cx, cy, *[*extra, 0.0, 0.0, 0.0, 0.0][:room]])


def _replace(pycolmap: Any, camera: Any, model: str, params: Sequence[float]) -> None:
    camera.model = getattr(pycolmap.CameraModelId, model)
    camera.params = list(params)


def adjust(pycolmap: Any, piece: Any, *, tied: bool, threads: int) -> None:
    """Bundle adjustment; ``tied`` keeps focal lengths, which two of them could not be kept equal otherwise."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = not tied
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = ITERATIONS
    options.ceres.solver_options.function_tolerance = 1e-6
    pycolmap.bundle_adjustment(piece, options)
