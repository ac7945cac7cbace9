"""Random exposure gains and slightly wrong camera poses, for captures with known ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from gs2d.core.camera import Camera
from gs2d.core.transforms import camera_extent, common_motion, focus_point, perturb_pose, similarity_motions

GAIN, BALANCE = 1.35, 1.08  # largest gain and largest ratio between channels; their inverses are the smallest
DEGREES, FRACTION = 0.5, 0.005  # root mean square of rotations, and of translations relative to the distance


def random_gains(count: int, seed: int, *, gain: float = GAIN, balance: float = BALANCE) -> np.ndarray:
    """Return gains of the three channels of ``count`` images [count, 3]; the mean of each channel is 1.

    The logarithms of gain and balance are uniform. Gains apply to sRGB values, which is exact for a power-law camera
    response.
    """
    rng = np.random.default_rng([seed, 2])
    logs = np.log(gain) * rng.uniform(-1, 1, (count, 1)) + np.log(balance) * rng.uniform(-1, 1, (count, 3))
    gains = np.exp(logs)
    return np.asarray(gains / gains.mean(axis=0))


def with_gains(image: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Multiply an image uint8 [H, W, 3 or 4] by gains [3], clipped at 255; alpha is unchanged."""
    changed = image.copy()
    changed[..., :3] = np.rint(np.minimum(image[..., :3] * gains, 255))
    return changed


def disturbed(
    cameras: Sequence[Camera], seed: int, *, degrees: float = DEGREES, fraction: float = FRACTION
) -> list[Camera]:
    """Return the cameras after small random motions, normally distributed.

    The motion of a similarity of the whole scene is removed, because images do not determine it: refined poses are then
    comparable with the true ones.
    """
    rng, views = np.random.default_rng([seed, 3]), len(cameras)
    extent = camera_extent(cameras) or 1.0
    middle = focus_point(cameras)
    distance = np.array([np.linalg.norm(camera.center - middle) for camera in cameras])[:, None]
    noise = rng.normal(size=(views, 6)) / np.sqrt(3)
    motions = np.concatenate([noise[:, :3] * np.radians(degrees), noise[:, 3:] * fraction * distance / extent], axis=1)
    J = similarity_motions(np.stack([camera.T_cam_world for camera in cameras]), extent)
    motions -= J @ common_motion(motions, J)
    motions[:, 3:] *= extent
    return [perturb_pose(camera, torch.from_numpy(motion)) for camera, motion in zip(cameras, motions, strict=True)]
