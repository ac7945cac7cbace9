"""Read and write ``.splat`` files of antimatter15/splat: 32 bytes per splat, without view-dependent colour.

A record consists of position (3 float32), scales (3 float32, not logarithms), colour and opacity (4 bytes) and rotation
(4 bytes: 128 w + 128, then x, y, z). Large opaque splats come first, because viewers show the file while it loads.
"""

from __future__ import annotations

import os

import numpy as np

from gs2d.contrib.formats.quantised import log_scales_of, logit_of_byte, to_byte
from gs2d.core.atomic_files import atomic_write
from gs2d.core.json_files import read_bytes
from gs2d.core.sh import C0
from gs2d.errors import DataError
from gs2d.io.formats.splat_formats import register_format, register_splat_reader
from gs2d.io.gaussians import Gaussians, Warn, sigmoid, unit_quats

_RECORD = np.dtype([("position", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])


def write_splat(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a ``.splat`` file, atomically, by decreasing importance and with colours of SH degree 0 only."""
    opacity = sigmoid(gaussians.opacity_logits)
    importance = gaussians.log_scales.sum(axis=1, dtype=np.float64) + np.log(np.maximum(opacity, 1e-300))
    order = np.argsort(-importance, kind="stable")
    g = gaussians.rows(order)
    rows = np.empty(len(g), dtype=_RECORD)
    rows["position"] = g.means
    rows["scales"] = np.exp(np.clip(g.log_scales.astype(np.float64), None, 88.0))  # avoids overflow of float32
    rows["rgba"][:, :3] = to_byte(255.0 * (0.5 + C0 * g.sh0.astype(np.float64)))
    rows["rgba"][:, 3] = to_byte(255.0 * opacity[order])
    rows["rotation"] = to_byte(128.0 * unit_quats(g.quats) + 128.0)
    with atomic_write(path) as file:
        file.write(rows.tobytes())


def read_splat(path: str | os.PathLike[str]) -> Gaussians:
    """Read a ``.splat`` file. It has no header, so a DataError reports an incomplete record or invalid values."""
    data = read_bytes(path)
    if len(data) % _RECORD.itemsize:
        raise DataError(
            f"{os.fspath(path)}: expected a .splat file with {_RECORD.itemsize} bytes per splat, got {len(data)} in "
            "total; copy or export the file again"
        )
    rows = np.frombuffer(data, dtype=_RECORD)
    if (rows["scales"] < 0).any():
        raise DataError(f"{os.fspath(path)}: expected positive scales; is it a .splat file?")
    color = rows["rgba"][:, :3].astype(np.float64) / 255.0
    return Gaussians(
        rows["position"].copy(),
        unit_quats((rows["rotation"].astype(np.float64) - 128.0) / 128.0).astype(np.float32),
        log_scales_of(rows["scales"]),
        logit_of_byte(rows["rgba"][:, 3]),
        ((color - 0.5) / C0).astype(np.float32),
        np.zeros((len(rows), 0, 3), np.float32),
    )


register_format("splat", ending=".splat")(lambda path, splats: write_splat(path, Gaussians.of(splats)))


@register_splat_reader("splat", endings=(".splat",))
def _read(path: str | os.PathLike[str], _: Warn) -> tuple[Gaussians, str]:
    return read_splat(path), ".splat"
