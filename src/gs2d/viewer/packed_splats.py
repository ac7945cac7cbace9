"""Splats in the compact form that the page reads: 32 bytes each and up to 48 bytes of spherical harmonics."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from gs2d.core.splats import Splats
from gs2d.errors import DataError
from gs2d.render.types import MAX_SIZE

MAX_SPLATS = 5_000_000  # rows of 2048 texels, 3 per splat: fits a texture of 8192 rows, which any GPU supports
CLIPPED_SHARE = 1e-4  # share of the SH coefficients that is clipped, which makes the steps of the others smaller
CHUNK_ROWS = 1 << 14  # converted at once in 64 bits
CHUNK_BYTES = 1 << 20  # compressed and written at once
ZIP_LEVEL = 6
SPIKE = 0.4  # visible radius of a spike, relative to its distance from the cameras
SIGN_OF_OPACITY = np.uint32(1 << 31)  # in the last word
WORD_BYTES = 32  # per splat, without the SH coefficients above degree 0


@dataclass(frozen=True, eq=False)
class PackedSplats:
    """Splats as the page stores them, the most important ones first."""

    count: int
    degree: int  # SH degree
    scales: list[float]  # [15] value of the 8-bit SH coefficient 127, for each coefficient of degree 1 to 3
    # [N, 8] uint32, per splat: mean relative to the page's origin (3 x float32), log scales (2 x float16), unit
    # quaternion w x y z (4 x int16, 32767 = 1), SH of degree 0 (3 x float16), opacity (float16; negative for spikes).
    words: np.ndarray
    # [N, 16 * texels] int8: other SH coefficients of each splat, as red, green, blue of each coefficient, padded to a
    # multiple of 16 bytes.
    harmonics: np.ndarray

    @property
    def data(self) -> list[memoryview]:
        """Return the bytes of words and harmonics."""
        return [array.reshape(-1).view(np.uint8).data for array in (self.words, self.harmonics)]

    @property
    def metadata(self) -> dict[str, Any]:
        """Return the values that a page needs to read the data."""
        return {"splats": self.count, "degree": self.degree, "texels": sh_texels(self.degree), "scales": self.scales}

    def zipped(self) -> Iterator[bytes]:
        """Yield words and harmonics as a gzip file in pieces."""
        zipper = zlib.compressobj(ZIP_LEVEL, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
        for flat in self.data:
            for start in range(0, len(flat), CHUNK_BYTES):
                yield zipper.compress(flat[start : start + CHUNK_BYTES])
        yield zipper.flush()


def sh_texels(degree: int) -> int:
    """Return the number of texels of 16 bytes for the SH coefficients above degree 0 of a splat."""
    return math.ceil(3 * ((degree + 1) ** 2 - 1) / 16)


@torch.no_grad()
def pack_splats(
    splats: Splats, origin: np.ndarray, degree: int, alpha_min: float, eyes: np.ndarray | None = None
) -> PackedSplats:
    """Pack splats for the page, without invisible ones (not finite, or opacity below ``alpha_min``).

    Raise DataError if more than ``MAX_SPLATS`` are visible. ``origin`` [3] world units: means are stored relative to
    it, which preserves their precision in float32. ``degree``: highest SH degree to store. ``eyes`` [V, 3] world units:
    camera centres. Splats that are too wide for the distance from the cameras, such as needles that point at the
    cameras, are marked as spikes.
    """
    splats = splats.to("cpu")
    rows = _visible_rows(splats, alpha_min)
    count, degree = len(rows), min(degree, splats.sh_degree)
    if count > MAX_SPLATS:
        raise DataError(
            f"Expected at most {MAX_SPLATS:,} splats for a page, got {count:,}. Train with a smaller max_splats."
        )
    scales = _harmonic_scales(splats, rows, degree)
    words = np.zeros((count, WORD_BYTES // 4), np.uint32)
    harmonics = np.zeros((count, 16 * sh_texels(degree)), np.int8)
    for start in range(0, count, CHUNK_ROWS):
        part = splats.rows(rows[start : start + CHUNK_ROWS]).to("cpu", torch.float64)
        target = slice(start, start + len(part))
        _fill_words(words[target], part, origin)
        if eyes is not None:
            words[target, 7] |= np.where(_are_spikes(part, eyes, alpha_min), SIGN_OF_OPACITY, np.uint32(0))
        _fill_harmonics(harmonics[target], part.shN.numpy(), scales, degree)
    return PackedSplats(count, degree, [float(scale) for scale in scales], words, harmonics)


def _visible_rows(splats: Splats, alpha_min: float) -> torch.Tensor:
    """Return the indices of visible splats, sorted by opacity times area: a page may draw only the first ones."""
    if not len(splats):
        return torch.zeros(0, dtype=torch.int64)
    visible = splats.opacity_logits.double().sigmoid() >= alpha_min
    visible &= splats.quats.double().norm(dim=1) > 0
    for _, tensor in splats.items():
        if tensor.numel():
            visible &= tensor.reshape(len(tensor), -1).isfinite().all(dim=1)
    # Rule 23 of the rasterizer, as far as it does not depend on the camera.
    visible &= (splats.means.abs().amax(dim=1) <= MAX_SIZE) & (splats.scales.amax(dim=1) <= MAX_SIZE)
    rows = visible.nonzero().squeeze(1)
    importance = splats.opacity_logits[rows].sigmoid().log() + splats.log_scales[rows].sum(dim=1)
    return rows[importance.argsort(descending=True, stable=True)]


def _fill_words(words: np.ndarray, splats: Splats, origin: np.ndarray) -> None:
    words[:, :3] = (splats.means.numpy() - origin).astype(np.float32).view(np.uint32)
    words[:, 3] = _float16_pairs(splats.log_scales)
    quats = torch.nn.functional.normalize(splats.quats, dim=1).numpy()
    words[:, 4:6] = np.round(quats * 32767).astype(np.int16).view(np.uint32)
    light = torch.cat([splats.sh0.reshape(len(splats), 3), splats.opacities[:, None]], dim=1)
    words[:, 6], words[:, 7] = _float16_pairs(light[:, :2]), _float16_pairs(light[:, 2:])


def _float16_pairs(columns: torch.Tensor) -> np.ndarray:
    """Return two columns as one column of words, each of two float16."""
    limited = columns.clamp(-65000, 65000).numpy().astype(np.float16)
    return np.ascontiguousarray(limited).view(np.uint32)[:, 0]


def _are_spikes(splats: Splats, eyes: np.ndarray, alpha_min: float) -> np.ndarray:
    """Return whether the visible radius of each splat is large for its distance from the nearest cameras."""
    nearby = 1 + len(eyes) // 10  # the tenth nearest of 100: one camera may stand close to a wall
    distance = np.asarray(cKDTree(eyes).query(splats.means.numpy(), k=[nearby])[0])[:, 0]
    widths = (2 * (splats.opacities / alpha_min).clamp(min=1).log()).sqrt() * splats.scales.amax(dim=1)
    return np.asarray(widths.numpy() > SPIKE * distance)


def _harmonic_scales(splats: Splats, rows: torch.Tensor, degree: int) -> np.ndarray:
    """Return the scales [15] of the SH coefficients."""
    scales = np.zeros(15)
    for k in range((degree + 1) ** 2 - 1 if len(rows) else 0):
        used = splats.shN[:, k].index_select(0, rows).double().numpy()
        scales[k] = np.quantile(np.abs(used), 1 - CLIPPED_SHARE)
    return scales


def _fill_harmonics(stored: np.ndarray, shN: np.ndarray, scales: np.ndarray, degree: int) -> None:
    count = (degree + 1) ** 2 - 1
    steps = np.where(scales > 0, scales, 1.0)[:count, None]
    stored[:, : 3 * count] = np.clip(np.round(shN[:, :count] / steps * 127), -127, 127).reshape(len(shN), -1)
