"""Images as arrays: compositing, area filtering, names."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from gs2d.core.checks import check_shapes
from gs2d.errors import ShapeError


def natural_key(name: str) -> tuple[list[str | int], str]:
    """Return a sort key in numeric order: ``frame_2`` before ``frame_10``.

    For pairing files by index. The views of a scene are sorted as text, as in the official loaders, so that every 8th
    is the same view.
    """
    parts: list[str | int] = list(re.split("([0-9]+)", name))  # text, number, text ...
    parts[1::2] = [int(part) for part in parts[1::2]]
    return parts, name


def is_twice_as_wide(width: int, height: int) -> bool:
    """Whether an image has the aspect ratio of an equirectangular panorama, within 1 %."""
    return min(width, height) >= 1 and abs(width / (2 * height) - 1) <= 0.01


def is_number(text: str) -> bool:
    """Whether text consists of 1 to 18 ASCII digits."""
    return re.fullmatch("[0-9]{1,18}", text) is not None


def enlarged(cells: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return a map [S, T] of cells as an image [height, width]."""
    rows, columns = (np.arange(side) * count // side for side, count in zip((height, width), cells.shape, strict=True))
    return np.asarray(cells[rows[:, None], columns])


def at_cells(image: np.ndarray, cells: int) -> np.ndarray:
    """Return the pixels [cells, cells, ...] of an image [H, W, ...] at the centres of the cells."""
    rows, columns = (np.floor((np.arange(cells) + 0.5) / cells * side).astype(int) for side in image.shape[:2])
    return np.asarray(image[rows[:, None], columns])


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Convert float in [0, 1] (clipped) or bool to uint8; uint8 is returned unchanged."""
    image = np.asarray(image)
    if image.dtype == np.uint8:
        return image
    if image.dtype == np.bool_:
        return image.astype(np.uint8) * np.uint8(255)
    if not np.issubdtype(image.dtype, np.floating):
        raise ShapeError(f"image must be uint8, bool or float, got {image.dtype}")
    if np.isnan(image).any():
        raise ShapeError("image must not contain NaN")
    return np.asarray((np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8))


def composite(image: np.ndarray, background: Sequence[float] | np.ndarray) -> np.ndarray:
    """Composite an image with straight alpha over a background: c alpha + (1 - alpha) b.

    The image is uint8 [H, W, 3 or 4], the background 3 floats in [0, 1], the result float32 [H, W, 3] in [0, 1].
    """
    rgb = np.divide(image[:, :, :3], np.float32(255), dtype=np.float32)
    if image.shape[2] == 3:
        return np.asarray(rgb)
    back = np.asarray(background, dtype=np.float32)
    check_shapes({"background": (back, "3")})
    alpha = np.divide(image[:, :, 3:], np.float32(255), dtype=np.float32)
    rgb -= back
    rgb *= alpha
    rgb += back
    return np.asarray(rgb)


_BAND = 1 << 21  # px averaged at a time


def area_downscale(image: np.ndarray, factor: int) -> np.ndarray:
    """Average n x n blocks of pixels, rounded to nearest; leftover rows and columns are cut.

    Images are uint8 [H, W, 3 or 4]. Colour is averaged premultiplied by alpha and stored straight.
    """
    if factor == 1:
        return image
    _block_parts(image, factor)  # raises
    rows = max(1, _BAND // (image.shape[1] * factor)) * factor  # in bands, to bound memory
    whole = image.shape[0] // factor * factor
    return np.concatenate([_area_average(image[y : min(y + rows, whole)], factor) for y in range(0, whole, rows)])


def _area_average(image: np.ndarray, factor: int) -> np.ndarray:
    count = np.uint32(factor * factor)
    if image.shape[2] == 3:
        parts = _block_parts(image, factor)
        wide = np.uint16 if factor <= 16 else np.uint32  # 16^2 (255 + 1/2) < 2^16
        total = parts[0].astype(wide)
        for part in parts[1:]:
            np.add(total, part, out=total)
        np.add(total, wide(count // 2), out=total)
        np.floor_divide(total, wide(count), out=total)
        return total.astype(np.uint8)
    height, width = image.shape[0] // factor, image.shape[1] // factor
    color = np.zeros((height, width, 3), dtype=np.uint64)
    weight = np.zeros((height, width, 1), dtype=np.uint64)
    for part in _block_parts(image, factor):
        alpha = part[..., 3:].astype(np.uint64)
        weight += alpha
        color += part[..., :3] * alpha
    safe = np.maximum(weight, np.uint64(1))
    straight = (color + safe // np.uint64(2)) // safe
    return np.concatenate([straight, (weight + count // 2) // count], axis=2).astype(np.uint8)


def mask_downscale(mask: np.ndarray, factor: int, *, need: float) -> np.ndarray:
    """Reduce bool [H, W] to [H // n, W // n]: True where at least the fraction ``need`` of the block is True."""
    if factor == 1:
        return mask
    fraction = sum(part.astype(np.float64) for part in _block_parts(mask, factor)) / factor**2
    return np.asarray(fraction >= need)


def _block_parts(image: np.ndarray, factor: int) -> list[np.ndarray]:
    """Return n x n views [H // n, W // n, ...], one per position in the blocks."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    if factor < 1 or height < 1 or width < 1:
        raise ShapeError(f"downscale must leave at least one pixel of {image.shape[1]}x{image.shape[0]}, got {factor}")
    h, w = height * factor, width * factor
    return [image[dy:h:factor, dx:w:factor] for dy in range(factor) for dx in range(factor)]
