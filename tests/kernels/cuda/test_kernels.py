"""The CUDA kernels, executed on the CPU by the emulator, against the reference: images, radii and every gradient."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from emulate import Emulator
from gs2d.core.splats import ATTRIBUTES, Splats
from gs2d.errors import ShapeError
from gs2d.render import cuda, reference
from gs2d.render.api import rasterize
from kernel_cases import SETTINGS, Case, cases, double, gradients, many_tiles, quantile, render
from render_scenes import IMAGES, front_camera, random_cotangents, splat, stack


def test_images_and_radii_agree_with_the_reference_on_random_scenes(emulator: Emulator) -> None:
    differences: dict[str, list[Tensor]] = {name: [] for name in IMAGES}
    radii = []
    for case in cases(30):
        low = render(emulator, case.splats, case.camera, SETTINGS)
        high = reference.rasterize(double(case.splats), case.camera, SETTINGS)
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
        assert quantile(merged, 0.5) < 1e-6, name
        assert quantile(merged, 0.998) < 1e-4, name
        assert float((merged > 2 / 255).double().mean()) < 2e-4, name
    assert float((torch.cat(radii) > 1e-3).double().mean()) <= 2e-3


@pytest.mark.parametrize("near_plane_policy", ["cull", "box"])
def test_crossing_splats_are_culled_or_boxed_as_by_the_reference_if_wanted(
    emulator: Emulator, near_plane_policy: str
) -> None:
    settings = replace(SETTINGS, near_plane_policy=near_plane_policy)
    differences, culled, smaller = [], 0, 0
    for case in cases(12, ("crossing", "huge", "plain")):
        low = render(emulator, case.splats, case.camera, settings)
        high = reference.rasterize(double(case.splats), case.camera, settings)
        drawn = reference.rasterize(double(case.splats), case.camera, SETTINGS)
        assert torch.equal(low.radii > 0, high.radii > 0)
        differences.append((low.color.double() - high.color).abs().flatten())
        culled += int(((drawn.radii > 0) & (high.radii == 0)).sum())
        smaller += int(((drawn.radii > high.radii) & (high.radii > 0)).sum())
    assert quantile(torch.cat(differences), 0.998) < 1e-4
    assert culled > (20 if near_plane_policy == "cull" else 0)
    assert (smaller > 20) is (near_plane_policy == "box")


@pytest.mark.parametrize("columns", [2, 4])
def test_gradients_agree_where_every_decision_has_a_margin(
    emulator: Emulator, clear_cases: list[Case], columns: int
) -> None:
    errors: dict[str, list[float]] = {name: [] for name in (*ATTRIBUTES, "signed", "absolute")}
    for case in clear_cases:
        cotangents = random_cotangents(np.random.default_rng(case.seed), case.camera)
        low = gradients(emulator, case.splats, case.camera, cotangents, columns)
        high = gradients(None, double(case.splats), case.camera, cotangents, columns)
        for name, expected in high.items():
            norm = float(expected.norm())
            if norm > 1e-3:
                errors[name].append(float((low[name].double() - expected).norm()) / norm)
    for name, values in errors.items():
        assert len(values) >= 8 or (name == "absolute" and columns == 2), name
        if values:
            assert np.median(values) < 1e-5, (name, np.median(values))
            assert max(values) < 2e-3, (name, max(values))


def layers(count: int) -> Splats:
    """Faint splats one behind another, all seen by every pixel of a small image."""
    parts = [splat((0.0, 0.0, 2.0 + 0.01 * i), (3.0, 3.0), 0.02, (i % 3 / 2, 0.5, 0.2)) for i in range(count)]
    return stack(*parts)


@pytest.mark.parametrize("count", [1, 31, 32, 33, 65])
def test_lists_around_the_chunk_size_agree(emulator: Emulator, count: int) -> None:
    camera = front_camera(5, 3)
    scene = layers(count)
    low = render(emulator, scene, camera, SETTINGS)
    high = rasterize(double(scene), camera, SETTINGS, backend="reference")
    assert float((low.color.double() - high.color).abs().max()) < 1e-5
    cotangents = random_cotangents(np.random.default_rng(count), camera)
    low_grads = gradients(emulator, scene, camera, cotangents, 2)
    high_grads = gradients(None, double(scene), camera, cotangents, 2)
    for name in ("means", "opacity_logits", "sh0"):
        error = (low_grads[name].double() - high_grads[name]).norm() / high_grads[name].norm()
        assert float(error) < 1e-4, name


def test_a_pixel_that_stops_on_the_last_bit_of_a_chunk_stays_stopped(emulator: Emulator) -> None:
    """Entry 31 stops every pixel; 32 opaque splats behind it must change nothing, forward or backward."""
    front = stack(*(splat((0.0, 0.0, 2.0 + 0.01 * i), (3.0, 3.0), 0.25) for i in range(31)))
    behind = stack(*(splat((0.0, 0.0, 3.0 + 0.01 * i), (3.0, 3.0), 0.98, (0.0, 1.0, 0.0)) for i in range(33)))
    camera = front_camera(5, 3)
    settings = replace(SETTINGS, transmittance_min=1e-4)
    before = render(emulator, front, camera, settings)
    assert float(1 - before.alpha.max()) > 1e-4
    scene = stack(front, behind)
    after = render(emulator, scene, camera, settings)
    assert torch.equal(before.color, after.color)
    grads = gradients(emulator, scene, camera, random_cotangents(np.random.default_rng(0), camera), 2)
    assert float(grads["sh0"][:31].abs().max()) > 0
    assert float(grads["sh0"][31:].abs().max()) == 0
    assert float(grads["opacity_logits"][31:].abs().max()) == 0


def test_the_order_of_threads_warps_and_blocks_does_not_change_images(emulator: Emulator) -> None:
    """A missing barrier would."""
    case = many_tiles()
    usual = render(emulator, case.splats, case.camera, SETTINGS)
    cotangents = random_cotangents(np.random.default_rng(1), case.camera)
    a = gradients(emulator, case.splats, case.camera, cotangents, 4)
    for other in (replace(emulator, descending=True), replace(emulator, seed=1)):
        images = render(other, case.splats, case.camera, SETTINGS)
        for name in (*IMAGES, "radii"):
            assert torch.equal(getattr(usual, name), getattr(images, name)), name
        b = gradients(other, case.splats, case.camera, cotangents, 4)
        for name in a:  # gradients are sums in the order of the threads
            assert float((a[name] - b[name]).norm()) <= 1e-5 * float(a[name].norm()), name


def test_many_tiles_agree_with_the_reference(emulator: Emulator) -> None:
    case = many_tiles()
    low = render(emulator, case.splats, case.camera, SETTINGS)
    high = reference.rasterize(double(case.splats), case.camera, SETTINGS)
    assert float(high.alpha.mean()) > 0.3
    for name in ("color", "alpha", "normal"):
        difference = (getattr(low, name).double() - getattr(high, name)).abs()
        assert quantile(difference, 0.5) < 1e-6, name
        assert quantile(difference, 0.999) < 2e-3, name


def test_what_would_read_beyond_an_array_is_refused(emulator: Emulator) -> None:
    camera, scene = front_camera(), splat()
    with pytest.raises(ShapeError, match="sh_degree"):
        cuda.rasterize_with(emulator, scene, camera, SETTINGS)  # degree 3, but no coefficients beyond the first
    with pytest.raises(ShapeError, match="float32"):
        cuda.rasterize_with(emulator, double(scene), camera, replace(SETTINGS, sh_degree=0))
    with pytest.raises(ShapeError, match="image"):
        cuda.splat_errors_with(emulator, scene, camera, torch.zeros(9, 8, 3), replace(SETTINGS, sh_degree=0))
