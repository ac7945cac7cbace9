"""Few values for many: the codebooks and the palette of harmonics in SOG, by k-means, the same for the same values."""

from __future__ import annotations

import numpy as np
import torch

_ROUNDS = 12  # of a codebook
_PALETTE_ROUNDS = 5
_LEARNT_FROM = 150_000  # splats, at random, that a palette is made of
_DISTANCES = 1 << 22  # at once, 16 MB


def codebook(values: np.ndarray, count: int = 256) -> np.ndarray:
    """Return ``count`` sorted numbers near which all values [N] are, float32: k-means on the line."""
    if not len(values):
        return np.zeros(count, np.float32)
    ordered = np.sort(values.astype(np.float64).reshape(-1))
    distinct = np.unique(ordered)
    if len(distinct) <= count:
        return np.concatenate([distinct, np.full(count - len(distinct), distinct[-1])]).astype(np.float32)
    # Half of them by rank, half by distance: what is rare has its place too.
    by_rank = distinct[np.linspace(0, len(distinct) - 1, count // 2).astype(int)]
    by_distance = np.linspace(distinct[0], distinct[-1], count - count // 2)
    centers = np.sort(np.concatenate([by_rank, by_distance]))
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    for _ in range(_ROUNDS):
        ends = np.concatenate([[0], np.searchsorted(ordered, (centers[1:] + centers[:-1]) / 2), [len(ordered)]])
        members = np.diff(ends)
        centers = np.where(members > 0, (sums[ends[1:]] - sums[ends[:-1]]) / np.maximum(members, 1), centers)
        centers.sort()
    return centers.astype(np.float32)


def nearest_code(values: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Return the index of the nearest of sorted numbers, uint8, in the shape of ``values``."""
    codes = codes.astype(np.float64)
    return np.searchsorted((codes[1:] + codes[:-1]) / 2, values.astype(np.float64)).astype(np.uint8)


def palette(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows [P, D] and for each of ``rows`` [N, D] the index of the nearest: P as PlayCanvas's converter has it.

    P is 1024 times a power of two, about N / 1024 of them and at most 64; all rows where they are fewer.
    """
    count = 1024 * min(64, 1 << max(0, int(np.log2(max(len(rows), 1) / 1024)))) if len(rows) >= 1024 else len(rows)
    generator = np.random.default_rng(0)
    if count == len(rows):
        return rows.astype(np.float32), np.arange(len(rows))
    data = torch.from_numpy(np.ascontiguousarray(rows, np.float32))
    some = data[torch.from_numpy(np.sort(generator.permutation(len(rows))[:_LEARNT_FROM]))]
    centers = some[torch.from_numpy(np.sort(generator.permutation(len(some))[:count]))].clone()
    for _ in range(_PALETTE_ROUNDS):
        label = _nearest(some, centers)
        members = torch.zeros(count).index_add_(0, label, torch.ones(len(some)))
        sums = torch.zeros_like(centers).index_add_(0, label, some)
        centers = torch.where(members[:, None] > 0, sums / members.clamp(min=1)[:, None], centers)
    return centers.numpy(), _nearest(data, centers).numpy()


def _nearest(rows: torch.Tensor, centers: torch.Tensor) -> torch.Tensor:
    half = 0.5 * centers.square().sum(dim=1)
    at_once = max(_DISTANCES // len(centers), 1)
    room = torch.empty(at_once, len(centers))  # taken once: fresh pages for every chunk cost as much as the products
    return torch.cat(
        [
            torch.addmm(half, chunk, centers.T, alpha=-1, out=room[: len(chunk)]).argmin(dim=1)
            for chunk in rows.split(at_once)
        ]
    )
