"""The vignetting and the response that a run found of each camera: its file ``photometry.json``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from gs2d.config.recipe import Recipe
from gs2d.core.json_files import read_json, write_json
from gs2d.core.photometry import CameraPhotometry
from gs2d.data import Scene
from gs2d.errors import DataError, RunError
from gs2d.io.run_dir import PHOTOMETRY, SPLATS, RunFolder
from gs2d.pipeline.events import Notice, OnEvent

NONE: Mapping[str, CameraPhotometry] = MappingProxyType({})
ABOUT = (
    "at a pixel whose distance from the principal point is r times reach, counted in focal lengths, a camera has "
    "exp(-(a r^2 + b r^4 + c r^6)) of the light, falloff = [a, b, c]; corner: what is left at r = 1. f(x) = k x / (1 + "
    "(k - 1) x), k = e^s, turns light into values, s = shift; the scene is in that of s = 0, the photographs' mean"
)


def write_photometries(run: RunFolder, scene: Scene, on_event: OnEvent) -> None:
    """Write ``photometry.json`` beside the splats, where views have any, and say what was found."""
    names: dict[CameraPhotometry, list[str]] = {}
    for view in scene.views:
        if view.photometry is not None:
            names.setdefault(view.photometry, []).append(view.name)
    if not names:
        return
    cameras = [
        {**found._asdict(), "corner": found.corner(), "photographs": photographs}
        for found, photographs in names.items()
    ]
    write_json(run.file(PHOTOMETRY), {"format": 1, "about": ABOUT, "cameras": cameras})
    on_event(Notice(f"{photometry_line(list(names))}: {PHOTOMETRY}"))


def photometry_line(cameras: list[CameraPhotometry]) -> str:
    """Return a line on the light of cameras."""
    corners, shifts = (sorted(of(camera) for camera in cameras) for of in (CameraPhotometry.corner, _shift))
    many = f" ({len(cameras)} cameras)" if len(cameras) > 1 else ""
    return f"corners have {_range(corners, '.3f')} of the light, responses are bent by {_range(shifts, '+.3f')}{many}"


def _shift(camera: CameraPhotometry) -> float:
    return camera.shift


def _range(values: list[float], form: str) -> str:
    low, high = format(values[0], form), format(values[-1], form)
    return low if low == high else f"{low} to {high}"


def with_found_photometries(run: RunFolder, recipe: Recipe, scene: Scene) -> Scene:
    """Return a scene with what :func:`write_photometries` wrote; as it is where the recipe learns nothing of it.

    Raises
    ------
    RunError
        The file is gone or damaged.
    """
    if recipe.photometry is None or not (run.file(PHOTOMETRY).exists() or run.file(SPLATS).exists()):
        return scene
    remedy = f"continue with `gs2d train ... --out {run.path} --resume`, which writes it again"
    try:
        cameras = [(_camera(entry), entry["photographs"]) for entry in read_json(run.file(PHOTOMETRY))["cameras"]]
        found = {str(name): camera for camera, names in cameras for name in names}
    except (DataError, LookupError, TypeError, ValueError, OverflowError) as error:
        raise RunError(
            f"{run.file(PHOTOMETRY)} must hold vignetting and response as this run found them, got: {error}; {remedy}"
        ) from error
    missing = [view.name for view in scene.train if view.name not in found]
    if missing:
        raise RunError(f"{run.file(PHOTOMETRY)} must name each training photograph, got none of {missing[0]}; {remedy}")
    return scene.with_photometries(found)


def _camera(entry: dict[str, Any]) -> CameraPhotometry:
    """Return what an entry says of a camera (ValueError: nothing that can be)."""
    a, b, c = map(float, entry["falloff"])
    found = CameraPhotometry((a, b, c), *(float(entry[name]) for name in ("reach", "shift")))
    numbers = (a, b, c, *found[1:])
    if not (all(map(math.isfinite, numbers)) and found.reach > 0 and max(map(abs, numbers)) < 100):
        raise ValueError(f"a camera of falloff {entry['falloff']}, reach {found.reach} and shift {found.shift}")
    return found
