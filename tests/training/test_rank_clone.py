"""Ranking by error and cloning in place."""

from __future__ import annotations

import pytest
import torch

from gs2d.config.recipe import CloneInPlace, RankByError
from gs2d.errors import DivergedError
from gs2d.render.api import rasterize
from gs2d.training.rank_clone import clone_in_place, rank_by_error, worst
from gs2d.training.state import TrainState
from train_toys import full_state, make_scene, random_splats


def test_the_worst_are_the_largest_and_ties_go_by_index() -> None:
    errors = torch.tensor([1.0, 5.0, 5.0, 2.0, 5.0])
    assert worst(errors, 40).tolist() == [1, 2]
    assert worst(errors, 100).tolist() == [1, 2, 4, 3, 0]
    assert worst(torch.ones(5000), 10).tolist() == list(range(500))  # many: an unstable sort would mix them


def test_ranking_sums_over_views_and_writes_the_group() -> None:
    state = full_state(4)
    by_view = [torch.tensor([1.0, 0.0, 3.0, 0.0]), torch.tensor([1.0, 4.0, 0.0, 0.0])]
    total = rank_by_error(state, RankByError(top_percent=50, writes="bad"), iter(by_view))
    assert total.tolist() == [2.0, 4.0, 3.0, 0.0]
    assert state.groups["bad"].tolist() == [False, True, True, False]


def test_an_error_that_is_not_finite_stops() -> None:
    with pytest.raises(DivergedError, match="NaN"):
        rank_by_error(full_state(2), RankByError(), [torch.tensor([1.0, float("nan")])])


def test_a_clone_is_an_exact_copy_in_the_groups_of_its_original() -> None:
    state = full_state(7)  # high_error: rows 0, 3, 6
    before = state.splats.clone()
    assert clone_in_place(state, CloneInPlace("high_error", "copy")) == 3
    state.check()
    for name, tensor in state.splats.items():
        original = dict(before.items())[name]
        assert torch.equal(tensor[:7], original), name
        assert torch.equal(tensor[7:], original[[0, 3, 6]]), name
    assert state.groups["clones"].tolist() == [False] * 7 + [True] * 3
    assert state.groups["high_error"].tolist() == [True, False, False, True, False, False, True] + [True] * 3
    assert not state.moments["means"].mean[7:].any()


def test_preserve_gives_both_the_opacity_that_transmits_the_same_twice() -> None:
    state = full_state(7)
    before = state.splats.clone()
    clone_in_place(state, CloneInPlace("high_error", "preserve"))
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
            clone_in_place(state, CloneInPlace("high_error", opacity))
            after = rasterize(state.splats, camera, backend="reference").color
        return float((after - before).abs().mean())

    assert change("preserve") < 0.4 * change("copy")
    assert change("copy") > 1e-3
