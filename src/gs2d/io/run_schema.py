"""What the files of a run hold, as far as gs2d reads them again: each value of the kind it was written with.

People open ``run.json`` and ``metrics.json`` in an editor, and disks damage them. Whatever else is in them stays; a
value that is read and is of another kind is one line that names the place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gs2d.errors import RunError

Shape = Any
"""``str``, ``bool``, ``int`` (a count), ``float`` (any number); a tuple: one of them; ``None``: null; ``[shape]``: a
list of them; a mapping: an object of such values. Those whose name ends in ``?`` may be missing, ``"*"`` is all others.
"""

_FIGURES = ("psnr", "ssim", "psnr_float", "ssim_float", "lpips", "lpips_signed")
_SCORES = {**{f"{name}?": (float, None) for name in _FIGURES}, "*": (float, str, bool, None, {"*": object}, [object])}
_SURFACE = {
    "chamfer?": (float, None),
    "unit?": str,
    "thresholds?": (
        None,
        [
            {
                "threshold": float,
                "precision": (float, None),
                "recall": (float, None),
                "f_score": (float, None),
                "*": object,
            }
        ],
    ),
    "*": object,
}
DEFINITION_SHAPE: Shape = {
    "recipe": {"name": str, "*": object},
    "protocol?": ({"*": object}, None),
    "scene": {
        **{"name": str, "path": str, "format": str, "train": int, "test": int},
        **{"extent?": (float, None), "skipped?": [str], "notes?": [str], "digest?": str, "*": object},
    },
    "downscale?": int,
    "seed?": (int, None),
    "backend?": ({"name": str, "*": object}, None),
    "raster?": ({"*": object}, None),
    "versions?": {"*": object},
    "machine?": {"*": object},
    "created?": (str, None),
    "title?": (str, None),
    "stage2_cache_bytes?": int,
    "schedule_scale?": (float, None),
    "*": object,
}
METRICS_SHAPE: Shape = {
    "stages": [
        {
            **{"name": str, "iterations": int, "seconds": float, "splats": int, "bytes": int},
            **{"peak_memory_bytes?": (float, None), "train?": (_SCORES, None), "test?": (_SCORES, None)},
            **{"reused_from?": (str, None), "after_clone?": (_SCORES, None), "*": object},
            "transparent?": ({"part": float, "view": str, "worst": float}, None),
        }
    ],
    "surface?": (_SURFACE, None),
    "surface_reason?": (str, None),
    "mesh?": ({"*": object}, None),
    "*": object,
}
VERDICT_SHAPE: Shape = {
    "verdict": {
        **{"grade": (str, None), "headline": str},
        "findings": [
            {"name": str, "grade": (str, None), "figure": str, "text": str, "advice": (str, None), "*": object}
        ],
        "*": object,
    },
    "*": object,
}
_KINDS = {str: "text", bool: "true or false", int: "a whole number >= 0", float: "a finite number", None: "null"}


def check_shape(path: Path, value: Any, shape: Shape, remedy: str) -> None:
    """Raise for the first value that is of another kind than ``shape`` says.

    Raises
    ------
    RunError
        Names the file, the place in it, what it must be and what it is.
    """
    found = _first_wrong(value, shape, "")
    if found is not None:
        place, wanted, got = found
        at = f"{place.lstrip('.')} must be" if place else "it must be"
        raise RunError(f"{path} was damaged or changed: {at} {_named(wanted)}, got {_shown(got)}; {remedy}")


def _first_wrong(value: Any, shape: Shape, place: str) -> tuple[str, Shape, Any] | None:
    if isinstance(shape, tuple):
        tried = [_first_wrong(value, one, place) for one in shape]
        if None in tried:
            return None
        deeper = [found for found in tried if found is not None and found[0] != place]
        return deeper[0] if deeper else (place, shape, value)
    if isinstance(shape, list):
        if not isinstance(value, list):
            return place, shape, value
        found_in = (_first_wrong(entry, shape[0], f"{place}[{i}]") for i, entry in enumerate(value))
        return next((found for found in found_in if found is not None), None)
    if isinstance(shape, Mapping):
        return _first_wrong_entry(value, shape, place)
    return None if _is(value, shape) else (place, shape, value)


def _first_wrong_entry(value: Any, shape: Mapping[str, Shape], place: str) -> tuple[str, Shape, Any] | None:
    if not isinstance(value, dict):
        return place, shape, value
    names = {name.removesuffix("?") for name in shape}
    for name, entry in shape.items():
        key = name.removesuffix("?")
        if key == "*":
            rest = [(k, v) for k, v in value.items() if k not in names]
        elif key in value:
            rest = [(key, value[key])]
        elif name.endswith("?"):
            continue
        else:
            return f"{place}.{key}", entry, "nothing"
        for k, v in rest:
            found = _first_wrong(v, entry, f"{place}.{k}")
            if found is not None:
                return found
    return None


def _is(value: Any, kind: Any) -> bool:
    if kind is object:
        return True
    if kind is None:
        return value is None
    if isinstance(value, bool):
        return kind is bool
    if kind is int:
        return isinstance(value, int) and 0 <= value < 1 << 63
    if kind is float:
        return isinstance(value, int | float) and abs(value) < 1e300 and math.isfinite(value)
    return isinstance(value, kind)


def _named(shape: Shape) -> str:
    if isinstance(shape, tuple):
        return " or ".join(_named(one) for one in shape)
    if isinstance(shape, Mapping):
        return "an object"
    return "a list" if isinstance(shape, list) else _KINDS.get(shape, str(shape))


def _shown(value: Any) -> str:
    if isinstance(value, dict | list):
        return "an object" if isinstance(value, dict) else "a list"
    try:
        return repr(value)[:40]
    except ValueError:  # of 4300 digits
        return "a long number"
