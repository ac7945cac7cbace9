"""Image metrics: hand-worked numbers, quantisation, masks, and LPIPS in the format of the public weight files."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from gs2d.errors import DataError
from gs2d.evaluation.image_metrics import (
    Metric,
    image_metrics,
    mean_metrics,
    psnr_float,
    quantise,
    ssim_float,
)
from gs2d.evaluation.lpips import BLOCKS, WIDTHS, Lpips, load_lpips
from lpips_states import head_state, vgg_state


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the two weight files; the VGG one has the classifier's keys too, as the real one does."""
    folder = tmp_path_factory.mktemp("lpips")
    torch.save(vgg_state() | {"classifier.0.bias": torch.zeros(4)}, folder / "vgg16.pth")
    torch.save(head_state(), folder / "vgg.pth")
    return folder


@pytest.fixture(scope="module")
def network(weights: Path) -> Lpips:
    return load_lpips(weights)


def test_psnr_of_a_constant_error_of_a_tenth_is_twenty_decibels() -> None:
    target = torch.full((4, 5, 3), 0.5)
    assert psnr_float(target + 0.1, target) == pytest.approx(20.0, abs=1e-4)


def test_the_8_bit_psnr_ignores_differences_below_quantisation() -> None:
    target = torch.full((3, 3, 3), 100 / 255)
    below, above = (image_metrics(target + error / 255, target, backend="reference") for error in (0.4, 0.6))
    assert below.psnr == Metric(None, "the images are equal: infinite")
    # 0.6/255 rounds to one level of 255: 20 log10(255)
    assert above.psnr.value == pytest.approx(20 * math.log10(255), abs=1e-3)
    assert above.psnr_float.value == pytest.approx(20 * math.log10(255 / 0.6), abs=1e-3)


def test_masked_pixels_are_ignored_in_psnr_and_ssim() -> None:
    g = torch.Generator().manual_seed(0)
    target = torch.rand(20, 24, 3, generator=g)
    image = (target + 0.1).clamp(0, 1)
    mask = torch.ones(20, 24, dtype=torch.bool)
    mask[5:9, 3:20] = False
    junk = torch.where(mask[..., None], image, torch.zeros(()))
    assert psnr_float(junk, target, mask) == psnr_float(image, target, mask)
    a, b = (image_metrics(x, target, mask, backend="reference").ssim.value for x in (junk, image))
    assert a == b
    assert ssim_float(junk, target, backend="reference") < a - 0.05


def test_native_and_reference_ssim_agree(native: None) -> None:
    g = torch.Generator().manual_seed(2)
    image, target = torch.rand(30, 41, 3, generator=g), torch.rand(30, 41, 3, generator=g)
    mask = torch.rand(30, 41, generator=g) < 0.7
    expected = ssim_float(image, target, mask, backend="reference")
    assert ssim_float(image, target, mask, backend="cpu") == pytest.approx(expected, abs=2e-6)


def test_a_metric_that_cannot_be_computed_is_null_with_its_reason() -> None:
    image = torch.rand(8, 9, 3)
    same = image_metrics(image, quantise(image).float() / 255, backend="reference").to_json()
    assert same["psnr"] is None
    assert "equal" in str(same["psnr_reason"])
    assert same["lpips"] is None
    assert "--lpips-weights" in str(same["lpips_reason"])
    empty = image_metrics(image, image, torch.zeros(8, 9, dtype=torch.bool), backend="reference")
    assert empty.psnr == empty.ssim == Metric(None, "no valid pixel")


def test_the_mean_over_views_reports_missing_values() -> None:
    target = torch.full((8, 8, 3), 0.5)
    views = [image_metrics(target + error, target, backend="reference") for error in (0.1, 0.0, 0.01)]
    mean = mean_metrics(views)
    assert mean.psnr_float.value == pytest.approx((20 + 40) / 2, abs=1e-3)
    assert mean.psnr_float.reason is not None
    assert mean.psnr_float.reason.startswith("1 of 3 views left out")
    assert mean.ssim_float.reason is None
    assert mean_metrics([]).psnr == Metric(None, "no views")


