"""3D Gaussians with three scales, as arrays: the form of splats in the files of other tools."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch

from gs2d.core.sh import MAX_DEGREE, num_coefficients
from gs2d.core.splats import Splats
from gs2d.errors import DataError

Warn = Callable[[str], object]
"""Receives a message about content that a reader dropped or changed."""
FLAT_LOG_SCALE = math.log(1e-6)  # world units; largest thickness of a disk in files with three scales
NO_SCALE = -80.0  # log scale that represents a scale of 0
_SHARE = 0.01  # largest ratio of the thickness of a disk to its smaller scale
THIN = 0.25  # largest ratio of the third scale to the larger of the others for disks, which quantization may thicken
_FLAT = 0.99  # fraction of the Gaussians that must be disks


@dataclass(frozen=True, eq=False)
class Gaussians:
    """Attributes of N Gaussians before activation, float32."""

    means: np.ndarray  # [N, 3] world units
    quats: np.ndarray  # [N, 4]; (w, x, y, z)
    log_scales: np.ndarray  # [N, 3]; logarithms of the standard deviations along the columns of the rotation
    opacity_logits: np.ndarray  # [N]
    sh0: np.ndarray  # [N, 3]
    shN: np.ndarray  # [N, K-1, 3]; higher SH coefficients, by degree, then order

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Highest degree of the coefficients."""
        return round(float(1 + self.shN.shape[1]) ** 0.5) - 1

    @classmethod
    def of(cls, splats: Splats) -> Gaussians:
        """Convert disks to Gaussians; the third scale, along the normal, is from ``with_thickness``."""
        a = {name: tensor.detach().to("cpu", torch.float32).numpy() for name, tensor in splats.items()}
        scales = with_thickness(a["log_scales"])
        return cls(a["means"], a["quats"], scales, a["opacity_logits"], a["sh0"].reshape(-1, 3), a["shN"])

    @classmethod
    def joined(cls, parts: Sequence[Gaussians]) -> Gaussians:
        """Concatenate several sets; lower SH degrees are padded with zeros."""
        count = max(part.shN.shape[1] for part in parts)
        padded = [np.pad(part.shN, ((0, 0), (0, count - part.shN.shape[1]), (0, 0))) for part in parts]
        others = {
            field.name: np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(cls)
            if field.name != "shN"
        }
        return cls(**others, shN=np.concatenate(padded))

    def rows(self, index: np.ndarray) -> Gaussians:
        """Return the Gaussians of an index array or a mask."""
        return Gaussians(*(getattr(self, field.name)[index] for field in fields(self)))

    @property
    def is_flat(self) -> bool:
        """Return whether nearly all are disks with their normals along the third axis."""
        thickest = self.log_scales[:, 2] - self.log_scales[:, :2].max(axis=1, initial=-np.inf)
        return bool((thickest <= math.log(THIN)).mean() >= _FLAT) if len(self) else True

    def to_surfels(self, path: str | os.PathLike[str]) -> Splats:
        """Convert to disks; ``path`` is the file, for the error.

        Raises DataError if they are not flat.
        """
        if not self.is_flat:
            raise DataError(
                f"{os.fspath(path)}: expected flat splats, got 3D Gaussians with three scales; use splats of a gs2d or "
                "2DGS run"
            )
        return self.disks()

    def disks(self) -> Splats:
        """Convert to disks by dropping the third scales."""
        arrays = (self.means, self.quats, self.log_scales[:, :2], self.opacity_logits, self.sh0[:, None, :], self.shN)
        return Splats(*(torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)) for array in arrays))

    def flattened(self) -> Splats:
        """Convert to disks by dropping the smallest scale of each Gaussian; its axis becomes the normal.

        The axes are permuted cyclically, which keeps a rotation: if s_0 is the smallest scale, (t_u, t_v, n) are
        columns (1, 2, 0) of the old rotation, and with s_1 columns (2, 0, 1).
        """
        smallest = self.log_scales.argmin(axis=1)  # [N]
        # Right factors that rotate the third axis to axis 0, 1, 2: by 120 degrees about (1, 1, 1), or not at all.
        turns = np.array([[0.5, 0.5, 0.5, 0.5], [0.5, -0.5, -0.5, -0.5], [1.0, 0.0, 0.0, 0.0]])[smallest]
        (w, x, y, z), (a, b, c, d) = unit_quats(self.quats).T, turns.T
        quats = np.stack(
            [
                w * a - x * b - y * c - z * d,
                w * b + x * a + y * d - z * c,
                w * c - x * d + y * a + z * b,
                w * d + x * c - y * b + z * a,
            ],
            axis=1,
        )
        in_plane = (smallest[:, None] + np.array([1, 2])) % 3
        scales = np.take_along_axis(self.log_scales, in_plane, axis=1)
        arrays = (self.means, quats, scales, self.opacity_logits, self.sh0[:, None, :], self.shN)
        return Splats(*(torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)) for array in arrays))


def with_thickness(log_scales: np.ndarray) -> np.ndarray:
    """Add a third scale to the log scales [N, 2] of disks, for formats of 3D Gaussians; float32 [N, 3].

    The third scale is 1e-6 world units, but at most a hundredth of the smaller scale, so that it is negligible in
    scenes of any size.
    """
    thickness = np.minimum(log_scales.min(axis=1, keepdims=True) + math.log(_SHARE), FLAT_LOG_SCALE)
    return np.concatenate([log_scales, thickness], axis=1).astype(np.float32)


def drawn_bands(path: str | os.PathLike[str], shN: np.ndarray, warn: Warn) -> np.ndarray:
    """Drop SH bands above degree 3 of coefficients [N, K-1, ...]; ``warn`` receives a message about it."""
    if shN.shape[1] < num_coefficients(MAX_DEGREE):
        return shN
    degree = math.isqrt(1 + shN.shape[1]) - 1
    warn(f"{Path(path).name}: SH degree {degree} was reduced to {MAX_DEGREE}, the highest supported")
    return shN[:, : num_coefficients(MAX_DEGREE) - 1]


def unit_quats(quats: np.ndarray) -> np.ndarray:
    """Normalise quaternions [N, 4], float64; zero becomes the identity."""
    q = quats.astype(np.float64)
    length = np.linalg.norm(q, axis=1, keepdims=True)
    return np.where(length > 0, q / np.where(length > 0, length, 1.0), (1.0, 0.0, 0.0, 0.0))


def sigmoid(x: np.ndarray) -> np.ndarray:
    """Return 1 / (1 + exp(-x)), float64, without overflow."""
    return 0.5 + 0.5 * np.tanh(0.5 * x.astype(np.float64))


def logit(opacities: np.ndarray) -> np.ndarray:
    """Return the logits, float32, of opacities; 0 and 1 are moved inside, because their logits are infinite."""
    o = np.clip(opacities.astype(np.float64), 1e-30, 1.0 - 2.0**-25)
    return np.asarray(np.log(o) - np.log1p(-o)).astype(np.float32)
