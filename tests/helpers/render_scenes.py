"""Scenes for rasterizer tests: single splats, and random scenes with edge cases."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields

import numpy as np
import torch
from torch import Tensor
from torch.testing import assert_close

from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.render.backends import Backend
from gs2d.render.types import RenderOutput

IMAGES = ("color", "alpha", "normal", "depth_mean", "depth_median", "distortion")
RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
Y_AXIS = (0.0, 1.0, 0.0)  # a rotation by d degrees about y: t_u = (cos d, 0, -sin d), t_w = (sin d, 0, cos d)
C0 = 0.5 / math.sqrt(math.pi)  # value of the degree-0 spherical harmonic


def equal(actual: Tensor | float | list[float], expected: Tensor | float | list[float] | list[list[float]]) -> None:
    """Assert equality up to float32 rounding."""
    actual, expected = torch.as_tensor(actual).detach().double(), torch.as_tensor(expected).double()
    assert_close(actual, expected, rtol=2e-5, atol=2e-6)


@contextmanager
def repeatable(backend: Backend) -> Iterator[None]:
    """Make gradients bit-identical between runs: on a GPU this needs torch's switch, because sums use atomics."""
    torch.use_deterministic_algorithms(backend.name == "cuda")
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(False)


def front_camera(width: int = 9, height: int = 9, focal: float = 10.0, **change: float) -> Camera:
    """Return a camera at the origin along +z, principal point at the image centre (a pixel centre for odd sizes)."""
    values = {"fx": focal, "fy": focal, "cx": width / 2, "cy": height / 2} | change
    return Camera(width, height, values["fx"], values["fy"], values["cx"], values["cy"], np.eye(4))


def splat(
    mean: tuple[float, float, float] = (0.0, 0.0, 2.0),
    scales: tuple[float, float] = (0.4, 0.4),
    opacity: float = 0.5,
    color: tuple[float, float, float] = (1.0, 0.5, 0.25),
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0),
    degrees: float = 0.0,
    dtype: torch.dtype = torch.float32,
) -> Splats:
    """Return one splat, rotated by ``degrees`` about ``axis``; unrotated, it lies in the plane z = const, normal +z."""
    half = math.radians(degrees) / 2
    n = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    quat = [math.cos(half), *(math.sin(half) * n)]
    rgb = torch.tensor(color, dtype=torch.float64)
    return Splats(
        means=torch.tensor([mean], dtype=dtype),
        quats=torch.tensor([quat], dtype=dtype),
        log_scales=torch.tensor([[math.log(s) for s in scales]], dtype=dtype),
        opacity_logits=torch.tensor([math.log(opacity / (1 - opacity))], dtype=dtype),
        sh0=((rgb - 0.5) / C0).to(dtype).reshape(1, 1, 3),
        shN=torch.zeros(1, 0, 3, dtype=dtype),
    )


def stack(*parts: Splats) -> Splats:
    """Concatenate scenes; rows keep their order."""
    return Splats(**{f.name: torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Splats)})


def requiring_grad(splats: Splats) -> Splats:
    """Return a copy whose tensors are leaves with ``requires_grad``."""
    return Splats(**{name: t.detach().clone().requires_grad_() for name, t in splats.items()})


def random_camera(rng: np.random.Generator) -> Camera:
    """Return a camera near the origin with a small image, unequal focal lengths and an off-centre principal point."""
    width, height = (int(rng.integers(5, 40)) for _ in range(2))
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, rng.normal(size=3) * 0.5
    fx, fy = rng.uniform(0.6, 1.6, size=2) * max(width, height)
    cx, cy = rng.uniform(0.3, 0.7, size=2) * (width, height)
    return Camera(width, height, fx, fy, cx, cy, T)


KINDS = ("plain", "edge_on", "huge", "tiny", "transparent", "opaque", "behind", "crossing", "near_plane", "twins")


