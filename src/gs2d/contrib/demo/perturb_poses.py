"""Slightly wrong camera poses, for captures with known true poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from gs2d.core.camera import Camera
from gs2d.core.transforms import camera_extent, common_motion, focus_point, perturb_pose, similarity_motions

TRUTH = "poses_gt.json"  # true poses of the training views, in the layout of transforms_train.json
DEGREES, FRACTION = 0.5, 0.005  # root mean square of rotations, and of translations relative to the distance


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
