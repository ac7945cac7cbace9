"""Quantize values for SOG by deterministic k-means: codebooks of numbers, and the palette of harmonics."""

from __future__ import annotations

import numpy as np
import torch

_ROUNDS = 12  # k-means iterations of a codebook
_PALETTE_ROUNDS = 5
_LEARNT_FROM = 150_000  # random splats from which a palette is computed
_GROUP = 512  # rows of a palette
_DISTANCES = 1 << 20  # per chunk; 4 MB fit in the cache


def codebook(values: np.ndarray) -> np.ndarray:
    """Return 256 sorted codes, float32, for values [N], by one-dimensional k-means."""
    count = 256
    if not len(values):
        return np.zeros(count, np.float32)
    ordered = np.sort(values.astype(np.float64).reshape(-1))
    distinct = np.unique(ordered)
    if len(distinct) <= count:
        return np.concatenate([distinct, np.full(count - len(distinct), distinct[-1])]).astype(np.float32)
    # Half of the initial codes by rank, half by distance, so that rare values are represented, too.
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
    """Return the indices of the nearest sorted codes, uint8, in the shape of ``values``."""
    codes = codes.astype(np.float64)
    return np.searchsorted((codes[1:] + codes[:-1]) / 2, values.astype(np.float64)).astype(np.uint8)


def palette(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a palette [P, D], and the index of a near palette row for each of ``rows`` [N, D].

    As in PlayCanvas's converter, P is 1024 times the largest power of two up to N / 1024, at most 64; with fewer
    distinct rows, the palette is exact. k-means runs in two steps: groups first, then palette rows in each group in
    proportion to its size. Searching in one group needs a hundredth of the distances and is nearly as accurate.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # many small products are faster without threads
    try:
        return _palette(rows)
    finally:
        torch.set_num_threads(threads)


def _palette(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    count = 1024 * min(64, 1 << int(np.log2(len(rows) / 1024))) if len(rows) >= 1024 else len(rows)
    generator = np.random.default_rng(0)
    rows = np.ascontiguousarray(rows, np.float32)
    learnt = rows[np.sort(generator.permutation(len(rows))[:_LEARNT_FROM])] if len(rows) > _LEARNT_FROM else rows
    learnt, place = np.unique(learnt, axis=0, return_inverse=True)
    if len(learnt) <= count and len(place) == len(rows):
        return learnt, place.reshape(-1)
    count = min(count, len(learnt))
    data, some = torch.from_numpy(rows), torch.from_numpy(learnt)
    groups = _means(some, max(count // _GROUP, 1), generator)
    members, homes = _split(_nearest(some, groups), len(groups)), _split(_nearest(data, groups), len(groups))
    parts, labels, before = [], np.empty(len(rows), np.int64), 0
    shares = _shares(np.array([len(own) for own in members]), count)
    for own, assigned, share in zip(members, homes, shares, strict=True):
        centers = some[own] if share == len(own) else _means(some[own], int(share), generator)
        if len(centers):
            labels[assigned.numpy()] = before + _nearest(data[assigned], centers).numpy()
        parts.append(centers)
        before += len(centers)
    return torch.cat(parts).numpy(), labels


def _shares(sizes: np.ndarray, count: int) -> np.ndarray:
    """Divide ``count`` among groups in proportion to their sizes: at least 1 and at most its size for each group."""
    shares = np.maximum(np.floor(count * sizes / sizes.sum()).astype(int), sizes > 0)
    for group in np.argsort(-sizes, kind="stable").tolist():
        shares[group] = min(max(shares[group] + count - shares.sum(), 1), sizes[group]) if sizes[group] else 0
    return np.asarray(shares)


def _split(label: torch.Tensor, count: int) -> tuple[torch.Tensor, ...]:
    """Return the indices of each label."""
    return torch.argsort(label, stable=True).split(torch.bincount(label, minlength=count).tolist())


def _means(rows: torch.Tensor, count: int, generator: np.random.Generator) -> torch.Tensor:
    """Return ``count`` means [count, D] of distinct rows, by k-means from random rows."""
    centers = rows[torch.from_numpy(np.sort(generator.permutation(len(rows))[:count]))].clone()
    for _ in range(_PALETTE_ROUNDS):
        label = _nearest(rows, centers)
        members = torch.bincount(label, minlength=len(centers)).to(rows.dtype)
        sums = torch.zeros_like(centers).index_add_(0, label, rows)
        centers = torch.where(members[:, None] > 0, sums / members.clamp(min=1)[:, None], centers)
    return centers


def _nearest(rows: torch.Tensor, centers: torch.Tensor) -> torch.Tensor:
    half = 0.5 * centers.square().sum(dim=1)
    at_once = max(_DISTANCES // len(centers), 1)
    room = torch.empty(min(at_once, len(rows)), len(centers))  # allocated once: new pages are slow
    return torch.cat(
        [
            torch.addmm(half, chunk, centers.T, alpha=-1, out=room[: len(chunk)]).argmin(dim=1)
            for chunk in rows.split(at_once)
        ]
    )
