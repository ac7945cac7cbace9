"""Shapes whose colour is a function of position, and ray-cast images of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gs2d.core.camera import Camera, look_at
from gs2d.core.mesh import Mesh
from gs2d.meshing.raycast import cast_camera
from gs2d.meshing.texture import Atlas, ColorSource, ColorSources

Paint = Callable[[np.ndarray], np.ndarray]  # points [n, 3] to colours [n, 3] in [0, 1]


def grid_plane(n: int = 8, side: float = 2.0, z: float = 0.0) -> Mesh:
    """Return a square of 2 n^2 triangles perpendicular to z, counter-clockwise as seen from +z."""
    ticks = np.linspace(-side / 2, side / 2, n + 1)
    x, y = np.meshgrid(ticks, ticks, indexing="xy")
    vertices = np.stack([x, y, np.full_like(x, z)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="xy")
    a = (j * (n + 1) + i).reshape(-1)
    faces = np.concatenate([np.stack([a, a + 1, a + n + 2], 1), np.stack([a, a + n + 2, a + n + 1], 1)])
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32))


def box(n: int = 6) -> Mesh:
    """Return the cube [-1, 1]^3 of 12 n^2 triangles that face outwards."""
    side = grid_plane(n, z=1.0)
    turns = [np.eye(3), np.diag([1.0, -1.0, -1.0])]
    turns += [np.array([[0, 0, s], [0, 1, 0], [-s, 0, 0]], float) for s in (1, -1)]
    turns += [np.array([[1, 0, 0], [0, 0, s], [0, -s, 0]], float) for s in (1, -1)]
    return join([Mesh((side.vertices @ turn.T).astype(np.float32), side.faces) for turn in turns])


def join(meshes: list[Mesh]) -> Mesh:
    """Concatenate meshes into one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    return Mesh(vertices, np.concatenate([m.faces + int(s) for m, s in zip(meshes, starts, strict=False)]))


def flat_atlas(mesh: Mesh) -> Atlas:
    """Return an atlas that maps x and y in [-1, 1]^2 to the texture, y up; overlapping pieces are not separated."""
    uv = (0.5 + 0.5 * mesh.vertices[:, :2] * (1, -1)).astype(np.float32)
    return Atlas(mesh, np.arange(len(mesh.vertices)), mesh.faces, uv, charts=1)


def checkers(places: np.ndarray) -> np.ndarray:
    """Return squares of side 1/3 with edges blurred over 0.02, in colours that depend on the position."""
    wave = np.prod(np.tanh(np.sin(3 * np.pi * (places + 0.1)) * 8), axis=1)[:, None]
    return np.asarray(0.5 + 0.2 * places * (1, -1, 1) + 0.25 * wave * (1.0, 0.6, -0.4))


def photograph(mesh: Mesh, camera: Camera, paint: Paint, gain: float = 1.0, samples: int = 3) -> ColorSource:
    """Render the unlit mesh as RGBA with straight alpha."""
    hits = cast_camera(mesh.vertices.astype(np.float64), mesh.faces, camera, samples=samples)
    hit = hits.face >= 0
    places = np.einsum("hk,hkc->hc", hits.weights[hit], mesh.vertices[mesh.faces[hits.face[hit]]])
    rays = np.zeros((*hits.face.shape, 4))
    rays[hit] = np.concatenate([np.clip(gain * paint(places), 0, 1), np.ones((len(places), 1))], axis=1)
    blocks = rays.reshape(camera.height, samples, camera.width, samples, 4).mean(axis=(1, 3))
    blocks[..., :3] /= np.maximum(blocks[..., 3:], 1e-9)
    return ColorSource(camera, np.rint(255 * blocks).astype(np.uint8))


def ring(count: int, distance: float = 4.0, size: int = 96, turn: float = 0.0) -> list[Camera]:
    """Return cameras around the z axis, alternating between above and below."""
    cameras = []
    for i in range(count):
        angle, rise = 2 * np.pi * i / count + turn, (0.75, -0.65)[i % 2]
        eye = distance * np.array([np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), np.sin(rise)])
        cameras.append(look_at(eye, np.zeros(3), np.array([0.0, 0, 1]), width=size, height=size, fx=1.4 * size))
    return cameras


def above(height: float, size: int = 64, focal: float = 64.0) -> Camera:
    """Return a camera on the z axis that looks down; image x is world x."""
    down = np.array([0.0, 0, height])
    return look_at(down, np.zeros(3), np.array([0.0, 1, 0]), width=size, height=size, fx=focal)


def listed(images: list[ColorSource]) -> ColorSources:
    """Return images held in memory, readable any number of times."""
    return lambda factor: (image.shrunk(factor) for image in images)
