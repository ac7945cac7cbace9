"""Loss and gradients from cached views, for a stage in which only the colours of a row group learn (stage 2).

Each view is then affine in those colours (:mod:`gs2d.render.cpu_cached`). The cache depends on frozen attributes only,
so a resumed run builds the same cache. The cached views are chosen when the stage begins, by their order and size.
"""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from gs2d.config.recipe import Recipe, Stage
from gs2d.losses.base import Losses
from gs2d.render.backends import Backend
from gs2d.render.cpu_cached import CachedView
from gs2d.render.types import RenderOutput
from gs2d.training.objective import FullRender
from gs2d.training.state import TrainState
from gs2d.training.step_result import StepResult

COLORS = frozenset({"sh0", "shN"})
MIN_FRACTION = 0.5  # of the views: a cache for fewer saves little time
WORTH = 2  # visits per view that repay filling the cache, which costs about two forward passes


def is_cacheable(recipe: Recipe, stage: Stage, *, backend: Backend, views: int, processes: int = 1) -> bool:
    """Return whether a stage can train from cached views, and is long enough to gain from it.

    Such a stage trains only the colours of one row group, at one SH degree, with losses of the colour image. Each of
    several ``processes`` visits only its share of the views.
    """
    groups = set(stage.train.values())
    return (
        backend.caches_views
        and COLORS.issuperset(stage.train)
        and len(groups) == 1
        and "all" not in groups
        and stage.densify is None
        and all(loss.only_color for _, loss in Losses(stage.losses))
        and stage.active_sh_degree(1, recipe.sh_degree) == stage.active_sh_degree(stage.iterations, recipe.sh_degree)
        and stage.iterations >= WORTH * views * processes
    )


def choose_objective(
    whole: FullRender, state: TrainState, stage: Stage, limit_bytes: int, processes: int = 1
) -> FullRender | CachedViews:
    """Return cached views if the stage allows them and enough fit in ``limit_bytes``, else ``whole``."""
    backend, views = whole.backend, len(whole.scene.train)
    fits = is_cacheable(whole.recipe, stage, backend=backend, views=views, processes=processes)
    if limit_bytes > 0 and whole.frozen is None and fits:
        cached = CachedViews(whole, state, stage, limit_bytes, least=MIN_FRACTION * views)
        return cached if cached.views else whole
    return whole


class CachedViews:
    """Caches the first training views that fit in ``limit_bytes``; ``whole`` evaluates the others.

    ``state``: geometry, opacity and the colours outside the group stay constant. ``stage``: a stage for which
    :func:`is_cacheable` is true. ``limit_bytes``: limit for all cached views together. ``least``: if fewer views of the
    size of the first would fit, none is cached.
    """

    def __init__(
        self, whole: FullRender, state: TrainState, stage: Stage, limit_bytes: int, *, least: float = 0.0
    ) -> None:
        self._whole = whole
        (group,) = set(stage.train.values())
        self.rows: Tensor | None = state.groups[group].nonzero().squeeze(1)  # [M] int64, of the group
        self.views: list[CachedView] = []  # training views 0, 1, ...
        settings, room = whole.settings(stage, 1), limit_bytes
        for index in range(len(whole.scene.train)):
            camera = whole.camera(state, index)
            cached = whole.backend.cache_view(state.splats, camera, settings, self.rows, limit_bytes=room)
            if cached is None or (index == 0 and cached.nbytes * least > limit_bytes):
                break
            room -= cached.nbytes
            self.views.append(cached)

    def evaluate(
        self, state: TrainState, stage: Stage, iteration: int, index: int, probe: Tensor | None = None
    ) -> StepResult:
        """Return loss and gradients of training view ``index``."""
        if index >= len(self.views):
            return self._whole.evaluate(state, stage, iteration, index, probe)
        parameters = dict(state.splats.items())
        leaves = {name: parameters[name][self.rows].requires_grad_(name in stage.train) for name in sorted(COLORS)}
        color = self.views[index].render(leaves["sh0"], leaves["shN"])
        unused = color.new_empty(0)  # losses of such a stage read only the colour
        output = RenderOutput(color, unused, unused, unused, unused, unused, unused)
        camera = self._whole.camera(state, index)  # constant in a stage that moves no splats
        result = self._whole.differentiate(state, stage, iteration, index, camera, output, leaves)
        return replace(result, rows=self.rows)
