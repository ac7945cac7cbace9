"""Command 3: measure the machine's ceilings, check the kernels, and run the sanitizer."""

from __future__ import annotations

import importlib.util
import itertools
import os
import re
import shutil
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.gpu import whole
from benchmarks.gpu.bench import ROOT, Bench, run_program
from benchmarks.gpu.probes import ceilings
from benchmarks.kernel_usage import usage_of
from gs2d.config.recipe import Stage
from gs2d.core.splats import Splats
from gs2d.kernels.cuda import launch
from gs2d.kernels.cuda.compile import ARCHITECTURES, compile_source, kernel_sources, source_names
from gs2d.kernels.cuda.cuda_losses import CudaLosses
from gs2d.kernels.tsdf import arguments_of, fuse_on_gpu
from gs2d.render.api import rasterize, splat_errors
from gs2d.render.cuda_backend import CudaBackend
from gs2d.render.reference_backend import PLAIN
from gs2d.render.types import PLAIN_COLORS, TRANSMITTANCE, Features, RasterSettings

TOOLS = ("memcheck", "racecheck", "synccheck", "initcheck")
SETTINGS = RasterSettings(background=(0.2, 0.5, 0.9))
IMAGES = ("color", "alpha", "normal", "depth_mean", "depth_median", "distortion")


def run(bench: Bench, only: list[str], progress: Any) -> dict[str, Any]:
    """Run all parts: ceilings, registers, parity, determinism, tests, sanitizer; ``progress`` gets the results after
    each.
    """
    parts: dict[str, Any] = {
        "ceilings": lambda: ceilings(bench),
        "registers": lambda: registers(bench),
        "parity": lambda: parity(bench, 2 if bench.dry else 60),
        "whole_steps": lambda: whole_steps(bench),
        "determinism": lambda: determinism(bench),
        "tests": lambda: gpu_tests(bench),
        **{tool: lambda tool=tool: sanitize(bench, tool) for tool in TOOLS},
    }
    return bench.attempt_all(parts, only, progress)


def wrong(found: dict[str, Any]) -> bool:
    """Return True if a test failed, a tool reported an error, or a part could not run."""
    return any("failed" in part or part.get("clean") is False or part.get("exit", 0) != 0 for part in found.values())


def registers(bench: Bench) -> dict[str, Any]:
    """Return registers, spills and shared memory of each kernel for this device."""
    arch = ARCHITECTURES[4] if bench.dry else str(bench.launcher.architecture)  # type: ignore[attr-defined]
    names = source_names()[:1] if bench.dry else source_names()
    used = {kernel: usage for name in names for kernel, usage in usage_of(compile_source(name, arch)).items()}
    return {"architecture": arch, **{kernel: vars(usage) for kernel, usage in used.items()}}


def _scenes() -> Any:
    """Return the random scenes of the rasterizer tests."""
    sys.path.insert(0, str(ROOT / "tests" / "helpers"))
    import render_scenes

    return render_scenes


def parity(bench: Bench, count: int) -> dict[str, Any]:
    """Compare images and gradients of random scenes with the float64 reference: medians, quantiles, flipped pixels."""
    scenes = _scenes()
    differences: dict[str, list[Tensor]] = {name: [] for name in IMAGES}
    gradients: dict[str, list[float]] = {}
    for seed in range(count):
        rng = np.random.default_rng(seed)
        camera = scenes.random_camera(rng)
        splats = scenes.random_splats(rng, camera, int(rng.integers(1, 60))).to(dtype=torch.float32)
        cotangents = scenes.random_cotangents(rng, camera)
        low, low_grads = _differentiate(bench, scenes, splats.to(bench.device), camera, cotangents, bench.backend)
        high, high_grads = _differentiate(
            bench, scenes, splats.to(dtype=torch.float64), camera, cotangents, "reference"
        )
        for name in IMAGES:
            a, b = getattr(low, name).detach().double().cpu(), getattr(high, name).detach()
            differences[name].append((a - b).abs().flatten())
        for name, expected in high_grads.items():
            if float(expected.norm()) > 1e-3:
                error = (low_grads[name].double().cpu() - expected).norm() / expected.norm()
                gradients.setdefault(name, []).append(float(error))
    images = {}
    for name, parts in differences.items():
        merged = torch.cat(parts).numpy()
        images[name] = {
            "median": float(np.median(merged)),
            "q999": float(np.quantile(merged, 0.999)),
            "flipped": float((merged > 2 / 255).mean()),
        }
    errors = {k: {"median": float(np.median(v)), "q90": float(np.quantile(v, 0.9))} for k, v in gradients.items()}
    return {"scenes": count, "images": images, "gradients": errors}


def _differentiate(
    bench: Bench, scenes: Any, splats: Splats, camera: Any, cotangents: Any, backend: Any
) -> tuple[Any, dict[str, Tensor]]:
    leaves = Splats(**{name: tensor.detach().requires_grad_() for name, tensor in splats.items()})
    output = rasterize(leaves, camera, SETTINGS, backend=backend)
    given = {name: tensor.to(splats.means) for name, tensor in cotangents.items()}
    scenes.contraction(output, given).backward()
    return output, {name: tensor.grad for name, tensor in leaves.items() if tensor.grad is not None}


