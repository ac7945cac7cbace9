"""Few values for many: the codebooks and the palette of harmonics in SOG, by k-means, the same for the same values."""

from __future__ import annotations

import numpy as np
import torch

_ROUNDS = 12  # of a codebook
_PALETTE_ROUNDS = 5
_LEARNT_FROM = 150_000  # splats, at random, that a palette is made of
_GROUP = 512  # rows of a palette
_DISTANCES = 1 << 20  # at once, 4 MB: they stay in the cache


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
    """Return rows [P, D] and for each of ``rows`` [N, D] the index of a near one: P as PlayCanvas's converter has it.

    P is 1024 times a power of two, about N / 1024 of them and at most 64; all different rows where they are fewer.
    k-means in two steps: groups first, then as many rows of the palette in each group as its members' share. A row is
    looked for in its own group alone, which costs a hundredth of the distances and little nearness.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # thousands of small products: threads that wait for each other cost more than they give
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
    found, labels, before = [], np.empty(len(rows), np.int64), 0
    for own, asked, wanted in zip(members, homes, _shares(np.array([len(own) for own in members]), count), strict=True):
        centers = some[own] if wanted == len(own) else _means(some[own], int(wanted), generator)
        if len(centers):
            labels[asked.numpy()] = before + _nearest(data[asked], centers).numpy()
        found.append(centers)
        before += len(centers)
    return torch.cat(found).numpy(), labels


def _shares(sizes: np.ndarray, count: int) -> np.ndarray:
    """Divide ``count`` among groups by their sizes: one or more to each that has members, and none more than it has."""
    shares = np.maximum(np.floor(count * sizes / sizes.sum()).astype(int), sizes > 0)
    for group in np.argsort(-sizes, kind="stable").tolist():
        shares[group] = min(max(shares[group] + count - shares.sum(), 1), sizes[group]) if sizes[group] else 0
    return np.asarray(shares)


def _split(label: torch.Tensor, count: int) -> tuple[torch.Tensor, ...]:
    """Return the places of each label."""
    return torch.argsort(label, stable=True).split(torch.bincount(label, minlength=count).tolist())


def _means(rows: torch.Tensor, count: int, generator: np.random.Generator) -> torch.Tensor:
    """Return ``count`` means [count, D] of rows that are all different: k-means from rows at random."""
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
    room = torch.empty(min(at_once, len(rows)), len(centers))  # taken once: fresh pages cost as much as the products
    return torch.cat(
        [
            torch.addmm(half, chunk, centers.T, alpha=-1, out=room[: len(chunk)]).argmin(dim=1)
            for chunk in rows.split(at_once)
        ]
    )
