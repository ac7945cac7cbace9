"""Gradients of a camera's pose, worked out of the gradients of the splats (rule 20; docs/math.md, "Camera").

Moving the camera is moving all splats the other way. What a backend computes for the splats anyway therefore says what
a rigid motion of the camera does, and no kernel knows of it. Two things are not carried along by such a motion: the
directions of view dependent colours, and the normal image, which is in the world frame.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.core.sh import C0, num_coefficients, sh_basis
from gs2d.core.splats import Splats
from gs2d.kernels.library import library_for
from gs2d.render import pose_gradient_native as native
from gs2d.render.types import RenderOutput

__all__ = ["attach_pose_grad", "normals_without_pose_grad", "pose_gradient", "with_world_normals"]


def attach_pose_grad(splats: Splats, pose: Tensor, sh_degree: int) -> Splats:
    """Return the same splats; what reaches their gradients also reaches that of the camera.

    Parameters
    ----------
    splats : Splats
    pose : Tensor [4, 4]
        T_cam_world, of any floating dtype and on any device.
    sh_degree : int
        That is evaluated.
    """
    moving = {"means": splats.means, "quats": splats.quats} | ({"sh0": splats.sh0} if sh_degree > 0 else {})
    tensors = _Carry.apply(pose, splats.shN.detach(), sh_degree, *moving.values())
    return replace(splats, **dict(zip(moving, tensors, strict=True)))


def with_world_normals(output: RenderOutput, pose: Tensor) -> RenderOutput:
    """Let the camera's gradient know that normals stay in the world where splats would be turned; same images."""
    normal = _TurnNormals.apply(pose, output.normal, -1.0)
    return replace(output, normal=normal, normal_without_pose_grad=output.normal)


def normals_without_pose_grad(output: RenderOutput, pose: Tensor) -> Tensor:
    """:func:`with_world_normals` undone: for a loss that compares them with other normals that turn with them."""
    before, now = output.normal_without_pose_grad, output.normal
    if before is not None and before.data_ptr() == now.data_ptr():
        return before
    return _TurnNormals.apply(pose, now, 1.0)  # somebody has changed them since


