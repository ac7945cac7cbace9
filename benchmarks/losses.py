"""Time native losses, value and gradient, next to the torch versions that they replace.

::

    python -m benchmarks.losses [--sizes 400 800] [--threads 1 2] [--repeats 40] [--json benchmarks/results/losses.json]

Times include the autograd and ctypes overhead of a training step. Each row also lists the peak rate of fused
multiply-adds (GFLOP/s, same threads), measured just before it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.timing import Timing, machine, measure, peak_probe
from gs2d.core.camera import Camera, look_at
from gs2d.kernels import native_losses as ops
from gs2d.kernels.library import load, ready_library
from gs2d.losses import formulas as reference


@dataclass(frozen=True)
class Row:
    """Row of the table."""

    loss: str
    size: int
    threads: int
    native: Timing
    torch: Timing | None
    probe_gflops: float


@dataclass(frozen=True, eq=False)
class Frame:
    """Seeded inputs of one image size."""

    rendered: Tensor  # [H, W, 3]
    target: Tensor  # [H, W, 3]
    mean: Tensor  # [H, W, 3]
    mask: Tensor  # [H, W]
    normal: Tensor  # [H, W, 3]
    depth: Tensor  # [H, W] world units
    alpha: Tensor  # [H, W]
    camera: Camera


def make_frame(size: int) -> Frame:
    """Return random images; depth with 10 % background."""
    g = torch.Generator().manual_seed(0)
    T = look_at(
        np.array([1.0, 2.0, 3.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]), width=1, height=1, fx=1.0
    ).T_cam_world
    target = torch.rand(size, size, 3, generator=g)
    depth = torch.where(torch.rand(size, size, generator=g) < 0.1, 0.0, 2 + torch.rand(size, size, generator=g))
    return Frame(
        rendered=(target + 0.1 * torch.randn(size, size, 3, generator=g)).requires_grad_(),
        target=target,
        mean=ops.blur(target),
        mask=torch.rand(size, size, generator=g) < 0.8,
        normal=(torch.rand(size, size, 3, generator=g) - 0.5).requires_grad_(),
        depth=depth.requires_grad_(),
        alpha=torch.rand(size, size, generator=g).requires_grad_(),
        camera=Camera(size, size, 0.9 * size, 0.9 * size, size / 2, size / 2, T),
    )


def photometric_step(frame: Frame, mask: Tensor | None = None, mean: Tensor | None = None) -> None:
    """Run 0.8 L1 - 0.2 SSIM, native, forward and backward."""
    l1, ssim, _ = ops.photometric(frame.rendered, frame.target, mask, mean)
    torch.autograd.grad(0.8 * l1 - 0.2 * ssim, frame.rendered)


def torch_photometric_step(frame: Frame) -> None:
    """Run 0.8 L1 - 0.2 SSIM in torch, forward and backward."""
    l1, ssim = reference.l1(frame.rendered, frame.target), reference.ssim(frame.rendered, frame.target)
    torch.autograd.grad(0.8 * l1 - 0.2 * ssim, frame.rendered)


def ssim_value(frame: Frame) -> None:
    """Compute SSIM without a gradient, native."""
    with torch.no_grad():
        ops.photometric(frame.rendered, frame.target)


def torch_ssim_value(frame: Frame) -> None:
    """Compute SSIM without a gradient in torch."""
    with torch.no_grad():
        reference.ssim(frame.rendered, frame.target)


def normal_step(frame: Frame) -> None:
    """Run normal consistency, native, forward and backward."""
    value = ops.normal_consistency(frame.normal, frame.depth, frame.alpha, ops.NormalOptions(frame.camera))
    torch.autograd.grad(0.05 * value, (frame.normal, frame.depth))


def torch_normal_step(frame: Frame) -> None:
    """Run normal consistency in torch, forward and backward."""
    value = reference.normal_consistency(frame.normal, frame.depth, frame.alpha, frame.camera)
    torch.autograd.grad(0.05 * value, (frame.normal, frame.depth))


def run(sizes: Sequence[int], threads: Sequence[int], repeats: int) -> list[Row]:
    """Measure every loss at every size and number of threads."""
    rows: list[Row] = []
    for size in sizes:
        frame = make_frame(size)
        cases: dict[str, tuple[Callable[[], object], Callable[[], object] | None]] = {
            "L1 + SSIM": (partial(photometric_step, frame), partial(torch_photometric_step, frame)),
            "L1 + SSIM, target mean cached": (partial(photometric_step, frame, None, frame.mean), None),
            "L1 + SSIM, masked": (partial(photometric_step, frame, frame.mask), None),
            "SSIM, value only": (partial(ssim_value, frame), partial(torch_ssim_value, frame)),
            "normal consistency": (partial(normal_step, frame), partial(torch_normal_step, frame)),
            "distortion mean": (partial(ops.masked_mean, frame.alpha), None),
        }
        for n in threads:
            for name, (native, slow) in cases.items():
                torch.set_num_threads(n)
                probe = peak_probe(ready_library())
                fast = measure(native, repeats=repeats)
                other = None if slow is None else measure(slow, repeats=max(3, repeats // 8), warmup=1)
                rows.append(Row(name, size, n, fast, other, probe))
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table, and write it to ``--json`` if requested."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[400, 800])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=40)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    before = torch.get_num_threads()
    try:
        rows = run(options.sizes, options.threads, options.repeats)
    finally:
        torch.set_num_threads(before)
    facts = machine() | {"kernels": load().variant}
    print(", ".join(f"{key} {value}" for key, value in facts.items()))
    print(
        "| loss (forward + backward) | image | threads | native ms, median (best) | torch ms, median | probe GFLOP/s |"
    )
    print("|---|---|---|---|---|---|")
    for row in rows:
        slow = "" if row.torch is None else f"{row.torch.median:.1f}"
        times = f"{row.native.median:.2f} ({row.native.best:.2f})"
        print(f"| {row.loss} | {row.size}x{row.size} | {row.threads} | {times} | {slow} | {row.probe_gflops:.0f} |")
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps({"machine": facts, "rows": [asdict(row) for row in rows]}, indent=1) + "\n")


if __name__ == "__main__":
    main()
