"""keep_rows and append_rows move parameters, moments, statistics and groups together; states round-trip completely."""

from __future__ import annotations

import io

import torch

from gs2d.training.rows import append_rows, keep_rows
from gs2d.training.state import TrainState
from train_toys import full_state, random_splats


def row_tensors(state: TrainState) -> dict[str, torch.Tensor]:
    """Return all tensors of a state that have one row per splat."""
    tensors = dict(state.splats.items())
    for name, moments in state.moments.items():
        tensors |= {f"mean of {name}": moments.mean, f"square of {name}": moments.square}
    tensors |= {f"group {name}": mask for name, mask in state.groups.items()}
    assert state.statistics is not None
    return tensors | state.statistics


def test_keep_rows_keeps_the_same_rows_of_all_tensors() -> None:
    state = full_state(10)
    before = {name: tensor.clone() for name, tensor in row_tensors(state).items()}
    mask = torch.tensor([0, 1, 1, 0, 0, 1, 0, 0, 0, 1], dtype=torch.bool)
    keep_rows(state, mask)
    state.check()
    after = row_tensors(state)
    assert set(after) == set(before)
    assert len(before) == 6 + 12 + 1 + 3
    for name, tensor in after.items():
        assert torch.equal(tensor, before[name][[1, 2, 5, 9]]), name
    assert all(moments.steps == 7 for moments in state.moments.values())


def test_append_rows_adds_parameters_and_zeros_elsewhere() -> None:
    state, new = full_state(10), random_splats(3, seed=9)
    before = {name: tensor.clone() for name, tensor in row_tensors(state).items()}
    append_rows(state, new, {"high_error": torch.tensor([True, False, True])})
    state.check()
    added = dict(new.items()) | {"group high_error": torch.tensor([True, False, True])}
    for name, tensor in row_tensors(state).items():
        assert torch.equal(tensor[:10], before[name]), name
        expected = added.get(name, torch.zeros_like(tensor[10:]))
        assert torch.equal(tensor[10:], expected), name


def test_a_new_group_holds_only_new_rows_and_an_unnamed_one_none_of_them() -> None:
    state = full_state(4)
    append_rows(state, random_splats(2), {"clones": torch.tensor([True, True])})
    assert state.groups["clones"].tolist() == [False] * 4 + [True] * 2
    assert state.groups["high_error"].tolist() == [True, False, False, True, False, False]


def test_a_state_survives_saving_with_plain_tensors_only() -> None:
    state = full_state(8)
    state.queue, state.stage, state.step, state.entered = [3, 1], 1, 5, True
    file = io.BytesIO()
    torch.save(state.state_dict(), file)
    loaded = TrainState.from_state_dict(torch.load(io.BytesIO(file.getvalue()), weights_only=True))
    for name, tensor in row_tensors(state).items():
        assert torch.equal(row_tensors(loaded)[name], tensor), name
    assert (loaded.queue, loaded.stage, loaded.step, loaded.entered) == ([3, 1], 1, 5, True)
    assert all(moments.steps == 7 for moments in loaded.moments.values())
    assert torch.equal(torch.randn(4, generator=loaded.generator), torch.randn(4, generator=state.generator))


def test_views_come_in_shuffled_epochs() -> None:
    state = full_state(1)
    epochs = [[state.next_view(7) for _ in range(7)] for _ in range(4)]
    assert all(sorted(epoch) == list(range(7)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 1
    again = full_state(1)
    assert [again.next_view(7) for _ in range(28)] == [view for epoch in epochs for view in epoch]
