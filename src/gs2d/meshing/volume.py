"""The fused field: blocks of 8^3 voxels of a grid, and the bound on their memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from gs2d.errors import ProtocolError
from gs2d.meshing.bounds import FusionBounds

BLOCK = 8  # voxels along the side of a block
VOXELS = BLOCK**3
_ALL_OF_LEAST = 16  # all blocks of a scene, in units of the least that one view needs: 5 to 15 were met


@dataclass(frozen=True, eq=False)
class Volume:
    """The fused field. Voxel (i, j, k) of block b is the point ``lower + (8 blocks[b] + (i, j, k)) * voxel``.

    Attributes
    ----------
    limits : FusionLimits
    dims : tuple of 3 ints
        Blocks that the box would hold along x, y, z.
    keys : ndarray [M] int64
        Sorted: (x * dims[1] + y) * dims[2] + z of each block.
    tsdf : ndarray [M, 512] float32
        In units of the truncation, positive towards the cameras; voxels in x, y, z order, z fastest.
    weight : ndarray [M, 512] float32
        0: unknown.
    color, color_weight : ndarray [M, 512, 3] and [M, 512] float32, or None
        0 to 255, from views that saw the voxel near their surface.
    frames : int
        How many depth maps were fused.
    """

    limits: FusionBounds
    dims: tuple[int, int, int]
    keys: np.ndarray
    tsdf: np.ndarray
    weight: np.ndarray
    color: np.ndarray | None
    color_weight: np.ndarray | None
    frames: int

    @property
    def blocks(self) -> np.ndarray:
        """Block coordinates [M, 3] int64."""
        return np.stack(np.unravel_index(self.keys, self.dims), axis=1)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        arrays = (self.keys, self.tsdf, self.weight, self.color, self.color_weight)
        return sum(a.nbytes for a in arrays if a is not None)


def block_bytes(colored: bool) -> int:
    """Bytes of one block in a Volume."""
    return 8 + VOXELS * 4 * (6 if colored else 2)


def invalid_volume(
    limits: FusionBounds, dims: tuple[int, int, int], keys: np.ndarray, *, colored: bool, frames: int
) -> Volume:
    """Blocks of which nothing is known yet."""
    m = len(keys)
    return Volume(
        limits=limits,
        dims=dims,
        keys=keys,
        tsdf=np.zeros((m, VOXELS), np.float32),
        weight=np.zeros((m, VOXELS), np.float32),
        color=np.zeros((m, VOXELS, 3), np.float32) if colored else None,
        color_weight=np.zeros((m, VOXELS), np.float32) if colored else None,
        frames=frames,
    )


def check_truncation(limits: FusionBounds) -> None:
    """Raise ProtocolError for a truncation beyond the box and many voxels: all of it would be near a surface."""
    if not limits.truncation <= max(limits.side, 20 * limits.voxel):
        raise ProtocolError(
            f"a truncation of at most the side of the box, {limits.side:.4g} world units, was expected, "
            f"got {limits.truncation:.4g}; leave it out, or give a larger bbox"
        )


def block_grid(limits: FusionBounds) -> tuple[int, int, int]:
    """How many blocks the box holds along x, y, z.

    Raises
    ------
    ProtocolError
        If the box is so large that blocks cannot be numbered: the voxel is far too small for it.
    """
    size = np.subtract(limits.upper, limits.lower)
    dims = np.ceil(size / (BLOCK * limits.voxel)) + 1
    if not np.isfinite(dims).all() or np.prod(dims) > 2**60:
        raise ProtocolError(
            f"a voxel that fits the box of {size.max():.4g} world units was expected, got {limits.voxel:.4g}"
        )
    return int(dims[0]), int(dims[1]), int(dims[2])


@dataclass(frozen=True)
class Budget:
    """The bound on memory, and the advice when it is reached."""

    limits: FusionBounds
    max_bytes: int
    side: float | None = None  # world units, of a cube that is made of whole steps of blocks
    step: int = 1  # voxels

    def check(self, blocks: int, colored: bool, *, partial: bool) -> None:
        """Stop when over the bound. While frames still come, count on (keys are small) up to 16 times the bound."""
        need = blocks * block_bytes(colored)
        if need <= self.max_bytes or (partial and need <= 16 * self.max_bytes):
            return
        self._refuse(need, need, "at least " if partial else "")

    def check_least(self, blocks: int, colored: bool) -> None:
        """Stop when blocks that one view alone needs for sure are over the bound: to count them could take for ever.

        The voxel that is named is a guess; where it is still too small, it can be counted.
        """
        need = blocks * block_bytes(colored)
        if need > self.max_bytes:
            self._refuse(need, _ALL_OF_LEAST * need, "at least ")

    def _refuse(self, need: int, expected: int, least: str) -> NoReturn:
        voxel = self.limits.voxel * (expected / self.max_bytes) ** 0.5 * 1.1  # a surface: blocks go with voxel^-2
        if self.side is not None:
            voxel = 1.005 * self.side / (max(1, int(self.side / voxel) // self.step) * self.step)
        raise ProtocolError(
            f"a volume of at most {self.max_bytes / 2**30:.3g} GiB was expected, voxels of {self.limits.voxel:.4g} "
            "world units "
            f"need {least}{need / 2**30:.3g} GiB; use a voxel of about {voxel:.3g} or more, a smaller bbox, or "
            "more memory"
        )