def small_scene(bench: Bench) -> tuple[Splats, Any]:
    """Return a few splats at 64 x 48 px: large enough for every code path, small enough for a sanitizer."""
    scenes = _scenes()
    rng = np.random.default_rng(7)
    camera = scenes.random_camera(rng).resized(*((16, 12) if bench.dry else (64, 48)))
    splats = scenes.random_splats(rng, camera, 12 if bench.dry else 200).to(bench.device, torch.float32)
    return splats, camera


def exercise(bench: Bench) -> list[str]:
    """Run every kernel at least once at sanitizer size; return the names of kernels that did not run."""
    with bench.recorded() as launched:
        _render_all_ways(bench)
        _all_losses(bench)
        _three_stages(bench)
        whole.run_kernels(bench, *small_scene(bench))
        _fusion(bench)
    bench.wait()
    return sorted(set(kernel_sources()) - launched)


def _render_all_ways(bench: Bench) -> None:
    """Run forward, all backward variants and splat errors; images of more than 32767 tiles only on a GPU."""
    splats, camera = small_scene(bench)
    every = ("color", "normal", "depth_median", "distortion")
    searched = SETTINGS.for_depths(TRANSMITTANCE)
    kinds = [(SETTINGS, names) for names in (every[:1], every[:3], every)]
    kinds += [(searched, (*names, "depth_transmittance")) for names in (every[:3], every)]
    for (settings, names), columns, deterministic in itertools.product(kinds, (2, 4), (False, True)):
        leaves = Splats(**{name: tensor.detach().requires_grad_() for name, tensor in splats.items()})
        probe = torch.zeros(len(splats), columns, device=bench.device, requires_grad=True)
        output = CudaBackend(deterministic=deterministic).rasterize(leaves, camera, settings, probe)
        sum(getattr(output, name).sum() for name in names).backward()  # type: ignore[union-attr]
    values = torch.rand(len(splats), 9, device=bench.device, requires_grad=True)
    further, plain = Features(values, values.detach()[0]), replace(SETTINGS, sh_degree=PLAIN_COLORS)
    for names, columns in itertools.product((every[:1], every), (2, 4)):
        probe = torch.zeros(len(splats), columns, device=bench.device, requires_grad=True)
        output = CudaBackend().rasterize_features(splats, camera, plain, further, probe)
        sum(getattr(output, name).sum() for name in names).backward()  # type: ignore[union-attr]
    image = torch.rand(camera.height, camera.width, 3, device=bench.device)
    for occlusion in (False, True):
        splat_errors(splats, camera, image, SETTINGS, backend=bench.backend, occlusion=occlusion)
    if not bench.dry:
        few = splats.rows(torch.arange(20, device=bench.device))
        CudaBackend().rasterize(few, camera.resized(16, 16 * 32768), SETTINGS)


def _all_losses(bench: Bench) -> None:
    """Run L1, SSIM and L2 and the mean of a map; training covers the other losses."""
    launcher = launch.launcher_for(bench.device)
    image, target = (torch.rand(45, 70, 3, device=bench.device, requires_grad=k == 0) for k in range(2))
    ops = CudaLosses(launcher)
    l1, ssim, l2 = ops.photometric(image, target)
    (l1 + ssim + l2 + ops.masked_mean(image[..., 0], target[..., 0] > 0.5)).backward()


def _three_stages(bench: Bench) -> None:
    """Train three short stages: normals, Adam, densification, ranking, clones, frozen rows."""
    sys.path.insert(0, str(ROOT / "tests" / "helpers"))
    import train_toys

    def shortened(stage: Stage) -> Stage:
        return replace(stage, iterations=min(stage.iterations, 2 if bench.dry else 4))

    recipe = train_toys.short()
    stages = tuple(map(shortened, recipe.stages))
    train_toys.train(train_toys.make_scene(), replace(recipe, stages=stages), backend=bench.backend)


def _fusion(bench: Bench) -> None:
    """Fuse a depth map into three blocks of voxels in front of and behind it, with colours."""
    height, width, blocks = 24, 30, 3

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, device=bench.device)

    depth = {"depth": 1 + random(height, width), "slope_x": random(height, width), "slope_y": random(height, width)}
    pixels = {"pixel_weight": random(height, width), "pixel_color": random(height, width, 3)}
    z = 1 + torch.arange(blocks, device=bench.device)[:, None] * 0.3
    place = {"rows": torch.arange(blocks, device=bench.device), "bases": z * torch.tensor([[9.0, 7, 1]]).to(z)}
    volume = {"tsdf": random(blocks, 512), "weight": random(blocks, 512)}
    colors = {"color": random(blocks, 512, 3), "color_weight": random(blocks, 512)}
    arrays = depth | pixels | place | {"offsets": 0.1 * random(3, 512)} | volume | colors
    fuse_on_gpu(launch.launcher_for(bench.device), arguments_of((height, width), 0.5, arrays))


