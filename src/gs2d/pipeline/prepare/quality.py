"""Training length and image size of each ``--quality``, by the device that trains."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from gs2d.config.recipe import Recipe
from gs2d.core.camera import Camera


@dataclass(frozen=True)
class QualityLevel:
    """Iterations (None: all of the recipe) and approximate longer side of the images in px."""

    iterations: int | None
    side: int

    def schedule_scale(self, recipe: Recipe) -> float:
        """Return the fraction of the recipe that is trained, at most 1."""
        return 1.0 if self.iterations is None else min(1.0, self.iterations / max(1, recipe.iterations))

    def downscale(self, cameras: Sequence[Camera]) -> int:
        """Return the factor by which images shrink so that the largest has about this side."""
        side = max(max(camera.width, camera.height) for camera in cameras)
        return max(1, math.floor(side / self.side + 0.5))


_FULL = QualityLevel(None, 1600)  # the image size of the official code
QUALITIES: Mapping[str, Mapping[str, QualityLevel]] = MappingProxyType(
    {
        "draft": {"cpu": QualityLevel(1_800, 400), "gpu": QualityLevel(6_000, 800)},
        "normal": {"cpu": QualityLevel(6_000, 800), "gpu": QualityLevel(30_000, 1600)},
        "full": {"cpu": _FULL, "gpu": _FULL},
    }
)


def quality_level(name: str, *, is_data_set: bool, on_host: bool) -> QualityLevel | None:
    """Return what a quality means; None: the whole recipe on full-size images.

    Parameters
    ----------
    name : str
    is_data_set : bool
        Whether the capture belongs to a data set with a protocol of its own, for which "auto" is the whole recipe.
    on_host : bool
        Whether the CPU trains.
    """
    if name == "auto" and is_data_set:
        return None
    return QUALITIES["normal" if name == "auto" else name]["cpu" if on_host else "gpu"]
