"""Read the particle fields of an OpenUSD file in a separate process: ``python usd_process.py FILE BYTES SECONDS``.

A malicious file can crash OpenUSD's parser or exhaust the memory, so it is parsed here, with limits of address space
and CPU time. The output is a header (a line of JSON, or ``{"error": ...}``), followed by the arrays that it names,
float32. Nothing of gs2d is imported, so that the process starts quickly.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

_KERNELS = {
    "ParticleFieldKernelGaussianSurfletAPI": "surflet",
    "ParticleFieldKernelGaussianEllipsoidAPI": "ellipsoid",
    "ParticleFieldKernelConstantSurfletAPI": "constant",
}
_ARRAYS = {
    "positions": 3,
    "orientations": 4,
    "scales": 3,
    "opacities": 1,
}  # also as halves, with an h appended
_HARMONICS = "radiance:sphericalHarmonicsCoefficients"
_OWN = "userProperties:gs2d:"  # exact values of training
_OWN_ARRAYS = {"logScales": 2, "opacityLogits": 1, "quaternions": 4}
_OUTSIDE = "expected all content in the file or its folder, but it refers to {}; flatten it into one file"


class _UnfitError(Exception):
    """A problem of the file, as a message."""


def _limit(most: int, seconds: int) -> None:
    """Limit the address space (bytes) and CPU time (s) of this process, if the system supports it."""
    try:
        import resource
    except ModuleNotFoundError:  # Windows
        return
    for kind, value in ((resource.RLIMIT_AS, most), (resource.RLIMIT_CPU, seconds), (resource.RLIMIT_CORE, 0)):
        _, hard = resource.getrlimit(kind)
        resource.setrlimit(kind, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))


def _check_inside(Sdf: Any, root: Any, home: Path) -> None:
    """Raise if the file refers to layers outside its own folder; they are not opened."""
    layers, seen = [root], set()
    while layers:
        layer = layers.pop()
        for asset in layer.GetCompositionAssetDependencies():
            name = layer.ComputeAbsolutePath(asset)
            if name in seen:
                continue
            seen.add(name)
            path = Path(os.path.realpath(name.partition("[")[0]))
            if not (path.is_file() and path.is_relative_to(home)):
                raise _UnfitError(_OUTSIDE.format(repr(asset)))
            dependency = Sdf.Layer.FindOrOpen(name)
            if dependency is not None:
                layers.append(dependency)


def _values(prim: Any, name: str, width: int, when: Any, *, half: bool) -> np.ndarray | None:
    """Return the array [N, width] of an attribute; None if it is not set."""
    for full in (name, name + "h") if half else (name,):
        attribute = prim.GetAttribute(full)
        value = attribute.Get(when) if attribute else None
        if value is None:
            continue
        array = np.asarray(value)
        if array.dtype.kind != "f" or array.size != len(value) * width:
            raise _UnfitError(f"expected {width} numbers per splat as {full}, got {attribute.GetTypeName()}")
        return array.reshape(-1, width).astype(np.float32)
    return None


def _field(prim: Any, when: Any, cache: Any) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Return header and arrays of one particle field. Arrays that are too short are ignored, as in the schema."""
    applied = prim.GetAppliedSchemas()
    kernels = [kernel for api, kernel in _KERNELS.items() if api in applied]
    arrays = {name: _values(prim, name, width, when, half=True) for name, width in _ARRAYS.items()}
    positions = arrays["positions"]
    count = 0 if positions is None else len(positions)
    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree")
    degree = degree.Get() if degree else None
    degree = 3 if degree is None else int(degree)
    if not 0 <= degree <= 8:
        raise _UnfitError(f"expected SH degree 0 to 3, got {degree}; export it with three bands")
    harmonics = _values(prim, _HARMONICS, 3, when, half=True)
    coefficients = (degree + 1) ** 2
    if harmonics is not None and len(harmonics) >= count * coefficients:
        arrays["harmonics"] = harmonics[: count * coefficients].reshape(count, 3 * coefficients)
    arrays |= {name: _values(prim, _OWN + name, width, when, half=False) for name, width in _OWN_ARRAYS.items()}
    complete = {name: array[:count] for name, array in arrays.items() if array is not None and len(array) >= count}
    matrix = np.array(cache.GetLocalToWorldTransform(prim), dtype=np.float64)
    if not np.isfinite(matrix).all():
        raise _UnfitError(f"expected a transform of finite numbers for {prim.GetPath()}")
    entry = {
        "path": str(prim.GetPath()),
        "kernel": kernels[-1] if kernels else "none",
        "count": count,
        "matrix": matrix.T.tolist(),  # USD's vectors are rows
        "arrays": {name: array.shape[1] for name, array in complete.items()},
    }
    return entry, list(complete.values())


def _read(path: str) -> tuple[dict[str, Any], list[np.ndarray]]:
    from pxr import Sdf, Tf, Usd, UsdGeom, UsdUtils, UsdVol

    delegate = UsdUtils.CoalescingDiagnosticDelegate()  # suppresses terminal output
    try:
        root = Sdf.Layer.FindOrOpen(path)
        if root is None:
            raise _UnfitError("expected OpenUSD, but its reader does not recognise the file; copy or export it again")
        _check_inside(Sdf, root, Path(os.path.realpath(path)).parent)
        stage = Usd.Stage.Open(root)
        if stage is None:
            raise _UnfitError("expected OpenUSD, but its stage does not open; copy or export it again")
        when = Usd.TimeCode.EarliestTime()
        cache = UsdGeom.XformCache(when)
        prims = [p for p in stage.Traverse(Usd.TraverseInstanceProxies()) if p.IsA(UsdVol.ParticleField)]
        fields = [_field(prim, when, cache) for prim in prims]
    except Tf.ErrorException as error:
        words = " ".join(str(error).split())[:200]
        raise _UnfitError(f"expected OpenUSD, but its reader reports: {words}; copy or export it again") from error
    finally:
        delegate.TakeUncoalescedDiagnostics()
    header = {"fields": [entry for entry, _ in fields]}
    return header, [array for _, arrays in fields for array in arrays]


def main(path: str, most: str, seconds: str) -> None:
    """Write the result to stdout, and exit."""
    _limit(int(most), int(seconds))
    arrays: list[np.ndarray] = []
    try:
        header, arrays = _read(path)
    except _UnfitError as error:
        header = {"error": str(error)}
    except MemoryError:
        header = {"error": "the splats need more memory than a file of this size may use"}
    sys.stdout.buffer.write(json.dumps(header).encode() + b"\n")
    for array in arrays:
        sys.stdout.buffer.write(np.ascontiguousarray(array, "<f4").data)
    sys.stdout.buffer.flush()
    os._exit(0)  # skips the slow cleanup of OpenUSD


if __name__ == "__main__":
    main(*sys.argv[1:])
