"""Read and write OpenUSD: a ParticleField of Gaussian surflets, which are 2D Gaussians (extra ``usd``).

The schema (UsdVol of OpenUSD 26.03) has centres, rotations, linear scales, linear opacities and spherical harmonics in
the order of 3DGS. Log scales and logits are stored in addition, as user properties, so that reading is exact; they are
used if they agree with the schema's values. Surflets ignore the third scale; for programs that read all fields as
ellipsoids, it is a negligible thickness.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.contrib.formats import usd_process
from gs2d.contrib.formats.quantised import log_scales_of
from gs2d.contrib.formats.turned import placed
from gs2d.core.atomic_files import atomic_write, disk_error
from gs2d.core.extras import install
from gs2d.errors import BackendError, DataError
from gs2d.io.formats.splat_formats import register_format, register_splat_reader
from gs2d.io.gaussians import Gaussians, Warn, drawn_bands, logit, sigmoid, unit_quats, with_thickness

ENDINGS = (".usd", ".usdc", ".usda", ".usdz")
_APIS = (
    "PositionAttribute", "OrientationAttribute", "ScaleAttribute", "OpacityAttribute", "KernelGaussianSurflet",
    "SphericalHarmonicsAttribute",
)  # fmt: skip
_OWN = "userProperties:gs2d:"
_ADDRESSES = 3 << 30  # bytes; address space for OpenUSD's libraries and threads
_RATIO = 20  # bytes of address space per byte of the file, beyond ``_ADDRESSES``
_SECONDS, _RATE = 10, 1 << 20  # s of CPU time for any file; bytes per further second
_WAIT = 10  # times the CPU time, as wall time on a busy machine
_AGREE = 2e-6  # tolerance; rounding of exp and log is smaller


def required_usd() -> Any:
    """Import OpenUSD's package pxr, or raise BackendError."""
    try:
        for name in ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdVol", "Vt"):
            importlib.import_module(f"pxr.{name}")
        return importlib.import_module("pxr")
    except ModuleNotFoundError as error:
        raise BackendError(f"OpenUSD needs {error.name}, which is not installed; {install('usd')}") from error


