"""Densification, computed by hand: statistics, clone, split, prune, resets."""

from __future__ import annotations

import math

import pytest
import torch

from gs2d.config.recipe import GradDensify
from gs2d.core.transforms import quats_to_matrices
from gs2d.errors import DivergedError
from gs2d.kernels.torch_kernels import accumulate
from gs2d.training.densify.gradient import (
    DensifyCounts,
    densify_and_prune,
    limit_opacity,
    no_statistics,
)
from gs2d.training.state import Moments, TrainState
from train_toys import random_splats


def statistics_of(signed: torch.Tensor, absolute: torch.Tensor, count: torch.Tensor) -> dict[str, torch.Tensor]:
    return {"signed": signed, "absolute": absolute, "count": count}


def logit(opacity: float) -> float:
    return math.log(opacity / (1 - opacity))


def state_of(
    scales: list[tuple[float, float]], opacities: list[float], signed: list[float], count: list[float]
) -> TrainState:
    """Return splats with these sizes, opacities and statistics; all other attributes differ between rows."""
    n = len(scales)
    splats = random_splats(n, seed=1)
    splats.log_scales = torch.tensor(scales).log()
    splats.opacity_logits = torch.tensor([logit(o) for o in opacities])
    state = TrainState(splats, torch.Generator().manual_seed(0))
    state.moments = {name: Moments(torch.ones_like(t), torch.ones_like(t), 5) for name, t in splats.items()}
    state.groups = {"g": torch.arange(n) % 2 == 0}
    state.statistics = statistics_of(torch.tensor(signed), torch.zeros(n), torch.tensor(count))
    return state


def run(state: TrainState, densify: GradDensify | None = None, iteration: int = 600) -> DensifyCounts:
    counts = densify_and_prune(state, densify or GradDensify(), iteration=iteration, extent=1.0, white=False)
    state.check()
    return counts


def test_statistics_add_norms_of_visible_splats() -> None:
    statistics = no_statistics(random_splats(3))
    signal = torch.tensor([[3.0, 4.0, 6.0, 8.0], [1.0, 1.0, 1.0, 1.0], [0.0, 0.0, 5.0, 12.0]])
    accumulate(*statistics.values(), signal, torch.tensor([2.0, 0.0, 1.0]))
    accumulate(*statistics.values(), signal, torch.tensor([2.0, 0.0, 0.0]))
    assert statistics["signed"].tolist() == [10.0, 0.0, 0.0]
    assert statistics["absolute"].tolist() == [20.0, 0.0, 13.0]
    assert statistics["count"].tolist() == [2.0, 0.0, 1.0]


def test_small_splats_are_cloned_and_large_ones_split_from_the_threshold_on() -> None:
    # extent 1: up to 0.01 is small. Row 0: mean exactly 2e-4, size exactly at most 0.01 -> clone. Row 1: just below.
    # Row 2: large, mean 3e-4 -> split. Row 3: large, never visible.
    state = state_of(
        [(0.005, 0.009), (0.005, 0.009), (0.02, 0.005), (0.02, 0.02)],
        [0.5, 0.5, 0.5, 0.5],
        [4e-4, 3.9e-4, 3e-4, 0.0],
        [2.0, 2.0, 1.0, 0.0],
    )
    before = state.splats.clone()
    counts = run(state)
    assert counts == DensifyCounts(cloned=1, split=1, pruned_by_opacity=0, pruned_large=0)
    after = state.splats
    # rows: 0, 1, 3 (2 was split), the clone of 0, two children of 2
    assert len(after) == 6
    for name, tensor in after.items():
        assert torch.equal(tensor[:3], dict(before.items())[name][[0, 1, 3]]), name
        assert torch.equal(tensor[3], dict(before.items())[name][0]), name  # an exact copy in the same position
    for child in (4, 5):
        for name in ("quats", "opacity_logits", "sh0", "shN"):
            assert torch.equal(dict(after.items())[name][child], dict(before.items())[name][2]), name
        torch.testing.assert_close(after.log_scales[child].exp(), torch.tensor([0.02, 0.005]) / 1.6)
        assert not torch.equal(after.means[child], before.means[2])
    assert not torch.equal(after.means[4], after.means[5])
    # clones and children inherit the groups of their origins (0 and 2 are in g); their moments start at zero
    assert state.groups["g"].tolist() == [True, False, False, True, True, True]
    for moments in state.moments.values():
        assert moments.mean[:3].all()
        assert not moments.mean[3:].any()
        assert moments.steps == 5
    assert state.statistics is not None
    assert all(not tensor.any() for tensor in state.statistics.values())


def test_children_lie_in_the_plane_of_their_parent_and_spread_like_its_gaussian() -> None:
    n = 4000
    state = state_of([(0.2, 0.05)] * n, [0.5] * n, [1.0] * n, [1.0] * n)
    state.splats.means = torch.zeros(n, 3)
    state.splats.quats = random_splats(1, seed=5).quats.repeat(n, 1)
    frame = quats_to_matrices(state.splats.quats[:1])[0]
    run(state)
    local = state.splats.means @ frame  # [2n, 3] along t_u, t_v, t_w
    assert len(local) == 2 * n
    assert local[:, 2].abs().max() < 1e-6
    # 8000 draws: standard error 0.8 % for the standard deviation, 0.0022 and 0.0006 for the mean
    assert local[:, :2].std(dim=0).tolist() == pytest.approx([0.2, 0.05], rel=0.04)
    assert local[:, :2].mean(dim=0).abs().max() < 0.01


