"""Freed memory is returned to the system, and cached images are dropped on request."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gs2d.core.camera import look_at
from gs2d.data import Scene, View
from gs2d.data.cache import DecodedImage, ImageCache
from gs2d.pipeline.prepare.limits import release


def test_a_scene_decodes_forgotten_images_again(tmp_path: Path) -> None:
    cache, decoded = ImageCache(1 << 20), []
    camera = look_at(np.array([0.0, 0.0, -3.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]), width=4, height=4, fx=5.0)

    def view(name: str) -> View:
        def decode() -> DecodedImage:
            decoded.append(name)
            return DecodedImage(np.full((4, 4, 3), len(name), np.uint8))

        return View(name, camera, decode, cache)

    scene = Scene("s", "colmap", (view("a"),), (view("bb"),), None, 1.0, np.zeros((2, 3)))
    assert [v.name for v in scene.preload(2)] == ["a", "bb"]
    assert cache.nbytes == 2 * 48
    scene.views[0].image()
    assert sorted(decoded) == ["a", "bb"]
    release(scene)
    assert (cache.nbytes, len(cache)) == (0, 0)
    assert scene.views[1].image()[0, 0, 0] == 2
    assert len(decoded) == 3