def whole_steps(bench: Bench) -> dict[str, Any]:
    """Compare kernel-only iterations with torch iterations; they fail if parameter updates differ by 1 % or more."""
    _scenes()
    found = whole.differences(bench)
    return found | {"exit": int(max(value for way in found.values() for value in way.values()) > 1e-2)}


def determinism(bench: Bench) -> dict[str, Any]:
    """Render twice and compare: images bitwise, gradients by relative norm."""
    scenes = _scenes()
    splats, camera = small_scene(bench)
    cotangents = scenes.random_cotangents(np.random.default_rng(1), camera)
    runs = [_differentiate(bench, scenes, splats, camera, cotangents, bench.backend) for _ in range(2)]
    (a, grads_a), (b, grads_b) = runs
    same = {name: bool(torch.equal(getattr(a, name), getattr(b, name))) for name in IMAGES}
    change = {
        name: float((grad - grads_b[name]).norm() / grad.norm().clamp(min=1e-30)) for name, grad in grads_a.items()
    }
    judge = PLAIN.rasterize(splats.to("cpu", torch.float64), camera, SETTINGS)
    covered = float(judge.alpha.mean())
    return {"images_are_the_same_bits": same, "relative_change_of_gradients": change, "mean_alpha": covered}


def gpu_tests(bench: Bench) -> dict[str, Any]:
    """Run ``pytest -m gpu``; return the numbers of passed, failed and skipped tests, partial at the deadline."""
    if importlib.util.find_spec("pytest") is None:
        return {"skipped": "pytest is not installed here"}
    # Warnings of package versions other than the pinned ones are not failures; -v prints each test as it ends.
    command = [sys.executable, "-m", "pytest", "-W", "default", "-m", "gpu", "-q" if bench.dry else "-v"]
    if importlib.util.find_spec("pytest_timeout") is None:
        command += ["-o", "addopts=-ra --import-mode=importlib"]  # an option with the project's name
    command += ["--collect-only"] if bench.dry else []
    # only these folders: others need more packages
    command += ["tests/gpu", *([] if bench.dry else ["tests/render"])]
    path = {"PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"}
    done = run_program(command, seconds=bench.seconds_left(1500), environment=path)
    outcomes = Counter(re.findall(r"::\S.* (PASSED|FAILED|SKIPPED|ERROR)\b", "\n".join(done.lines)))
    last = (done.lines or ["it said nothing"])[-1] if done.exit is not None else "its time was up"
    counts = {kind.lower(): number for kind, number in outcomes.items()}
    names = [line for line in done.lines if line.startswith(("FAILED", "ERROR"))]
    names += [line for line in done.lines if re.search(r"::\S.* (FAILED|ERROR)\b", line) and done.exit is None]
    return {"exit": done.exit, "summary": last, "counts": counts, "not_passed": names}


def sanitize(bench: Bench, tool: str) -> dict[str, Any]:
    """Run every kernel once under a compute-sanitizer tool, without torch's caching allocator: it hides errors."""
    command = [sys.executable, "-m", "benchmarks.gpu", "exercise"]
    environment = {"PYTHONPATH": f"{ROOT / 'src'}:{ROOT}", "PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
    if bench.dry:
        if tool != TOOLS[0]:
            return {"skipped": "needs a GPU"}
        command.append("--dry-run")
    else:
        program = sanitizer()
        if program is None:
            return {
                "skipped": "compute-sanitizer is neither on the PATH nor in CUDA_HOME; it comes with the CUDA toolkit"
            }
        command = [program, "--tool", tool, "--error-exitcode", "9", "--print-limit", "20", *command]
    done = run_program(command, seconds=bench.seconds_left(1500), environment=environment)
    if done.exit is None:
        return {"exit": None, "clean": None, "summary": "its time was up", "last_lines": done.lines[-5:]}
    return {"exit": done.exit, "clean": done.exit == 0, "last_lines": done.lines[-5:]}


def sanitizer() -> str | None:
    """Return the path of compute-sanitizer: from the PATH, or from a toolkit folder."""
    homes = [os.environ[name] for name in ("CUDA_HOME", "CUDA_PATH") if os.environ.get(name)] + ["/usr/local/cuda"]
    folders = [str(Path(home) / part) for home in homes for part in ("bin", "compute-sanitizer")]
    return shutil.which("compute-sanitizer") or shutil.which("compute-sanitizer", path=os.pathsep.join(folders))


def table(found: dict[str, Any]) -> list[str]:
    """Return a short table."""
    images = found.get("parity", {}).get("images", {})
    lines = [
        f"{name}: median {row['median']:.1e}, q99.9 {row['q999']:.1e}, flipped {row['flipped']:.1e}"
        for name, row in images.items()
    ]
    if "tests" in found:
        lines.append(f"tests: {found['tests'].get('summary', found['tests'])}")
    lines += [f"{tool}: {'clean' if found[tool].get('clean') else found[tool]}" for tool in TOOLS if tool in found]
    return lines
