"""Native kernels against the reference: random scenes, all images, all gradients.

The kernels compute in float32, the reference in float64 on the same float32 inputs. Threshold decisions may flip for
about one pair in 1e5. Images are therefore compared by quantiles and outlier counts, and gradients by relative
Frobenius norm on scenes in which every decision has a margin.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from gs2d.core.splats import ATTRIBUTES
from gs2d.render.backends import Backend
from gs2d.render.reference_backend import PLAIN
from kernel_cases import SETTINGS, Case, cases, cases_with_margins, double, gradients, quantile
from render_scenes import IMAGES, random_camera, random_cotangents, random_splats


@pytest.fixture(params=["cpu", "emulated", pytest.param("cuda", marks=pytest.mark.gpu)])
def native(request: pytest.FixtureRequest, backend_named: Callable[[str], Backend]) -> Backend:
    return backend_named(request.param)


@pytest.fixture
def part(request: pytest.FixtureRequest) -> int:
    """Return N to run one case in N; the emulator is slow and runs fewer."""
    return 8 if "emulated" in request.node.callspec.id else 1


@pytest.fixture(scope="module")
def clear_cases() -> list[Case]:
    return cases_with_margins(220)


def test_images_and_radii_agree_on_random_scenes(native: Backend, part: int) -> None:
    differences: dict[str, list[Tensor]] = {name: [] for name in IMAGES}
    radii = []
    for case in cases(120 // part):
        low = native.rasterize(case.splats, case.camera, SETTINGS)
        high = PLAIN.rasterize(double(case.splats), case.camera, SETTINGS)
        for name in IMAGES:
            a, b = getattr(low, name).double(), getattr(high, name)
            assert a.shape == b.shape
            assert bool(a.isfinite().all()), name
            if name.startswith("depth"):
                a, b = a / b.clamp(min=0.1), b / b.clamp(min=0.1)
            differences[name].append((a - b).abs().flatten())
        radii.append((low.radii.double() - high.radii).abs() / (1 + high.radii))
    for name, parts in differences.items():
        merged = torch.cat(parts)
        flips = float((merged > 2 / 255).double().mean())
        assert quantile(merged, 0.5) < 1e-6, name
        assert quantile(merged, 0.999) < 1e-4, name
        assert flips < 2e-4, (name, flips)
    merged = torch.cat(radii)
    assert len(merged) > 2000 // part
    assert float((merged > 1e-3).double().mean()) <= 2e-3


def test_a_larger_image_with_many_tiles_and_layers_agrees(native: Backend) -> None:
    rng = np.random.default_rng(5)
    camera = random_camera(rng).resized(150, 110)
    splats = random_splats(rng, camera, 1500)
    splats = replace(splats, log_scales=splats.log_scales - 1).to(dtype=torch.float32)
    low = native.rasterize(splats, camera, SETTINGS)
    high = PLAIN.rasterize(double(splats), camera, SETTINGS)
    assert float(high.alpha.mean()) > 0.8
    for name in ("color", "alpha", "normal"):
        difference = (getattr(low, name).double() - getattr(high, name)).abs()
        assert quantile(difference, 0.5) < 1e-6, name
        assert quantile(difference, 0.999) < 2e-3, name


@pytest.mark.parametrize(
    "change",
    [
        {"near": 1.5, "far": 6.0},
        {"alpha_min": 0.05, "alpha_max": 0.9},
        {"transmittance_min": 0.2},
        {"lowpass_px": 1.7},
        {"mip_px": 0.5},
        {"sh_degree": 1, "background": (1.0, 1.0, 1.0)},
        {"near_plane_policy": "cull"},
        {"near_plane_policy": "box"},
    ],
    ids=str,
)
def test_every_setting_is_used_alike(native: Backend, part: int, change: dict[str, float]) -> None:
    settings = replace(SETTINGS, **change)  # type: ignore[arg-type]
    differences = []
    moved = 0.0
    for case in cases(20 // part):
        low = native.rasterize(case.splats, case.camera, settings)
        high = PLAIN.rasterize(double(case.splats), case.camera, settings)
        default = PLAIN.rasterize(double(case.splats), case.camera, SETTINGS)
        for name in ("color", "alpha", "distortion"):
            differences.append((getattr(low, name).double() - getattr(high, name)).abs().flatten())
        moved += float((high.color - default.color).abs().sum() + (high.distortion - default.distortion).abs().sum())
    assert quantile(torch.cat(differences), 0.998) < 1e-4
    assert moved > 1 / part  # the setting has an effect


@pytest.mark.parametrize(("columns", "mip_px"), [(2, 0.0), (4, 0.0), (4, 0.5)])
def test_gradients_agree_where_every_decision_has_a_margin(
    native: Backend, part: int, clear_cases: list[Case], columns: int, mip_px: float
) -> None:
    """Random cotangents on all images at once; relative Frobenius norm per attribute."""
    settings = replace(SETTINGS, mip_px=mip_px)
    errors: dict[str, list[float]] = {name: [] for name in (*ATTRIBUTES, "signed", "absolute")}
    for case in clear_cases[columns // 4 :: 2 * part]:
        cotangents = random_cotangents(np.random.default_rng(case.seed), case.camera)
        low = gradients(native.rasterize, case.splats, case.camera, cotangents, columns, settings)
        high = gradients(PLAIN.rasterize, double(case.splats), case.camera, cotangents, columns, settings)
        for name, expected in high.items():
            norm = float(expected.norm())
            if norm > 1e-3:
                errors[name].append(float((low[name].double() - expected).norm()) / norm)
    for name, values in errors.items():
        assert len(values) >= 20 // part or (name == "absolute" and columns == 2), name
        if values:
            assert np.median(values) < 1e-5, (name, np.median(values))
            assert np.quantile(values, 0.9) < 1e-4, (name, np.quantile(values, 0.9))
            assert max(values) < 2e-3, (name, max(values))


@pytest.mark.parametrize("name", IMAGES)
def test_gradients_of_each_image_alone_agree(native: Backend, part: int, clear_cases: list[Case], name: str) -> None:
    """A wrong sign in a small channel is not hidden by a large one."""
    errors = []
    for case in clear_cases[: 20 // part]:
        cotangents = {name: random_cotangents(np.random.default_rng(case.seed), case.camera)[name]}
        low = gradients(native.rasterize, case.splats, case.camera, cotangents, 4)
        high = gradients(PLAIN.rasterize, double(case.splats), case.camera, cotangents, 4)
        a = torch.cat([low[attribute].double().flatten() for attribute in ATTRIBUTES])
        b = torch.cat([high[attribute].flatten() for attribute in ATTRIBUTES])
        if float(b.norm()) > 1e-3:
            errors.append(float((a - b).norm() / b.norm()))
    assert len(errors) >= 10 // part, name
    assert np.median(errors) < 2e-5, errors
    assert max(errors) < 2e-3, errors


@pytest.mark.parametrize("occlusion", [False, True])
def test_splat_errors_agree(native: Backend, part: int, occlusion: bool) -> None:
    relative = []
    for case in cases(40 // part):
        rng = np.random.default_rng(case.seed)
        H, W = case.camera.height, case.camera.width
        image = torch.tensor(rng.uniform(size=(H, W, 3)), dtype=torch.float32)
        mask = torch.tensor(rng.uniform(size=(H, W)) < 0.8) if case.seed % 2 else None
        low = native.splat_errors(case.splats, case.camera, image, SETTINGS, mask, occlusion).double()
        high = PLAIN.splat_errors(double(case.splats), case.camera, image.double(), SETTINGS, mask, occlusion)
        assert low.shape == high.shape
        relative.append((low - high).abs() / high.clamp(min=1))
    merged = torch.cat(relative)
    assert quantile(merged, 0.5) < 1e-6
    assert quantile(merged, 0.97) < 1e-4
    assert float((merged > 0.05).double().mean()) < 0.01  # one flipped pixel in a small image
