"""The photographs as training wants them: float tensors over the background, kept as far as memory allows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from gs2d.core.memory_limit import cache_bytes
from gs2d.data.scene import View
from gs2d.losses.api import TargetMaps

TARGET_BYTES = 1 << 28  # small captures stay whole
# Part of the views that must fit, or none stays: of 292 photographs of 780x520 a tenth would, for less than 1 % of an
# iteration's time, because to make a target anew from its bytes takes a few ms.
WORTH_KEEPING = 0.5
PINNED_BYTES = 1 << 33


@dataclass(frozen=True, eq=False)
class Target:
    """What one view should look like.

    Attributes
    ----------
    image : Tensor [H, W, 3]
        In [0, 1], over the background.
    mask : Tensor [H, W] bool or None
        False = ignore this pixel.
    maps : TargetMaps or None
        What the native SSIM needs of the image alone; kept with images that are kept.
    silhouette : Tensor [H, W] or None
        Alpha of the photograph in [0, 1], where it has one and a loss asks for it.
    """

    image: Tensor
    mask: Tensor | None
    maps: TargetMaps | None
    silhouette: Tensor | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        tensors = [self.image, self.mask, self.silhouette, None if self.maps is None else self.maps.mean]
        return sum(tensor.numel() * tensor.element_size() for tensor in tensors if tensor is not None)


@dataclass(frozen=True, eq=False)
class Photograph:
    """A training view as it was decoded, on the device.

    Attributes
    ----------
    image : Tensor [H, W, 3 or 4] uint8
    mask : Tensor [H, W] bool or None
        False = ignore this pixel.
    valid : int
        Pixels that count.
    """

    image: Tensor
    mask: Tensor | None
    valid: int


class TargetSource(Protocol):
    """Targets by the index of their training view."""

    def __getitem__(self, index: int) -> Target: ...

    def photograph(self, index: int) -> Photograph | None:
        """Return the bytes of a view, where they wait on the device of training; None: targets are floats."""


class Targets:
    """Targets of the training views. The first ones that fit in ``limit_bytes`` stay; the others are made anew.

    Where most of them would be, none stays.

    ``maps`` makes what the losses need of an image alone, which stays with it.

    Nothing is evicted: views come in shuffled epochs, where the least recently used is the next to be wanted.
    """

    def __init__(
        self,
        views: Sequence[View],
        background: tuple[float, float, float],
        *,
        use_masks: bool,
        maps: Callable[[Tensor], TargetMaps | None] | None = None,
        with_silhouettes: bool = False,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        limit_bytes: int = TARGET_BYTES,
    ) -> None:
        self._views = views
        self._background = background
        self._use_masks = use_masks
        self._maps, self._with_silhouettes = maps, with_silhouettes
        self._dtype, self._device = dtype, device
        room, all_bytes = cache_bytes(limit_bytes), self._bytes_of_all()
        self._room = room if room >= WORTH_KEEPING * all_bytes else 0
        self._kept: dict[int, Target] = {}

    def _bytes_of_all(self) -> int:
        """Return what the images of all views take, and what is made of them alone."""
        pixels = sum(view.camera.width * view.camera.height for view in self._views)
        return pixels * 3 * self._dtype.itemsize * (1 if self._maps is None else 2)

    def photograph(self, index: int) -> Photograph | None:
        """Return None: targets are kept as floats."""
        return None

    def __getitem__(self, index: int) -> Target:
        kept = self._kept.get(index)
        if kept is not None:
            return kept
        view = self._views[index]
        image = torch.as_tensor(view.target(self._background)).to(self._device, self._dtype)
        mask = view.usable(masks=self._use_masks)
        alpha = view.alpha() if self._with_silhouettes else None
        target = Target(
            image,
            None if mask is None else torch.as_tensor(mask).to(self._device),
            None,
            None if alpha is None else torch.as_tensor(alpha).to(self._device, self._dtype),
        )
        if target.nbytes + (0 if self._maps is None else image.nbytes) > self._room:
            return target
        if self._maps is not None:
            target = replace(target, maps=self._maps(image))
        self._room -= target.nbytes
        self._kept[index] = target
        return target


@dataclass(frozen=True, eq=False)
class _DecodedImage:
    """A photograph as it was decoded."""

    image: Tensor  # [H, W, 3 or 4] uint8
    mask: Tensor | None  # [H, W] bool
    valid: int

    def nbytes(self, place: str) -> int:
        """Return the bytes it takes on the device or (torch rounds up to powers of two) in pinned memory."""
        sizes = [self.image.nbytes, 0 if self.mask is None else self.mask.nbytes]
        return sum(1 << (size - 1).bit_length() if place == "pinned" and size else size for size in sizes)

    def map(self, change: Callable[[Tensor], Tensor]) -> _DecodedImage:
        return _DecodedImage(change(self.image), None if self.mask is None else change(self.mask), self.valid)


class DeviceTargets:
    """Targets on a GPU: photographs wait there as bytes, 3 or 4 a pixel, and become floats when they are wanted.

    The first ones that fit in ``limit_bytes`` stay on the device. The next ones, up to ``pinned_bytes`` or what the
    system gives, stay in pinned memory of the host, from which they are copied without waiting; any others are decoded
    anew each time.

    Parameters
    ----------
    views : sequence of View
    background : 3 floats in [0, 1]
    use_masks : bool
    device : torch.device
    dtype : torch.dtype
    limit_bytes, pinned_bytes : int
    pin : callable
        Makes a copy in pinned memory.
    """

    def __init__(
        self,
        views: Sequence[View],
        background: tuple[float, float, float],
        *,
        use_masks: bool,
        device: torch.device,
        dtype: torch.dtype = torch.float32,
        limit_bytes: int = 1 << 31,
        pinned_bytes: int = PINNED_BYTES,
        pin: Callable[[Tensor], Tensor] = torch.Tensor.pin_memory,
    ) -> None:
        self._views, self._use_masks = views, use_masks
        self._background = torch.tensor(background, dtype=dtype, device=device)
        self._dtype, self._device, self._pin = dtype, device, pin
        self._room = {"device": limit_bytes, "pinned": pinned_bytes}
        self._kept: dict[int, _DecodedImage] = {}
        self._places: dict[tuple[torch.Size, torch.dtype], Tensor] = {}  # for what comes from the host's memory

    def photograph(self, index: int) -> Photograph | None:
        """Return a view's bytes; those of views that wait elsewhere are good until the next one is asked for."""
        image = self._kept.get(index)
        if image is None:
            image = self._take_in(index)
        there = image.map(self._brought)
        return Photograph(there.image, there.mask, there.valid)

    def _brought(self, tensor: Tensor) -> Tensor:
        """Return a tensor on the device; a copy goes to the same place each time."""
        if tensor.device == self._device:
            return tensor
        key = tensor.shape, tensor.dtype
        if key not in self._places:
            self._places[key] = torch.empty(tensor.shape, dtype=tensor.dtype, device=self._device)
        return self._places[key].copy_(tensor, non_blocking=True)

    def __getitem__(self, index: int) -> Target:
        image = self._kept.get(index)
        if image is None:
            image = self._take_in(index)
        there = image.map(lambda tensor: tensor.to(self._device, non_blocking=True))
        color = there.image[..., :3].to(self._dtype) / 255
        alpha = None
        if there.image.shape[2] == 4:  # as images.composite
            alpha = there.image[..., 3].to(self._dtype) / 255
            color = (color - self._background) * alpha[..., None] + self._background
        return Target(color, there.mask, None, alpha)

    def _take_in(self, index: int) -> _DecodedImage:
        """Decode a photograph, and keep it where there is room."""
        view = self._views[index]
        mask = view.usable(masks=self._use_masks)
        pixels = torch.tensor(view.image())
        valid = pixels.shape[0] * pixels.shape[1] if mask is None else int(mask.sum())
        image = _DecodedImage(pixels, None if mask is None else torch.tensor(mask), valid)
        for place in ("device", "pinned"):
            if image.nbytes(place) > self._room[place]:
                continue
            change = self._pin if place == "pinned" else lambda tensor: tensor.to(self._device)
            try:
                self._kept[index] = image.map(change)
            except RuntimeError:
                if place == "device":
                    raise
                self._room[place] = 0  # the system locks no more memory: slower, but no reason to stop
                break
            self._room[place] -= image.nbytes(place)
            return self._kept[index]
        return image
