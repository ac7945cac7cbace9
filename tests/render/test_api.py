"""The public API checks arguments before running, and selects backends by name without silent fallback."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from fake_backends import altered
from gs2d.errors import BackendError, ShapeError
from gs2d.kernels import library
from gs2d.render.api import rasterize, splat_errors
from gs2d.render.backends import BACKENDS, Backend, backend_report, get_backend
from gs2d.render.types import RasterSettings
from render_scenes import front_camera, splat


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"near": 0.0}, "positive"),
        ({"near": float("nan")}, "near must be positive"),
        ({"far": 0.1}, "larger"),
        ({"alpha_min": 0.0}, "alpha_min must be in"),
        ({"alpha_max": 1.0}, "alpha_max must be in"),
        ({"transmittance_min": 0.7}, "transmittance_min must be in"),
        ({"error_cutoff": -3.0}, "positive"),
        ({"lowpass_px": 0.0}, "positive"),
        ({"mip_px": -0.1}, "0 or positive"),
        ({"background": (0.0, 0.0, 2.0)}, "numbers"),
        ({"background": (0.0, 0.0)}, "numbers"),
        ({"sh_degree": 4}, "colours"),
        ({"sh_degree": -2}, "sh_degree must be 0 to 3"),
        ({"sh_degree": -1, "background": (0.0, 0.0, float("nan"))}, "numbers"),
        ({"lowpass_depth": "both"}, "center"),
        ({"near_plane_policy": "yes"}, "draw"),
    ],
)
def test_settings_out_of_range_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        rasterize(splat(), front_camera(), RasterSettings(**change), backend="reference")


def test_splats_with_different_numbers_of_rows_are_refused() -> None:
    scene = splat()
    scene.quats = torch.ones(2, 4)  # Splats are checked on construction, but their tensors are mutable
    with pytest.raises(ShapeError, match="quats"):
        rasterize(scene, front_camera(), backend="reference")


@pytest.mark.parametrize(
    ("probe", "message"),
    [
        (torch.zeros(1, 3), "screen_probe"),
        (torch.zeros(2, 2), "screen_probe"),
        (torch.zeros(1, 2, dtype=torch.float64), "screen_probe"),
        (torch.ones(1, 2), "screen_probe"),
    ],
)
def test_a_screen_probe_must_be_zeros_of_the_right_shape(probe: torch.Tensor, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        rasterize(splat(), front_camera(), backend="reference", screen_probe=probe)


def test_splat_errors_checks_image_and_mask() -> None:
    camera = front_camera(4, 3)
    with pytest.raises(ShapeError, match="image"):
        splat_errors(splat(), camera, torch.zeros(4, 3, 3), backend="reference")
    with pytest.raises(ShapeError, match=r"mask must be \[3, 4\]"):
        splat_errors(splat(), camera, torch.zeros(3, 4, 3), backend="reference", mask=torch.ones(4, 3) > 0)
    with pytest.raises(ShapeError, match="mask must be bool"):
        splat_errors(splat(), camera, torch.zeros(3, 4, 3), backend="reference", mask=torch.ones(3, 4))
    with pytest.raises(ShapeError, match="splats"):
        splat_errors(splat(), camera, torch.zeros(3, 4, 3, dtype=torch.uint8), backend="reference")


def test_unknown_backends_and_cuda_are_refused_with_a_remedy() -> None:
    with pytest.raises(BackendError, match="reference"):
        get_backend("gpu")
    cuda = next(status for status in backend_report() if status.name == "cuda")
    if not cuda.available:
        with pytest.raises(BackendError, match="--backend"):
            rasterize(splat(), front_camera(), backend="cuda")


def test_auto_takes_the_first_that_the_report_calls_available() -> None:
    first = next(status.name for status in backend_report() if status.available)
    assert get_backend("auto").name == first


def test_for_tensors_auto_follows_their_device(monkeypatch: pytest.MonkeyPatch) -> None:
    def gpu() -> Backend:
        return altered(get_backend("reference"), name="cuda")

    monkeypatch.setitem(BACKENDS._objects, "cuda", gpu)
    assert get_backend("auto").name == "cuda"
    assert get_backend("auto", "cuda").name == "cuda"
    assert get_backend("auto", "cpu").name in ("cpu", "reference")
    assert get_backend("auto", "meta").name == "reference"


def test_tensors_on_a_gpu_never_fall_back_to_a_slower_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> Backend:
        raise BackendError("no compiler; install it")

    monkeypatch.setitem(BACKENDS._objects, "cuda", broken)
    with pytest.raises(BackendError, match="no compiler"):
        get_backend("auto", "cuda")
    assert get_backend("auto").name in ("cpu", "reference")


def test_without_the_native_library_cpu_is_an_error_and_auto_is_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(variant: str | None = None) -> library.Library:
        raise BackendError("expected the native CPU library, found none; do this")

    monkeypatch.setattr(library, "load", missing)
    with pytest.raises(BackendError, match="found none; do this"):
        get_backend("cpu")
    assert get_backend("auto", "cpu").name == "reference"
    status = next(status for status in backend_report() if status.name == "cpu")
    assert not status.available
    assert "found none" in status.reason
    assert status.remedy == library.REMEDY


def test_the_report_names_every_backend_with_a_reason_or_details() -> None:
    for status in backend_report():
        assert status.available == (status.reason == "") == (status.remedy == "")
        assert status.available == (status.details != "")
    assert [status.name for status in backend_report()] == ["cuda", "cpu", "reference"]


def test_the_ray_plane_depth_of_filtered_pairs_is_refused_by_the_kernels(cpu: Any) -> None:
    with pytest.raises(BackendError, match="lowpass_depth"):
        rasterize(splat(), front_camera(), RasterSettings(lowpass_depth="plane"), backend=cpu)


def test_arguments_of_other_types_or_in_another_order_are_named() -> None:
    splats, camera = splat(), front_camera()
    with pytest.raises(ShapeError, match="splats"):
        rasterize(camera, splats)  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="ndarray"):
        rasterize(splats, camera.T_cam_world)  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="RasterSettings"):
        rasterize(splats, camera, "cpu")  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="RasterSettings"):
        splat_errors(splats, camera, torch.zeros(9, 9, 3), torch.ones(9, 9))  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="as_tensor"):
        rasterize(replace(splats, means=np.zeros((1, 3), np.float32)), camera)
    with pytest.raises(ShapeError, match="gradient_rows"):
        rasterize(splats, camera, gradient_rows=np.ones(1, bool))  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="ndarray"):
        splat_errors(splats, camera, np.zeros((9, 9, 3), np.float32))  # type: ignore[arg-type]
