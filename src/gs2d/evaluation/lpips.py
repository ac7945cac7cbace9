"""LPIPS (Zhang et al. 2018) with VGG-16 and five 1x1 heads, from weight files of the user.

Two conventions with different values are in use: ``"-1..1"`` scales images to [-1, 1], as the package of the authors
does; ``"0..1"`` uses [0, 1], as the evaluation scripts of 3DGS and 2DGS do.

Nothing is downloaded. The files are the VGG-16 state dict of torchvision (keys ``features.0.weight`` ...) and the heads
of the ``lpips`` package, version 0.1 (keys ``lin0.model.1.weight`` ...).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError

import torch
import torch.nn.functional as F
from torch import Tensor

from gs2d.core.text import first_line
from gs2d.errors import DataError, ShapeError

CONVENTIONS = ("0..1", "-1..1")
BLOCKS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))  # convolutions in torchvision's `features`
WIDTHS = (64, 128, 256, 512, 512)
SHIFT = (-0.030, -0.088, -0.188)  # shift and scale of the LPIPS scaling layer, for [-1, 1]
SCALE = (0.458, 0.448, 0.450)
MIN_SIZE = 16  # px; four poolings reduce it to one
REMEDY = (
    "pass --lpips-weights with torchvision's vgg16-397923af.pth and the lpips package's weights/v0.1/vgg.pth, "
    "or the folder of both"
)


@dataclass(frozen=True, eq=False)
class Lpips:
    """The network: VGG-16 convolutions and heads."""

    # ``features.{i}.weight`` [out, in, 3, 3], ``features.{i}.bias`` [out] and ``lin{b}.model.1.weight`` [1, C, 1, 1]
    weights: Mapping[str, Tensor]

    @property
    def device(self) -> torch.device:
        """Device of the weights, on which images must be."""
        return next(iter(self.weights.values())).device

    def to(self, device: str | torch.device) -> Lpips:
        """Return the same network on a device."""
        return Lpips({name: weight.to(device) for name, weight in self.weights.items()})

    def __call__(self, image: Tensor, target: Tensor, *, convention: str = "0..1") -> Tensor:
        """Return the distance [] of two images [H, W, 3] with values in [0, 1], in float32 on every device.

        Raise ShapeError if the images have different or too small sizes, or the convention is unknown.
        """
        if convention not in CONVENTIONS:
            raise ShapeError(f"LPIPS convention must be one of {', '.join(CONVENTIONS)}, got {convention!r}")
        if image.shape != target.shape or image.dim() != 3 or image.shape[2] != 3 or min(image.shape[:2]) < MIN_SIZE:
            raise ShapeError(
                f"LPIPS needs two images [H, W, 3] of one size, at least {MIN_SIZE} px, "
                f"got {list(image.shape)} and {list(target.shape)}"
            )
        pair = torch.stack([image, target]).permute(0, 3, 1, 2)  # [2, 3, H, W]
        if convention == "-1..1":
            pair = 2 * pair - 1
        shift, scale = (pair.new_tensor(v).view(1, 3, 1, 1) for v in (SHIFT, SCALE))
        x = (pair - shift) / scale
        with _full_precision():
            return self._distance(x)

    def _distance(self, x: Tensor) -> Tensor:
        """Return the distance of a normalised pair [2, 3, H, W]."""
        total = x.new_zeros(())
        for block, layers in enumerate(BLOCKS):
            if block > 0:
                x = F.max_pool2d(x, 2)
            for i in layers:
                kernel, bias = (self.weights[f"features.{i}.{name}"] for name in ("weight", "bias"))
                x = F.relu(F.conv2d(x, kernel, bias, padding=1))
            unit = x / (x.square().sum(dim=1, keepdim=True).sqrt() + 1e-10)  # [2, C, h, w]
            difference = (unit[:1] - unit[1:]).square()
            total = total + F.conv2d(difference, self.weights[f"lin{block}.model.1.weight"]).mean()
        return total


@contextmanager
def _full_precision() -> Iterator[None]:
    """Disable TF32, with which convolutions on a GPU have 10 bits of mantissa, and the metric differs from the CPU."""
    cudnn = torch.backends.cudnn
    # torch 2.9 has a setting per operation; reading the old setting fails after the new one was used
    owner, name, full = (
        (cudnn.conv, "fp32_precision", "ieee") if hasattr(cudnn, "conv") else (cudnn, "allow_tf32", False)
    )
    before = getattr(owner, name)
    setattr(owner, name, full)
    try:
        yield
    finally:
        setattr(owner, name, before)


def _expected() -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    width_in = 3
    for block, (layers, width) in enumerate(zip(BLOCKS, WIDTHS, strict=True)):
        for i in layers:
            shapes[f"features.{i}.weight"] = (width, width_in, 3, 3)
            shapes[f"features.{i}.bias"] = (width,)
            width_in = width
        shapes[f"lin{block}.model.1.weight"] = (1, width, 1, 1)
    return shapes


def load_lpips(paths: str | Path | Iterable[str | Path]) -> Lpips:
    """Read the weights from files, or from a folder with .pth and .pt files.

    Raise DataError if a file is missing or no state dict, or weights are missing or have another shape.
    """
    sources = [Path(paths)] if isinstance(paths, str | Path) else [Path(path) for path in paths]
    files: list[Path] = []
    for path in sources:
        if not path.exists():
            raise DataError(f"LPIPS weights not found: {path}; {REMEDY}")
        files += sorted([*path.glob("*.pth"), *path.glob("*.pt")]) if path.is_dir() else [path]
    expected, weights = _expected(), dict[str, Tensor]()
    for file in files:
        try:
            state = torch.load(file, map_location="cpu", weights_only=True)
        except MemoryError:
            raise
        except Exception as error:  # torch's readers raise many kinds
            first = first_line(error)
            first = first.split(".")[0] if isinstance(error, UnpicklingError) else first  # without torch's advice
            raise DataError(f"{file} is not a readable PyTorch state dict ({first}); {REMEDY}") from error
        if not isinstance(state, Mapping):
            raise DataError(f"{file} must hold a state dict, got {type(state).__name__}; {REMEDY}")
        weights |= {key: value.float() for key, value in state.items() if key in expected}
    for key, shape in expected.items():
        if key not in weights:
            where = ", ".join(map(str, files)) or f"no .pth file in {', '.join(map(str, sources))}"
            raise DataError(f"LPIPS weights lack {key} (in {where}); {REMEDY}")
        if tuple(weights[key].shape) != shape:
            raise DataError(f"LPIPS weight {key} must be {list(shape)}, got {list(weights[key].shape)}; {REMEDY}")
    return Lpips(weights)
