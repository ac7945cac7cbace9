"""Entry actions: ranking by error and cloning in place."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch

from gs2d.config.actions import ACTIONS, CLONE_IN_PLACE, RANK_BY_ERROR, Action
from gs2d.errors import DivergedError, RecipeError
from gs2d.render.api import rasterize
from gs2d.training import events
from gs2d.training.actions.clone_in_place import CloneInPlace
from gs2d.training.actions.entry_action import StageEntry
from gs2d.training.actions.rank_by_error import RankByError, worst
from gs2d.training.state import TrainState
from train_toys import full_state, make_scene, random_splats


def entry(by_view: Sequence[torch.Tensor] = ()) -> StageEntry:
    return StageEntry("refine", make_scene(), lambda occlusion: iter(by_view))


def test_worst_takes_the_largest_errors_and_the_lower_index_of_ties() -> None:
    errors = torch.tensor([1.0, 5.0, 5.0, 2.0, 5.0])
    assert worst(errors, 40).tolist() == [1, 2]
    assert worst(errors, 100).tolist() == [1, 2, 4, 3, 0]
    assert worst(torch.ones(5000), 10).tolist() == list(range(500))  # many ties: an unstable sort would shuffle them


def test_ranking_sums_over_views_and_writes_the_group() -> None:
    state = full_state(4)
    by_view = [torch.tensor([1.0, 0.0, 3.0, 0.0]), torch.tensor([1.0, 4.0, 0.0, 0.0])]
    (event,) = RankByError("bad", top_percent=50).run(state, entry(by_view))
    assert event == events.Ranked("refine", "bad", 2, 3.0, pytest.approx(7 / 9))  # type: ignore[arg-type]
    assert state.groups["bad"].tolist() == [False, True, True, False]


def test_an_error_that_is_not_finite_stops() -> None:
    with pytest.raises(DivergedError, match="NaN"):
        RankByError("bad").run(full_state(2), entry([torch.tensor([1.0, float("nan")])]))


def test_options_that_an_action_does_not_take_are_refused() -> None:
    for action, message in (
        (RANK_BY_ERROR.with_options(top_percent=0.0), "top_percent must be in"),
        (RANK_BY_ERROR.with_options(top_percent=101), "top_percent must be in"),
        (CLONE_IN_PLACE.with_options(opacity="halve"), "one of copy, preserve; got 'halve'"),
        (Action("clone_in_place"), "does not take the options"),
    ):
        with pytest.raises(RecipeError, match=message):
            ACTIONS.make(action.name, options=action.options)


def test_a_clone_is_an_exact_copy_in_the_groups_of_its_original() -> None:
    state = full_state(7)  # high_error: rows 0, 3, 6
    before = state.splats.clone()
    assert CloneInPlace("high_error", "clones").run(state, entry()) == (
        events.Cloned("refine", "clones", 3, "copy", 10),
    )
    state.check()
    for name, tensor in state.splats.items():
        original = dict(before.items())[name]
        assert torch.equal(tensor[:7], original), name
        assert torch.equal(tensor[7:], original[[0, 3, 6]]), name
    assert state.groups["clones"].tolist() == [False] * 7 + [True] * 3
    assert state.groups["high_error"].tolist() == [True, False, False, True, False, False, True] + [True] * 3
    assert not state.moments["means"].mean[7:].any()


def test_preserve_keeps_the_transmittance_of_a_pair() -> None:
    state = full_state(7)
    before = state.splats.clone()
    CloneInPlace("high_error", "clones", "preserve").run(state, entry())
    new, old = state.splats.opacities.double(), before.opacities.double()
    torch.testing.assert_close((1 - new[[0, 3, 6]]) ** 2, 1 - old[[0, 3, 6]], rtol=1e-5, atol=1e-7)
    assert torch.equal(state.splats.opacity_logits[7:], state.splats.opacity_logits[[0, 3, 6]])
    assert torch.equal(state.splats.opacity_logits[[1, 2, 4, 5]], before.opacity_logits[[1, 2, 4, 5]])


def test_preserve_hardly_changes_the_image_and_copy_does() -> None:
    scene = make_scene()
    camera = scene.train[0].camera

    def change(opacity: str) -> float:
        state = TrainState(random_splats(60, seed=3), torch.Generator())
        state.groups["high_error"] = torch.arange(60) < 20
        with torch.no_grad():
            before = rasterize(state.splats, camera, backend="reference").color
            CloneInPlace("high_error", "clones", opacity).run(state, entry())
            after = rasterize(state.splats, camera, backend="reference").color
        return float((after - before).abs().mean())

    assert change("preserve") < 0.4 * change("copy")
    assert change("copy") > 1e-3
