"""Five images of a textured wall with a textureless part, with sparse points: a scene of known depth."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np
import torch

from gs2d.core.camera import Camera, look_at
from gs2d.core.splats import Splats
from gs2d.data.prior_maps import ObservedPoints
from gs2d.data.scene import PointCloud, Scene, View
from train_toys import random_splats

WALL = 4.0  # the wall is the plane z = 4; cameras stand at z = 0 and look along z
WIDTH, HEIGHT, FOCAL = 48, 36, 40.0


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return non-repeating wall colours [..., 3] in [0.1, 0.9]."""
    rng = np.random.default_rng(5)
    waves = rng.normal(size=(24, 2)) * 6
    phases = rng.uniform(0, 2 * np.pi, size=(24, 3))
    value = sum(np.sin(x[..., None] * w[0] + y[..., None] * w[1] + p) for w, p in zip(waves, phases, strict=True))
    return np.asarray(0.5 + 0.4 * np.tanh(0.3 * value))


def image(
    camera: Camera, gain: float = 1.0, bare: Callable[[np.ndarray], np.ndarray] = lambda places: places[..., 0] < -1.2
) -> np.ndarray:
    """Render the wall from a camera at z = 0, uint8; its left third, or where ``bare`` is true, has no texture."""
    x = (np.arange(WIDTH) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(HEIGHT) + 0.5 - camera.cy) / camera.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((HEIGHT, WIDTH))], axis=-1) @ camera.rotation
    places = camera.center + rays * ((WALL - camera.center[2]) / rays[..., 2])[..., None]
    color = texture(places[..., 0], places[..., 1])
    color[bare(places)] = 0.5
    return np.rint(np.clip(color * gain, 0, 1) * 255).astype(np.uint8)


@cache
def wall(gains: tuple[float, ...] = (1.0,) * 5) -> Scene:
    """Return five images of a wall, with sparse points on its textured part."""
    cameras = [
        look_at(np.array([x, 0.1 * i, 0.0]), np.array([x * 0.5, 0, WALL]), np.array([0.0, -1.0, 0.0]),
                width=WIDTH, height=HEIGHT, fx=FOCAL)
        for i, x in enumerate(np.linspace(-0.8, 0.8, 5))
    ]  # fmt: skip
    views = tuple(
        View.from_arrays(f"{i}.png", c, image(c, g)) for i, (c, g) in enumerate(zip(cameras, gains, strict=True))
    )
    rng = np.random.default_rng(1)
    points = np.stack([rng.uniform(-1.1, 1.8, 300), rng.uniform(-1.4, 1.4, 300), np.full(300, WALL)], axis=1)
    seen = {view.name: np.arange(300) for view in views}
    observed = ObservedPoints(points, np.full(300, 0.5), np.full(300, 5), seen)
    bounds = np.array([[-2.0, -2, 0], [2, 2, 5]])
    return Scene("wall", "colmap", views, (), PointCloud(points), 1.0, bounds, observe=lambda: observed)


def flat_wall() -> Splats:
    """Return splats on the wall that cover all images."""
    x, y = torch.meshgrid(torch.arange(-4, 4, 0.25), torch.arange(-3, 3, 0.25), indexing="xy")
    splats = random_splats(x.numel())
    splats.means[:] = torch.stack([x.reshape(-1), y.reshape(-1), torch.full((x.numel(),), WALL)], dim=1)
    splats.quats[:] = torch.tensor([1.0, 0, 0, 0])
    splats.log_scales[:], splats.opacity_logits[:] = math.log(0.2), 6.0
    return splats
