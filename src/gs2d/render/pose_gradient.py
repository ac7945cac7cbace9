"""Gradient of a camera's pose from the gradients of the splats (rule 20; docs/math.md, "Camera").

Moving the camera is moving all splats the opposite way, so the gradients of the splats determine the gradient of a
rigid motion of the camera, and no kernel computes it. Two parts do not move with the splats and are corrected: the
directions of view-dependent colours, and the normal image, which is in the world frame.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gs2d.core.sh import C0, num_coefficients, sh_basis, turns_of_harmonics
from gs2d.core.splats import Splats
from gs2d.kernels.c_structures import arguments_of
from gs2d.kernels.library import Library, library_for
from gs2d.render.types import RenderOutput


def attach_pose_grad(splats: Splats, pose: Tensor, sh_degree: int) -> Splats:
    """Return the same splats; their gradients also reach the camera's ``pose``, a tensor of any dtype on any device."""
    moving = {"means": splats.means, "quats": splats.quats} | ({"sh0": splats.sh0} if sh_degree > 0 else {})
    tensors = _Carry.apply(pose, splats.shN.detach(), sh_degree, *moving.values())
    return replace(splats, **dict(zip(moving, tensors, strict=True)))


def with_world_normals(output: RenderOutput, pose: Tensor) -> RenderOutput:
    """Return the same images; the pose gradient treats the normal image as fixed in the world frame."""
    normal = _TurnNormals.apply(pose, output.normal, -1.0)
    return replace(output, normal=normal, normal_without_pose_grad=output.normal)


def normals_without_pose_grad(output: RenderOutput, pose: Tensor) -> Tensor:
    """Undo :func:`with_world_normals`, for a loss that compares normals with others that rotate with the camera."""
    before, now = output.normal_without_pose_grad, output.normal
    if before is not None and before.data_ptr() == now.data_ptr():
        return before
    return _TurnNormals.apply(pose, now, 1.0)  # a caller replaced the image


class _Carry(torch.autograd.Function):
    """Identity on tensors of splats, with a gradient for the pose."""

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
                # Splats that are not finite have zero gradients (rule 16), but NaN times zero is NaN.
                means, quats, shN = (torch.where(tensor.isfinite(), tensor, 0.0) for tensor in (means, quats, shN))
                force, torque = _wrench(pose, means, quats, shN, ctx.degree, gradients)
            to_pose = pose_gradient(pose, force, torque)
        needed = ctx.needs_input_grad[3:]
        return to_pose, None, None, *(g if need else None for g, need in zip(gradients, needed, strict=True))


class _TurnNormals(torch.autograd.Function):
    """Identity on the normal image; ``sign`` times its torque is added to the pose gradient."""

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
            # A torque without a force is the same about every point.
            to_pose = pose_gradient(pose, torch.zeros_like(torque), torque)
        return to_pose, gradient if ctx.needs_input_grad[1] else None, None


def _wrench(
    pose: Tensor, means: Tensor, quats: Tensor, shN: Tensor, degree: int, gradients: tuple[Tensor, ...]
) -> tuple[Tensor, Tensor]:
    """Return force and torque [3], float64, of the gradients of means, quats and, for ``degree`` > 0, sh0.

    They are the derivatives by a translation and by a rotation of the scene about the camera centre, world axes.
    """
    T = pose.detach().double().cpu()
    center = -T[:3, :3].T @ T[:3, 3]
    library = library_for(means)
    if library is not None:
        fields = {"points": means, "to_points": gradients[0], "quats": quats, "to_quats": gradients[1]}
        if degree > 0:  # harmonics do not rotate with the scene
            fields |= {"shN": shN, "to_sh0": gradients[2]}
        sizes = {"sh_rest": shN.shape[1], "degree": degree}
        return _native_wrench(library, center, len(means), **fields, **sizes)
    to_splats = means - center.to(means)  # [N, 3]
    force = gradients[0].sum(dim=0).double().cpu()
    products = _products(quats, gradients[1])  # [4, 4]
    turned = (products[0, 1:] - products[1:, 0] + _axial(products[1:, 1:])) / 2
    torque = _turned(to_splats, gradients[0]) + turned
    if degree > 0:  # rotating the camera about its centre changes no view direction
        weights = (shN[:, : num_coefficients(degree) - 1] * (gradients[2] / C0)).sum(dim=2)  # [N, K-1]
        values = sh_basis(torch.nn.functional.normalize(to_splats, dim=1), degree)[:, 1:]
        torque = torque - torch.einsum("akj,kj->a", turns_of_harmonics(degree), _products(weights, values))
    return force, torque


def _native_wrench(library: Library, center: Tensor, count: int, **tensors: Tensor | int) -> tuple[Tensor, Tensor]:
    """Return force and torque, summed in native code, which skips rows that are not finite.

    ``tensors`` are fields of ``struct Moved`` of ``kernels/cpu/camera.cpp``. Without ``quats`` the points are vectors
    that rotate. The result does not depend on the number of threads.
    """
    fields = {name: t.detach().contiguous() if isinstance(t, Tensor) else t for name, t in tensors.items()}
    moved = arguments_of("gs2d_camera_wrench", count=count, center=tuple(center.tolist()), **fields)
    sums = torch.empty(2, 3, dtype=torch.float64)
    if library.call("gs2d_camera_wrench", moved, sums) != 0:
        raise MemoryError("gs2d_camera_wrench could not allocate its sums")
    return sums[0], sums[1]


def pose_gradient(pose: Tensor, force: Tensor, torque: Tensor) -> Tensor:
    """Return the gradient [4, 4] of T_cam_world from the derivatives by a translation and a rotation of the scene.

    ``force`` [3] is the derivative by a translation v, ``torque`` [3] by a rotation w about the camera centre. The
    motion x + w x (x - center) + v changes T_cam_world to T_cam_world (1 + [w]x, v - w x center). The matrix of least
    norm with the required inner products is R [torque about the origin]x / 2 next to R force.
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
    """Return the derivative [3] by a rotation of vectors [N, 3], float64 on the CPU."""
    library = library_for(vectors)
    if library is not None:
        return _native_wrench(library, vectors.new_zeros(3), len(vectors), points=vectors, to_points=gradients)[1]
    return _axial(_products(vectors, gradients))


def _axial(products: Tensor) -> Tensor:
    """Return the sum of a x b [3] from the sums of a_i b_j [3, 3]."""
    return torch.stack([products[i, j] - products[j, i] for i, j in ((1, 2), (2, 0), (0, 1))])


def _products(left: Tensor, right: Tensor) -> Tensor:
    """Return the sums over rows of left_i right_j [p, q] of tensors [N, p] and [N, q], float64 on the CPU."""
    return (left.T @ right).double().cpu()
