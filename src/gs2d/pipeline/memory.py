"""Memory between the phases of a run: what the next phase has no use for goes first."""

from __future__ import annotations

import gc

from gs2d.core.memory import trim
from gs2d.data import Scene
from gs2d.kernels.library import available_variants, load


def release(scene: Scene) -> None:
    """Drop decoded pictures, reused buffers and whatever waits for the garbage collector; nothing is lost by it.

    A trainer and its listener hold each other, so that targets and moments would stay until the collector happens by.
    Pictures are decoded again where somebody asks for one.
    """
    scene.forget()
    gc.collect()
    if available_variants():
        load().pool.clear()
    trim()
