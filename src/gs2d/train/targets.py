"""The photographs as training wants them: float tensors over the background, kept as far as memory allows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gs2d.data.scene import View
from gs2d.losses import TargetMaps, target_maps


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
    """

    image: Tensor
    mask: Tensor | None
    maps: TargetMaps | None

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        tensors = [self.image, self.mask, None if self.maps is None else self.maps.mean]
        return sum(tensor.numel() * tensor.element_size() for tensor in tensors if tensor is not None)


class Targets:
    """Targets of the training views. The first ones that fit in ``limit_bytes`` stay; the others are made anew.

    Nothing is evicted: views come in shuffled epochs, where the least recently used is the next to be wanted.
    """

    def __init__(
        self,
        views: Sequence[View],
        background: tuple[float, float, float],
        *,
        use_masks: bool,
        with_maps: bool,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        limit_bytes: int = 1 << 29,
    ) -> None:
        self._views = views
        self._background = background
        self._use_masks = use_masks
        self._with_maps = with_maps
        self._dtype, self._device = dtype, device
        self._room = limit_bytes
        self._kept: dict[int, Target] = {}

    def __getitem__(self, index: int) -> Target:
        kept = self._kept.get(index)
        if kept is not None:
            return kept
        view = self._views[index]
        image = torch.as_tensor(view.target(self._background)).to(self._device, self._dtype)
        mask = view.mask() if self._use_masks else None
        target = Target(image, None if mask is None else torch.as_tensor(mask).to(self._device), None)
        if target.nbytes + (image.nbytes if self._with_maps else 0) > self._room:
            return target
        if self._with_maps:
            target = Target(image, target.mask, target_maps(image))
        self._room -= target.nbytes
        self._kept[index] = target
        return target
