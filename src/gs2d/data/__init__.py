"""Captures on disk become scenes: readers of every format, image files, masks and maps."""

from __future__ import annotations

from gs2d.data.cache import DecodedImage, ImageCache
from gs2d.data.load import DEFAULT_CACHE_BYTES, FORMATS, detect_format, load_scene
from gs2d.data.scene import PointCloud, Scene, View

__all__ = [
    "DEFAULT_CACHE_BYTES",
    "FORMATS",
    "DecodedImage",
    "ImageCache",
    "PointCloud",
    "Scene",
    "View",
    "detect_format",
    "load_scene",
]