def test_splats_below_the_opacity_cull_are_pruned_clones_and_children_included() -> None:
    # Row 0 is faint and cloned: both are pruned. Row 1 is faint and split: so are its children. Row 2 is bright enough.
    state = state_of(
        [(0.005, 0.005), (0.02, 0.02), (0.02, 0.02)], [0.04, 0.04, 0.0501], [1.0, 1.0, 0.0], [1.0, 1.0, 1.0]
    )
    assert run(state) == DensifyCounts(cloned=1, split=1, pruned_by_opacity=4, pruned_large=0)
    assert len(state.splats) == 1


def test_large_splats_are_pruned_only_after_the_first_reset_interval() -> None:
    scales = [(0.11, 0.01), (0.09, 0.01)]
    early = state_of(scales, [0.5, 0.5], [0.0, 0.0], [1.0, 1.0])
    assert run(early, iteration=3000).pruned_large == 0
    late = state_of(scales, [0.5, 0.5], [0.0, 0.0], [1.0, 1.0])
    assert run(late, iteration=3100) == DensifyCounts(0, 0, 0, 1)
    assert late.splats.log_scales.amax().exp() == pytest.approx(0.09)


def test_nothing_is_pruned_for_opacity_within_the_grace_of_a_reset() -> None:
    densify = GradDensify(prune_grace=100)

    def pruned(iteration: int) -> int:
        state = state_of([(0.02, 0.02)] * 2, [0.01, 0.5], [0.0, 0.0], [1.0, 1.0])
        return run(state, densify, iteration=iteration).pruned_by_opacity

    assert [pruned(i) for i in (2999, 3000, 3001, 3100, 3101)] == [1, 1, 0, 0, 1]


def test_absgs_splits_by_the_absolute_gradient_and_clones_by_the_signed_one() -> None:
    densify = GradDensify(absolute=True, abs_threshold=4e-4, percent_dense=0.001)
    # small (<= 0.001), small, large, large
    state = state_of(
        [(1e-3, 1e-3), (1e-3, 1e-3), (0.02, 0.02), (0.02, 0.02)], [0.5] * 4, [3e-4, 0.0, 3e-4, 0.0], [1.0] * 4
    )
    assert state.statistics is not None
    state.statistics["absolute"] = torch.tensor([0.0, 9e-4, 3e-4, 4e-4])
    assert run(state, densify) == DensifyCounts(cloned=1, split=1, pruned_by_opacity=0, pruned_large=0)
    # rows 0, 1, 2 remain, then the clone of 0, then the children of 3
    torch.testing.assert_close(state.splats.scales[4:], torch.full((2, 2), 0.02 / 1.6))


def test_max_splats_prefers_the_largest_gradients() -> None:
    small = [(0.005, 0.005)] * 5
    state = state_of(small, [0.5] * 5, [3e-4, 9e-4, 5e-4, 9e-4, 1e-4], [1.0] * 5)
    before = state.splats.clone()
    counts = run(state, GradDensify(max_splats=7))
    assert counts.cloned == 2
    assert torch.equal(state.splats.means[5:], before.means[[1, 3]])
    assert run(state, GradDensify(max_splats=7)).cloned == 0


def test_max_splats_counts_splats_after_pruning() -> None:
    # The first of five splats is too faint: it uses no budget, and its gradient does not count. Four remain. The
    # budget of six lets two of the other three grow, one of them by a split (a parent is replaced by two children).
    sizes = [(0.005, 0.005), (0.005, 0.005), (0.02, 0.02), (0.005, 0.005), (0.005, 0.005)]
    state = state_of(sizes, [0.01, 0.5, 0.5, 0.5, 0.5], [9e-3, 3e-4, 9e-4, 5e-4, 0.0], [1.0] * 5)
    assert run(state, GradDensify(max_splats=6)) == DensifyCounts(
        cloned=1, split=1, pruned_by_opacity=1, pruned_large=0
    )
    assert len(state.splats) == 6


def test_the_prune_by_size_may_start_independently_of_resets() -> None:
    def pruned(densify: GradDensify, iteration: int) -> int:
        return run(
            state_of([(0.11, 0.01), (0.09, 0.01)], [0.5] * 2, [0.0] * 2, [1.0] * 2), densify, iteration
        ).pruned_large

    assert [pruned(GradDensify(reset_every=0), i) for i in (100, 3100)] == [1, 1]
    assert [pruned(GradDensify(reset_every=0, scale_cull_start=600), i) for i in (600, 700)] == [0, 1]


def test_pruning_all_splats_is_an_error() -> None:
    state = state_of([(0.02, 0.02)] * 2, [0.01, 0.02], [0.0, 0.0], [1.0, 1.0])
    with pytest.raises(DivergedError, match="iteration"):
        run(state)


def test_limiting_opacity_zeroes_its_moments_but_not_the_step_count() -> None:
    state = state_of([(0.02, 0.02)] * 3, [0.9, 0.01, 0.005], [0.0] * 3, [1.0] * 3)
    faint = state.splats.opacity_logits[2].clone()
    limit_opacity(state, 0.01)
    assert state.splats.opacities.tolist() == pytest.approx([0.01, 0.01, 0.005])
    assert torch.equal(state.splats.opacity_logits[2], faint)
    assert not state.moments["opacity_logits"].mean.any()
    assert not state.moments["opacity_logits"].square.any()
    assert state.moments["opacity_logits"].steps == 5
    assert state.moments["means"].mean.all()
