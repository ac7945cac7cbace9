"""Check that training can continue from a state of a file: it must be complete and fit the recipe and the scene."""

from __future__ import annotations

from gs2d.config.recipe import GradDensify, Recipe
from gs2d.data.scene import Scene
from gs2d.errors import RunError
from gs2d.training.densify.gradient import no_statistics
from gs2d.training.learned.learned_table import LearnedTable
from gs2d.training.state import TrainState


def check_resumable(state: TrainState, recipe: Recipe, scene: Scene, views: int | None = None) -> None:
    """Raise RunError unless training of a recipe on a scene, in epochs of ``views``, can continue from a state."""
    state.check()
    if state.splats.sh_degree != recipe.sh_degree:
        raise RunError(
            f"the checkpoint has SH degree {state.splats.sh_degree}, but recipe {recipe.name!r} trains "
            f"{recipe.sh_degree}; start a new run"
        )
    _check_place(state, recipe)
    last, views = max(state.queue, default=0), len(scene.train) if views is None else views
    if last >= views:
        raise RunError(
            f"the checkpoint refers to training view {last}, but the scene has {views}; is it from another scene?"
        )
    views = len(scene.train)
    for name, cells in state.maps.items():
        if len(cells) != views:
            raise RunError(
                f"the checkpoint has maps of {name} for {len(cells)} training views, but the scene has {views}; is it "
                "of another scene?"
            )
    LearnedTable(recipe, scene).check(state.learned)
    _check_stage(state, recipe)


def _check_place(state: TrainState, recipe: Recipe) -> None:
    """Raise RunError unless the recipe has the stage and the iteration."""
    stages = recipe.stages
    inside = 0 <= state.stage < len(stages) and 0 <= state.step <= stages[state.stage].iterations
    at_end = state.stage == len(stages) and state.step == 0
    if not (inside or at_end) or (state.step > 0 and not state.entered):
        raise RunError(
            f"the checkpoint is at stage {state.stage}, iteration {state.step}, which recipe {recipe.name!r} "
            "does not have; start a new run"
        )


def _check_stage(state: TrainState, recipe: Recipe) -> None:
    """Raise RunError unless the state has the row groups, moments and statistics that the current stage needs."""
    begun = recipe.stages[: state.stage + state.entered]
    written = (action.writes for stage in begun for action in stage.on_enter)
    missing = {name for name in written if name is not None} - state.groups.keys()
    if missing:
        raise RunError(f"the checkpoint lacks the row group {min(missing)!r}; start a new run")
    if not state.entered or state.stage >= len(recipe.stages):
        return
    stage = recipe.stages[state.stage]
    untrained = stage.train.keys() - state.moments.keys()
    if untrained:
        raise RunError(f"the checkpoint lacks the moments of {min(untrained)}; start a new run")
    if stage.densify is None:
        return
    by_gradient = isinstance(stage.densify, GradDensify) and stage.densify.stop > 0
    needed = no_statistics(state.splats).keys() if by_gradient else set()
    if state.statistics is None or needed - state.statistics.keys():
        raise RunError("the checkpoint lacks the statistics of densification; start a new run")
