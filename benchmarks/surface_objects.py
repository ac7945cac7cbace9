"""Geometry and materials of the scenes of ``benchmarks/surfaces.py``: procedural, in metres or about one unit high."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import map_coordinates

from gs2d.contrib.demo import shapes, textures
from gs2d.contrib.demo.shapes import Patch

Color = tuple[float, float, float]
Texture = Callable[[np.ndarray, np.ndarray], np.ndarray]  # points [n, 3], uvs [n, 2] -> sRGB colours [n, 3]
_VOLUME = 96  # voxels along each side of a noise volume
CHALK: Color = (0.90, 0.89, 0.87)


# -- materials -----------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Material:
    """How a part reflects light.

    Attributes
    ----------
    texture : callable
        Colour of the diffuse reflection, or of the mirror reflection of a metal.
    metal : bool
        Metals have no diffuse reflection.
    reflectance : float
        Mirror reflection at normal incidence of other materials; 0 is matt.
    roughness : float
        Standard deviation of the facet slopes, about the blur of the reflection in radians.
    """

    texture: Texture
    metal: bool = False
    reflectance: float = 0.0
    roughness: float = 0.3


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a scene.

    Attributes
    ----------
    patch : Patch
    material : Material
    role : str
        "subject" is scored; "support" is true surface next to it, which is not scored; "backdrop" is only photographed.
    """

    patch: Patch
    material: Material
    role: str = "subject"


