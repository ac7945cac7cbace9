"""Choose image pairs to match if all pairs would be too many. Uses numpy and scipy only."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

WORDS = 64
_ROUNDS = 10  # of k-means
_SAMPLES = 30_000  # descriptors for k-means


@dataclass(frozen=True)
class Chosen:
    """Pairs to match, with the reasons."""

    pairs: tuple[tuple[int, int], ...]  # i < j, ascending
    reasons: Mapping[str, int]  # number of pairs for each reason; a pair may have several

    def __len__(self) -> int:
        return len(self.pairs)

    def line(self, count: int) -> str:
        """Summarize how many of all pairs of ``count`` images are matched, and why."""
        why = ", ".join(f"{number:,} {reason}" for reason, number in self.reasons.items())
        both = " (some for two reasons)" if sum(self.reasons.values()) > len(self.pairs) else ""
        return f"{len(self.pairs):,} of {count * (count - 1) // 2:,} pairs of photographs are matched: {why}{both}"


def chosen(reasons: Mapping[str, set[tuple[int, int]]]) -> Chosen:
    """Return the union of sets of pairs, by reason."""
    pairs = sorted(set().union(*reasons.values()))
    return Chosen(tuple(pairs), {reason: len(some) for reason, some in reasons.items() if some})


def neighbour_pairs(count: int, overlap: int) -> set[tuple[int, int]]:
    """Return pairs (i < j) of each image with the next ``overlap`` ones, and with those 2^k images later.

    The distant ones (k < overlap) bridge blurred frames, as COLMAP's quadratic overlap does.
    """
    steps = {*range(1, overlap + 1), *(1 << k for k in range(overlap))}
    return {(i, i + step) for i in range(count) for step in steps if i + step < count}


def near_pairs(positions: Sequence[Sequence[float] | None], neighbours: int) -> set[tuple[int, int]]:
    """Return pairs (i < j) of each image with the spatially nearest ones.

    ``positions`` [3]: metres; None if unknown. ``neighbours``: number of nearest images to pair each image with.
    """
    known = [i for i, position in enumerate(positions) if position is not None]
    if len(known) < 2:
        return set()
    at = np.array([positions[i] for i in known], dtype=float)
    count = min(neighbours, len(known) - 1)
    _, found = cKDTree(at).query(at, k=count + 1)
    pairs = set()
    for row, others in enumerate(np.atleast_2d(found)):  # with equal positions, the image itself need not be first
        for other in [j for j in others if j != row][:count]:
            pairs.add((known[min(row, other)], known[max(row, other)]))
    return pairs


def similar_pairs(
    read: Callable[[int], np.ndarray], count: int, *, neighbours: int | Sequence[int], seed: int = 0
) -> set[tuple[int, int]]:
    """Return pairs (i < j) of each image with the most similar ones.

    Each image becomes one vector: sums of the residuals of its SIFT descriptors to ``WORDS`` cluster centres,
    normalised per centre and as a whole (VLAD with intra-normalisation: Jegou et al. 2010, Arandjelovic and
    Zisserman 2013). The cluster centres are computed from the images, so nothing is downloaded.

    ``read``: returns the descriptors [M, 128] of an image; called twice for each. ``neighbours``: number of similar
    images to pair each image with, for all or for each.
    """
    each_of = [neighbours] * count if isinstance(neighbours, int) else neighbours
    rng = np.random.default_rng(seed)
    each = max(1, _SAMPLES // max(count, 1))
    chosen = [_sample(read(i), each, rng) for i in range(count)]
    samples = np.concatenate(chosen) if chosen else np.empty((0, 128), np.float32)
    if len(samples) < WORDS:
        return set()
    words = _cluster(samples, rng)
    vectors = np.stack([_vlad(read(i).astype(np.float32), words) for i in range(count)])
    return _nearest((vectors[i : i + 256] @ vectors.T for i in range(0, count, 256)), each_of)


def _sample(descriptors: np.ndarray, most: int, rng: np.random.Generator) -> np.ndarray:
    rows = rng.permutation(len(descriptors))[:most]
    return np.asarray(descriptors[np.sort(rows)], dtype=np.float32)


def _cluster(samples: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return centres [WORDS, 128] by Lloyd's algorithm from random samples; an empty cluster keeps its centre."""
    words = samples[rng.choice(len(samples), WORDS, replace=False)]
    for _ in range(_ROUNDS):
        nearest = _nearest_word(samples, words)
        counts = np.bincount(nearest, minlength=WORDS)
        sums = np.zeros_like(words)
        np.add.at(sums, nearest, samples)
        words = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], words).astype(np.float32)
    return words


def _nearest_word(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    return np.asarray(((words**2).sum(axis=1) - 2 * descriptors @ words.T).argmin(axis=1))


def _vlad(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Return the VLAD vector [WORDS * 128], of unit length (zero without descriptors)."""
    vector = np.zeros_like(words, dtype=np.float32)
    if len(descriptors):
        nearest = _nearest_word(descriptors, words)
        np.add.at(vector, nearest, descriptors - words[nearest])
        vector /= np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-12)
    flat = vector.ravel()
    return np.asarray(flat / max(float(np.linalg.norm(flat)), 1e-12))


def _nearest(blocks: Iterable[np.ndarray], neighbours: Sequence[int]) -> set[tuple[int, int]]:
    pairs = set()
    row = 0
    for block in blocks:
        for similarity in block:
            order = np.argsort(-similarity, kind="stable")
            best = [int(j) for j in order[: neighbours[row] + 1] if j != row][: neighbours[row]]
            pairs |= {(min(row, j), max(row, j)) for j in best}
            row += 1
    return pairs
