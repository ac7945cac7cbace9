"""Synthetic COLMAP models: cameras on an arc observe random points through a known lens."""

from __future__ import annotations

from typing import Any

import numpy as np

from gs2d.core.camera import look_at

WIDTH, HEIGHT = 640, 480


def synthetic_model(
    pycolmap: Any, model: str, params: tuple[float, ...], *, count: int = 12, points: int = 400, noise: float = 0.3
) -> Any:
    """Return a model with observations through a lens of these parameters, with Gaussian ``noise`` in px."""
    rng = np.random.default_rng(0)
    piece = pycolmap.Reconstruction()
    lens = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=list(params), camera_id=1)
    piece.add_camera_with_trivial_rig(lens)
    xyz = rng.uniform(-1.6, 1.6, (points, 3))  # reaches the image corners
    numbers = [piece.add_point3D(p, pycolmap.Track(), np.zeros(3, np.uint8)) for p in xyz]
    for i, angle in enumerate(np.linspace(0, 2.5, count)):
        eye = np.array([4 * np.cos(angle), 4 * np.sin(angle), 1 + 0.8 * np.sin(3 * angle)])
        T = look_at(eye, np.zeros(3), np.array([0.0, 0.0, 1.0]), width=8, height=8, fx=8.0).T_cam_world
        in_camera = xyz @ T[:3, :3].T + T[:3, 3]
        projected = [(number, lens.img_from_cam(p)) for number, p in zip(numbers, in_camera, strict=True)]
        inside = [(n, at + rng.normal(0, noise, 2)) for n, at in projected if at is not None and (at > 0).all()
                  and (at < (WIDTH, HEIGHT)).all()]  # fmt: skip
        image = pycolmap.Image(name=f"{i:03}.jpg", camera_id=1, image_id=i + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(at) for _, at in inside])
        piece.add_image_with_trivial_frame(image, pycolmap.Rigid3d(T[:3]))
        for index, (number, _) in enumerate(inside):
            piece.add_observation(number, pycolmap.TrackElement(i + 1, index))
    return piece
