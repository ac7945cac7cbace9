"""The first splats, on the points of the scene or on random points in its bounds (official 2DGS values)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gs2d.core.sh import num_coefficients, rgb_to_sh0
from gs2d.core.splats import Splats
from gs2d.core.transforms import nearest_distances
from gs2d.data.scene import Scene
from gs2d.errors import DataError, ProtocolError

INITIAL_OPACITY = 0.1
SCALE_FLOOR = math.sqrt(1e-7)  # world units; the official floor of the squared distance is 1e-7
RELATIVE_SCALE_FLOOR = 1e-4  # of the extent; used in small scenes, where it is smaller


@dataclass(frozen=True, eq=False)
class Initial:
    """The first splats."""

    splats: Splats
    source: str  # "points" of the scene, or "random" points
    dropped: int  # number of unusable points
    sized: Tensor  # [N] bool; splats with the size of their point


def initial_splats(
    scene: Scene,
    *,
    sh_degree: int,
    random_points: int,
    near: float,
    generator: torch.Generator,
    dtype: torch.dtype = torch.float32,
) -> Initial:
    """Create splats on the points of the scene, or on random points in its bounds if it has none.

    Points that no training camera sees beyond the depth ``near`` (world units), or that are nearer to one, are dropped.
    ``generator``, on the CPU, is for random points and rotations. Raises DataError or ProtocolError if fewer than two
    points are usable.
    """
    cloud = scene.points
    if cloud is not None and len(cloud) > 0:
        points = np.asarray(cloud.points, dtype=np.float64)
        colors = np.full((len(points), 3), 0.5) if cloud.colors is None else cloud.colors / 255.0
        source = "points"
    else:
        unit = torch.rand(random_points, 3, generator=generator, dtype=torch.float64).numpy()
        points = scene.bounds[0] + unit * (scene.bounds[1] - scene.bounds[0])
        colors, source = np.full((random_points, 3), 0.5), "random"
    usable = usable_points(points, scene, near)
    means = points[usable]
    if len(means) < 2:
        raise _no_points(points, scene, near)
    floor = min(SCALE_FLOOR, RELATIVE_SCALE_FLOOR * scene.extent)
    scales = nearest_distances(means, k=3)
    sizes = np.zeros(len(means)) if cloud is None or cloud.sizes is None else cloud.sizes[usable]
    scales = np.maximum(np.where(sizes > 0, sizes, scales), floor)
    quats = random_rotations(len(means), generator)
    if cloud is not None and cloud.normals is not None:
        quats = turned_to(torch.as_tensor(cloud.normals[usable], dtype=torch.float64), quats)
    splats = Splats(
        means=torch.as_tensor(means).to(dtype),
        quats=quats.to(dtype),
        log_scales=torch.as_tensor(np.log(scales)).to(dtype)[:, None].repeat(1, 2),
        opacity_logits=torch.full((len(means),), math.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY)), dtype=dtype),
        sh0=rgb_to_sh0(torch.as_tensor(colors[usable]).to(dtype)),
        shN=torch.zeros(len(means), num_coefficients(sh_degree) - 1, 3, dtype=dtype),
    )
    return Initial(splats, source, len(points) - len(means), torch.from_numpy(sizes > 0))


def splats_as_start(splats: Splats, *, sh_degree: int, dtype: torch.dtype = torch.float32) -> Splats:
    """Return a copy of splats with an SH degree; missing coefficients are 0.

    Raises DataError if there are no splats, or a value is not finite.
    """
    if len(splats) == 0:
        raise DataError("expected at least one splat to start from, got none")
    for name, tensor in splats.items():
        if not bool(torch.isfinite(tensor).all()):
            raise DataError(f"splats to start from must be finite, got NaN or infinity in their {name}")
    available, needed = splats.shN.shape[1], num_coefficients(sh_degree) - 1
    rest = splats.shN[:, :needed]
    if available < needed:
        rest = torch.cat([rest, rest.new_zeros(len(splats), needed - available, 3)], dim=1)
    parts = dict(splats.items()) | {"shN": rest}
    return Splats(**{name: tensor.detach().to("cpu", dtype, copy=True).contiguous() for name, tensor in parts.items()})


def usable_points(points: np.ndarray, scene: Scene, near: float) -> np.ndarray:
    """Return which points [P, 3] are finite, in front of a training camera and not within ``near`` of one, [P] bool.

    In front: with a depth > ``near``. All are in world units.
    """
    finite = np.isfinite(points).all(axis=1)
    safe = np.where(finite[:, None], points, 0.0)
    visible = np.zeros(len(points), dtype=bool)
    too_close = np.zeros(len(points), dtype=bool)
    for view in scene.train:
        visible |= view.camera.project(safe)[1] > near
        too_close |= np.linalg.norm(safe - view.camera.center, axis=1) < near
    return np.asarray(finite & visible & ~too_close)


def random_rotations(count: int, generator: torch.Generator) -> Tensor:
    """Return unit quaternions [count, 4] float64, uniform over rotations."""
    quats = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    return quats / quats.norm(dim=1, keepdim=True)


def turned_to(normals: Tensor, others: Tensor) -> Tensor:
    """Return unit quaternions [P, 4] that rotate z, the normal of a splat, to normals; ``others`` where those are 0."""
    valid = (normals != 0).any(dim=1)
    n = torch.where(normals[:, 2:] < 0, -normals, normals)  # of both directions, the one nearer to z
    quats = torch.stack([1 + n[:, 2], -n[:, 1], n[:, 0], torch.zeros_like(n[:, 0])], dim=1)
    return torch.where(valid[:, None], quats / quats.norm(dim=1, keepdim=True), others)


def _no_points(points: np.ndarray, scene: Scene, near: float) -> Exception:
    """Return the error for fewer than two usable points."""
    if int(usable_points(points, scene, 0.0).sum()) >= 2:
        return ProtocolError(
            f"near = {near:g} leaves none of the {len(points)} points of scene {scene.name} (extent {scene.extent:g}); "
            "use a protocol with a smaller near, such as --protocol generic"
        )
    return DataError(
        f"scene {scene.name} has {len(points)} points, but fewer than 2 are finite and in front of a camera; "
        "check the camera convention, or remove the point file to start from random points"
    )
