"""Splats sharded over processes train what one process does with batches of as many views, and each has its part."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from gs2d.config.protocols import GENERIC
from gs2d.core.processes import Place
from gs2d.data.scene import Scene
from gs2d.errors import RecipeError
from gs2d.training.densify.gradient import GradientDensifier
from gs2d.training.parallel import ONE_PROCESS
from gs2d.training.shards import Shards
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer
from together import RECIPES, SHARDED, Batch, flat, together_in, trained
from train_toys import random_splats, short

CASES = list(RECIPES)
CLOSE = 1e-5  # of the largest number of a tensor


def differing(a: Any, b: Any) -> list[str]:
    """Where two states differ by more than rounding, or in what is counted or chosen."""
    first, second = flat(a), flat(b)
    assert first.keys() == second.keys()
    found = []
    for name in first.keys() - {"/processes"}:
        one, other = first[name], second[name]
        one, other = (t.double() if t.is_floating_point() else t for t in (one, other))
        if one.shape != other.shape or (not one.is_floating_point() and not torch.equal(one, other)):
            found.append(name)
        elif one.is_floating_point() and one.numel():
            most = float((one - other).abs().max())
            found += [f"{name} {most:.1e}"] if most > CLOSE * max(1.0, float(one.abs().max())) else []
    return found


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """All cases, done by two processes that have a part each."""
    cases = [SHARDED + case for case in [*CASES, "resumed", "dropped"]]
    return together_in(2, cases, tmp_path_factory.mktemp("two"))


@pytest.mark.parametrize("case", CASES)
def test_two_processes_train_what_one_does_with_batches_of_two(case: str, two: dict[str, list[Any]]) -> None:
    """The same rows, in the same order, with the same numbers to rounding: moments, statistics and groups too."""
    state, heard = trained(RECIPES[case](), Batch(2))
    found = two[SHARDED + case][0]
    assert differing(state.state_dict(), found["state"]) == []
    assert found["state"]["processes"] == [[0, 0, 2, 1]]
    for (*at, losses, lr), (*there, others, other_lr) in zip(heard["losses"], found["losses"], strict=True):
        assert at == there
        assert others == pytest.approx(losses, rel=1e-4, abs=1e-6)
        assert other_lr == lr


@pytest.mark.parametrize("case", CASES)
def test_each_process_has_half_of_the_splats_whenever_some_come_or_go(case: str, two: dict[str, list[Any]]) -> None:
    first, second = two[SHARDED + case]
    assert first["rows"]
    for (own, of_all), (other, _) in zip(first["rows"], second["rows"], strict=True):
        assert own + other == of_all
        assert abs(own - other) <= 1
    assert len(second["state"]["splats"]["means"]) == 0  # in the end process 0 has all


def test_splats_came_and_went_and_moved_between_processes(two: dict[str, list[Any]]) -> None:
    """Else the tests above would say nothing."""
    for case in ("short", "absgs", "relocating"):
        counts = [of_all for _, of_all in two[f"{SHARDED}{case}"][0]["rows"]]
        assert len(set(counts)) > 1


def test_a_run_goes_on_from_the_whole_state_of_process_0(two: dict[str, list[Any]]) -> None:
    """To the bit: what is sent where does not depend on when the run was begun."""
    found = two[f"{SHARDED}resumed"][0]
    assert found["at"] == (0, 7)
    assert differing(found["state"], found["whole"]) == []
    for name, tensor in flat(found["state"]).items():
        assert torch.equal(tensor, flat(found["whole"])[name]), name


def test_what_process_0_finds_of_all_splats_goes_in_each(two: dict[str, list[Any]], scene: Scene) -> None:
    first, second = two[f"{SHARDED}dropped"]
    state = Trainer(scene, short(), GENERIC, backend="reference").state
    goes = state.splats.means[:, 0] > 0.1
    assert first["dropped"] == second["dropped"] == int(goes.sum()) > 0
    assert abs(first["here"] - second["here"]) <= 1
    assert torch.equal(first["state"]["splats"]["means"], state.splats.means[~goes])
    assert torch.equal(first["state"]["splats"]["sh0"], state.splats.sh0[~goes])


@pytest.mark.slow
def test_four_processes_train_what_one_does_with_batches_of_four(tmp_path: Path) -> None:
    """Iterations of fewer views leave processes without one, which have their splats in the others' views."""
    cases = ["short", "learning", "relocating", "compared", "dropping", "by_error"]
    for case, found in together_in(4, [SHARDED + case for case in cases], tmp_path).items():
        state, _ = trained(RECIPES[case.removeprefix(SHARDED)](), Batch(4))
        assert differing(state.state_dict(), found[0]["state"]) == [], case
        assert all(abs(own - of_all / 4) <= 1 for one in found for own, of_all in one["rows"])


def test_a_sharded_run_goes_on_in_one_process_and_back(two: dict[str, list[Any]]) -> None:
    """A checkpoint knows of no parts but in its history."""
    state = TrainState.from_state_dict(two[f"{SHARDED}short"][0]["state"])
    assert state.processes == [(0, 0, 2, 1)]
    state.trained_by(2)
    state.trained_by(2)
    state.trained_by(2, splits=True)
    state.trained_by(1)
    assert [since[2:] for since in state.processes] == [(2, 1), (2,), (2, 1), (1,)]
    again = TrainState.from_state_dict(state.state_dict())
    assert again.processes == state.processes
    _, heard = trained(short(), Batch(2))
    done, _ = trained(short(), ONE_PROCESS, heard["states"][1])
    assert done.stage == 3


class Alone(Shards):
    """Shards of which there is one, before it says anything to others."""

    def __init__(self) -> None:
        self.place, self.hears = Place(0, 2, 0, 2), lambda: False

    def share(self, make: Any) -> TrainState:
        return make()


class Greedy(GradientDensifier):
    """Of a package that knows of no parts."""

    splits_rows = False


def test_a_densifier_that_looks_at_all_splats_is_refused(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gs2d.training.trainer.densifier_of", lambda densify, around: densify and Greedy(around))
    with pytest.raises(RecipeError, match=r"got Greedy, which looks at all \(Densifier.splits_rows\)"):
        Trainer(scene, short(), GENERIC, backend="reference", processes=Alone())


def test_frozen_splats_are_refused(scene: Scene) -> None:
    with pytest.raises(RecipeError, match="frozen splats need all splats in a process, got 3; do not shard"):
        Trainer(scene, short(), GENERIC, backend="reference", processes=Alone(), frozen=random_splats(3))