def naive_lpips(state: dict[str, Tensor], image: Tensor, target: Tensor) -> float:
    """LPIPS with torch modules, numbered like torchvision's VGG-16, hooked after relu1_2, 2_2, 3_3, 4_3, 5_3."""
    layers: list[torch.nn.Module] = []
    width_in = 3
    for block, (indices, width) in enumerate(zip(BLOCKS, WIDTHS, strict=True)):
        if block:
            layers.append(torch.nn.MaxPool2d(2, 2))
        for i in indices:
            assert len(layers) == i  # the numbering of torchvision
            convolution = torch.nn.Conv2d(width_in, width, 3, padding=1)
            convolution.load_state_dict({k: state[f"features.{i}.{k}"] for k in ("weight", "bias")})
            layers += [convolution, torch.nn.ReLU()]
            width_in = width
    taps = {3: 0, 8: 1, 15: 2, 22: 3, 29: 4}
    mean, std = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x, y = (((v - mean) / std).permute(2, 0, 1)[None] for v in (image, target))
    total = 0.0
    with torch.no_grad():
        for i, layer in enumerate(layers):
            x, y = layer(x), layer(y)
            if i in taps:
                fx, fy = (v / (v.norm(dim=1, keepdim=True) + 1e-10) for v in (x, y))
                head = state[f"lin{taps[i]}.model.1.weight"][0, :, 0, 0]
                total += float(((fx - fy) ** 2 * head.view(1, -1, 1, 1)).sum(dim=1).mean())
    return total


def test_lpips_equals_a_network_of_modules_in_both_conventions(network: Lpips) -> None:
    g = torch.Generator().manual_seed(4)
    image, target = torch.rand(32, 37, 3, generator=g), torch.rand(32, 37, 3, generator=g)
    state = vgg_state() | head_state()
    plain = network(image, target, convention="0..1").item()
    signed = network(image, target, convention="-1..1").item()
    assert plain == pytest.approx(naive_lpips(state, image, target), rel=1e-4)
    assert signed == pytest.approx(naive_lpips(state, 2 * image - 1, 2 * target - 1), rel=1e-4)
    assert abs(plain - signed) > 1e-3 * plain


def test_lpips_is_zero_for_equal_images_and_ignores_masked_pixels(network: Lpips) -> None:
    target = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(5))
    mask = torch.ones(16, 16, dtype=torch.bool)
    mask[:4] = False
    junk = torch.where(mask[..., None], target, 1 - target)
    metrics = image_metrics(junk, target, mask, backend="reference", lpips=network)
    assert metrics.lpips == metrics.lpips_signed == Metric(0.0)
    unmasked = image_metrics(junk, target, backend="reference", lpips=network)
    assert unmasked.lpips.value is not None
    assert unmasked.lpips.value > 0


def test_wrong_weight_files_are_one_line_errors(tmp_path: Path, weights: Path) -> None:
    noise = tmp_path / "noise.pth"
    noise.write_bytes(b"not a checkpoint at all")
    tensor = tmp_path / "tensor.pth"
    torch.save(torch.zeros(3), tensor)
    wrong = tmp_path / "wrong.pth"
    torch.save(head_state() | {"lin2.model.1.weight": torch.zeros(1, 3, 1, 1)}, wrong)
    empty = tmp_path / "empty"
    empty.mkdir()
    cases = [
        (tmp_path / "nowhere", "not found"),
        (empty, "no .pth file"),
        (noise, "not a readable"),
        (tensor, "state dict, got Tensor"),
        (weights / "vgg.pth", r"lack features\.0\.weight"),
        ([weights / "vgg16.pth", wrong], r"must be \[1, 256, 1, 1\], got \[1, 3, 1, 1\]"),
    ]
    for path, words in cases:
        with pytest.raises(DataError, match=words) as caught:
            load_lpips(path)
        assert "\n" not in str(caught.value)
        assert "--lpips-weights" in str(caught.value)
