"""Votes of lines of sight for tetrahedra inside and outside the surface.

A line from a camera to a point that it sees crosses facets in free space: a surface there costs the weight of the line,
but little close to the point, whose depth is uncertain (soft visibility of Labatut et al. 2009). The tetrahedron one
sigma behind the point is inside, that of the camera outside. Lines to the sky vote for free space alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gs2d.kernels.library import Library
from gs2d.kernels.native_tetrahedra import votes_on_cpu
from gs2d.meshing.tetrahedra import FACES, Tetrahedra

UNIT = 128  # whole-number weight of a line with weight 1
STEPS = 1 << 20  # of a walk, which rounding could let run in circles
PARALLEL = -1e-12  # cosine between line and facet above which the line does not cross the facet


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines from points to cameras.

    Attributes
    ----------
    ends : ndarray [L] int32
        Points, as rows of ``Tetrahedra.xyz``.
    starts : ndarray [L, 3] float64, world units
        Camera centres.
    sigma : ndarray [L] float64, world units
        Uncertainty of the points along the lines.
    weights : ndarray [L] float
    surfaces : int
        The first lines end on a surface, the others in free space.
    """

    ends: np.ndarray
    starts: np.ndarray
    sigma: np.ndarray
    weights: np.ndarray
    surfaces: int


@dataclass(frozen=True, eq=False)
class Votes:
    """Sums of the lines, in units of 1 / ``UNIT``.

    Attributes
    ----------
    facets : ndarray [T, 4] int32
        Cost of a facet with its tetrahedron outside and the neighbour inside.
    full : ndarray [T] int32
        Cost of a tetrahedron outside.
    cameras : ndarray [T] uint8
        1 where a line starts.
    """

    facets: np.ndarray
    full: np.ndarray
    cameras: np.ndarray


def cast_votes(space: Tetrahedra, lines: Lines, library: Library | None) -> Votes:
    """Return the votes of all lines, by the native library or in numpy."""
    count = len(space.corners)
    votes = Votes(np.zeros((count, 4), np.int32), np.zeros(count, np.int32), np.zeros(count, np.uint8))
    order = np.argsort(lines.ends[: lines.surfaces], kind="stable")  # neighbours walk through the same memory
    order = np.concatenate([order, np.arange(lines.surfaces, len(lines.ends))])
    ends, starts = np.ascontiguousarray(lines.ends[order], np.int32), np.ascontiguousarray(lines.starts[order])
    sigma, weight = lines.sigma[order].astype(np.float64), np.rint(UNIT * lines.weights[order]).astype(np.int32)
    if library is None:
        _vote(space, Lines(ends, starts, sigma, weight, lines.surfaces), votes)
        return votes
    arrays = {"xyz": space.xyz, "corners": space.corners, "neighbours": space.neighbours, "mirror": space.mirror}
    arrays |= {"first": space.first(), "ends": ends, "starts": starts, "sigma": sigma, "weight": weight}
    arrays |= {"facets": votes.facets, "full": votes.full, "cameras": votes.cameras}
    votes_on_cpu(library, arrays, lines.surfaces)
    return votes


def _vote(space: Tetrahedra, lines: Lines, votes: Votes) -> None:
    away = lines.starts - space.xyz[lines.ends]
    length = np.linalg.norm(away, axis=1)
    away /= length[:, None]
    walk = _Walk(space, lines.ends, away)
    while len(rows := np.flatnonzero(walk.alive & (walk.distance < length))):
        at, out = walk.at[rows], walk.out[rows]
        soft = 1 - np.exp(-0.5 * (walk.distance[rows] / lines.sigma[rows]) ** 2)
        amount = np.floor(lines.weights[rows] * soft + 0.5).astype(np.int32)
        inner = space.neighbours[at, out] >= 0
        np.add.at(votes.facets, (space.neighbours[at, out][inner], space.mirror[at, out][inner]), amount[inner])
        walk.step(rows)
    votes.cameras[walk.at[walk.alive]] = 1
    ends = slice(lines.surfaces)
    behind = _Walk(space, lines.ends[ends], -away[ends])
    begun = behind.alive.copy()
    while len(rows := np.flatnonzero(behind.alive & (behind.distance < lines.sigma[ends]))):
        behind.step(rows)
    np.add.at(votes.full, behind.at[begun], lines.weights[ends][begun])


class _Walk:
    """Straight walks through the tetrahedra from corners of them, all at once.

    Attributes
    ----------
    at, out : ndarray [L] int
        Tetrahedron, and its facet through which the line leaves.
    distance : ndarray [L] float64, world units
        From the corner to that facet.
    alive : ndarray [L] bool
        False where a line left the space.
    """

    def __init__(self, space: Tetrahedra, ends: np.ndarray, directions: np.ndarray) -> None:
        self._space, self._directions, self._origins = space, directions, space.xyz[ends]
        self.at = space.first()[ends].astype(np.int64)
        self.out = np.zeros(len(ends), np.int64)
        self.distance = np.zeros(len(ends))
        self.alive = np.zeros(len(ends), bool)
        looking = np.flatnonzero(self.at >= 0)
        for _ in range(STEPS):
            if not len(looking):
                break
            own = (space.corners[self.at[looking]] == ends[looking][:, None]).argmax(axis=1)
            rates = self._rates(looking)[0]
            rates[np.arange(len(looking)), own] = 0
            worst = rates.argmin(axis=1)
            found = rates[np.arange(len(looking)), worst] >= PARALLEL
            rows = looking[found]
            self.out[rows], self.alive[rows] = own[found], True
            self.distance[rows] = self._leave(rows)[np.arange(len(rows)), own[found]]
            looking, worst = looking[~found], worst[~found]
            self.at[looking] = space.neighbours[self.at[looking], worst]
            looking = looking[self.at[looking] >= 0]

    def step(self, rows: np.ndarray) -> None:
        """Enter the next tetrahedra of some lines."""
        at, out = self.at[rows], self.out[rows]
        entry, following = self._space.mirror[at, out], self._space.neighbours[at, out]
        self.alive[rows[following < 0]] = False
        rows, entry, following = rows[following >= 0], entry[following >= 0], following[following >= 0]
        self.at[rows] = following
        found = self._leave(rows)
        found[np.arange(len(rows)), entry] = np.inf
        self.out[rows] = found.argmin(axis=1)
        nearest = found.min(axis=1)
        self.alive[rows[~np.isfinite(nearest)]] = False
        self.distance[rows] = np.maximum(self.distance[rows], nearest)

    def _rates(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return cosines between lines and inward normals of the facets [R, 4], and heights of the origins [R, 4]."""
        corners = self._space.xyz[self._space.corners[self.at[rows]]]
        rates, heights = np.empty((len(rows), 4)), np.empty((len(rows), 4))
        for k in range(4):
            p, q, r = (corners[:, i] for i in FACES[k])
            normal = np.cross(q - p, r - p)
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            rates[:, k] = (normal * self._directions[rows]).sum(axis=1)
            heights[:, k] = (normal * (self._origins[rows] - p)).sum(axis=1)
        return rates, heights

    def _leave(self, rows: np.ndarray) -> np.ndarray:
        """Return distances [R, 4] at which lines leave through the planes of the facets; infinite if they do not."""
        rates, heights = self._rates(rows)
        return np.where(rates < 0, -heights / np.where(rates < 0, rates, -1), np.inf)
