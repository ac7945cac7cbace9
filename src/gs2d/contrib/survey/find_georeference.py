"""``gs2d survey``: finds scale, orientation and position of a run from one source, and checks the result."""

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
from gs2d.data.exif import read_metadata
from gs2d.data.positions import Positions, matched, read_positions
from gs2d.errors import DataError, RunError
from gs2d.io.run_dir import GEOREFERENCE, POSES, RunFolder, open_run
from gs2d.pipeline.prepare.loaded import reload_run
from gs2d.training.events import OnEvent, counted, ignore

SOURCES = ("gps", "positions", "control", "known_distance", "markers")
_FEWEST = 3  # smallest number of camera positions
# Limits beyond which a warning is reported:
_MAX_OUTLIERS = 0.3  # fraction of outliers
_SCALE_ERROR = 0.02  # relative standard error of the scale
_TILTED = 20.0  # degrees between up from the positions and up from the cameras
_NOISY = 0.2  # rms relative to the spread of the positions
_OFF = 5.0  # error of a control point, relative to the rms of the others
_CONTROL_OFF = 0.02  # rms relative to the spread of the control points
_CHECK_OFF = 3.0  # rms of check points, relative to that of fitted points
_ON_LINE = 1e-9


def georeference_run(
    path: Path,
    options: GeoreferenceOptions,
    on_event: OnEvent = ignore,
) -> Georeference | None:
    """Compute the georeference of a run and write ``georeference.json``; without a source, read it.

    Other files of the run keep their coordinates. Returns None if the run has none, or it was removed.
    """
    run = open_run(path)
    sources = [name for name in SOURCES if _is_set(getattr(options, name))]
    _check(options, sources)
    if options.remove:
        with run.locked():
            run.file(GEOREFERENCE).unlink(missing_ok=True)
        return None
    if not sources:
        return read_georeference(run.path)
    georeference = _fitted(run, options, sources[0], on_event)
    with run.locked():
        write_georeference(run.path, georeference)
    return georeference


def _check(options: GeoreferenceOptions, chosen: Sequence[str]) -> None:
    """Raise for options that contradict each other or have no effect."""
    names = [f"--{name.replace('_', '-')}" for name in chosen]
    if len(chosen) > 1 or (options.remove and chosen):
        raise RunError(f"use one source at a time, got {' and '.join([*names, *['--remove'] * options.remove])}")
    needs = {
        "check_points": ("control",),
        "epsg": ("gps", "positions", "control"),
        "enu": ("gps", "positions"),
        "up": SOURCES,
    }
    for name, sources in needs.items():
        if _is_set(getattr(options, name)) and not set(sources) & set(chosen):
            of = " or ".join(f"--{source.replace('_', '-')}" for source in sources)
            raise RunError(f"{name} needs {of}")
    if options.enu and options.epsg is not None:
        raise RunError("--set enu and --epsg exclude each other; leave one out")
    if options.up is not None and not (np.isfinite(options.up).all() and np.linalg.norm(options.up) > _ON_LINE):
        raise RunError(f"up must be a direction of three finite numbers, got {options.up}")


def _is_set(value: object) -> bool:
    return value is not None and value is not False and value != ()


def _fitted(run: RunFolder, options: GeoreferenceOptions, source: str, on_event: OnEvent) -> Georeference:
    if source == "known_distance":
        assert options.known_distance is not None
        level, origin = _up(options, lambda: [view.camera for view in _views(run, on_event)])
        return _of_known_distance(options.known_distance, level, origin)
    views = _views(run, on_event)
    cameras = [view.camera for view in views]
    if source == "markers":
        return _of_markers(views, options, *_up(options, lambda: cameras), on_event)
    up = cameras_up(cameras) if options.up is None else np.array(options.up)
    tilt = "cameras" if options.up is None else "given"
    if source == "control":
        assert options.control is not None
        return _of_control(views, options, up, tilt)
    return _of_positions(views, _positions(views, options, on_event), options, up, tilt)


def _views(run: RunFolder, on_event: OnEvent) -> list[View]:
    """Return the views; only training views if poses were refined."""
    scene = reload_run(run, on_event).scene
    return list(scene.train if run.file(POSES).exists() else scene.views)


def _up(options: GeoreferenceOptions, cameras: Callable[[], Sequence[Camera]]) -> tuple[np.ndarray, str]:
    """Return the up direction of the run and its source; default: +z."""
    if options.up is not None:
        return np.array(options.up) / np.linalg.norm(options.up), "given"
    up = cameras_up(cameras())
    return (np.array([0.0, 0.0, 1.0]), "the run's z") if up is None else (up, "cameras")


