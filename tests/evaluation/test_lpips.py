"""LPIPS against the package's own code, as torchmetrics carries it, with the published heads and with random weights.

torchmetrics holds a copy of ``lpips.py`` and ``pretrained_networks.py`` of the lpips package, and its files of heads
(version 0.1). Its only change that matters here: features are divided by sqrt(|f|^2 + 1e-8), not by |f| + 1e-10.
"""

from __future__ import annotations

import inspect
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from gs2d.errors import DataError
from gs2d.evaluation.image_metrics import image_metrics
from gs2d.evaluation.lpips import load_lpips
from lpips_states import head_state, vgg_state

package = pytest.importorskip("torchmetrics.functional.image.lpips")
HEADS = Path(inspect.getfile(package)).parent / "lpips_models"
# torchvision's VGG-16, configuration D: channels, M = max pooling
LAYOUT = (64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512, "M")


def features(state: dict[str, Tensor]) -> nn.Sequential:
    """``torchvision.models.vgg16().features`` with the weights of the test (torchvision itself is not needed)."""
    layers: list[nn.Module] = []
    width = 3
    for entry in LAYOUT:
        if entry == "M":
            layers.append(nn.MaxPool2d(kernel_size=2, stride=2))
        else:
            layers += [nn.Conv2d(width, int(entry), kernel_size=3, padding=1), nn.ReLU(inplace=True)]
            width = int(entry)
    network = nn.Sequential(*layers)
    network.load_state_dict({key.removeprefix("features."): value for key, value in state.items()})
    return network


@pytest.fixture(scope="module")
def vgg_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file as torchvision distributes it: the classifier's keys follow those of the features."""
    path = tmp_path_factory.mktemp("vgg") / "vgg16-397923af.pth"
    torch.save(vgg_state() | {f"classifier.{i}.bias": torch.zeros(4) for i in (0, 3, 6)}, path)
    return path


def oracle(monkeypatch: pytest.MonkeyPatch, heads: Path) -> nn.Module:
    """The package's network over the same VGG."""
    monkeypatch.setattr(package, "_get_tv_model_features", lambda net, pretrained: features(vgg_state()))
    network: nn.Module = package._LPIPS(pretrained=True, net="vgg", model_path=str(heads))
    return network


def pair(seed: int) -> tuple[Tensor, Tensor]:
    """Two images [40, 51, 3] in [0, 1]: smooth, and the same with noise."""
    g = torch.Generator().manual_seed(seed)
    rows, columns = torch.meshgrid(torch.linspace(0, 3, 40), torch.linspace(0, 4, 51), indexing="ij")
    image = 0.5 + 0.4 * torch.stack([torch.sin(rows), torch.cos(columns), torch.sin(rows * columns)], dim=-1)
    return image, (image + 0.1 * torch.randn(image.shape, generator=g)).clamp(0, 1)


@pytest.mark.parametrize("published", [True, False], ids=["published heads", "random heads"])
def test_lpips_equals_the_package_in_both_conventions(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, vgg_file: Path, published: bool
) -> None:
    heads = HEADS / "vgg.pth"
    if not published:
        heads = tmp_path / "vgg.pth"
        torch.save(head_state(), heads)
    theirs, ours = oracle(monkeypatch, heads), load_lpips([vgg_file, heads])
    for seed in range(2):
        image, target = pair(seed)
        a, b = (x.permute(2, 0, 1)[None] for x in (image, target))
        with torch.no_grad():
            signed, unit = theirs(a, b, normalize=True).item(), theirs(a, b, normalize=False).item()
        assert ours(image, target, convention="-1..1").item() == pytest.approx(signed, rel=2e-5)
        assert ours(image, target, convention="0..1").item() == pytest.approx(unit, rel=2e-5)
        assert abs(signed - unit) > 0.01 * signed  # two numbers: each must be named


def test_the_published_heads_load_as_distributed(vgg_file: Path) -> None:
    network = load_lpips([vgg_file, HEADS / "vgg.pth"])
    heads = [network.weights[f"lin{b}.model.1.weight"] for b in range(5)]
    assert [tuple(head.shape) for head in heads] == [(1, width, 1, 1) for width in (64, 128, 256, 512, 512)]
    assert all(bool((head >= 0).all()) for head in heads)  # so that a distance is never negative


@pytest.mark.parametrize(("name", "head"), [("alex", 1), ("squeeze", 3)])
def test_heads_of_another_network_are_a_one_line_error(vgg_file: Path, name: str, head: int) -> None:
    """Channels: VGG 64 128 256 512 512, AlexNet 64 192 384 256 256, SqueezeNet 64 128 256 384 384 512 512."""
    with pytest.raises(
        DataError, match=rf"LPIPS weight lin{head}\.model\.1\.weight must be .*; pass --lpips"
    ) as caught:
        load_lpips([vgg_file, HEADS / f"{name}.pth"])
    assert "\n" not in str(caught.value)


def test_both_lpips_values_use_the_8_bit_image(vgg_file: Path) -> None:
    """A change below half a level of 255 vanishes in the 8-bit image, so that LPIPS does not see it."""
    network = load_lpips([vgg_file, HEADS / "vgg.pth"])
    target = torch.full((24, 24, 3), 100 / 255)
    row = image_metrics(target + 0.4 / 255, target, backend="reference", lpips=network).to_json()
    assert row["lpips"] == row["lpips_signed"] == 0.0
    assert row["psnr"] is None  # equal after quantisation
    assert row["psnr_float"] is not None


@pytest.mark.parametrize("torch_is_old", [False, True])
def test_convolutions_use_full_precision_and_restore_the_setting(
    vgg_file: Path, monkeypatch: pytest.MonkeyPatch, torch_is_old: bool
) -> None:
    """TF32 is torch's default for convolutions on a GPU. Before 2.9 it had one setting for all of cuDNN."""
    cudnn = torch.backends.cudnn
    if torch_is_old:
        owner, name, full = SimpleNamespace(allow_tf32=True), "allow_tf32", False
        monkeypatch.setattr(torch.backends, "cudnn", owner)
    elif hasattr(cudnn, "conv"):
        owner, name, full = cudnn.conv, "fp32_precision", "ieee"
    else:
        pytest.skip("this torch has the old setting only")
    before, found, conv2d = getattr(owner, name), [], torch.nn.functional.conv2d

    def convolve(*args: Any, **kwargs: Any) -> Tensor:
        found.append(getattr(owner, name))
        if len(found) > 18:
            raise RuntimeError("out of memory")
        return conv2d(*args, **kwargs)

    monkeypatch.setattr(torch.nn.functional, "conv2d", convolve)
    torch.save(head_state(), heads := vgg_file.with_name("heads.pth"))
    network = load_lpips([vgg_file, heads])
    images = torch.rand(2, 32, 32, 3)
    network(*images)
    assert found == [full] * 18  # 13 layers, 5 heads
    assert getattr(owner, name) == before
    with pytest.raises(RuntimeError, match="out of memory"):
        network(*images)
    assert getattr(owner, name) == before
    if not torch_is_old:
        assert cudnn.allow_tf32 in (True, False)  # and asking the old way still works
