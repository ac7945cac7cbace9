"""The splats that a training starts from, by its recipe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gs2d.config.recipe import Recipe
from gs2d.core.splats import Splats
from gs2d.training import events
from gs2d.training.robust.robustness import Robustness
from gs2d.training.start.initialize import initial_splats, splats_as_start
from gs2d.training.start.known_points import with_known_points

MIN_START = 10  # a dense start with fewer splats gives way to the splats of ``init``


@dataclass(frozen=True, eq=False)
class FirstSplats:
    """Creates the first splats of a training.

    Attributes
    ----------
    recipe : Recipe
    robust : Robustness
        Dense start of the recipe, with the scene that holds its points.
    near : float, world units
        Points nearer to a camera are dropped.
    generator : torch.Generator
    dtype : torch.dtype
    """

    recipe: Recipe
    robust: Robustness
    near: float
    generator: torch.Generator
    dtype: torch.dtype

    def make(self, init: Splats | None, within: Callable[[Tensor], Tensor] | None) -> tuple[Splats, events.Initialised]:
        """Return the first splats, and the event that reports them.

        Parameters
        ----------
        init : Splats, optional
            Splats to start from, unless a dense start finds enough others.
        within : callable, optional
            Returns which points [M, 3] belong to the trained part of the scene, [M] bool.
        """
        if init is not None and not self.robust.starts_densely:
            return self._copied(init)
        splats, event = self._from_points(within)
        return self._copied(init) if init is not None and len(splats) < MIN_START else (splats, event)

    def _copied(self, init: Splats) -> tuple[Splats, events.Initialised]:
        splats = splats_as_start(init, sh_degree=self.recipe.sh_degree, dtype=self.dtype)
        return splats, events.Initialised(len(splats), "splats", 0)

    def _from_points(self, within: Callable[[Tensor], Tensor] | None) -> tuple[Splats, events.Initialised]:
        start = with_known_points(self.robust.scene, self.recipe)
        initial = initial_splats(
            start,
            sh_degree=self.recipe.sh_degree,
            random_points=self.recipe.init_points,
            near=self.near,
            generator=self.generator,
            dtype=self.dtype,
        )
        source = initial.source if start is self.robust.scene else "depths"
        source = "sweep" if source == "points" and self.robust.starts_densely else source
        splats = self.robust.fitted(initial)
        splats = splats if within is None else splats.rows(within(splats.means))
        return splats, events.Initialised(len(splats), source, initial.dropped, self.robust.lacks)