def write_usd(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a binary OpenUSD file, atomically and deterministically, or raise BackendError without OpenUSD.

    The stage states z-up and metres, which is true for georeferenced splats only; coordinates are not changed.
    """
    pxr = required_usd()
    stage = pxr.Usd.Stage.CreateInMemory("splats.usdc")
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    prim = pxr.UsdVol.ParticleField.Define(stage, "/Splats").GetPrim()
    stage.SetDefaultPrim(prim)
    for api in _APIS:
        getattr(pxr.UsdVol, f"ParticleField{api}API").Apply(prim)
    for name, value in _schema_values(pxr, gaussians).items():
        prim.GetAttribute(name).Set(value)
    own = {
        "logScales": ("float2[]", pxr.Vt.Vec2fArray, gaussians.log_scales[:, :2]),
        "opacityLogits": ("float[]", pxr.Vt.FloatArray, gaussians.opacity_logits),
        "quaternions": ("float4[]", pxr.Vt.Vec4fArray, gaussians.quats),
    }
    for name, (kind, array, values) in own.items():
        attribute = prim.CreateAttribute(_OWN + name, pxr.Sdf.ValueTypeNames.Find(kind), custom=True)
        attribute.Set(_vt(array, values))
    stage.GetRootLayer().customLayerData = {"creator": "gs2d"}
    _save(pxr, Path(path), stage.GetRootLayer())


def _vt(kind: Any, values: np.ndarray) -> Any:
    return kind.FromNumpy(np.ascontiguousarray(values, np.float32)) if len(values) else kind()


def _schema_values(pxr: Any, g: Gaussians) -> dict[str, Any]:
    """Return the attributes of the schema, by name."""
    scales = _schema_scales(g.log_scales)
    harmonics = np.concatenate([g.sh0[:, None], g.shN], axis=1).reshape(-1, 3)
    reach = 3.0 * scales.max(axis=1, keepdims=True, initial=0.0)
    low, high = ((g.means + sign * reach).astype(np.float64) for sign in (-1, 1))
    finite = np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1)
    box = np.stack([low[finite].min(axis=0), high[finite].max(axis=0)]) if finite.any() else np.zeros((2, 3))
    return {
        "positions": _vt(pxr.Vt.Vec3fArray, g.means),
        "orientations": _vt(pxr.Vt.QuatfArray, _schema_quats(g.quats)),
        "scales": _vt(pxr.Vt.Vec3fArray, scales),
        "opacities": _vt(pxr.Vt.FloatArray, _schema_opacities(g.opacity_logits)),
        "radiance:sphericalHarmonicsDegree": g.sh_degree,
        "radiance:sphericalHarmonicsCoefficients": _vt(pxr.Vt.Vec3fArray, harmonics),
        "extent": _vt(pxr.Vt.Vec3fArray, box),
    }


def _schema_scales(log_scales: np.ndarray) -> np.ndarray:
    return np.exp(np.clip(log_scales.astype(np.float64), -100.0, 88.0)).astype(np.float32)


def _schema_opacities(logits: np.ndarray) -> np.ndarray:
    return sigmoid(logits).astype(np.float32)


def _schema_quats(quats: np.ndarray) -> np.ndarray:
    """Return unit quaternions (x, y, z, w), the memory layout of USD."""
    return unit_quats(quats)[:, [1, 2, 3, 0]].astype(np.float32)


def _save(pxr: Any, path: Path, layer: Any) -> None:
    """Write a layer to a temporary folder, because OpenUSD requires its own suffixes, and copy it atomically."""
    with tempfile.TemporaryDirectory(prefix="gs2d-usd-") as home:
        temporary = Path(home, "splats.usdc")
        try:
            written = layer.Export(str(temporary))
        except pxr.Tf.ErrorException as error:
            raise disk_error(temporary, OSError(None, " ".join(str(error).split())[:200])) from error
        if not written:
            raise disk_error(temporary, OSError(None, "OpenUSD could not write"))
        with open(temporary, "rb") as source, atomic_write(path) as file:
            while block := source.read(1 << 20):
                file.write(block)


def read_usd(path: str | os.PathLike[str], warn: Warn = warnings.warn) -> tuple[Gaussians, str]:
    """Read all particle fields of an OpenUSD file, in the frame of its stage; also returns their kernels.

    The third scale of surflets is ignored. ``warn`` receives a message if SH bands above degree 3 are dropped. Raises
    DataError if the file is missing, no OpenUSD, or has no such fields, or an unsupported kernel or transform, and
    BackendError if OpenUSD is not installed.
    """
    header, data = _read_isolated(path)
    fields, at = [], 0
    for entry in header["fields"]:
        arrays = {}
        for name, width in entry["arrays"].items():
            size = entry["count"] * width
            arrays[name] = np.frombuffer(data, "<f4", size, at).reshape(entry["count"], width)
            at += 4 * size
        fields.append(_gaussians(path, entry, arrays, warn))
    if not fields:
        raise DataError(f"{os.fspath(path)}: expected a ParticleField, but the stage has none; export splats to it")
    kernels = sorted({entry["kernel"] for entry in header["fields"]})
    return Gaussians.joined(fields), "OpenUSD, " + " and ".join(f"{kernel}s" for kernel in kernels)


def _read_isolated(path: str | os.PathLike[str]) -> tuple[dict[str, Any], memoryview]:
    """Read a file in a separate process; return its header, and the bytes of the arrays."""
    required_usd()
    try:
        size = os.stat(path).st_size
        with open(path, "rb"):
            pass
    except OSError as error:
        raise DataError(f"cannot read {os.fspath(path)}: {error.strerror or error}") from error
    most, seconds = _ADDRESSES + _RATIO * size, _SECONDS + size // _RATE
    try:
        status, output = _read_apart(os.path.abspath(path), most, seconds)
    except subprocess.TimeoutExpired as error:
        raise DataError(
            f"{os.fspath(path)}: reading OpenUSD took more than {error.timeout:.0f} s; do not trust the file"
        ) from error
    line, _, _ = output.partition(b"\n")
    try:
        header = json.loads(line)
    except ValueError:
        raise DataError(
            f"{os.fspath(path)}: expected OpenUSD, but its reader failed (status {status}); copy or "
            "export the file again"
        ) from None
    if "error" in header:
        raise DataError(f"{os.fspath(path)}: {header['error']}")
    data = memoryview(output)[len(line) + 1 :]
    return header, data


def _read_apart(path: str, most: int, seconds: int) -> tuple[int, bytes]:
    """Run ``usd_process`` with limits of address space (bytes) and CPU time (s); returns exit status and stdout."""
    words = [sys.executable, "-P", usd_process.__file__, path, str(most), str(seconds)]
    # One thread, because each needs address space.
    environment = {**os.environ, "PXR_WORK_THREAD_LIMIT": "1", "MALLOC_ARENA_MAX": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(words, capture_output=True, timeout=_WAIT * seconds, env=environment)
    return done.returncode, done.stdout


def _gaussians(
    path: str | os.PathLike[str], entry: dict[str, Any], arrays: dict[str, np.ndarray], warn: Warn
) -> Gaussians:
    """Convert one field, with the defaults of the schema."""
    where, count = f"{path}: {entry['path']}", entry["count"]
    if entry["kernel"] not in ("surflet", "ellipsoid"):
        raise DataError(f"{where}: expected a kernel of Gaussian surflets or ellipsoids, got {entry['kernel']}")
    opacities = arrays.get("opacities", np.ones((count, 1), np.float32))
    if ((opacities < 0) | (opacities > 1)).any():  # NaN is dropped later
        raise DataError(f"{where}: expected opacities from 0 to 1; export the file again")
    scales = arrays.get("scales", np.ones((count, 3), np.float32))
    if (scales < 0).any():
        raise DataError(f"{where}: expected scales >= 0; export the file again")
    quats = arrays.get("orientations", np.tile(np.array([0, 0, 0, 1], np.float32), (count, 1)))
    harmonics = arrays.get("harmonics", np.zeros((count, 3), np.float32))
    harmonics = harmonics.reshape(count, harmonics.shape[1] // 3, 3)
    log_scales = log_scales_of(scales)
    raw = Gaussians(
        arrays.get("positions", np.zeros((0, 3), np.float32)).copy(),
        np.ascontiguousarray(quats[:, [3, 0, 1, 2]]),
        log_scales,
        logit(opacities[:, 0]),
        harmonics[:, 0].copy(),
        drawn_bands(path, harmonics[:, 1:], warn).copy(),
    )
    exact = _exact(raw, scales, opacities[:, 0], quats, arrays)
    if entry["kernel"] == "surflet":
        exact = replace(exact, log_scales=with_thickness(exact.log_scales[:, :2]))
    return _placed(where, exact, np.array(entry["matrix"]))


def _exact(
    g: Gaussians, scales: np.ndarray, opacities: np.ndarray, quats: np.ndarray, own: dict[str, np.ndarray]
) -> Gaussians:
    """Use the exact values of splats whose schema values agree; other programs may have changed them."""
    log_scales, logits, rotations = g.log_scales, g.opacity_logits, g.quats
    with np.errstate(over="ignore", invalid="ignore"):  # invalid values
        if "logScales" in own:
            same = np.isclose(_schema_scales(own["logScales"]), scales[:, :2], rtol=_AGREE, atol=0)
            log_scales = np.concatenate([np.where(same, own["logScales"], log_scales[:, :2]), log_scales[:, 2:]], 1)
        if "opacityLogits" in own:
            same = np.isclose(_schema_opacities(own["opacityLogits"][:, 0]), opacities, rtol=0, atol=_AGREE)
            logits = np.where(same, own["opacityLogits"][:, 0], logits)
        if "quaternions" in own:
            same = np.isclose(_schema_quats(own["quaternions"]), quats, rtol=0, atol=_AGREE).all(axis=1, keepdims=True)
            rotations = np.where(same, own["quaternions"], rotations)
    return Gaussians(g.means, rotations, log_scales, logits, g.sh0, g.shN)


def _placed(where: str, g: Gaussians, matrix: np.ndarray) -> Gaussians:
    """Transform a field to the frame of the stage."""
    if np.array_equal(matrix, np.eye(4)):
        return g
    try:
        return placed(g, matrix)
    except ValueError as error:
        raise DataError(f"{where}: {error}; bake the transform into the splats") from error


register_format("usd", ending=".usd")(lambda path, splats: write_usd(path, Gaussians.of(splats)))


register_splat_reader("usd", endings=ENDINGS)(read_usd)
