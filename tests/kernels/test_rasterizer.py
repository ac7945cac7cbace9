"""Native rasterizer: gradients, instruction sets, threads, culling. Its contract is tested in tests/render."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from gs2d.core.camera import Camera, look_at
from gs2d.core.splats import ATTRIBUTES, Splats
from gs2d.errors import BackendError
from gs2d.kernels.library import Library, available_variants, load
from gs2d.render.cpu_backend import CpuBackend
from gs2d.render.reference_backend import PLAIN
from gs2d.render.types import RasterSettings
from render_scenes import IMAGES, random_camera, random_splats, requiring_grad

SETTINGS = RasterSettings(background=(0.2, 0.5, 0.7))


def cotangents(camera: Camera, dtype: torch.dtype, seed: int) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shape = (camera.height, camera.width)
    return {
        name: torch.randn(
            *shape, *([3] if name in ("color", "normal") else []), generator=generator, dtype=torch.float64
        ).to(dtype)
        for name in IMAGES
    }


def everything(library: Library, splats: Splats, camera: Camera, *, seed: int = 0, probe: int = 4) -> dict[str, Tensor]:
    """Return all images, radii, gradients and splat errors of one view, by name."""
    leaves = requiring_grad(splats.to(dtype=library.dtype))
    zeros = torch.zeros(len(splats), probe, dtype=library.dtype, requires_grad=True) if probe else None
    output = CpuBackend(library).rasterize(leaves, camera, SETTINGS, zeros)
    given = cotangents(camera, library.dtype, seed)
    torch.autograd.backward([getattr(output, name) for name in IMAGES], [given[name] for name in IMAGES])
    image = torch.rand(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(9)).to(library.dtype)
    found = {name: getattr(output, name).detach() for name in (*IMAGES, "radii")}
    found |= {f"d_{name}": tensor.grad for name, tensor in leaves.items() if tensor.grad is not None}
    if zeros is not None and zeros.grad is not None:
        found["d_probe"] = zeros.grad
    for occlusion in (False, True):
        given_errors = (leaves.detach(), camera, image, SETTINGS, None, occlusion)
        found[f"errors_{occlusion}"] = CpuBackend(library).splat_errors(*given_errors)
    return found


def awkward_scene(seed: int, count: int = 120) -> tuple[Splats, Camera]:
    rng = np.random.default_rng(seed)
    camera = random_camera(rng)
    return random_splats(rng, camera, count), camera


# ------------------------------------------------------------------------------------------------ formulas in float64


@pytest.mark.parametrize("seed", range(12))
def test_the_float64_build_equals_the_reference_to_rounding(native64: Library, seed: int) -> None:
    splats, camera = awkward_scene(seed, 60)
    leaves = requiring_grad(splats)
    zeros = torch.zeros(len(splats), 4, dtype=torch.float64, requires_grad=True)
    expected = PLAIN.rasterize(leaves, camera, SETTINGS, zeros)
    given = cotangents(camera, torch.float64, seed)
    torch.autograd.backward([getattr(expected, name) for name in IMAGES], [given[name] for name in IMAGES])
    found = everything(native64, splats, camera, seed=seed)
    for name in (*IMAGES, "radii"):
        torch.testing.assert_close(found[name], getattr(expected, name).detach(), rtol=1e-9, atol=1e-9, msg=name)
    for name, leaf in (*leaves.items(), ("probe", zeros)):
        assert leaf.grad is not None
        # edge-on splats have a condition number of about 1e4 here
        torch.testing.assert_close(
            found[f"d_{name}"], leaf.grad, rtol=1e-7, atol=1e-7 * float(leaf.grad.norm()), msg=name
        )
    image = torch.rand(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(9)).double()
    for occlusion in (False, True):
        errors = PLAIN.splat_errors(splats, camera, image, SETTINGS, None, occlusion)
        torch.testing.assert_close(found[f"errors_{occlusion}"], errors, rtol=1e-9, atol=1e-9)


def smooth_scene() -> tuple[Splats, Camera]:
    """Return five overlapping splats: hits, a filtered sliver, a clamped colour; no pair is near a threshold."""
    rng = np.random.default_rng(4)
    camera = look_at(
        np.array([0.1, -0.2, -3.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]), width=9, height=7, fx=9.0, fy=8.0
    )
    splats = Splats(
        means=torch.tensor(rng.normal(size=(5, 3)) * 0.35),
        quats=torch.tensor(rng.normal(size=(5, 4))),
        log_scales=torch.tensor(np.log([[0.5, 0.3], [0.6, 0.7], [0.9, 0.4], [0.05, 0.08], [0.4, 1.2]])),
        opacity_logits=torch.tensor([0.3, -0.5, 1.2, 2.0, 0.1], dtype=torch.float64),
        sh0=torch.tensor(rng.normal(size=(5, 1, 3)) * 0.8),
        shN=torch.tensor(rng.normal(size=(5, 15, 3)) * 0.2),
    )
    return splats, camera


@pytest.mark.parametrize("image", IMAGES)
def test_gradients_of_every_image_equal_finite_differences(native64: Library, image: str) -> None:
    splats, camera = smooth_scene()
    given = cotangents(camera, torch.float64, 3)[image]

    def scalar(*tensors: Tensor) -> Tensor:
        output = CpuBackend(native64).rasterize(Splats(*tensors), camera, SETTINGS)
        return (getattr(output, image) * given).sum()

    inputs = tuple(tensor.clone().requires_grad_() for _, tensor in splats.items())
    assert torch.autograd.gradcheck(scalar, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


# --------------------------------------------------------------------------------------- instruction sets, threads


@pytest.mark.parametrize("seed", range(4))
def test_every_instruction_set_agrees_with_float64(native: Library, native64: Library, seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    camera = random_camera(rng)
    splats = random_splats(rng, camera, 80, ("plain", "huge", "tiny", "transparent", "opaque", "behind", "twins"))
    splats = splats.to(dtype=torch.float32)  # the same numbers for both
    single, double = everything(native, splats, camera, seed=seed), everything(native64, splats, camera, seed=seed)
    for name in IMAGES:
        difference = (single[name].double() - double[name]).abs()
        scale = max(1.0, float(double[name].abs().max()))
        assert difference.median() < 1e-5 * scale, name
        assert (difference > 1e-3 * scale).double().mean() < 0.01, name  # threshold flips
    for name in (f"d_{attribute}" for attribute in ATTRIBUTES):
        assert (single[name].double() - double[name]).norm() < 2e-3 * double[name].norm(), name


@pytest.mark.parametrize("probe", [0, 2, 4])
def test_results_are_bit_identical_for_any_number_of_threads(native: Library, probe: int) -> None:
    rng = np.random.default_rng(7)
    camera = replace(random_camera(rng), width=83, height=70)  # 30 tiles
    splats = random_splats(rng, camera, 700)
    results = []
    for threads in (1, 2, 3, 8):
        native.use_threads(threads)
        results.append(everything(native, splats, camera, probe=probe))
    for other in results[1:]:
        for name, tensor in results[0].items():
            assert torch.equal(tensor, other[name]), name


# ------------------------------------------------------------------------------------------------- culling and order


@pytest.mark.parametrize("seed", range(6))
def test_culling_inside_tiles_does_not_change_a_single_bit(any_native: Library, seed: int) -> None:
    splats, camera = awkward_scene(50 + seed, 150)
    splats = splats.to(dtype=any_native.dtype)
    culled, full = (
        CpuBackend(any_native, exact_masks=exact).rasterize(splats, camera, SETTINGS) for exact in (True, False)
    )
    for name in IMAGES:
        assert torch.equal(getattr(culled, name), getattr(full, name)), name


@pytest.mark.parametrize("size", [(1, 1), (4, 4), (15, 17), (16, 16), (33, 5), (3, 50)])
def test_images_of_any_size_are_filled_to_the_last_pixel(any_native: Library, size: tuple[int, int]) -> None:
    # One opaque splat covers everything: alpha is 0.99 in every pixel, for all tiles and blocks.
    width, height = size
    camera = look_at(np.array([0.0, 0, -2]), np.zeros(3), np.array([0.0, -1, 0]), width=width, height=height, fx=100.0)
    one = torch.ones(1, 3, dtype=any_native.dtype)
    quat = torch.tensor([[2.0, 0, 0, 0]], dtype=any_native.dtype)
    splats = Splats(
        0 * one, quat, 5 * one[:, :2], 20 * one[:, 0], one[None], torch.zeros(1, 0, 3, dtype=any_native.dtype)
    )
    output = CpuBackend(any_native).rasterize(splats, camera, replace(SETTINGS, sh_degree=0))
    assert torch.allclose(output.alpha, torch.full_like(output.alpha, 0.99))
    assert output.radii.item() == max(width, height) / 2


# --------------------------------------------------------------------------------------------------------- edges


@pytest.mark.parametrize(
    "wanted", [("sh0",), ("sh0", "shN"), ("means", "quats"), ("opacity_logits",), ("log_scales", "sh0")]
)
def test_only_the_wanted_gradients_are_computed_and_they_are_the_same(
    any_native: Library, wanted: tuple[str, ...]
) -> None:
    splats, camera = awkward_scene(3)
    full = everything(any_native, splats, camera, probe=0)
    part = splats.to(dtype=any_native.dtype).clone()
    for name in wanted:
        getattr(part, name).requires_grad_()
    output = CpuBackend(any_native).rasterize(part, camera, SETTINGS)
    given = cotangents(camera, any_native.dtype, 0)
    torch.autograd.backward([getattr(output, name) for name in IMAGES], [given[name] for name in IMAGES])
    for name, tensor in part.items():
        if name in wanted:
            assert tensor.grad is not None
            torch.testing.assert_close(tensor.grad, full[f"d_{name}"], rtol=1e-4, atol=1e-5)
        else:
            assert tensor.grad is None


def test_memory_of_views_without_a_backward_pass_is_given_back() -> None:
    if not available_variants():
        pytest.skip("the native library was not built")
    resource, native = pytest.importorskip("resource"), load()
    splats, camera = awkward_scene(8)
    splats = requiring_grad(splats.to(dtype=torch.float32))
    camera = camera.resized(800, 800)  # 10 MB of saved images each
    for i in range(40):
        if i == 5:
            gc.collect()
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        CpuBackend(native).rasterize(splats, camera, SETTINGS)
    growth = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before  # KiB on Linux
    assert growth < 150_000


def test_the_best_variant_is_chosen_and_the_environment_overrides_it(monkeypatch: pytest.MonkeyPatch) -> None:
    if not available_variants():
        pytest.skip("the native library was not built")
    monkeypatch.delenv("GS2D_CPU_VARIANT", raising=False)
    assert load().variant == available_variants()[0]
    monkeypatch.setenv("GS2D_CPU_VARIANT", "portable")
    assert load().variant == "portable"
    monkeypatch.setenv("GS2D_CPU_VARIANT", "sse9")
    with pytest.raises(BackendError, match="portable"):
        load()


def test_a_missing_library_is_an_error_with_a_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: object) -> None:
    monkeypatch.setattr("gs2d.kernels.library.FOLDER", tmp_path)
    assert available_variants() == ()
    with pytest.raises(BackendError, match="--backend"):
        load()
