"""Depth of shiny surface moves outward to the visual hull."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from gs2d.core.camera import Camera, look_at
from gs2d.meshing.depth_maps import RenderedView
from gs2d.meshing.visual_hull import to_visual_hull

SIZE, CELLS, INSIDE, WALL = 192, 48, 0.95, 9.0


def cameras() -> Iterator[Camera]:
    """Twenty-four cameras around the origin, at a distance of 5."""
    ring = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    for height in (-3.0, 0.0, 3.0):
        for angle in ring + height:
            eye = (5 * np.cos(angle), 5 * np.sin(angle), height)
            yield look_at(np.array(eye), np.zeros(3), np.array([0, 0, 1.0]), width=SIZE, height=SIZE, fx=300.0)


def pixel_rays(camera: Camera) -> np.ndarray:
    """Return the points [SIZE, SIZE, 3] at depth 1 in the frame of a camera."""
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    return np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=-1)


def ball(camera: Camera) -> RenderedView:
    """A view of a ball of radius 1 before a wall; inside its outline, depth is too large."""
    rays = pixel_rays(camera)
    center = camera.T_cam_world[:3, 3]
    a, b = (rays**2).sum(axis=-1), rays @ center
    inner = b**2 - a * (center @ center - 1)
    outline = inner > 0
    dented = b**2 - a * (center @ center - INSIDE**2)
    z = np.where(dented > 0, (b - np.sqrt(np.maximum(dented, 0))) / a, b / a)
    return RenderedView(camera, np.where(outline, z, WALL).astype(np.float32))


def plane_depth(camera: Camera) -> np.ndarray:
    """Return the depth [SIZE, SIZE] of the plane z = 0."""
    down = (pixel_rays(camera) @ camera.rotation)[..., 2]
    return np.where(down < 0, -camera.center[2] / np.minimum(down, -1e-9), 0.0)


def moved_depths(frames: list[RenderedView], shine: int | None) -> list[np.ndarray]:
    """The depth maps of frames after their surface, as shiny as ``shine``, has moved."""
    maps = [None if shine is None else np.full((CELLS, CELLS), shine, np.uint8)] * len(frames)
    return [np.asarray(frame.depth) for frame in to_visual_hull(iter(frames), maps)]


def radii(frame: RenderedView, depth: np.ndarray) -> np.ndarray:
    """Return the distances of the pixels on the ball from its centre."""
    camera = frame.camera
    points = (pixel_rays(camera) * depth[..., None] - camera.T_cam_world[:3, 3]) @ camera.rotation
    return np.linalg.norm(points[depth < WALL], axis=-1)


def test_depths_of_shiny_surface_move_to_the_outlines() -> None:
    frames = [ball(camera) for camera in cameras()]
    for frame, depth in zip(frames, moved_depths(frames, 255), strict=True):
        before, after = radii(frame, np.asarray(frame.depth)), radii(frame, depth)
        assert np.abs(before - 1).mean() > 0.02
        assert np.abs(after - 1).mean() < 0.5 * np.abs(before - 1).mean()
        assert after.max() < 1.04
        np.testing.assert_array_equal(depth == WALL, np.asarray(frame.depth) == WALL)


@pytest.mark.parametrize("shine", [None, 60])
def test_depths_of_matt_surface_stay(shine: int | None) -> None:
    frames = [ball(camera) for camera in cameras()]
    for frame, depth in zip(frames, moved_depths(frames, shine), strict=True):
        np.testing.assert_array_equal(depth, frame.depth)


def test_depths_of_a_shiny_plane_and_invalid_pixels_stay() -> None:
    frames = [RenderedView(camera, plane_depth(camera).astype(np.float32)) for camera in cameras()]
    for frame, depth in zip(frames, moved_depths(frames, 255), strict=True):
        np.testing.assert_array_equal(depth, frame.depth)


def test_the_inside_of_a_bowl_stays() -> None:
    """No outline shows it, and views see past what leaves it."""
    bowl = [RenderedView(camera, far_side(camera)) for camera in cameras() if camera.center[2] > 1]
    for frame, depth in zip(bowl, moved_depths(bowl, 255), strict=True):
        inside = np.asarray(frame.depth) < WALL
        assert inside.mean() > 0.1
        assert np.mean(depth[inside] != np.asarray(frame.depth)[inside]) < 0.01  # some of the rim


def far_side(camera: Camera) -> np.ndarray:
    """Return the depth of the lower half of the ball, seen from inside, before a wall."""
    rays = pixel_rays(camera)
    center = camera.T_cam_world[:3, 3]
    a, b = (rays**2).sum(axis=-1), rays @ center
    z = (b + np.sqrt(np.maximum(b**2 - a * (center @ center - 1), 0))) / a
    height = (rays * z[..., None] - center) @ camera.rotation[:, 2]
    return np.where((b**2 > a * (center @ center - 1)) & (height < 0), z, WALL).astype(np.float32)