class Noise:
    """Smooth periodic noise in space, of mean 0 and standard deviation 1.

    ``waves`` are the lowest and highest number of waves per period; one world unit is one period.
    """

    def __init__(self, rng: np.random.Generator, waves: tuple[float, float]) -> None:
        f = np.fft.fftfreq(_VOLUME) * _VOLUME
        radius = np.sqrt(f[:, None, None] ** 2 + f[None, :, None] ** 2 + f[None, None, : _VOLUME // 2 + 1] ** 2)
        spectrum = np.fft.rfftn(rng.standard_normal((_VOLUME,) * 3))
        spectrum *= ((radius >= waves[0]) & (radius <= waves[1])) / np.maximum(radius, 1) ** 1.5
        field = np.fft.irfftn(spectrum, s=(_VOLUME,) * 3, axes=(0, 1, 2))
        self._field = (field / field.std()).astype(np.float32)

    def __call__(self, points: np.ndarray, scale: float = 1.0) -> np.ndarray:
        """Return values [...] at points [..., 3]; ``scale`` multiplies the number of waves per unit."""
        at = np.moveaxis(np.asarray(points) * (scale * _VOLUME), -1, 0)
        return np.asarray(map_coordinates(self._field, at, order=1, mode="grid-wrap"))


def mixed(one: Color, other: Color, amount: np.ndarray) -> np.ndarray:
    """Return colours [n, 3] between two, by an amount [n] that is clipped to [0, 1]."""
    t = np.clip(amount, 0, 1)[:, None]
    return np.asarray((1 - t) * np.array(one) + t * np.array(other))


def plain(color: Color) -> Texture:
    """Return a texture without pattern."""
    return lambda points, uvs: np.broadcast_to(np.array(color), points.shape)


def mottled(noise: Noise, one: Color, other: Color, scale: float, *, contrast: float = 0.5) -> Texture:
    """Return a texture that varies smoothly between two colours."""
    return lambda points, uvs: mixed(one, other, 0.5 + contrast * noise(points, scale))


def speckled(noise: Noise, one: Color, other: Color, scale: float, *, level: float = 0.8) -> Texture:
    """Return a mottled texture with dark and light spots; a higher ``level`` has fewer spots."""

    def texture(points: np.ndarray, _uvs: np.ndarray) -> np.ndarray:
        coarse, fine = noise(points, 0.4 * scale), noise(points + 0.37, scale)
        return mixed(one, other, 0.25 + 0.2 * coarse + 0.9 * (fine > level) - 0.25 * (fine < -level))

    return texture


def planks(noise: Noise, one: Color, other: Color, width: float) -> Texture:
    """Return wooden planks along x with grain and dark joints."""

    def texture(points: np.ndarray, _uvs: np.ndarray) -> np.ndarray:
        row = np.floor(points[:, 1] / width)
        along = points[:, 0] + 0.618 * row
        board = np.sin(12.9898 * row + 78.233 * np.floor(along / (9 * width))) * 43758.5453 % 1
        grain = noise(points * np.array([0.15, 1.5, 1.0]) + row[:, None] * 0.31, 1.5)
        joint = np.minimum(points[:, 1] / width % 1, along / (9 * width) % 1 * 9) < 0.05
        return mixed(one, other, 0.15 + 0.5 * board + 0.22 * grain) * np.where(joint, 0.45, 1.0)[:, None]

    return texture


def slabs(noise: Noise, one: Color, other: Color, size: tuple[float, float]) -> Texture:
    """Return paving or bricks in the plane of x and (y + z), in running bond, with joints."""

    def texture(points: np.ndarray, _uvs: np.ndarray) -> np.ndarray:
        across = points[:, 1] + points[:, 2]
        row = np.floor(across / size[1])
        along = points[:, 0] / size[0] + 0.5 * (row % 2)
        each = np.sin(12.9898 * row + 78.233 * np.floor(along)) * 43758.5453 % 1
        joint = ((across / size[1] % 1) * size[1] < 0.012) | ((along % 1) * size[0] < 0.012)
        amount = 0.1 + 0.6 * each + 0.2 * noise(points, 2.0) + 0.12 * noise(points + 0.4, 0.5)
        return np.where(joint[:, None], np.array((0.62, 0.60, 0.57)), mixed(one, other, amount))

    return texture


def printed(image: np.ndarray) -> Texture:
    """Return the texture of an image [rows, columns, 3], nearest texel at (u, v)."""
    rows, columns = image.shape[:2]

    def texture(_points: np.ndarray, uvs: np.ndarray) -> np.ndarray:
        column = np.clip((uvs[:, 0] * columns).astype(np.int64), 0, columns - 1)
        return np.asarray(image[np.clip((uvs[:, 1] * rows).astype(np.int64), 0, rows - 1), column])

    return texture


def print_sheet(rng: np.random.Generator, *, columns: int = 6, plain_sides: int = 0) -> np.ndarray:
    """Return a printed atlas sRGB [160, columns * 160, 3] for a box: fields, lines of text, emblems."""
    n = 160
    base = rng.uniform(0.25, 0.9, 3)
    sheet = np.empty((n, columns * n, 3))
    sheet[:] = base
    for column in range(columns - plain_sides):
        side = sheet[:, column * n : (column + 1) * n]
        for _ in range(rng.integers(3, 7)):
            (x, y), (w, h) = rng.integers(0, n - 20, 2), rng.integers(12, 90, 2)
            side[y : y + h, x : x + w] = rng.uniform(0.05, 0.95, 3)
        x, y = (np.arange(n) - rng.integers(40, 120) for _ in range(2))
        ring = np.hypot(*np.meshgrid(x, y))
        side[(ring < 26) & (ring % 9 > 4)] = rng.uniform(0, 1, 3)
        ink = rng.uniform(0, 0.3, 3)
        for line in range(rng.integers(3, 8)):
            row, left = 8 + 9 * line + rng.integers(0, 60), rng.integers(5, 60)
            letters = np.repeat(rng.random(40) < 0.6, 2)[: n - left - 5]
            side[row : row + 4, left : left + len(letters)][:, letters] = ink
    return np.clip(sheet * (1 + 0.03 * textures.noise(rng, n, columns * n, 3, 60)[..., None]), 0, 1)


# -- shapes --------------------------------------------------------------------------------------------------------
def star(radius: Callable[[np.ndarray], np.ndarray], *, rows: int, around: int) -> Patch:
    """Return the closed surface radius(d) d over the unit directions d, about the origin."""
    angle = np.linspace(0, 2 * np.pi, around + 1)
    angle[-1] = 0.0
    height = np.linspace(-np.pi / 2, np.pi / 2, rows)
    a, h = np.meshgrid(angle, height, indexing="ij")
    flat = np.cos(h)
    flat[:, [0, -1]] = 0.0
    d = np.stack([flat * np.cos(a), flat * np.sin(a), np.sin(h)], axis=-1)
    u = np.meshgrid(np.linspace(0, 1, around + 1), np.linspace(0, 1, rows), indexing="ij")
    return shapes.grid(radius(d)[..., None] * d, np.stack(u, axis=-1))


def stretched(patch: Patch, factors: Sequence[float]) -> Patch:
    """Scale a patch along the axes."""
    f = np.asarray(factors, dtype=np.float64)
    normals = patch.normals / f
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    return replace(patch, vertices=patch.vertices * f, normals=normals)


def turned(patch: Patch, axis: int, angle: float) -> Patch:
    """Rotate a patch about a coordinate axis by an angle in radians."""
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    R = np.eye(3)
    R[i, i] = R[j, j] = np.cos(angle)
    R[j, i], R[i, j] = np.sin(angle), -np.sin(angle)
    return replace(patch, vertices=patch.vertices @ R.T, normals=patch.normals @ R.T)


def sheet(corner: Sequence[float], along_u: Sequence[float], along_v: Sequence[float], cell: float) -> Patch:
    """Return a rectangle with cells of about a size; its front is on the side of along_u x along_v."""
    u, v = (np.linspace(0, 1, max(round(np.linalg.norm(edge) / cell), 1) + 1) for edge in (along_u, along_v))
    a, b = np.meshgrid(u, v, indexing="ij")
    points = np.asarray(corner, float) + a[..., None] * np.asarray(along_u) + b[..., None] * np.asarray(along_v)
    return shapes.grid(points, np.stack([a, b], axis=-1))


def block(low: Sequence[float], high: Sequence[float], cell: float = 0.15) -> Patch:
    """Return an axis-aligned box."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
    sides = (
        ((x1, y0, z0), (0, dy, 0), (0, 0, dz)),
        ((x1, y1, z0), (-dx, 0, 0), (0, 0, dz)),
        ((x0, y1, z0), (0, -dy, 0), (0, 0, dz)),
        ((x0, y0, z0), (dx, 0, 0), (0, 0, dz)),
        ((x0, y0, z1), (dx, 0, 0), (0, dy, 0)),
        ((x0, y1, z0), (dx, 0, 0), (0, -dy, 0)),
    )
    return shapes.join([sheet(*side, cell) for side in sides])


def rod(start: Sequence[float], end: Sequence[float], radius: float, *, steps: int = 10, around: int = 8) -> Patch:
    """Return a straight round rod with rounded ends."""
    return shapes.tube(np.linspace(start, end, steps), radius, around=around)


def turned_profile(points: Sequence[tuple[float, float]], *, rows: int = 70, around: int = 80) -> Patch:
    """Return a surface of revolution through (radius, height), bottom first, closed at the axis."""
    knots = np.array(points, dtype=np.float64)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    profile = PchipInterpolator(length, knots)(np.linspace(0, length[-1], rows))  # does not overshoot
    profile[0, 0] = profile[-1, 0] = 0.0
    return shapes.lathe(profile, np.linspace(0, 1, rows), around)


def _bumps(d: np.ndarray, bumps: Sequence[tuple[Sequence[float], float, float]]) -> np.ndarray:
    """Return the sum of bumps (direction, height, sharpness) at unit directions."""
    total = np.zeros(d.shape[:-1])
    for towards, height, sharpness in bumps:
        axis = np.asarray(towards, float) / np.linalg.norm(towards)
        total += height * np.exp(sharpness * (d @ axis - 1))
    return total


def head(rng: np.random.Generator) -> Patch:
    """Return a bust, 1.05 units high on z = 0, that looks along +y: bumpy hair, face, neck, shoulders and foot."""
    curls = Noise(rng, (2, 6))
    face = [
        *[((0.0, 1.0, z), 0.035, 90.0) for z in (0.16, 0.10, 0.04)],
        ((0.0, 1.0, -0.06), 0.075, 110.0),
        *[((side * 0.36, 0.9, 0.27), 0.03, 70.0) for side in (-1, 1)],
        *[((side * 0.33, 0.92, 0.13), -0.035, 80.0) for side in (-1, 1)],
        *[((side * 0.33, 0.92, 0.12), 0.016, 400.0) for side in (-1, 1)],
        *[((side * 0.52, 0.8, -0.15), 0.03, 30.0) for side in (-1, 1)],
        *[((side * 0.09, 0.95, -0.36), 0.022, 260.0) for side in (-1, 1)],
        ((0.0, 0.95, -0.45), 0.024, 200.0),
        ((0.0, 0.85, -0.72), 0.05, 40.0),
        *[((side * 1.0, -0.1, 0.02), 0.055, 120.0) for side in (-1, 1)],
    ]

    def radius(d: np.ndarray) -> np.ndarray:
        shape = 1 / np.sqrt((d[..., 0] / 0.205) ** 2 + (d[..., 1] / 0.245) ** 2 + (d[..., 2] / 0.285) ** 2)
        hair = 1 / (1 + np.exp(-30 * np.maximum(d[..., 2] - 0.45 + 0.2 * d[..., 1], -d[..., 1] - 0.15)))
        return np.asarray(
            shape * (1 + 0.5 * _bumps(d, face)) + _bumps(d, face) + hair * (0.02 + 0.011 * curls(0.45 * d))
        )

    bust = turned_profile(
        [
            (0.0, 0.10),
            (0.12, 0.10),
            (0.27, 0.16),
            (0.33, 0.26),
            (0.24, 0.36),
            (0.115, 0.43),
            (0.10, 0.52),
            (0.08, 0.60),
            (0.0, 0.62),
        ]
    )
    foot = turned_profile(
        [(0.0, 0.0), (0.19, 0.0), (0.20, 0.02), (0.17, 0.05), (0.11, 0.08), (0.14, 0.115), (0.0, 0.13)]
    )
    return shapes.join(
        [
            star(radius, rows=130, around=160).moved(offset=(0, 0.03, 0.75)),
            stretched(bust, (1.15, 0.72, 1.0)),
            stretched(foot, (1.0, 0.85, 1.0)),
        ]
    )


def urn(rng: np.random.Generator) -> Patch:
    """Return a fluted, hammered urn with two handles and a lid, 0.95 units high on z = 0."""
    dents = Noise(rng, (2, 5))
    body = turned_profile(
        [
            *[
                (0.0, 0.0),
                (0.17, 0.0),
                (0.18, 0.03),
                (0.10, 0.08),
                (0.08, 0.13),
                (0.20, 0.22),
                (0.31, 0.38),
                (0.33, 0.50),
            ],
            *[
                (0.27, 0.61),
                (0.15, 0.68),
                (0.14, 0.73),
                (0.20, 0.78),
                (0.19, 0.80),
                (0.10, 0.84),
                (0.03, 0.87),
                (0.0, 0.88),
            ],
        ],
        rows=150,
        around=180,
    )
    z, angle = body.vertices[:, 2], np.arctan2(body.vertices[:, 1], body.vertices[:, 0])
    fluted = np.clip((z - 0.17) / 0.05, 0, 1) * np.clip((0.44 - z) / 0.04, 0, 1)
    belly = np.clip((z - 0.47) / 0.03, 0, 1) * np.clip((0.66 - z) / 0.03, 0, 1)
    factor = 1 + 0.035 * fluted * np.cos(18 * angle) + 0.012 * belly * dents(body.vertices, 1.8)
    points = (body.vertices * np.stack([factor, factor, np.ones_like(z)], axis=1)).reshape(181, 150, 3)
    handles = []
    for side in (-1.0, 1.0):
        arc = shapes.smooth_path(
            [[side * x, 0, h] for x, h in ((0.16, 0.71), (0.30, 0.74), (0.40, 0.62), (0.31, 0.47))], 40
        )
        handles.append(shapes.tube(arc, 0.022, around=14))
    knob = shapes.ball(0.045, rows=30, around=40).moved(offset=(0, 0, 0.90))
    return shapes.join([shapes.grid(points, body.uvs.reshape(181, 150, 2)), *handles, knob])


def porcelain() -> tuple[Patch, Patch]:
    """Return a glazed figure (a bird on a foot) with a vase and a bowl, and the blue rings around them."""
    bird = [
        stretched(shapes.ball(0.2, rows=60, around=80), (1.45, 1.0, 1.0)).moved(offset=(0, 0, 0.42)),
        turned(stretched(shapes.ball(0.1, rows=40, around=50), (2.2, 0.8, 0.5)), 1, 0.35).moved(
            offset=(-0.36, 0, 0.50)
        ),
        shapes.ball(0.115, rows=50, around=60).moved(offset=(0.25, 0, 0.66)),
        shapes.tube(shapes.smooth_path([[0.12, 0, 0.45], [0.20, 0, 0.56], [0.25, 0, 0.66]], 20), 0.095, around=40),
        turned(stretched(shapes.ball(0.035, rows=24, around=30), (1.0, 0.8, 2.2)), 1, 1.75).moved(
            offset=(0.38, 0, 0.65)
        ),
        turned_profile(
            [(0, 0), (0.19, 0), (0.20, 0.03), (0.08, 0.08), (0.06, 0.18), (0.14, 0.27), (0.0, 0.30)], rows=70, around=70
        ),
        *[
            turned(stretched(shapes.ball(0.14, rows=40, around=50), (1.5, 0.35, 0.8)), 1, 0.2).moved(
                offset=(-0.06, s * 0.18, 0.44)
            )
            for s in (-1, 1)
        ],
    ]
    outline = np.array(
        [[0.09, 0.0], [0.10, 0.02], [0.17, 0.18], [0.16, 0.32], [0.07, 0.46], [0.06, 0.54], [0.10, 0.60]]
    )
    vase = shapes.vase(outline, wall=0.012, rows=70, around=90).moved(offset=(-0.42, 0.40, 0))
    bowl = shapes.vase(
        np.array([[0.10, 0.0], [0.105, 0.015], [0.20, 0.10], [0.245, 0.17], [0.26, 0.20]]),
        wall=0.012,
        rows=40,
        around=90,
    ).moved(offset=(0.35, 0.42, 0))
    ring = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    circle = np.stack([np.cos(ring), np.sin(ring), np.zeros(90)], axis=1)
    rings = [
        shapes.tube(0.103 * circle + (-0.42, 0.40, 0.605), 0.008, around=8, closed=True),
        shapes.tube(0.257 * circle + (0.35, 0.42, 0.205), 0.008, around=8, closed=True),
        shapes.tube(0.199 * circle + (0, 0, 0.03), 0.008, around=8, closed=True),
    ]
    return shapes.join([*bird, vase, bowl]), shapes.join(rings)


def chair() -> Patch:
    """Return a wire chair with a spindle back and a woven wire seat, 1.05 units high."""
    parts, half = [], 0.26
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    for k, (x, y) in enumerate(corners):
        top = 1.0 if y > 0 else 0.47
        parts.append(
            shapes.tube(
                shapes.smooth_path([[1.15 * x, 1.15 * y, 0], [x, y, 0.45], [x, y * (1 + 0.25 * (top > 0.5)), top]], 24),
                0.017,
                around=12,
            )
        )
        following = corners[(k + 1) % 4]
        parts.append(rod((x, y, 0.45), (*following, 0.45), 0.016, steps=16, around=12))
        parts.append(rod((1.1 * x, 1.1 * y, 0.18), (1.1 * following[0], 1.1 * following[1], 0.18), 0.009, steps=16))
    for t in np.linspace(-half, half, 11)[1:-1]:
        parts.append(rod((t, -half, 0.455), (t, half, 0.455), 0.0055, steps=20))
        parts.append(rod((-half, t, 0.455), (half, t, 0.455), 0.0055, steps=20))
    back = 1.25 * half
    parts.append(
        shapes.tube(
            shapes.smooth_path([[-half, back, 1.0], [0, back + 0.05, 1.05], [half, back, 1.0]], 24), 0.017, around=12
        )
    )
    for t in np.linspace(-half, half, 8)[1:-1]:
        parts.append(
            rod(
                (t, half, 0.45),
                (t, back + 0.04 * (1 - (t / half) ** 2), 1.0 + 0.045 * (1 - (t / half) ** 2)),
                0.007,
                steps=20,
            )
        )
    return shapes.join(parts)


def wheel(radius: float = 0.33, spokes: int = 20) -> Patch:
    """Return an upright spoked wheel in the xz plane, standing on z = 0."""
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    circle = np.stack([np.cos(angle), np.zeros(90), np.sin(angle)], axis=1)
    parts = [
        shapes.tube((radius - 0.022) * circle, 0.022, around=14, closed=True),
        turned(shapes.ball(0.035, stretch=1.6), 0, np.pi / 2),
    ]
    for k in range(spokes):
        a, side = 2 * np.pi * k / spokes, 0.03 * (-1) ** k
        parts.append(
            rod(
                (0.03 * np.cos(a), side, 0.03 * np.sin(a)),
                ((radius - 0.03) * np.cos(a), 0, (radius - 0.03) * np.sin(a)),
                0.0045,
                steps=8,
                around=6,
            )
        )
    return shapes.join(parts).moved(offset=(0, 0, radius))


def trellis(width: float, height: float, gap: float) -> Patch:
    """Return a lattice of diagonal slats in the xz plane."""
    parts = [rod((x, 0, 0), (x, 0, height), 0.014) for x in (-width / 2, width / 2)]
    for slope in (-1, 1):
        for start in np.arange(-height, width, gap):
            x = np.array([start, start + height])
            z = np.array([0.0, height]) if slope > 0 else np.array([height, 0.0])
            t = np.clip(np.array([(0 - x[0]) / height, (width - x[0]) / height]), 0, 1)
            ends = [(x[0] + u * height - width / 2, 0.006 * slope, z[0] + u * (z[1] - z[0])) for u in t]
            if t[1] - t[0] > 0.05:
                parts.append(rod(ends[0], ends[1], 0.007, steps=12, around=6))
    return shapes.join(parts)


def rock(rng: np.random.Generator, size: float, *, rows: int, around: int) -> Patch:
    """Return a rough boulder about the origin."""
    coarse, fine = Noise(rng, (1, 3)), Noise(rng, (3, 16))

    def radius(d: np.ndarray) -> np.ndarray:
        ridge = 1 - np.abs(coarse(0.21 * d + 0.3))
        return np.asarray(
            size * (1 + 0.17 * coarse(0.14 * d) + 0.13 * ridge + 0.030 * fine(0.35 * d) + 0.012 * fine(1.1 * d))
        )

    return stretched(star(radius, rows=rows, around=around), (1.0, 0.85, 0.8))


def plant(rng: np.random.Generator) -> tuple[Patch, Patch, Patch]:
    """Return stems, leaves and pot of a bushy pot plant, 1 unit high on z = 0."""
    outline = np.array([[0.15, 0.0], [0.16, 0.02], [0.20, 0.16], [0.22, 0.26], [0.235, 0.30]])
    pot = shapes.join(
        [
            shapes.vase(outline, wall=0.02, rows=30, around=60),
            shapes.ball(0.2, stretch=0.15, rows=12).moved(offset=(0, 0, 0.25)),
        ]
    )
    stems, leaves = [], []
    for k in range(16):
        angle = 2 * np.pi * (k * 0.618)
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        reach, rise = rng.uniform(0.05, 0.38), rng.uniform(0.3, 0.68)
        path = shapes.smooth_path(
            [
                [0.06 * out[0], 0.06 * out[1], 0.24],
                [*(0.35 * reach * out + 0.03 * out)[:2], 0.3 + 0.5 * rise],
                [*(reach * out)[:2], 0.3 + rise],
            ],
            30,
        )
        stems.append(shapes.tube(path, np.linspace(0.011, 0.006, 30), around=8))
        for j in range(11):
            at = 8 + 2 * j
            tangent = path[min(at + 1, 29)] - path[min(at, 29) - 1]
            tangent /= np.linalg.norm(tangent)
            spin = np.cross(tangent, [np.cos(2.4 * j + k), np.sin(2.4 * j + k), 0.3])
            spin /= np.linalg.norm(spin)
            length = rng.uniform(0.13, 0.22)
            leaves.append(
                shapes.leaf(
                    path[min(at, 29)],
                    0.4 * tangent + 0.9 * spin,
                    tangent + np.array([0, 0, 0.5]),
                    length=length,
                    width=0.45 * length,
                )
            )
    return shapes.join(stems), shapes.join(leaves), pot


def person(rng: np.random.Generator) -> list[Part]:
    """Return a walking person of 1.75 m, standing at the origin and facing a random direction."""
    coat, trousers, skin = (
        tuple(srgb) for srgb in (rng.uniform(0.1, 0.9, 3), rng.uniform(0.05, 0.5, 3), (0.80, 0.62, 0.50))
    )
    stride = rng.uniform(0.1, 0.3)
    legs = [rod((s * stride, s * 0.09, 0.05), (0, s * 0.08, 0.85), 0.075) for s in (-1, 1)]
    arms = [
        shapes.tube(
            shapes.smooth_path([[0, s * 0.22, 1.42], [-s * 0.05, s * 0.27, 1.15], [-s * 0.2, s * 0.24, 0.92]], 12), 0.05
        )
        for s in (-1, 1)
    ]
    body = stretched(shapes.ball(0.33), (0.5, 0.68, 1.1)).moved(offset=(0, 0, 1.18))
    turn, checked = rng.uniform(0, 2 * np.pi), Noise(rng, (3, 9))
    parts = (
        (shapes.join(legs), plain(trousers)),
        (shapes.join([body, *arms]), mottled(checked, coat, tuple(0.6 * c for c in coat), 1.0)),
        (stretched(shapes.ball(0.11), (1, 0.9, 1.25)).moved(offset=(0, 0, 1.62)), plain(skin)),
    )
    return [Part(patch.moved(turn=turn), Material(texture), "backdrop") for patch, texture in parts]
