"""Run every kernel of the package on sizes that are not multiples of a block, for the sanitizers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from emulate import Emulator
from gs2d.core.splats import Splats
from gs2d.kernels.cuda.cuda_adam import AdamUpdate, adam_step
from gs2d.kernels.cuda.cuda_losses import CudaLosses
from gs2d.kernels.loss_operations import NormalOptions
from gs2d.render.cuda_backend import CudaBackend
from gs2d.render.cuda_step import Stepper
from gs2d.render.pair_budget import PairBudget, Rendering
from gs2d.render.types import PLAIN_COLORS, Features, RasterSettings
from gs2d.render.whole_step import Learned, StepLosses, StepNormals, WholeStep
from kernel_cases import SETTINGS, Case, many_tiles
from render_scenes import contraction, random_cotangents

ROOM = 1 << 12


def rendering(emulator: Emulator, case: Case) -> dict[str, Tensor]:
    """Return images, splat errors, and all gradients from both accumulation methods."""
    cotangents, found = random_cotangents(np.random.default_rng(1), case.camera), {}

    def render(
        name: str,
        trained: tuple[str, ...],
        settings: RasterSettings = SETTINGS,
        rows: Tensor | None = None,
        sure: bool | None = None,
    ) -> None:
        backend = CudaBackend(launcher=emulator, deterministic=sure)
        leaves = Splats(**{k: t.clone().requires_grad_(k in trained) for k, t in case.splats.items()})
        probe = torch.zeros(len(leaves), 4, requires_grad=True) if "means" in trained else None
        output = backend.rasterize(leaves, case.camera, settings, probe, rows)
        there = {k: c for k, c in cotangents.items() if k != "distortion" or settings.with_distortion}
        total = contraction(output, there)
        if settings.with_transmittance_depth:
            total = total + output.depth("transmittance").sum()
        total.backward()
        found[f"{name}.color"] = output.color.detach()
        for key, tensor in (*leaves.items(), ("probe", probe)):
            if tensor is not None and tensor.grad is not None:
                found[f"{name}.{key}"] = tensor.grad

    every = tuple(name for name, _ in case.splats.items())
    rows = torch.arange(len(case.splats)) % 3 == 0
    for sure in (False, True):
        render(f"all {sure}", every, sure=sure)
        render(f"colours {sure}", ("sh0", "shN"), rows=rows, sure=sure)
    numbers = torch.randn(len(case.splats), 9, generator=_numbers())
    for columns in (2, 4):
        for distortion, sure in ((False, False), (True, False), (True, True)):
            values, probe = numbers.clone().requires_grad_(), torch.zeros(len(numbers), columns, requires_grad=True)
            settings = replace(SETTINGS, sh_degree=PLAIN_COLORS)
            further = Features(values, numbers[0])
            backend = CudaBackend(launcher=emulator, deterministic=sure)
            output = backend.rasterize_features(case.splats, case.camera, settings, further, probe)
            (output.color.square().sum() + (output.distortion.sum() if distortion else 0.0)).backward()
            assert values.grad is not None
            assert probe.grad is not None
            name = f"channels {columns} {distortion} {sure}"
            found |= {f"{name}.values": values.grad, f"{name}.probe": probe.grad}
    render("by transmittance", every, SETTINGS.for_depths("transmittance"))
    image, mask = torch.rand(45, 70, 3, generator=_numbers()), torch.rand(45, 70, generator=_numbers()) > 0.3
    for occlusion in (False, True):
        inputs = (case.splats, case.camera, image, SETTINGS, mask, occlusion)
        found[f"errors {occlusion}"] = CudaBackend(launcher=emulator).splat_errors(*inputs)
    return found


def losses(emulator: Emulator, case: Case) -> dict[str, Tensor]:
    """Return values and gradients of all losses."""
    g, found, ops = _numbers(), {}, CudaLosses(emulator)
    for size in ((37, 44), (1, 1), (12, 43)):
        x, y, m = torch.rand(*size, 3, generator=g), torch.rand(*size, 3, generator=g), torch.rand(*size, generator=g)
        x, m = x.requires_grad_(), m > 0.4
        depth = torch.rand(*size, generator=g).add(1).requires_grad_()
        alpha = torch.rand(*size, generator=g).requires_grad_()
        known = ops.photometric(x, y, m)
        values = ops.photometric(x, y)
        camera = case.camera.resized(size[1], size[0])
        normals = sum(
            ops.normal_consistency(
                x,
                depth,
                alpha,
                NormalOptions(camera, m, y[..., 0].contiguous(), at_camera=form, per_splat=form),
            )
            for form in (False, True)
        )
        total = sum(known) + sum(values) + normals + ops.masked_mean(depth, m)
        total.backward()
        results = {"value": total.detach(), "x": x.grad, "depth": depth.grad, "alpha": alpha.grad}
        found |= {f"losses {size}.{name}": value for name, value in results.items() if value is not None}
    return found


def steps(emulator: Emulator) -> dict[str, Tensor]:
    """Run Adam on all rows, on selected rows, and with a compact gradient for selected rows."""
    g, found = _numbers(), {}
    trained = torch.arange(57) % 2 == 0
    index = trained.nonzero().squeeze(1)
    constants = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-8, "launcher": emulator}
    for columns in ((3,), (15, 3), ()):
        tensors = [torch.rand(57, *columns, generator=g) for _ in range(3)]
        gradient = torch.rand(57, *columns, generator=g)
        for choice in ({}, {"trained": trained}, {"rows": index}):
            adam_step([AdamUpdate(*tensors, gradient, 0.1, 1, **choice)], **constants)  # type: ignore[arg-type]
        adam_step([AdamUpdate(*tensors, gradient[index], 0.1, 1, rows=index, compact=True)], **constants)  # type: ignore[arg-type]
        found |= {f"adam {columns}.{k}": tensor for k, tensor in enumerate(tensors)}
    return found


def whole_steps(emulator: Emulator, case: Case) -> dict[str, Tensor]:
    """Run fused iterations: targets with and without alpha, training all parameters or only colours."""
    g, found = _numbers(), {}
    height, width, count = case.camera.height, case.camera.width, len(case.splats)
    stepper = Stepper(emulator, torch.device("cpu"))
    for channels, names, absolute in ((3, None, False), (4, None, True), (4, ("sh0", "shN"), False)):
        splats = case.splats.clone()
        learned = {
            name: Learned(torch.zeros_like(tensor), torch.zeros_like(tensor), 1e-3, 1, None)
            for name, tensor in splats.items()
            if names is None or name in names
        }
        gathered = {name: torch.zeros(count) for name in ("signed", "count", *(("absolute",) if absolute else ()))}
        more = {"l2": 10.0, "silhouette": 0.1} if channels == 4 else {}
        step = WholeStep(
            splats=splats,
            camera=case.camera,
            settings=RasterSettings(with_distortion=False),
            photograph=torch.randint(0, 256, (height, width, channels), generator=g, dtype=torch.uint8),
            mask=torch.rand(height, width, generator=g) < 0.8,
            valid=height * width,
            background=(0.1, 0.5, 0.2),
            losses=StepLosses(
                0.8, 0.2, normals=StepNormals(0.05, "mean", False, True, flat=3.0), smooth_normals=0.8, **more
            ),
            rows=None if names is None else torch.arange(count) % 3 == 0,
            learned=learned,
            betas=(0.9, 0.999, 1e-15),
            gathered=gathered if names is None else {},
            flatness=torch.randint(0, 256, (height, width), generator=g, dtype=torch.uint8),
        )
        budget = PairBudget()
        budget.learn(Rendering(-(-width // 16) * -(-height // 16)), ROOM)
        assert stepper.run(step, budget)
        assert not budget.overflowed()
        found |= {f"whole {channels} {names}.{k}": t for k, t in (*splats.items(), *gathered.items())}
    return found


def everything(emulator: Emulator) -> dict[str, Tensor]:
    """Return the results of all kernels for fixed inputs; all must be finite."""
    case = many_tiles()  # 70 x 45 px
    found = rendering(emulator, case) | losses(emulator, case) | steps(emulator) | whole_steps(emulator, case)
    assert all(bool(tensor.isfinite().all()) for tensor in found.values())
    return found


def _numbers() -> torch.Generator:
    return torch.Generator().manual_seed(4)
