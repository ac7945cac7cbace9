"""The splats that a training starts from, by its recipe."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gs2d.config.recipe import Recipe
from gs2d.core.splats import Splats
from gs2d.training import events
from gs2d.training.robust.robustness import Robustness
from gs2d.training.start.initialize import initial_splats, splats_as_start
from gs2d.training.start.known_points import with_known_points

MIN_START = 10  # a dense start with fewer splats gives way to the splats of ``init``


def first_splats(
    recipe: Recipe,
    robust: Robustness,
    near: float,
    generator: torch.Generator,
    dtype: torch.dtype,
    init: Splats | None = None,
    within: Callable[[Tensor], Tensor] | None = None,
) -> tuple[Splats, events.Initialised]:
    """Return the first splats, and the event that reports them.

    ``robust``: dense start of the recipe, with the scene that holds its points. ``near`` (world units): points nearer
    to a camera are dropped. ``init``: splats to start from, unless a dense start finds enough others. ``within``:
    returns which points [M, 3] belong to the trained part of the scene, [M] bool.
    """
    if init is None or robust.starts_densely:
        start = with_known_points(robust.scene, recipe)
        options = {"random_points": recipe.init_points, "near": near, "generator": generator, "dtype": dtype}
        initial = initial_splats(start, sh_degree=recipe.sh_degree, **options)  # type: ignore[arg-type]
        source = initial.source if start is robust.scene else "depths"
        source = "sweep" if source == "points" and robust.starts_densely else source
        splats = robust.fitted(initial)
        splats = splats if within is None else splats.rows(within(splats.means))
        if init is None or len(splats) >= MIN_START:
            return splats, events.Initialised(len(splats), source, initial.dropped, robust.lacks)
    splats = splats_as_start(init, sh_degree=recipe.sh_degree, dtype=dtype)
    return splats, events.Initialised(len(splats), "splats", 0)