class _Carry(torch.autograd.Function):
    """Tensors of splats, unchanged."""

    @staticmethod
    def forward(ctx: Any, pose: Tensor, shN: Tensor, degree: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(pose, shN, *tensors[:2])
        ctx.degree = degree
        return tuple(tensor.view_as(tensor) for tensor in tensors)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        pose, shN, means, quats = ctx.saved_tensors
        to_pose = None
        if ctx.needs_input_grad[0]:
            force, torque = _wrench(pose, means, quats, shN, ctx.degree, gradients)
            if not bool(torch.isfinite(force).all() & torch.isfinite(torque).all()):
                # What is not finite has zero gradients (rule 16), but NaN times zero is no zero.
                means, quats, shN = (torch.where(tensor.isfinite(), tensor, 0.0) for tensor in (means, quats, shN))
                force, torque = _wrench(pose, means, quats, shN, ctx.degree, gradients)
            to_pose = pose_gradient(pose, force, torque)
        wanted = ctx.needs_input_grad[3:]
        return to_pose, None, None, *(g if want else None for g, want in zip(gradients, wanted, strict=True))


class _TurnNormals(torch.autograd.Function):
    """The normal image, unchanged; ``sign`` times its torque goes to the camera."""

    @staticmethod
    def forward(ctx: Any, pose: Tensor, normal: Tensor, sign: float) -> Tensor:
        ctx.save_for_backward(pose, normal)
        ctx.sign = sign
        return normal.view_as(normal)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        pose, normal = ctx.saved_tensors
        to_pose = None
        if ctx.needs_input_grad[0]:
            torque = ctx.sign * _turned(normal.reshape(-1, 3), gradient.reshape(-1, 3))
            # without a force: the same about every point
            to_pose = pose_gradient(pose, torch.zeros_like(torque), torque)
        return to_pose, gradient if ctx.needs_input_grad[1] else None, None


def _wrench(
    pose: Tensor, means: Tensor, quats: Tensor, shN: Tensor, degree: int, gradients: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor]:
    """Return derivative by a shift [3] and by a turn about the camera's centre [3] of the scene, world axes, float64.

    ``gradients`` are those of the means, of the quaternions and, where ``degree`` > 0, of ``sh0``.
    """
    T = pose.detach().double().cpu()
    center = -T[:3, :3].T @ T[:3, 3]
    library = library_for(means)
    if library is not None:
        colors = (shN, gradients[2], degree) if degree > 0 else None
        return native.wrench(library, center, means, gradients[0], (quats, gradients[1]), colors)
    to_splats = means - center.to(means)  # [N, 3]
    force = gradients[0].sum(dim=0).double().cpu()
    products = _products(quats, gradients[1])  # [4, 4]
    turned = (products[0, 1:] - products[1:, 0] + _axial(products[1:, 1:])) / 2
    torque = _turned(to_splats, gradients[0]) + turned
    if degree > 0:  # a turn of the camera about its centre changes no direction in which a colour is seen
        weights = (shN[:, : num_coefficients(degree) - 1] * (gradients[2] / C0)).sum(dim=2)  # [N, K-1]
        values = sh_basis(torch.nn.functional.normalize(to_splats, dim=1), degree)[:, 1:]
        torque = torque - torch.einsum("akj,kj->a", turns_of_harmonics(degree), _products(weights, values))
    return force, torque


@cache
@torch.enable_grad()
def turns_of_harmonics(degree: int) -> Tensor:
    """L [3, K-1, K-1] float64: how the harmonics of degrees 1 to ``degree`` change where their argument turns.

    Y_k(g + w x g) = Y_k(g) + sum over axes a and harmonics j of w_a L_akj Y_j(g), for small w. The harmonics of one
    degree turn into each other; the squares of all entries are multiples of 1/4.
    """
    count = num_coefficients(degree) - 1
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(10 * count, 3, generator=generator, dtype=torch.float64)
    directions = (directions / directions.norm(dim=1, keepdim=True)).requires_grad_()
    basis = sh_basis(directions, degree)[:, 1:]
    changes = []
    for k in range(count):
        (slope,) = torch.autograd.grad(basis[:, k].sum(), directions, retain_graph=True)
        changes.append(torch.linalg.cross(directions.detach(), slope))
    wanted = torch.stack(changes, dim=2).flatten(1)  # [10 (K-1), 3 (K-1)]
    turns = torch.linalg.lstsq(basis.detach(), wanted).solution.T.reshape(3, count, count)
    return turns.sign() * ((4 * turns * turns).round() / 4).sqrt()


def pose_gradient(pose: Tensor, force: Tensor, torque: Tensor) -> Tensor:
    """Return the gradient [4, 4] of T_cam_world whose product with each rigid motion of the scene is the wrench's.

    ``force`` [3] and ``torque`` [3] about the camera's centre are derivatives by a shift and by a turn of the scene.

    A scene that moves by x + w x (x - center) + v is T_cam_world (1 + [w]x, v - w x center): the smallest matrix with
    the right products is R [torque about the origin]x / 2 beside R force.
    """
    T = pose.detach().double().cpu()
    R, t = T[:3, :3], T[:3, 3]
    about_origin = torque + torch.linalg.cross(-R.T @ t, force)
    x, y, z = about_origin.tolist()
    gradient = torch.zeros(4, 4, dtype=torch.float64)
    gradient[:3, :3] = R @ torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64) / 2
    gradient[:3, 3] = R @ force
    return gradient.to(pose)


def _turned(vectors: Tensor, gradients: Tensor) -> Tensor:
    """Return derivative by a turn [3] of vectors [N, 3], float64 on the CPU."""
    library = library_for(vectors)
    if library is not None:
        return native.wrench(library, vectors.new_zeros(3), vectors, gradients)[1]
    return _axial(_products(vectors, gradients))


def _axial(products: Tensor) -> Tensor:
    """Sum of a x b [3] from the sums of a_i b_j [3, 3]."""
    return torch.stack([products[i, j] - products[j, i] for i, j in ((1, 2), (2, 0), (0, 1))])


def _products(left: Tensor, right: Tensor) -> Tensor:
    """Sum over rows of left_i right_j [p, q], float64 on the CPU, of tensors [N, p] and [N, q]."""
    return (left.T @ right).double().cpu()
