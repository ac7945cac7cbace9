"""Expected structure of the JSON files of a run, checked when they are read, because files can be damaged."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from gs2d.errors import RunError

Shape = Any
"""A type (``int``: a count; ``float``: any finite number); ``[shape]``: a list; ``(shape, None)``: nullable;
``{name: shape}``: an object. Names that end in ``?`` are optional; other names in the file are not checked.
"""

_NUMBER = (float, None)
_SCORES = {f"{name}?": _NUMBER for name in ("psnr", "ssim", "psnr_float", "ssim_float", "lpips", "lpips_signed")}
_THRESHOLD = {"threshold": float, "precision": _NUMBER, "recall": _NUMBER, "f_score": _NUMBER}
DEFINITION_SHAPE: Shape = {
    "recipe": {"name": str},
    "protocol?": (dict, None),
    "scene": {
        **{"name": str, "path": str, "format": str, "train": int, "test": int},
        **{"extent?": _NUMBER, "skipped?": [str], "notes?": [str], "digest?": str},
    },
    "downscale?": int,
    "seed?": (int, None),
    "backend?": ({"name": str}, None),
    "raster?": (dict, None),
    "versions?": dict,
    "machine?": dict,
    "created?": (str, None),
    "title?": (str, None),
    "schedule_scale?": _NUMBER,
}
METRICS_SHAPE: Shape = {
    "stages": [
        {
            **{"name": str, "iterations": int, "seconds": float, "splats": int, "bytes": int},
            **{"peak_memory_bytes?": _NUMBER, "train?": (_SCORES, None), "test?": (_SCORES, None)},
            "reused_from?": (str, None),
            "transparent?": ({"part": float, "view": str, "worst": float}, None),
        }
    ],
    "surface?": ({"chamfer?": _NUMBER, "unit?": str, "thresholds?": ([_THRESHOLD], None)}, None),
    "mesh?": (dict, None),
}
VERDICT_SHAPE: Shape = {
    "verdict": {
        **{"grade": (str, None), "headline": str},
        "findings": [{"name": str, "grade": (str, None), "figure": str, "text": str, "advice": (str, None)}],
    },
}
_KINDS: dict[type, str] = {
    **{str: "text", bool: "true or false", int: "an integer >= 0", float: "a finite number"},
    **{list: "a list", dict: "an object"},
}


def check_shape(path: Path, value: Any, shape: Shape, remedy: str) -> None:
    """Check a value against a shape.

    Raises RunError for the first mismatch, with the file, the path of the value in it, and the expected type.
    """
    try:
        _check(value, shape, "")
    except ValueError as error:
        raise RunError(f"{path} was damaged or changed: {error}; {remedy}") from None


def _check(value: Any, shape: Shape, name: str) -> None:
    if isinstance(shape, tuple):
        if value is not None:
            _check(value, shape[0], name)
        return
    kind = type(shape) if isinstance(shape, list | dict) else shape
    if not _is(value, kind):
        raise ValueError(f"{name or 'the file'} must be {_KINDS[kind]}, got {value!r:.40}")
    if isinstance(shape, list):
        for index, entry in enumerate(value):
            _check(entry, shape[0], f"{name}[{index}]")
    if isinstance(shape, dict):
        for field, entry in shape.items():
            key = field.removesuffix("?")
            if key in value:
                _check(value[key], entry, f"{name}.{key}".lstrip("."))
            elif key == field:
                raise ValueError(f"{name or 'the file'} must hold {key!r}")


def _is(value: Any, kind: type) -> bool:
    if isinstance(value, bool):
        return kind is bool
    if kind is int:
        return isinstance(value, int) and 0 <= value < 1 << 63
    if kind is float:
        return isinstance(value, int | float) and abs(value) < 1e300 and math.isfinite(value)
    return isinstance(value, kind)