def random_splats(rng: np.random.Generator, camera: Camera, count: int, kinds: tuple[str, ...] = KINDS) -> Splats:
    """Return random splats in front of a camera, each of a random kind; float64."""
    W, H = camera.width, camera.height
    pixel = np.stack([rng.uniform(-0.1 * W, 1.1 * W, count), rng.uniform(-0.1 * H, 1.1 * H, count)], axis=1)
    z = rng.uniform(1.0, 6.0, count)
    scales = 10 ** rng.uniform(-1.6, -0.2, size=(count, 2))
    opacity = rng.uniform(0.05, 0.95, count)
    quats = rng.normal(size=(count, 4))
    kind = rng.choice(kinds, count)
    z = np.where(kind == "behind", -z, z)
    z = np.where(kind == "crossing", rng.uniform(0.3, 1.0, count), z)
    z = np.where(kind == "near_plane", rng.uniform(0.1, 0.4, count), z)
    scales = np.where((kind == "huge")[:, None], scales * 30, scales)
    scales = np.where((kind == "crossing")[:, None], rng.uniform(0.5, 2.0, (count, 2)), scales)
    scales = np.where((kind == "tiny")[:, None], scales * 1e-3, scales)
    opacity = np.where(kind == "transparent", rng.uniform(0.001, 0.01, count), opacity)
    opacity = np.where(kind == "opaque", rng.uniform(0.985, 0.9999, count), opacity)
    x_cam = np.stack([(pixel[:, 0] - camera.cx) / camera.fx * z, (pixel[:, 1] - camera.cy) / camera.fy * z, z], axis=1)
    means = (x_cam - camera.T_cam_world[:3, 3]) @ camera.rotation
    for i in np.flatnonzero(kind == "edge_on"):  # the view direction lies (almost) in the splat's plane
        quats[i] = _edge_on_quat(means[i] - camera.center, rng)
    means_t = torch.tensor(means)
    for i in np.flatnonzero(kind == "twins"):
        if i > 0:  # an exact copy of the previous row: equal depths are ordered by index
            means_t[i] = means_t[i - 1]
            quats[i], scales[i], opacity[i] = quats[i - 1], scales[i - 1], opacity[i - 1]
    return Splats(
        means=means_t,
        quats=torch.tensor(quats),
        log_scales=torch.tensor(np.log(scales)),
        opacity_logits=torch.tensor(np.log(opacity / (1 - opacity))),
        sh0=torch.tensor(rng.normal(size=(count, 1, 3)) * 1.2),
        shN=torch.tensor(rng.normal(size=(count, 15, 3)) * 0.15),
    )


def _edge_on_quat(view: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a rotation whose third column is perpendicular to ``view`` up to 1e-3 rad."""
    normal = np.cross(view, rng.normal(size=3))
    normal = normal / np.linalg.norm(normal) + rng.normal(size=3) * 1e-3
    normal /= np.linalg.norm(normal)
    first = np.cross(normal, rng.normal(size=3))
    first /= np.linalg.norm(first)
    m = np.stack([first, np.cross(normal, first), normal], axis=1)
    # Quaternion of a rotation matrix without branches: the top eigenvector of Bar-Itzhack's K.
    K = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [0, m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[2, 0] + m[0, 2]],
            [0, 0, m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2]],
            [0, 0, 0, m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    return np.linalg.eigh(K, UPLO="U")[1][:, -1]


def contraction(output: RenderOutput, cotangents: dict[str, Tensor]) -> Tensor:
    """Sum <image, cotangent> over all images: its gradient is a vector-Jacobian product."""
    total = output.color.new_zeros(())
    for name, cotangent in cotangents.items():
        total = total + (getattr(output, name) * cotangent.to(output.color.dtype)).sum()
    return total


def random_cotangents(rng: np.random.Generator, camera: Camera) -> dict[str, Tensor]:
    """Return a standard normal cotangent for every image; float64."""
    shape = {name: (camera.height, camera.width, 3) for name in ("color", "normal")}
    return {name: torch.tensor(rng.normal(size=shape.get(name, (camera.height, camera.width)))) for name in IMAGES}
