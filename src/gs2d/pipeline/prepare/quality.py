"""What draft, normal and full mean: how long is trained on how large pictures, on the device that trains."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from gs2d.config.recipe import Recipe
from gs2d.core.camera import Camera
from gs2d.errors import RecipeError
from gs2d.render.backends import get_backend


@dataclass(frozen=True)
class Quality:
    """How much is trained on what: iterations (None: as many as the recipe has), and the longer side in px, about."""

    iterations: int | None
    side: int

    def schedule_scale(self, recipe: Recipe) -> float:
        """Return the part of the recipe that is trained: never more than all of it."""
        return 1.0 if self.iterations is None else min(1.0, self.iterations / max(1, recipe.iterations))

    def downscale(self, cameras: Sequence[Camera]) -> int:
        """Return by how much pictures shrink so that the largest has about this side."""
        side = max(max(camera.width, camera.height) for camera in cameras)
        return max(1, math.floor(side / self.side + 0.5))


_FULL = Quality(None, 1600)  # the side at which the official code trains, too
QUALITIES: Mapping[str, Mapping[str, Quality]] = MappingProxyType(  # name -> values on a CPU and on other devices
    {
        "draft": {"cpu": Quality(1_800, 400), "gpu": Quality(6_000, 800)},
        "normal": {"cpu": Quality(6_000, 800), "gpu": Quality(30_000, 1600)},
        "full": {"cpu": _FULL, "gpu": _FULL},
    }
)


def quality_of(name: str, backend: str) -> Quality:
    """Return the schedule and the picture size that are meant, on the device that this machine trains with."""
    if name not in QUALITIES:
        raise RecipeError(f"--quality must be one of {', '.join(QUALITIES)}, got {name}")
    return QUALITIES[name]["cpu" if get_backend(backend).on_host else "gpu"]
