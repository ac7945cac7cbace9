"""Generate land to fly over: hills, fields, roads, and a house on every other lot, as triangles.

Triangles are sorted by square ground tiles, so that a camera can query the triangles near its view at a cost that does
not depend on the total. Colour is a procedural function of position, not an image, so its detail does not depend on
distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gs2d.contrib.demo.shapes import merge_vertices
from gs2d.contrib.demo.textures import noise, srgb_to_linear

STEP = 4.0  # m, between ground vertices
TILE = 32.0  # m, side of a triangle list tile; a multiple of the step
LOT = 48.0  # m, side of a lot, including half a road on each side
ROAD = 4.0  # m, half the road width
HILLS = 5.0  # m, standard deviation of the ground's height
DEPTH = 12.0  # m, depth of walls below the ground at the house centre
GROUND, WALL, ROOF = 0, 1, 2
_TEXELS = 512  # samples along a side of a noise tile
_SUN = np.array([-0.45, -0.35, 0.82]) / np.linalg.norm([-0.45, -0.35, 0.82])  # unit, towards the sun


@dataclass(frozen=True, eq=False)
class Land:
    """Triangles of a square of land, z up, in metres.

    Attributes
    ----------
    corners : ndarray [F, 3, 3] float64, m
        Counter-clockwise seen from outside; sorted by tile.
    kind : ndarray [F] uint8
        GROUND, WALL or ROOF.
    tint : ndarray [F, 3] float32
        Linear base colour of the face, without noise.
    starts : ndarray [T * T + 1] int64
        First triangle of each tile, by rows along x.
    low : float, m
        Smallest x and y.
    tiles : int
        T, number of tiles along a side.
    grain : float, m
        Size of the finest pattern: about a pixel's width.
    waves : ndarray [3, 512, 512] float32
        Periodic noise.
    """

    corners: np.ndarray
    kind: np.ndarray
    tint: np.ndarray
    starts: np.ndarray
    low: float
    tiles: int
    grain: float
    waves: np.ndarray

    @cached_property
    def normals(self) -> np.ndarray:
        """Return unit normals [F, 3] of the triangles."""
        a, b, c = (self.corners[:, k] for k in range(3))
        cross = np.cross(b - a, c - a)
        return np.asarray(cross / np.linalg.norm(cross, axis=1, keepdims=True))

    @cached_property
    def heights(self) -> tuple[float, float]:
        """Return the heights of the lowest ground and the highest roof, m."""
        return float(self.corners[self.kind == GROUND][:, :, 2].min()), float(self.corners[:, :, 2].max())

    def near(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return triangle indices [n] of all tiles that overlap a ground rectangle with two corners [2].

        A house belongs to the tile of its centre, which may be a neighbouring tile: callers extend the rectangle by a
        tile.
        """
        first = np.clip(((low - self.low) // TILE).astype(int), 0, self.tiles - 1)
        last = np.clip(((high - self.low) // TILE).astype(int), 0, self.tiles - 1)
        rows = range(first[1], last[1] + 1)
        parts = [
            np.arange(self.starts[row * self.tiles + first[0]], self.starts[row * self.tiles + last[0] + 1])
            for row in rows
        ]
        return np.concatenate(parts)

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices [P, 3] and faces [F, 3] of all triangles; coincident corners are merged."""
        count = len(self.corners)
        return merge_vertices(self.corners.reshape(-1, 3), np.arange(3 * count).reshape(count, 3))


def build_land(side: float, grain: float, seed: int) -> Land:
    """Return a square of land centred at the origin.

    Parameters
    ----------
    side : float, m
        Minimum side; rounded up to a whole number of lots.
    grain : float, m
        See ``Land``.
    seed : int
    """
    rng = np.random.default_rng(seed)
    lots = max(2, int(np.ceil(side / LOT)))
    side, low = lots * LOT, -lots * LOT / 2
    waves = np.stack([noise(rng, _TEXELS, _TEXELS, 3, 90) for _ in range(3)]).astype(np.float32)
    ground = _ground(rng, low, round(side / STEP))
    houses, walls = _houses(rng, ground, low, lots)
    tints = _field_tints(rng, lots)
    faces = _ground_faces(ground, low)
    lot = np.clip(((faces.mean(axis=1)[:, :2] - low) // LOT).astype(int), 0, lots - 1)
    corners = np.concatenate([faces, *houses]) if houses else faces
    kind = np.concatenate([np.zeros(len(faces), np.uint8), *walls]) if houses else np.zeros(len(faces), np.uint8)
    tint = [tints[lot[:, 1], lot[:, 0]]]
    for part in walls:
        colors = _house_tints(rng)
        tint.append(colors[(part == ROOF).astype(int)])
    middles = [faces.mean(axis=1)[:, :2]] + [np.tile(h[:, :, :2].mean(axis=(0, 1)), (len(h), 1)) for h in houses]
    tiles = int(np.ceil(side / TILE))
    tile = np.clip(((np.concatenate(middles) - low) // TILE).astype(int), 0, tiles - 1)
    number = tile[:, 1] * tiles + tile[:, 0]
    order = np.argsort(number, kind="stable")
    starts = np.searchsorted(number[order], np.arange(tiles * tiles + 1))
    colors = srgb_to_linear(np.concatenate(tint)[order]).astype(np.float32)
    return Land(corners[order], kind[order], colors, starts, low, tiles, grain, waves)


def _ground(rng: np.random.Generator, low: float, cells: int) -> np.ndarray:
    """Return ground heights [cells + 1, cells + 1], m, y first: waves of 60 to 700 m."""
    x = low + STEP * np.arange(cells + 1)
    height = np.zeros((cells + 1, cells + 1))
    for _ in range(12):
        length, angle, phase = rng.uniform(60, 700), rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi)
        kx, ky = 2 * np.pi / length * np.array([np.cos(angle), np.sin(angle)])
        height += length / 300 * np.sin(kx * x[None, :] + ky * x[:, None] + phase)
    return np.asarray(HILLS * (height - height.mean()) / height.std())


def _ground_faces(height: np.ndarray, low: float) -> np.ndarray:
    """Return triangles [F, 3, 3] of a height grid."""
    n = len(height)
    x = low + STEP * np.arange(n)
    points = np.stack([*np.broadcast_arrays(x[None, :], x[:, None]), height], axis=-1)  # [y, x, 3]
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    return np.stack([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)], axis=2).reshape(-1, 3, 3)


def _field_tints(rng: np.random.Generator, lots: int) -> np.ndarray:
    """Return field colours [lots, lots, 3] of each lot."""
    kinds = [[0.36, 0.45, 0.22], [0.55, 0.52, 0.30], [0.46, 0.37, 0.27], [0.28, 0.38, 0.20], [0.62, 0.58, 0.50]]
    return np.array(kinds)[rng.integers(len(kinds), size=(lots, lots))] * rng.uniform(0.85, 1.15, (lots, lots, 1))


def _house_tints(rng: np.random.Generator) -> np.ndarray:
    """Return colours [2, 3] of the walls and the roof of a house."""
    walls = np.array([[0.82, 0.78, 0.70], [0.70, 0.52, 0.42], [0.60, 0.62, 0.66], [0.88, 0.84, 0.62]])
    roofs = np.array([[0.58, 0.26, 0.18], [0.34, 0.34, 0.37], [0.48, 0.36, 0.28], [0.22, 0.28, 0.36]])
    return np.stack([walls[rng.integers(4)], roofs[rng.integers(4)]])


def _houses(
    rng: np.random.Generator, height: np.ndarray, low: float, lots: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return triangles [F, 3, 3] of each house and their kind, wall or roof."""
    houses, kinds = [], []
    for row in range(lots):
        for column in range(lots):
            size, rise, turn = rng.uniform(9, 22, 2), rng.uniform(5, 18), rng.uniform(0, np.pi)
            offset, peak = rng.uniform(-8, 8, 2), rng.uniform(2, 6) * (rng.random() < 0.6)
            if rng.random() > 0.75:
                continue
            middle = low + LOT * (np.array([column, row]) + 0.5) + offset
            cell = ((middle - low) / STEP).astype(int)
            faces, kind = _house(size, rise, peak)
            c, s = np.cos(turn), np.sin(turn)
            moved = faces @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
            houses.append(moved + np.append(middle, height[cell[1], cell[0]]))
            kinds.append(kind)
    return houses, kinds


def _house(size: np.ndarray, rise: float, peak: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the walls of a rectangle with a flat roof, or with two slopes along x that rise ``peak`` m above the
    walls.
    """
    x, y = size / 2
    base = np.array([[-x, -y], [x, -y], [x, y], [-x, y]])
    lower, upper = (np.column_stack([base, np.full(4, z)]) for z in (-DEPTH, rise))
    faces: list[list[np.ndarray]] = []
    for k in range(4):
        a, b, c, d = lower[k], lower[(k + 1) % 4], upper[(k + 1) % 4], upper[k]
        faces += [[a, b, c], [a, c, d]]
    ridge = np.array([[-x, 0, rise + peak], [x, 0, rise + peak]])
    if peak > 0:
        faces += [[upper[1], upper[2], ridge[1]], [upper[3], upper[0], ridge[0]]]  # gables
    walls = len(faces)
    if peak > 0:
        faces += [[upper[0], upper[1], ridge[1]], [upper[0], ridge[1], ridge[0]]]
        faces += [[upper[2], upper[3], ridge[0]], [upper[2], ridge[0], ridge[1]]]
    else:
        faces += [[upper[0], upper[1], upper[2]], [upper[0], upper[2], upper[3]]]
    return np.array(faces), np.repeat(np.array([WALL, ROOF], np.uint8), [walls, len(faces) - walls])


def shade(land: Land, face: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return linear colours [n, 3] of points [n, 3] on faces [n]: sky light, sun light, pattern and noise."""
    kind, color = land.kind[face], land.tint[face].copy()
    normal = land.normals[face]
    ground, wall, roof = (np.flatnonzero(kind == k) for k in (GROUND, WALL, ROOF))
    x, y = ((place[ground, k] - land.low) % LOT - LOT / 2 for k in range(2))  # from the lot centre
    on_road = np.maximum(np.abs(x), np.abs(y)) > LOT / 2 - ROAD
    color[ground[on_road]] = 0.16
    across, along = ((LOT / 2 - f(np.abs(x[on_road]), np.abs(y[on_road]))) for f in (np.maximum, np.minimum))
    color[ground[on_road][(across < 0.35) & (along % 6 < 3)]] = 0.62  # dashes along the centre line
    along = np.where(np.abs(normal[wall, 0]) > np.abs(normal[wall, 1]), place[wall, 1], place[wall, 0])
    color[wall[((along % 3) < 1.2) & ((place[wall, 2] % 3) < 1.5)]] *= 0.18  # windows
    color[roof[(place[roof, 2] % 0.8 < 0.2) & (normal[roof, 2] < 0.99)]] *= 0.7  # rows of roof tiles
    light = 0.45 + 0.15 * normal[:, 2] + 0.75 * np.maximum(normal @ _SUN, 0)
    level = 1 + 0.22 * _waves(land, place)
    return np.asarray(color * (light * np.maximum(level, 0.1))[:, None].astype(np.float32))


def _waves(land: Land, place: np.ndarray) -> np.ndarray:
    """Return the sum [n] of noise at three scales; on walls it also varies with height."""
    total = np.zeros(len(place), np.float32)
    slanted = place[:, :2] + place[:, 2:] * (0.37, 0.61)
    for wave, texel in zip(land.waves, land.grain * np.array([0.6, 2.7, 13.0]), strict=True):
        column, row = (slanted / texel).astype(np.int64).T % _TEXELS
        total += wave[row, column]
    return total
