"""A thread-safe cache of decoded images, with bounded memory; the rest is in a temporary file."""

from __future__ import annotations

import contextlib
import pickle
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from gs2d.core.image_arrays import area_downscale, mask_downscale
from gs2d.core.memory import trim
from gs2d.core.spill import SpillFile
from gs2d.errors import DiskError

AHEAD = 8  # images that training requests in advance, if not all stay in memory
TRIM_EVERY = 16  # decoded images between two calls of trim(), which take a few ms


@dataclass(frozen=True, eq=False)
class DecodedImage:
    """A decoded image with its masks; the arrays are shared and therefore read-only."""

    image: np.ndarray  # uint8 [H, W, 3 or 4]; sRGB, straight alpha in the fourth channel
    mask: np.ndarray | None = None  # bool [H, W]; False = ignore this pixel
    object_mask: np.ndarray | None = None  # bool [H, W]; True = the object
    # bool [H, W]; False = outside the photograph after undistortion (black). None: all valid.
    valid: np.ndarray | None = None

    def __post_init__(self) -> None:
        for field in ("image", "mask", "object_mask", "valid"):
            array = getattr(self, field)
            if array is not None:
                frozen = array.view()
                frozen.setflags(write=False)
                object.__setattr__(self, field, frozen)

    def downscaled(self, factor: int) -> DecodedImage:
        """Return the image at 1 / ``factor`` of its size, area-filtered; leftover rows and columns are cut.

        A pixel is used if its whole block is, and belongs to the object if half of its block does.
        """
        if factor == 1:
            return self
        mask, valid = (
            None if pixels is None else mask_downscale(pixels, factor, need=1.0) for pixels in (self.mask, self.valid)
        )
        object_mask = None if self.object_mask is None else mask_downscale(self.object_mask, factor, need=0.5)
        return DecodedImage(area_downscale(self.image, factor), mask, object_mask, valid)

    @property
    def nbytes(self) -> int:
        """Memory of the arrays, bytes."""
        arrays = [array for array in (self.image, self.mask, self.object_mask, self.valid) if array is not None]
        return sum({array.ctypes.data: array.nbytes for array in arrays}.values())  # mask may be valid


class ImageCache:
    """A least-recently-used cache of at most ``max_bytes``; images that it drops go to a temporary file.

    Decoding, undistorting and shrinking a photograph takes much longer than reading the result from a file. Where that
    file cannot be written, images are decoded again. Decoding happens outside the lock: threads decode different images
    in parallel; two threads that request the same image may both decode it.

    ``spills`` False: dropped images are decoded again.
    """

    def __init__(self, max_bytes: int, *, spills: bool = False) -> None:
        self.max_bytes = int(max_bytes)
        self._file = SpillFile() if spills else None
        self._places: dict[Hashable, tuple[int, int]] = {}  # in the file
        self._images: OrderedDict[Hashable, DecodedImage] = OrderedDict()
        self._nbytes = self._decoded = 0
        self._lock = threading.Lock()

    @property
    def nbytes(self) -> int:
        """Current memory use, bytes."""
        return self._nbytes

    def __len__(self) -> int:
        return len(self._images)

    def clear(self) -> None:
        """Drop all images from memory."""
        with self._lock:
            self._images.clear()
            self._nbytes = 0

    def get(self, key: Hashable, decode: Callable[[], DecodedImage]) -> DecodedImage:
        """Return the image of ``key``, decoded if it is not in the cache."""
        with self._lock:
            cached = self._images.get(key)
            if cached is not None:
                self._images.move_to_end(key)
                return cached
            if self._file is not None and key in self._places:
                return self._keep(key, DecodedImage(*self._file.get(self._places[key])))
        image = decode()
        with self._lock:
            self._decoded += 1
            trims = self._decoded % TRIM_EVERY == 0
            self._keep(key, image)
        if trims:
            trim()
        return image

    def _keep(self, key: Hashable, image: DecodedImage) -> DecodedImage:
        """Keep an image in memory, and drop the oldest ones beyond the limit."""
        if image.nbytes > self.max_bytes:
            self._spill(key, image)
        elif key not in self._images:
            self._images[key] = image
            self._nbytes += image.nbytes
        while self._nbytes > self.max_bytes:
            oldest, dropped = self._images.popitem(last=False)
            self._nbytes -= dropped.nbytes
            self._spill(oldest, dropped)
        return image

    def _spill(self, key: Hashable, image: DecodedImage) -> None:
        """Write a dropped image to the file, once."""
        if self._file is None or key in self._places:
            return
        try:
            parts = (image.image, image.mask, image.object_mask, image.valid)
            self._places[key] = self._file.put(pickle.dumps(parts, protocol=pickle.HIGHEST_PROTOCOL))
        except DiskError:
            self._file = None


class ReadAhead:
    """Decodes images in advance, on its own threads, to fill a cache.

    Errors are ignored here; they are raised again when the image is requested. ``load``: requests the image of an
    index.
    """

    def __init__(self, load: Callable[[int], object]) -> None:
        self._load = load
        self._pool = ThreadPoolExecutor(2, thread_name_prefix="read-ahead")
        self._requested: set[int] = set()

    def expect(self, indices: Sequence[int]) -> None:
        """Request the images of indices that were not in the previous call."""
        for index in indices:
            if index not in self._requested:
                self._pool.submit(self._quietly, index)
        self._requested = set(indices)

    def _quietly(self, index: int) -> None:
        with contextlib.suppress(Exception):
            self._load(index)
