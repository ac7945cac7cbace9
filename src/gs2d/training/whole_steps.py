"""Iterations that a backend does in one piece: which ones it can do, and their description for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import is_not
from types import MappingProxyType
from typing import Any

from torch import Tensor

from gs2d.config.recipe import LossTerm, Stage
from gs2d.render.types import RasterSettings
from gs2d.render.whole_step import Learned, StepLosses, WholeStep
from gs2d.training.densify.densifier import Densifier
from gs2d.training.objective import FullRender, learning_rows
from gs2d.training.optimizer import lr_at
from gs2d.training.robust.regularise import another_background
from gs2d.training.state import TrainState

NOTHING: Mapping[str, Tensor] = MappingProxyType({})


class WholeSteps:
    """Describes iterations of a stage to a backend that does them in one piece.

    All active losses must allow it (``Loss.in_step``), and no quantity of images or cameras may be learned. Other
    iterations are done by :class:`~gs2d.training.objective.FullRender`.
    """

    def __init__(self, whole: FullRender, stage: Stage) -> None:
        self._whole, self._stage = whole, stage
        self._terms = whole.protocol.resolve(stage.losses)
        self._possible = whole.frozen is None and whole.drops(stage) == 0
        self._settings: dict[object, RasterSettings] = {}  # by SH degree and background
        self._rows: tuple[tuple[Tensor, ...], Tensor | None] | None = None  # groups, and their union

    def learn(self, state: TrainState, iteration: int, index: int, densifier: Densifier | None) -> bool:
        """Do an iteration; return False if it cannot be done in one piece, and nothing was done."""
        if not self._possible or state.learned:
            return False
        active = [term for term in self._terms if term.is_active(iteration)]
        gathered = NOTHING if densifier is None else densifier.gathers(state, iteration)
        if gathered is None:
            return False
        photograph = self._whole.targets.photograph(index)
        if photograph is None:
            return False
        opaque = photograph.image.shape[2] == 3
        losses = self._losses(active, opaque=opaque)
        stage, whole = self._stage, self._whole
        learned = self._learned(state, iteration)
        if losses is None or not learned:
            return False
        step = WholeStep(
            splats=state.splats,
            camera=whole.camera(state, index),
            settings=self._settings_at(iteration, opaque=opaque),
            photograph=photograph.image,
            mask=photograph.mask,
            flatness=state.bare(index, photograph.flatness, whole.cells),
            valid=photograph.valid,
            background=whole.protocol.background,
            losses=losses,
            rows=None if gathered else self._learning_rows(state),
            learned=learned,
            betas=(stage.lr.beta1, stage.lr.beta2, stage.lr.eps),
            gathered=gathered,
        )
        if not whole.backend.step(step):
            return False
        for name in learned:
            state.moments[name].steps += 1
        return True

    def _losses(self, active: Sequence[LossTerm], *, opaque: bool) -> StepLosses | None:
        """Return the losses of the step; None if a step cannot have all active ones."""
        fields: dict[str, Any] = {}
        for term in active:
            added = self._whole.losses[term].in_step(term, opaque=opaque)
            if added is None or not fields.keys().isdisjoint(added):
                return None
            fields |= added
        losses = StepLosses(**fields)
        return None if losses.smooth_normals and losses.normals is None else losses

    def _learned(self, state: TrainState, iteration: int) -> dict[str, Learned]:
        rates, stage, learned = lr_at(self._stage.lr, iteration, self._whole.scene.extent), self._stage, {}
        for name, parameter in state.splats.items():
            if name in stage.train and parameter.numel() > 0:
                moments, group = state.moments[name], stage.train[name]
                trained = None if group == "all" else state.groups[group]
                learned[name] = Learned(moments.mean, moments.square, rates[name], moments.steps + 1, trained)
        return learned

    def _settings_at(self, iteration: int, *, opaque: bool) -> RasterSettings:
        """Return the rasterizer settings; the same object while they are equal."""
        recipe = self._whole.recipe
        background = another_background(recipe, self._stage, iteration) if opaque else None
        key = self._stage.active_sh_degree(iteration, recipe.sh_degree), background
        if key not in self._settings:
            self._settings[key] = self._whole.settings(self._stage, iteration, background)
        return self._settings[key]

    def _learning_rows(self, state: TrainState) -> Tensor | None:
        """Return the splats that the stage trains, computed anew when the groups have changed."""
        groups = tuple(state.groups[group] for group in set(self._stage.train.values()) - {"all"})
        if self._rows is None or len(groups) != len(self._rows[0]) or any(map(is_not, groups, self._rows[0])):
            self._rows = groups, learning_rows(state, self._stage)
        return self._rows[1]
