"""Procedural textures of the demo scene: printed, tiled and mottled, so that colour varies faster than geometry.

Each is a linear-light float32 image [rows, columns, 3] looked up at (u, v) in [0, 1): u along columns, v along rows.
"""

from __future__ import annotations

import numpy as np

CREAM, COBALT, SKY, OCHRE = (0.80, 0.77, 0.69), (0.09, 0.20, 0.50), (0.45, 0.64, 0.84), (0.88, 0.62, 0.16)
CLAY, SOOT, IVORY, RUST = (0.77, 0.43, 0.24), (0.13, 0.10, 0.10), (0.86, 0.78, 0.64), (0.60, 0.21, 0.13)

# Letters of five columns and seven rows, one string per row.
_LETTERS = {
    "2": "01110 10001 00001 00110 01000 10000 11111",
    "D": "11110 10001 10001 10001 10001 10001 11110",
    "G": "01110 10001 10000 10111 10001 10001 01110",
    "S": "01111 10000 10000 01110 00001 00001 11110",
    "R": "11110 10001 10001 11110 10100 10010 10001",
    "-": "00000 00000 00000 01110 00000 00000 00000",
}


def srgb_to_linear(color: np.ndarray) -> np.ndarray:
    """Convert sRGB to linear light (IEC 61966-2-1)."""
    return np.where(color <= 0.04045, color / 12.92, ((np.maximum(color, 0.04045) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(color: np.ndarray) -> np.ndarray:
    """Convert linear light, clipped to [0, 1], to sRGB (IEC 61966-2-1)."""
    color = np.clip(color, 0, 1)
    return np.where(color <= 0.0031308, 12.92 * color, 1.055 * np.maximum(color, 0.0031308) ** (1 / 2.4) - 0.055)


def noise(
    rng: np.random.Generator, rows: int, columns: int, low: float, high: float, *, aspect: float = 1.0
) -> np.ndarray:
    """Return periodic noise of mean 0 and standard deviation 1, with ``low`` to ``high`` waves per row.

    ``aspect`` is the length of a row divided by that of a column on the surface.
    """
    spectrum = np.fft.rfft2(rng.standard_normal((rows, columns)))
    fy, fx = np.meshgrid(np.fft.fftfreq(rows) * rows, np.fft.rfftfreq(columns) * columns, indexing="ij")
    waves = np.hypot(fx, fy * aspect)
    field = np.fft.irfft2(spectrum * ((waves >= low) & (waves <= high)), s=(rows, columns))
    return np.asarray(field / field.std())


def _paint(image: np.ndarray, where: np.ndarray, color: tuple[float, float, float]) -> None:
    image[where] = color


def _finish(image: np.ndarray, mottle: np.ndarray) -> np.ndarray:
    """Modulate the brightness and convert to linear light."""
    return srgb_to_linear(np.clip(image * (1 + mottle[..., None]), 0.02, 0.98)).astype(np.float32)


def tiles(rng: np.random.Generator, *, size: int = 1024, count: int = 8) -> np.ndarray:
    """Return a round floor of glazed tiles with two alternating motifs, inside a ring of terrazzo."""
    t = (np.arange(size) + 0.5) / size
    u, v = np.meshgrid(t, t)
    tile_x, tile_y = np.floor(u * count).astype(int), np.floor(v * count).astype(int)
    x, y = 2 * (u * count - tile_x) - 1, 2 * (v * count - tile_y) - 1  # [-1, 1] within a tile
    image = np.empty((size, size, 3))
    image[:] = CREAM
    odd = (tile_x + tile_y) % 2 == 1
    r, angle = np.hypot(x, y), np.arctan2(y, x)
    corner = np.hypot(1 - np.abs(x), 1 - np.abs(y))

    petal = 0.80 * np.abs(np.cos(2 * angle)) ** 0.6
    _paint(image, ~odd & (r < petal), COBALT)
    _paint(image, ~odd & (r < 0.62 * petal), SKY)
    _paint(image, ~odd & (r < 0.17), OCHRE)
    _paint(image, ~odd & (np.abs(corner - 0.42) < 0.07), COBALT)
    _paint(image, ~odd & (corner < 0.22), OCHRE)

    diamond = np.abs(x) + np.abs(y)
    star = np.minimum(diamond, 1.4 * np.maximum(np.abs(x), np.abs(y)))
    _paint(image, odd & (np.abs(diamond - 0.98) < 0.09), COBALT)
    _paint(image, odd & (star < 0.55), COBALT)
    _paint(image, odd & (star < 0.36), CREAM)
    _paint(image, odd & (r < 0.15), COBALT)
    _paint(image, odd & (np.abs(corner - 0.42) < 0.07), SKY)
    _paint(image, odd & (corner < 0.22), COBALT)
    _paint(image, np.maximum(np.abs(x), np.abs(y)) > 0.965, (0.62, 0.60, 0.56))

    glaze = 0.05 * noise(rng, size, size, 3, 40) + 0.035 * noise(rng, size, size, 60, 160)
    glaze += (rng.normal(0, 0.035, (count, count)))[tile_y, tile_x]
    _terrazzo_ring(image, np.hypot(u - 0.5, v - 0.5) * 2, rng)
    return _finish(image, glaze)


def _terrazzo_ring(image: np.ndarray, radius: np.ndarray, rng: np.random.Generator) -> None:
    size = len(image)
    ring = radius > 0.86
    _paint(image, ring, (0.87, 0.83, 0.77))
    for color, level in (
        ((0.35, 0.33, 0.33), 1.45),
        ((0.74, 0.42, 0.32), 1.5),
        ((0.84, 0.82, 0.78), 1.3),
        (OCHRE, 1.7),
    ):
        _paint(image, ring & (noise(rng, size, size, 30, 75) > level), color)
    _paint(image, ring & (radius < 0.875), COBALT)


def plinth_side(rng: np.random.Generator, *, aspect: float) -> np.ndarray:
    """Return terrazzo for the rim of the plinth (upper half) and its underside (lower half)."""
    rows, columns = 64, 2048
    image = np.empty((rows, columns, 3))
    image[:] = (0.87, 0.83, 0.77)
    for color, level in (((0.35, 0.33, 0.33), 1.45), ((0.74, 0.42, 0.32), 1.5), ((0.84, 0.82, 0.78), 1.3)):
        _paint(image, noise(rng, rows, columns, 90, 230, aspect=aspect) > level, color)
    return _finish(image, 0.04 * noise(rng, rows, columns, 10, 120, aspect=aspect))


def vase(rng: np.random.Generator, *, painted: float = 0.8) -> np.ndarray:
    """Paint a pot: bands, a meander, triangles and dots over mottled clay; rows above ``painted`` are inside."""
    rows, columns = 640, 1024
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows / painted, (np.arange(columns) + 0.5) / columns, indexing="ij")
    image = np.empty((rows, columns, 3))
    image[:] = CLAY

    def band(low: float, high: float) -> np.ndarray:
        return np.asarray((v >= low) & (v < high))

    def across(low: float, high: float) -> np.ndarray:
        return np.asarray((v - low) / (high - low))

    _paint(image, band(0.0, 0.10), SOOT)
    rays = np.abs((u * 28) % 1 - 0.5) * 2
    _paint(image, band(0.10, 0.24) & (rays < 1 - across(0.10, 0.24)), SOOT)
    for low in (0.255, 0.29, 0.475, 0.70, 0.735):
        _paint(image, band(low, low + 0.013), SOOT)
    _paint(image, band(0.31, 0.465), IVORY)
    _paint(image, band(0.31, 0.465) & _meander(u * 18, across(0.31, 0.465)), RUST)
    wave = 0.5 + 0.32 * np.sin(2 * np.pi * 12 * u)
    _paint(image, band(0.50, 0.69) & (np.abs(across(0.50, 0.69) - wave) < 0.10), SOOT)
    dots = np.hypot(((u * 24 + 0.5) % 1 - 0.5) * 0.9, (across(0.50, 0.69) - 1 + wave) * 1.2)
    _paint(image, band(0.50, 0.69) & (dots < 0.17), IVORY)
    _paint(image, band(0.76, 0.86) & (((u * 32).astype(int) + (across(0.76, 0.86) * 3).astype(int)) % 2 == 0), IVORY)
    _paint(image, band(0.76, 0.86) & (((u * 32).astype(int) + (across(0.76, 0.86) * 3).astype(int)) % 2 == 1), SOOT)
    _paint(image, band(0.93, 1.0), SOOT)
    _paint(image, v >= 1.0, (0.52, 0.29, 0.17))
    return _finish(image, 0.06 * noise(rng, rows, columns, 2, 20) + 0.05 * noise(rng, rows, columns, 40, 110))


def _meander(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return a Greek key of period 1 in x, between y = 0 and 1, drawn on a 7 x 7 raster."""
    key = np.array(
        [[int(c) for c in row] for row in ("1111111", "0000000", "1111110", "1000010", "1011010", "1001010", "1111011")]
    )
    return np.asarray(key[np.clip((y * 7).astype(int), 0, 6), ((x % 1) * 7).astype(int)] == 1)


def _write(image: np.ndarray, text: str, *, left: int, top: int, scale: int, color: tuple[float, float, float]) -> None:
    """Draw text into an image whose row 0 is the lower edge; ``top`` counts from the upper edge."""
    for letter in text:
        bitmap = np.array([[c == "1" for c in row] for row in _LETTERS[letter].split()])
        large = np.kron(bitmap, np.ones((scale, scale), dtype=bool))
        upright = image[::-1]
        upright[top : top + 7 * scale, left : left + 5 * scale][large] = color
        left += 6 * scale


def tin(rng: np.random.Generator) -> np.ndarray:
    """Return a printed tea tin: an atlas of six columns (+x, +y, -x, -y, top, bottom)."""
    n = 256
    v, u = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n, indexing="ij")
    front, side, top = np.empty((n, n, 3)), np.empty((n, n, 3)), np.empty((n, n, 3))
    front[:] = side[:] = top[:] = (0.10, 0.38, 0.36)
    for face in (front, side):
        checker = ((u * 16).astype(int) + (v * 16).astype(int)) % 2 == 0
        _paint(face, (v < 0.125) & checker, CREAM)
        _paint(face, (v > 0.875) & checker, OCHRE)
        _paint(face, (np.abs(v - 0.145) < 0.012) | (np.abs(v - 0.855) < 0.012), OCHRE)
    oval = np.hypot((u - 0.5) / 0.49, (v - 0.56) / 0.23)
    _paint(front, oval < 1, CREAM)
    _paint(front, np.abs(oval - 0.9) < 0.025, RUST)
    _write(front, "2DGS-R", left=23, top=91, scale=6, color=SOOT)
    for row in range(3):  # lines of small print
        line = (np.abs(v - 0.29 + 0.05 * row) < 0.012) & (u > 0.15) & (u < 0.85)
        _paint(front, line & (rng.random(64)[(u * 64).astype(int)] < 0.75), CREAM)
    leaf = np.minimum(np.hypot(u - 0.32, v - 0.5), np.hypot(u - 0.68, v - 0.5))
    _paint(side, leaf < 0.42, (0.16, 0.50, 0.44))
    lens = np.maximum(np.hypot(u - 0.32, v - 0.5), np.hypot(u - 0.68, v - 0.5))
    _paint(side, lens < 0.40, CREAM)
    _paint(side, (lens < 0.37) & (np.sin(70 * (v + np.abs(u - 0.5))) > 0.1), RUST)
    ring = np.hypot(u - 0.5, v - 0.5)
    _paint(top, np.sin(60 * ring) > 0.2, OCHRE)
    _paint(top, ring < 0.2, CREAM)
    atlas = np.concatenate([side, side, front, front, top, top], axis=1)
    return _finish(atlas, 0.04 * noise(rng, n, 6 * n, 6, 60))


def speckled(
    rng: np.random.Generator,
    color: tuple[float, float, float],
    spots: tuple[float, float, float],
    *,
    level: float = 1.5,
    mottle: float = 0.05,
) -> np.ndarray:
    """Return a plain colour with fine spots and mottle; a higher ``level`` has fewer spots."""
    image = np.empty((256, 512, 3))
    image[:] = color
    _paint(image, noise(rng, 256, 512, 20, 50) > level, spots)
    return _finish(image, mottle * noise(rng, 256, 512, 3, 14))


def foliage(rng: np.random.Generator) -> np.ndarray:
    """Return a leaf with a pale midrib and side veins: u along the leaf, v across."""
    v, u = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(128) + 0.5) / 128, indexing="ij")
    image = np.empty((64, 128, 3))
    image[:] = (0.22, 0.42, 0.20)
    veins = np.abs((u * 7 - 2.2 * np.abs(v - 0.5)) % 1 - 0.5) < 0.09
    _paint(image, veins, (0.38, 0.56, 0.28))
    _paint(image, np.abs(v - 0.5) < 0.07, (0.66, 0.74, 0.44))
    return _finish(image, 0.06 * noise(rng, 64, 128, 2, 20))
