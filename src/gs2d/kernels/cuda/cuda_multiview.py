"""The comparison of two views on a GPU: ``kernels/native_multiview.py`` over a launcher, without waiting."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gs2d.kernels.cuda.cuda_losses import ready
from gs2d.kernels.cuda.kernel_arguments import fill
from gs2d.kernels.native_multiview import CompareArguments, Compared, compare_on

if TYPE_CHECKING:
    from gs2d.kernels.cuda.launch import Launcher

__all__ = ["compare_views"]

THREADS = 128
PATCHES = 4  # multiview.cu: per block


def compare_views(
    depth: Tensor, normal: Tensor, motion: Tensor, given: Compared, *, launcher: Launcher
) -> tuple[Tensor, Tensor]:
    """Compare pixels of a view with a neighbouring view: the CUDA form of ``native_multiview.compare_views``."""
    ready(depth=depth, normal=normal, motion=motion, reference=given.reference, source=given.source)
    ready(depth=depth, source_depth=given.source_depth)

    def run(arguments: CompareArguments, tensors: dict[str, Tensor | None]) -> Tensor:
        fill(arguments, **tensors)
        launcher.launch("compare_views", -(-arguments.count // PATCHES), THREADS, arguments)
        rows = [tensors["values"], tensors["motion_gradients"]]
        return torch.cat([part.sum(dim=1, dtype=torch.float64) for part in rows if part is not None]).to(depth.dtype)

    return compare_on(depth, normal, motion, given, run)
