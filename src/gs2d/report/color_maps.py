"""Colour images of normals, depths, errors and high-error splats."""

from __future__ import annotations

import numpy as np

from gs2d.core.checks import check_shapes

ERROR_TOP = 0.2  # mean absolute error at the end of the scale, for colours in [0, 1]
HIGHLIGHT = (0.93, 0.11, 0.62)  # colour of high-error splats
HATCH, HATCHED = 6, (0.9, 0.9, 0.92)  # width of the stripes of invalid pixels in px, and the lighter colour
IGNORED = (0.82, 0.82, 0.84)  # colour of masked pixels

_ERROR_SCALE = np.array(
    [[0.03, 0.03, 0.09], [0.33, 0.08, 0.42], [0.75, 0.20, 0.38], [0.97, 0.53, 0.22], [1.00, 0.96, 0.72]]
)
_DEPTH_SCALE = np.array(
    [[0.99, 0.91, 0.60], [0.60, 0.81, 0.47], [0.16, 0.60, 0.56], [0.17, 0.36, 0.56], [0.19, 0.11, 0.36]]
)


def _scale(anchors: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return colours [..., 3] at positions ``t`` in [0, 1] (clipped) on a piecewise linear scale."""
    position = np.clip(t, 0.0, 1.0)
    knots = np.linspace(0.0, 1.0, len(anchors))
    return np.stack([np.interp(position, knots, anchors[:, k]) for k in range(3)], axis=-1).astype(np.float32)


def error_scale(steps: int) -> np.ndarray:
    """Return the colours of errors from 0 to :data:`ERROR_TOP`, float32 [steps, 3]."""
    return _scale(_ERROR_SCALE, np.linspace(0, 1, steps))


def depth_scale(steps: int) -> np.ndarray:
    """Return the colours of depths from near to far, float32 [steps, 3]."""
    return _scale(_DEPTH_SCALE, np.linspace(0, 1, steps))


def normal_image(normal: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return world normals as colours, (n + 1) / 2, over white, float32 [H, W, 3] in [0, 1].

    ``normal`` [H, W, 3]: normals of any length, as in ``RenderOutput.normal``; zero vectors are white. ``alpha``
    [H, W].
    """
    check_shapes({"normal": (normal, "H W 3"), "alpha": (alpha, "H W")})
    length = np.linalg.norm(normal, axis=2, keepdims=True)
    unit = normal / np.maximum(length, 1e-12)
    cover = np.where(length > 1e-12, np.clip(alpha, 0, 1)[..., None], 0.0)
    return np.asarray(cover * (unit + 1) / 2 + (1 - cover), dtype=np.float32)


def depth_limits(depth: np.ndarray, alpha: np.ndarray) -> tuple[float, float]:
    """Return the 1st and 99th percentile of the depth where alpha is at least 0.5, world units.

    Use the limits of one stage for all stages, so that their images compare. (0, 1) where nothing was hit.
    """
    check_shapes({"depth": (depth, "H W"), "alpha": (alpha, "H W")})
    covered = depth[(alpha >= 0.5) & (depth > 0) & np.isfinite(depth)]
    if not covered.size:
        return 0.0, 1.0
    near, far = (float(value) for value in np.percentile(covered, [1, 99]))
    return near, max(far, near * (1 + 1e-6) + 1e-12)


def depth_image(depth: np.ndarray, alpha: np.ndarray, limits: tuple[float, float] | None = None) -> np.ndarray:
    """Return depth as colours from near (light) to far (dark), over white, float32 [H, W, 3] in [0, 1].

    ``depth`` [H, W] world units: 0 where nothing was hit. ``alpha`` [H, W]. ``limits``: near and far, world units;
    default: :func:`depth_limits` of this image.
    """
    near, far = depth_limits(depth, alpha) if limits is None else limits
    cover = np.where((depth > 0) & np.isfinite(depth), np.clip(alpha, 0, 1), 0.0)[..., None]
    position = np.where(np.isfinite(depth), (depth - near) / (far - near), 0.0)
    return np.asarray(cover * _scale(_DEPTH_SCALE, position) + (1 - cover), dtype=np.float32)


def error_image(color: np.ndarray, photo: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """Return the mean absolute error over channels, from black at 0 to pale yellow at :data:`ERROR_TOP` and above.

    The result is float32 [H, W, 3] in [0, 1]. ``color``, ``photo`` [H, W, 3] in [0, 1]: the rendering is clipped to
    [0, 1]. ``mask`` [H, W] bool: False = this pixel is ignored: it shows grey.
    """
    check_shapes({"photo": (photo, "H W 3"), "color": (color, "H W 3")})
    error = np.abs(np.clip(color, 0, 1) - photo).mean(axis=2)
    image = _scale(_ERROR_SCALE, error / ERROR_TOP)
    if mask is not None:
        check_shapes({"photo": (photo, "H W 3"), "mask": (mask, "H W")})
        image[~mask] = IGNORED
    return image


def valid_image(photo: np.ndarray, valid: np.ndarray | None) -> np.ndarray:
    """Return a photograph with hatching where ``valid`` is False, which undistortion left black.

    ``photo`` [H, W, 3 or 4]: uint8, or floats in [0, 1]; the result has the same type. ``valid`` [H, W] bool: None: all
    pixels are valid.
    """
    if valid is None:
        return photo
    check_shapes({"photo": (photo, "H W C"), "valid": (valid, "H W")})
    rows, columns = np.indices(valid.shape)
    stripes = ((rows + columns) // HATCH % 2 == 0)[..., None]
    opaque = np.where(stripes, (*IGNORED, 1.0), (*HATCHED, 1.0))[..., : photo.shape[2]]
    tones = np.rint(255 * opaque) if photo.dtype == np.uint8 else opaque
    return np.where(valid[..., None], photo, tones.astype(photo.dtype))


def highlight_image(color: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the high-error splats in magenta over a pale grey image, float32 [H, W, 3] in [0, 1].

    ``color`` [H, W, 3] in [0, 1]: the rendering. ``weight`` [H, W] in [0, 1]: sum of their blending weights in each
    pixel.
    """
    check_shapes({"color": (color, "H W 3"), "weight": (weight, "H W")})
    grey = np.clip(color, 0, 1) @ np.array([0.2126, 0.7152, 0.0722])
    base = (0.30 + 0.70 * grey)[..., None]
    fraction = np.clip(weight, 0, 1)[..., None]
    return np.asarray(fraction * np.array(HIGHLIGHT) * (0.55 + 0.45 * base) + (1 - fraction) * base, dtype=np.float32)