# -- scale alone -------------------------------------------------------------------------------------------------------
def _of_known_distance(distance: Sequence[float], up: np.ndarray, up_source: str) -> Georeference:
    ends, metres = np.array(distance[:6]).reshape(2, 3), distance[6]
    if not np.isfinite(distance).all() or not metres > 0:
        raise RunError(f"--known-distance must be six finite numbers and a positive distance, got {distance}")
    units = float(np.linalg.norm(ends[1] - ends[0]))
    if not units > _ON_LINE * max(1.0, float(np.abs(ends).max())):
        raise RunError("--known-distance must have two different points")
    details = {"up": up_source, "points": ends.tolist(), "metres": metres, "units": units}
    doubts = () if up_source != "the run's z" else ("the cameras do not determine up: using z of the run",)
    place = (metres / units, rotation_to_z(up), np.zeros(3), np.zeros(3))
    return Georeference(*place, "a known distance", details=details, doubts=doubts)


def _of_markers(
    views: Sequence[View], options: GeoreferenceOptions, up: np.ndarray, up_source: str, on_event: OnEvent
) -> Georeference:
    metres, dictionary = options.markers, options.marker_dictionary
    assert metres is not None
    if not (math.isfinite(metres) and metres > 0):
        raise RunError(f"--markers must be the side length of a marker in metres, a positive number, got {metres}")
    aruco = detector(dictionary)
    detections = [(view, detected(aruco, view)) for view in counted(views, "detecting markers", len(views), on_event)]
    markers, rejected = in_run(detections)
    if not markers:
        count = sum(len(corners) for _, corners in detections)
        why = f"; {rejected[0]}" if rejected else ""
        raise DataError(
            f"no {dictionary} marker is usable: {count} detections in {len(views)} photographs{why}; check "
            "marker_dictionary, and that markers are at least 20 px wide in two photographs"
        )
    sides = np.array([marker.side for marker in markers])
    scale = float(metres * sides.sum() / np.square(sides).sum())
    errors = scale * sides - metres
    residuals = tuple(
        Residual(f"marker {marker.number}", np.array([error, 0.0, 0.0]), FITTED)
        for marker, error in zip(markers, errors, strict=True)
    )
    doubts = list(rejected)
    if len(markers) > 1 and float(np.abs(errors).max()) > _SCALE_ERROR * metres:
        doubts.append(
            f"marker sides differ from {metres:g} m by up to {np.abs(errors).max() / metres:.1%}: are all equal?"
        )
    details = {"up": up_source, "side": metres, "markers": [_marker_details(marker) for marker in markers]}
    zeros = np.zeros(3)
    return Georeference(
        *(scale, rotation_to_z(up), zeros, zeros, f"{len(markers)} printed markers"),
        residuals=residuals,
        details=details,
        doubts=tuple(doubts),
    )


def _marker_details(marker: Marker) -> dict[str, Any]:
    return {"number": marker.number, "photographs": marker.photographs, "corners": marker.corners.tolist()}


# -- camera positions --------------------------------------------------------------------------------------------------
def _positions(views: Sequence[View], options: GeoreferenceOptions, on_event: OnEvent) -> Positions:
    if options.positions is not None:
        return read_positions(options.positions)
    places = {}
    for view in counted(views, "reading EXIF", len(views), on_event):
        place = None if view.path is None else read_metadata(view.path).place
        if place is not None:
            places[view.name] = np.array(place)
    if not places:
        raise DataError(
            f"none of {len(views)} photographs has a position in its EXIF; use a file of positions (--positions) or a "
            "known distance (--known-distance)"
        )
    return Positions(places, None, "GPS in the photographs' EXIF", in_degrees=True)


def _of_positions(
    views: Sequence[View], positions: Positions, options: GeoreferenceOptions, up: np.ndarray | None, tilt: str
) -> Georeference:
    places = matched(positions, [view.name for view in views])
    if len(places) < _FEWEST:
        first = next(iter(positions.places))
        raise DataError(
            f"{positions.source} must have at least {_FEWEST} photographs of the run, got {len(places)} of "
            f"{len(views)} (first name {first}, first photograph of the run {views[0].name})"
        )
    used = [view for view in views if view.name in places]
    epsg = positions.epsg
    if epsg is None and not positions.in_degrees:
        epsg = _required_epsg(options, positions.source)
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


def _required_epsg(options: GeoreferenceOptions, source: str) -> int:
    if options.epsg is None:
        raise DataError(f"{source}: coordinates in metres need a coordinate system; set --epsg CODE")
    return options.epsg


