"""Training images as tensors over the background, kept in memory as far as it allows."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gs2d.config import protocols as config
from gs2d.core.memory_limit import cache_bytes
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene, View
from gs2d.losses.formulas import flatness
from gs2d.render.backends import Backend

TARGET_BYTES = 1 << 28  # of float targets: enough for all images of a small capture
DEVICE_BYTES = 1 << 31  # of images on a GPU
# Fraction of the images that must fit, or none is cached: making a target from decoded bytes takes only a few ms.
WORTH_KEEPING = 0.5
PINNED_BYTES = 1 << 33


@dataclass(frozen=True, eq=False)
class Target:
    """Expected rendering of a training view."""

    image: Tensor  # [H, W, 3] in [0, 1], over the background
    mask: Tensor | None  # [H, W] bool; False = ignore this pixel
    mean: Tensor | None  # [H, W, 3]: local mean of the image for the native SSIM, of cached images
    # [H, W]: alpha of the image in [0, 1], if it has an alpha channel and a loss needs it.
    silhouette: Tensor | None = None
    flatness: Tensor | None = None  # [H, W] uint8: ``losses.formulas.flatness`` of the image, if a loss needs it

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        tensors = (self.image, self.mask, self.silhouette, self.flatness, self.mean)
        return sum(tensor.nbytes for tensor in tensors if tensor is not None)


@dataclass(frozen=True, eq=False)
class ImageBytes:
    """A decoded training image."""

    image: Tensor  # [H, W, 3 or 4] uint8
    mask: Tensor | None  # [H, W] bool; False = ignore this pixel
    valid: int  # number of pixels that count
    flatness: Tensor | None = None  # [H, W] uint8, as of ``Target``

    def nbytes(self, place: str) -> int:
        """Return the bytes on the "device", or in "pinned" memory, where torch rounds up to powers of two."""
        sizes = [0 if tensor is None else tensor.nbytes for tensor in (self.image, self.mask, self.flatness)]
        return sum(1 << (size - 1).bit_length() if place == "pinned" and size else size for size in sizes)

    def map(self, change: Callable[[Tensor], Tensor]) -> ImageBytes:
        """Return the image with a function applied to its tensors."""
        image = change(self.image)
        mask, flat = (None if tensor is None else change(tensor) for tensor in (self.mask, self.flatness))
        return ImageBytes(image, mask, self.valid, flat)


def is_async(device: torch.device) -> bool:
    """Return whether reading a tensor on this device makes the host wait."""
    return device.type != "cpu"


def make_targets(
    scene: Scene, protocol: config.Protocol, backend: Backend, splats: Splats, needs: Collection[str]
) -> TargetSource:
    """Return the targets of the training views of a scene, on the device of the splats.

    ``needs`` has "silhouette" and "flatness" if a loss needs them.
    """
    views, background, device = scene.train, protocol.background, splats.device
    use_masks = protocol.use_mask_in_training
    if is_async(device):
        pinned = 0 if scene.ahead else cache_bytes(PINNED_BYTES)
        options = {"limit_bytes": DEVICE_BYTES, "pinned_bytes": pinned, "needs": needs}
        return DeviceTargets(views, background, use_masks=use_masks, device=device, **options)  # type: ignore[arg-type]
    operations = backend.loss_operations(device)
    return Targets(
        views,
        background,
        use_masks=use_masks,
        mean=None if operations is None or operations.blur is None else operations.blur,
        needs=needs,
        dtype=splats.dtype,
        device=device,
        limit_bytes=0 if scene.ahead else TARGET_BYTES,
    )


class Targets:
    """Targets as float tensors. The first ones that fit in ``limit_bytes`` are cached, unless they are few.

    Nothing is evicted: views come in shuffled epochs, so the least recently used one is needed next. ``background`` is
    in [0, 1]. ``mean``: computes the local mean of an image, which is cached with it. ``needs``: "silhouette" and
    "flatness", if they are needed.
    """

    def __init__(
        self,
        views: Sequence[View],
        background: tuple[float, float, float],
        *,
        use_masks: bool,
        mean: Callable[[Tensor], Tensor | None] | None = None,
        needs: Collection[str] = (),
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        limit_bytes: int = TARGET_BYTES,
    ) -> None:
        self._views, self._background, self._use_masks = views, background, use_masks
        self._mean, self._needs = mean, frozenset(needs)
        self._dtype, self._device = dtype, device
        pixels = sum(view.camera.width * view.camera.height for view in views)
        all_bytes = pixels * 3 * dtype.itemsize * (1 if mean is None else 2)
        room = cache_bytes(limit_bytes)
        self._room = room if room >= WORTH_KEEPING * all_bytes else 0
        self._cached: dict[int, Target] = {}

    def photograph(self, index: int) -> ImageBytes | None:
        """Return None: targets are kept as floats."""
        return None

    def __getitem__(self, index: int) -> Target:
        cached = self._cached.get(index)
        if cached is not None:
            return cached
        view = self._views[index]
        image = torch.as_tensor(view.target(self._background)).to(self._device, self._dtype)
        mask = view.usable(masks=self._use_masks)
        alpha = view.alpha() if "silhouette" in self._needs else None
        target = Target(
            image,
            None if mask is None else torch.as_tensor(mask).to(self._device),
            None,
            None if alpha is None else torch.as_tensor(alpha).to(self._device, self._dtype),
            flatness(image) if "flatness" in self._needs else None,
        )
        if target.nbytes + (0 if self._mean is None else image.nbytes) > self._room:
            return target
        if self._mean is not None:
            target = replace(target, mean=self._mean(image))
        self._room -= target.nbytes
        self._cached[index] = target
        return target


class DeviceTargets:
    """Targets on a GPU, kept as bytes, 3 or 4 a pixel, and converted to float32 on demand.

    The first images that fit in ``limit_bytes`` stay on the device. The next ones, up to ``pinned_bytes`` or what the
    system allows, stay in pinned host memory, from which they are copied without waiting. Others are decoded each time.
    ``needs``: "flatness", if it is needed. ``pin``: makes a copy in pinned memory.
    """

    def __init__(
        self,
        views: Sequence[View],
        background: tuple[float, float, float],
        *,
        use_masks: bool,
        device: torch.device,
        limit_bytes: int = DEVICE_BYTES,
        pinned_bytes: int = PINNED_BYTES,
        needs: Collection[str] = (),
        pin: Callable[[Tensor], Tensor] = torch.Tensor.pin_memory,
    ) -> None:
        self._views, self._use_masks, self._needs = views, use_masks, frozenset(needs)
        self._background = torch.tensor(background, dtype=torch.float32, device=device)
        self._device, self._pin = device, pin
        self._room = {"device": limit_bytes, "pinned": pinned_bytes}
        self._cached: dict[int, ImageBytes] = {}
        self._buffers: dict[tuple[torch.Size, torch.dtype], Tensor] = {}  # for images from host memory

    def photograph(self, index: int) -> ImageBytes | None:
        """Return the bytes of an image; one from host memory is valid until the next call."""
        return self._decoded(index).map(self._on_device)

    def __getitem__(self, index: int) -> Target:
        there = self._decoded(index).map(lambda tensor: tensor.to(self._device, non_blocking=True))
        color, alpha = self._composited(there.image)
        return Target(color, there.mask, None, alpha, there.flatness)

    def _composited(self, image: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return colours over the background, and alpha; as ``images.composite``."""
        color = image[..., :3].float() / 255
        if image.shape[2] == 3:
            return color, None
        alpha = image[..., 3].float() / 255
        background = self._background.to(image.device)
        return (color - background) * alpha[..., None] + background, alpha

    def _on_device(self, tensor: Tensor) -> Tensor:
        """Return a tensor on the device; copies of one shape share a buffer."""
        if tensor.device == self._device:
            return tensor
        key = tensor.shape, tensor.dtype
        if key not in self._buffers:
            self._buffers[key] = torch.empty(tensor.shape, dtype=tensor.dtype, device=self._device)
        return self._buffers[key].copy_(tensor, non_blocking=True)

    def _decoded(self, index: int) -> ImageBytes:
        """Return a cached image, or decode it and cache it if there is room."""
        if index in self._cached:
            return self._cached[index]
        view = self._views[index]
        mask = view.usable(masks=self._use_masks)
        pixels = torch.tensor(view.image())
        valid = pixels.shape[0] * pixels.shape[1] if mask is None else int(mask.sum())
        flat = flatness(self._composited(pixels)[0]) if "flatness" in self._needs else None
        image = ImageBytes(pixels, None if mask is None else torch.tensor(mask), valid, flat)
        for place in ("device", "pinned"):
            if image.nbytes(place) > self._room[place]:
                continue
            change = self._pin if place == "pinned" else lambda tensor: tensor.to(self._device)
            try:
                self._cached[index] = image.map(change)
            except RuntimeError:
                if place == "device":
                    raise
                self._room[place] = 0  # the system locks no more memory: slower, but no reason to stop
                break
            self._room[place] -= image.nbytes(place)
            return self._cached[index]
        return image


TargetSource = Targets | DeviceTargets
