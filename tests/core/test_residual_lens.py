"""Residual distortion: formula, inverse, gradients, border."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gs2d.core.camera import Camera
from gs2d.core.residual_lens import seen_at, through_lens

CAMERA = Camera(48, 36, 40.0, 42.0, 22.0, 19.0, np.eye(4))


def smooth_picture(camera: Camera = CAMERA) -> torch.Tensor:
    """Waves of ten pixels and more [H, W, 3]."""
    rows, columns = torch.meshgrid(
        *(torch.arange(n, dtype=torch.float64) + 0.5 for n in (camera.height, camera.width)), indexing="ij"
    )
    waves = [torch.sin(rows / 3), torch.sin(columns / 4 + rows / 7), torch.cos((columns - rows) / 5)]
    return torch.stack(waves, dim=2) / 2 + 0.5


@pytest.mark.parametrize("lens", [(0.1, 0.0), (-0.1, 0.02), (-0.05, -0.03)])
def test_the_inverse_of_the_residual_lens_is_exact(lens: tuple[float, float]) -> None:
    places, _ = seen_at(CAMERA, torch.zeros(1, dtype=torch.float64), lens)
    focal, center = torch.tensor([CAMERA.fx, CAMERA.fy]), torch.tensor([CAMERA.cx, CAMERA.cy])
    y = (places - center) / focal
    square = y.square().sum(dim=2, keepdim=True)
    ideal = y * (1 + lens[0] * square + lens[1] * square**2) * focal + center
    rows, columns = np.mgrid[:36, :48] + 0.5
    np.testing.assert_allclose(ideal.numpy(), np.stack([columns, rows], axis=2), atol=1e-9)


def test_gradients_of_lens_image_and_intrinsics_are_exact() -> None:
    camera = Camera(9, 7, 8.0, 9.0, 4.2, 3.4, np.eye(4))
    weights = torch.rand(7, 9, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def seen(picture: torch.Tensor, lens: torch.Tensor, numbers: torch.Tensor) -> torch.Tensor:
        fx, fy, cx, cy = numbers.detach().tolist()
        there = replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, intrinsics=numbers)
        return (through_lens(picture, there, lens)[0] * weights).sum()

    numbers = torch.tensor([8.0, 9.0, 4.2, 3.4], dtype=torch.float64, requires_grad=True)
    lens = torch.tensor([-0.07, 0.02], dtype=torch.float64, requires_grad=True)
    picture = smooth_picture(camera).requires_grad_()
    assert torch.autograd.gradcheck(seen, (picture, lens, numbers), eps=1e-7, atol=1e-5)
