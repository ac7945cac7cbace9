"""Removal of learned residual distortion from decoded images."""

from __future__ import annotations

import numpy as np
import torch

from gs2d.core.camera import Camera
from gs2d.core.residual_lens import sampled, seen_at
from gs2d.data.cache import DecodedImage
from gs2d.data.undistort import undistort_mask


def straightened_image(decoded: DecodedImage, camera: Camera, lens: tuple[float, float]) -> DecodedImage:
    """Return the pinhole image of ``camera``; pixels outside the photograph are black and invalid."""
    sources, within = seen_at(camera, torch.zeros(1), lens)
    positions, inside = sources.numpy(), within.numpy()
    valid = inside if decoded.valid is None else undistort_mask(decoded.valid, positions, need=1.0) & inside
    mask = None if decoded.mask is None else undistort_mask(decoded.mask, positions, need=1.0) & inside
    if mask is None and not valid.all():
        mask = valid
    found = None if decoded.object_mask is None else undistort_mask(decoded.object_mask, positions, need=0.5) & inside
    return DecodedImage(_moved(decoded.image, sources, inside), mask, found, None if valid.all() else valid)


def _moved(image: np.ndarray, sources: torch.Tensor, inside: np.ndarray) -> np.ndarray:
    """Sample an image uint8 [H, W, 3 or 4]: colour premultiplied by alpha, and stored straight."""
    values = torch.from_numpy(np.array(image)).to(torch.float32)
    has_alpha = values.shape[2] == 4
    if has_alpha:
        values[..., :3] *= values[..., 3:] / 255.0
    values = sampled(values, sources).clamp(0, 255)
    if has_alpha:
        values[..., :3] *= 255.0 / values[..., 3:].clamp_min(0.5)  # smaller alpha rounds to 0
    pixels = values.add_(0.5).clamp_(0, 255).to(torch.uint8).contiguous().numpy()
    pixels[~inside] = 0
    return pixels