def _doubts_of_fit(fit: Fit, target: np.ndarray, cameras: Sequence[Camera]) -> list[str]:
    """Return warnings about a fit to camera positions."""
    doubts = []
    outliers = int((~fit.inliers).sum())
    if outliers > _MAX_OUTLIERS * len(fit.inliers):
        doubts.append(f"{outliers} of {len(fit.inliers)} positions are outliers and were left out")
    rms = float(np.sqrt(np.mean(np.square(fit.residuals[fit.inliers]).sum(axis=1))))
    spread = float(np.sqrt(np.nansum(np.nanvar(target[fit.inliers], axis=0))))
    if rms > _NOISY * spread:
        doubts.append(
            f"errors of {rms:.2f} m are large for a capture of {spread:.2f} m: use a known distance for the scale"
        )
    if fit.scale_error > _SCALE_ERROR:
        doubts.append(f"the scale has an error of {fit.scale_error:.1%}: a known distance is more accurate")
    up = cameras_up(cameras)
    if fit.tilt == "places" and up is not None:
        angle = math.degrees(math.acos(float(np.clip(fit.rotation[2] @ up / np.linalg.norm(up), -1, 1))))
        if angle > _TILTED:
            doubts.append(f"up from the positions differs by {angle:.0f} degrees from up of the cameras")
    return doubts


# -- control points ----------------------------------------------------------------------------------------------------
def _of_control(views: Sequence[View], options: GeoreferenceOptions, up: np.ndarray | None, tilt: str) -> Georeference:
    assert options.control is not None
    control = read_control(options.control)
    located = locate(control.points, views, options.check_points)
    fitted = ~located.check
    if int(fitted.sum()) < 2:
        raise DataError(f"{options.control} must have at least two control points that are not check points")
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
    georeference = _georeference(fit, frame, located.names, located.check, source, doubts)
    return replace(georeference, details={**georeference.details, "pixels": pixels})


def fit_control(located: Located, target: np.ndarray, up: np.ndarray | None, tilt: str) -> Fit:
    """Fit to all control points that are not check points, without outlier removal."""
    fitted = ~located.check
    fit = fit_places(located.source[fitted], target[fitted], up, tilt=tilt, robust=False)
    residuals = located.source @ fit.T[:3, :3].T + fit.T[:3, 3] - target
    return Fit(fit.T, fitted, residuals, fit.tilt, fit.scale_error, fit.tilt_error)


def _doubts_of_control(fit: Fit, located: Located) -> list[str]:
    doubts = []
    distances = np.linalg.norm(fit.residuals, axis=1)
    fitted = np.flatnonzero(fit.inliers)
    if len(fitted) < 4:
        doubts.append(f"{len(fitted)} control points leave no redundancy: measure more, or add check points")
    for index in fitted[distances[fitted].argsort()[::-1][:1]]:
        others = distances[[i for i in fitted if i != index]]
        rms = float(np.sqrt(np.mean(others**2)))
        if len(fitted) > 4 and distances[index] > _OFF * max(rms, 1e-6):
            doubts.append(
                f"{located.names[index]} has an error of {distances[index]:.3f} m, the others {rms:.3f} m: check it"
            )
    rms = float(np.sqrt(np.mean(distances[fitted] ** 2)))
    spread = float(np.sqrt(np.var(located.source[fitted], axis=0).sum())) * fit.scale
    if rms > _CONTROL_OFF * spread:
        doubts.append(f"control points have an error of {rms:.3f} m over {spread:.3f} m: one of them may be wrong")
    if located.check.any() and len(fitted) > 3:
        inner, outer = (float(np.sqrt(np.mean(distances[rows] ** 2))) for rows in (fitted, located.check))
        if outer > _CHECK_OFF * max(inner, 1e-6):
            doubts.append(f"check points have an error of {outer:.3f} m, fitted points only {inner:.3f} m")
    return doubts


def _georeference(
    fit: Fit, frame: MapFrame, names: Sequence[str], check: np.ndarray, source: str, doubts: Sequence[str]
) -> Georeference:
    roles = [CHECK if held else FITTED if used else LEFT_OUT for held, used in zip(check, fit.inliers, strict=True)]
    residuals = tuple(
        Residual(name, error, role) for name, error, role in zip(names, fit.residuals, roles, strict=True)
    )
    details: dict[str, Any] = {"up": fit.tilt}
    if math.isfinite(fit.scale_error):
        details["scale_error"] = fit.scale_error
    if math.isfinite(fit.tilt_error):
        details["tilt_error_degrees"] = fit.tilt_error
    return Georeference(
        *(fit.scale, fit.rotation, fit.T[:3, 3], frame.origin, source),
        *(frame.epsg, frame.geodetic, frame.grid_scale, residuals, tuple(doubts)),
        details=details,
    )
