"""``gs2d georeference``: where a run is in the world, found from one source, checked, kept in the run as a value."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.contrib.survey.control import Located, locate, read_control
from gs2d.contrib.survey.fit import Fit, cameras_up, fit_places
from gs2d.contrib.survey.georeference import (
    CHECK,
    FITTED,
    LEFT_OUT,
    Georeference,
    Residual,
    read_georeference,
    write_georeference,
)
from gs2d.contrib.survey.markers import Marker, detected, detector, in_run
from gs2d.contrib.survey.projection import MapFrame, in_frame
from gs2d.contrib.survey.survey_commands import GeoreferenceOptions
from gs2d.core.camera import Camera
from gs2d.core.similarity import rotation_to_z
from gs2d.data import View
from gs2d.data.exif import read_place
from gs2d.data.positions import Positions, matched, read_positions
from gs2d.errors import DataError, RunError
from gs2d.io.run_dir import GEOREFERENCE, POSES, RunFolder, open_run
from gs2d.pipeline.prepare.loaded import reload_run
from gs2d.training.events import OnEvent, counted, ignore

SOURCES = ("gps", "positions", "control", "known_distance", "markers")
_FEWEST = 3  # places of photographs
_LEFT = 0.3  # of the places left out, from which the fit is doubted
_SCALE_ERROR = 0.02  # standard error from which the scale is doubted
_TILTED = 20.0  # degrees between the up of the places and that of the cameras
_NOISY = 0.2  # rms over the spread of the places
_OFF = 5.0  # times the rms of the others, at which a control point is named
_CONTROL_OFF = 0.02  # rms over the spread of the control points, from which they are doubted
_CHECK_OFF = 3.0  # times the rms of the fitted points, at which check points are doubted
_ON_LINE = 1e-9


def georeference_run(
    path: Path,
    options: GeoreferenceOptions,
    on_event: OnEvent = ignore,
) -> Georeference | None:
    """Find where a run is in the world and write ``georeference.json``; without a source, read it.

    Nothing else of the run changes: its files keep their coordinates.

    Returns
    -------
    Georeference or None
        None where the run has none, or it was removed.
    """
    run = open_run(path)
    asked = [name for name in SOURCES if _is_given(getattr(options, name))]
    _check(options, asked)
    if options.remove:
        with run.locked():
            run.file(GEOREFERENCE).unlink(missing_ok=True)
        return None
    if not asked:
        return read_georeference(run.path)
    found = _found(run, options, asked[0], on_event)
    with run.locked():
        write_georeference(run.path, found)
    return found


def _check(options: GeoreferenceOptions, asked: Sequence[str]) -> None:
    """Refuse options that contradict each other or would do nothing."""
    names = [f"--{name.replace('_', '-')}" for name in asked]
    if len(asked) > 1 or (options.remove and asked):
        raise RunError(f"one source at a time was expected, got {' and '.join([*names, *_removing(options)])}")
    needs = {
        "check_points": ("control",),
        "epsg": ("gps", "positions", "control"),
        "enu": ("gps", "positions"),
        "up": SOURCES,
    }
    for name, sources in needs.items():
        if _is_given(getattr(options, name)) and not set(sources) & set(asked):
            of = " or ".join(f"--{source.replace('_', '-')}" for source in sources)
            raise RunError(f"--{name.replace('_', '-')} belongs to {of}, which was not given")
    if options.enu and options.epsg is not None:
        raise RunError("--enu and --epsg contradict each other, got both; leave one out")
    if options.up is not None and not (np.isfinite(options.up).all() and np.linalg.norm(options.up) > _ON_LINE):
        raise RunError(f"--up must be a direction of three finite numbers, got {options.up}")


def _is_given(value: object) -> bool:
    return value is not None and value is not False and value != ()


def _removing(options: GeoreferenceOptions) -> list[str]:
    return ["--remove"] if options.remove else []


def _found(run: RunFolder, options: GeoreferenceOptions, source: str, on_event: OnEvent) -> Georeference:
    if source == "known_distance":
        assert options.known_distance is not None
        level, told = _up(options, lambda: [view.camera for view in _views(run, on_event)])
        return _of_known_distance(options.known_distance, level, told)
    views = _views(run, on_event)
    cameras = [view.camera for view in views]
    if source == "markers":
        assert options.markers is not None
        level, told = _up(options, lambda: cameras)
        return _of_markers(views, options.markers, options.marker_dictionary, level, told, on_event)
    up = cameras_up(cameras) if options.up is None else np.array(options.up)
    tilt = "cameras" if options.up is None else "given"
    if source == "control":
        assert options.control is not None
        return _of_control(views, options, up, tilt)
    return _of_positions(views, _positions(views, options, on_event), options, up, tilt)


def _views(run: RunFolder, on_event: OnEvent) -> list[View]:
    """Return the photographs with their cameras; where cameras were refined, those only."""
    scene = reload_run(run, on_event).scene
    return list(scene.train if run.file(POSES).exists() else scene.views)


def _up(options: GeoreferenceOptions, cameras: Callable[[], Sequence[Camera]]) -> tuple[np.ndarray, str]:
    """Return what is up in the run, and who says so; +z where nobody does."""
    if options.up is not None:
        return np.array(options.up) / np.linalg.norm(options.up), "given"
    up = cameras_up(cameras())
    return (np.array([0.0, 0.0, 1.0]), "the run's z") if up is None else (up, "cameras")


# -- scale alone -------------------------------------------------------------------------------------------------------
def _of_known_distance(known: Sequence[float], up: np.ndarray, told: str) -> Georeference:
    ends, metres = np.array(known[:6]).reshape(2, 3), known[6]
    if not np.isfinite(known).all() or not metres > 0:
        raise RunError(f"--known-distance must be six finite numbers and a positive distance, got {known}")
    units = float(np.linalg.norm(ends[1] - ends[0]))
    if not units > _ON_LINE * max(1.0, float(np.abs(ends).max())):
        raise RunError("--known-distance must name two different points, got the same twice")
    facts = {"up": told, "points": ends.tolist(), "metres": metres, "units": units}
    doubts = () if told != "the run's z" else ("the cameras do not agree on what is up: z of the run was taken",)
    zeros = np.zeros(3)
    return Georeference(metres / units, rotation_to_z(up), zeros, zeros, "a known distance", facts=facts, doubts=doubts)


def _of_markers(
    views: Sequence[View], metres: float, dictionary: str, up: np.ndarray, told: str, on_event: OnEvent
) -> Georeference:
    if not (math.isfinite(metres) and metres > 0):
        raise RunError(f"--markers must be the side of a marker in metres, a positive number, got {metres}")
    looking = detector(dictionary)
    seen = [(view, detected(looking, view)) for view in counted(views, "looking for markers", len(views), on_event)]
    markers, left = in_run(seen)
    if not markers:
        count = sum(len(found) for _, found in seen)
        why = f"; {left[0]}" if left else ""
        raise DataError(
            f"{dictionary} markers in two photographs or more were expected, got {count} in {len(views)}{why}; is "
            "--marker-dictionary right, and is each 20 px wide or more?"
        )
    sides = np.array([marker.side for marker in markers])
    scale = float(metres * sides.sum() / np.square(sides).sum())
    errors = scale * sides - metres
    residuals = tuple(
        Residual(f"marker {marker.number}", np.array([error, 0.0, 0.0]), FITTED)
        for marker, error in zip(markers, errors, strict=True)
    )
    doubts = list(left)
    if len(markers) > 1 and float(np.abs(errors).max()) > _SCALE_ERROR * metres:
        doubts.append(
            f"sides of the markers differ by {np.abs(errors).max() / metres:.1%} of {metres:g} m: are all of one size?"
        )
    facts = {"up": told, "side": metres, "markers": [_marker_facts(marker) for marker in markers]}
    zeros = np.zeros(3)
    return Georeference(
        *(scale, rotation_to_z(up), zeros, zeros, f"{len(markers)} printed markers"),
        residuals=residuals,
        facts=facts,
        doubts=tuple(doubts),
    )


def _marker_facts(marker: Marker) -> dict[str, Any]:
    return {"number": marker.number, "photographs": marker.photographs, "corners": marker.corners.tolist()}


# -- places of photographs ---------------------------------------------------------------------------------------------
def _positions(views: Sequence[View], options: GeoreferenceOptions, on_event: OnEvent) -> Positions:
    if options.positions is not None:
        return read_positions(options.positions)
    found = {}
    for view in counted(views, "reading EXIF", len(views), on_event):
        place = None if view.path is None else read_place(view.path)
        if place is not None:
            found[view.name] = place
    if not found:
        raise DataError(
            f"photographs with a position in their EXIF were expected, none of {len(views)} has one; give a file of "
            "positions (--positions), or a distance (--known-distance)"
        )
    return Positions(found, None, "GPS in the photographs' EXIF", in_degrees=True)


def _of_positions(
    views: Sequence[View], positions: Positions, options: GeoreferenceOptions, up: np.ndarray | None, tilt: str
) -> Georeference:
    places = matched(positions, [view.name for view in views])
    if len(places) < _FEWEST:
        first = next(iter(positions.places))
        raise DataError(
            f"{positions.source} must place {_FEWEST} photographs of the run at least, got {len(places)} of "
            f"{len(views)} (it names {first}, the run {views[0].name})"
        )
    used = [view for view in views if view.name in places]
    epsg = positions.epsg
    if epsg is None and not positions.in_degrees:
        epsg = _asked_epsg(options, positions.source)
    source = np.array([view.camera.center for view in used])
    target, frame = in_frame(
        np.array([places[view.name] for view in used]), epsg, requested=options.epsg, enu=options.enu
    )
    fit = fit_places(source, target, up, tilt=tilt)
    names = [view.name for view in used]
    doubts = [*_doubts_of_fit(fit, target, [view.camera for view in used])]
    if len(used) < 0.5 * len(views):
        doubts.append(f"only {len(used)} of {len(views)} photographs have a position")
    return _georeference(fit, frame, names, np.zeros(len(names), bool), positions.source, doubts)


def _asked_epsg(options: GeoreferenceOptions, source: str) -> int:
    if options.epsg is None:
        raise DataError(f"{source}: coordinates in metres need their system; name it with --epsg CODE")
    return options.epsg


def _doubts_of_fit(fit: Fit, target: np.ndarray, cameras: Sequence[Camera]) -> list[str]:
    """Return what is implausible about a fit to places of photographs."""
    doubts = []
    left = int((~fit.inliers).sum())
    if left > _LEFT * len(fit.inliers):
        doubts.append(f"{left} of {len(fit.inliers)} positions do not agree with the others and were left out")
    rms = float(np.sqrt(np.mean(np.square(fit.residuals[fit.inliers]).sum(axis=1))))
    spread = float(np.sqrt(np.nansum(np.nanvar(target[fit.inliers], axis=0))))
    if rms > _NOISY * spread:
        doubts.append(
            f"the positions are {rms:.2f} m off in a capture that spreads over {spread:.2f} m: the receiver's errors "
            "decide the place; a known distance tells the scale better"
        )
    if fit.scale_error > _SCALE_ERROR:
        doubts.append(f"the scale is known to {fit.scale_error:.1%} only: a known distance tells it better")
    up = cameras_up(cameras)
    if fit.tilt == "places" and up is not None:
        angle = math.degrees(math.acos(float(np.clip(fit.rotation[2] @ up / np.linalg.norm(up), -1, 1))))
        if angle > _TILTED:
            doubts.append(f"up by the positions is {angle:.0f} degrees from up by how the cameras were held")
    return doubts


# -- control points ----------------------------------------------------------------------------------------------------
def _of_control(views: Sequence[View], options: GeoreferenceOptions, up: np.ndarray | None, tilt: str) -> Georeference:
    assert options.control is not None
    control = read_control(options.control)
    located = locate(control.points, views, options.check_points)
    fitted = ~located.check
    if int(fitted.sum()) < 2:
        raise DataError(f"{options.control} must have two control points at least that are no check points")
    epsg = control.epsg if control.epsg is not None else None if control.in_degrees else options.epsg
    if epsg is None and not control.in_degrees:
        origin = np.round(np.median(located.world, axis=0))
        target, frame = located.world - origin, MapFrame(None, origin, None, 1.0)
    else:
        target, frame = in_frame(located.world, epsg, requested=options.epsg, enu=False)
    fit = fit_control(located, target, up, tilt)
    doubts = [*located.doubts, *_doubts_of_control(fit, located)]
    source = f"{int(fitted.sum())} control points in {options.control.name}"
    pixels = {name: px for name, px in zip(located.names, located.pixels.tolist(), strict=True) if math.isfinite(px)}
    found = _georeference(fit, frame, located.names, located.check, source, doubts)
    return replace(found, facts={**found.facts, "pixels": pixels})


def fit_control(located: Located, target: np.ndarray, up: np.ndarray | None, tilt: str) -> Fit:
    """Fit to all control points that are not check points: somebody measured each, so that none is voted out."""
    fitted = ~located.check
    fit = fit_places(located.source[fitted], target[fitted], up, tilt=tilt, robust=False)
    residuals = located.source @ fit.T[:3, :3].T + fit.T[:3, 3] - target
    return Fit(fit.T, fitted, residuals, fit.tilt, fit.scale_error, fit.tilt_error)


def _doubts_of_control(fit: Fit, located: Located) -> list[str]:
    doubts = []
    distances = np.linalg.norm(fit.residuals, axis=1)
    fitted = np.flatnonzero(fit.inliers)
    if len(fitted) < 4:
        doubts.append(f"{len(fitted)} control points fit whatever they are: measure more, or hold some out as checks")
    for index in fitted[distances[fitted].argsort()[::-1][:1]]:
        others = distances[[i for i in fitted if i != index]]
        rms = float(np.sqrt(np.mean(others**2)))
        if len(fitted) > 4 and distances[index] > _OFF * max(rms, 1e-6):
            doubts.append(
                f"{located.names[index]} is {distances[index]:.3f} m off, the others {rms:.3f} m: look at its numbers"
            )
    rms = float(np.sqrt(np.mean(distances[fitted] ** 2)))
    spread = float(np.sqrt(np.var(located.source[fitted], axis=0).sum())) * fit.scale
    if rms > _CONTROL_OFF * spread:
        doubts.append(f"control points are {rms:.3f} m off and spread over {spread:.3f} m: one of them may be wrong")
    if located.check.any() and len(fitted) > 3:
        inner, outer = (float(np.sqrt(np.mean(distances[rows] ** 2))) for rows in (fitted, located.check))
        if outer > _CHECK_OFF * max(inner, 1e-6):
            doubts.append(f"check points are {outer:.3f} m off, fitted ones {inner:.3f} m: the fit does not carry over")
    return doubts


def _georeference(
    fit: Fit, frame: MapFrame, names: Sequence[str], check: np.ndarray, source: str, doubts: Sequence[str]
) -> Georeference:
    roles = [CHECK if held else FITTED if used else LEFT_OUT for held, used in zip(check, fit.inliers, strict=True)]
    residuals = tuple(
        Residual(name, error, role) for name, error, role in zip(names, fit.residuals, roles, strict=True)
    )
    facts: dict[str, Any] = {"up": fit.tilt}
    if math.isfinite(fit.scale_error):
        facts["scale_error"] = fit.scale_error
    if math.isfinite(fit.tilt_error):
        facts["tilt_error_degrees"] = fit.tilt_error
    return Georeference(
        *(fit.scale, fit.rotation, fit.T[:3, 3], frame.origin, source),
        *(frame.epsg, frame.geodetic, frame.grid_scale, residuals, tuple(doubts)),
        facts=facts,
    )
