"""The recipes of the rows of the paper's tables."""

from __future__ import annotations

import pytest

from gs2d.config.actions import CLONE_IN_PLACE
from gs2d.config.presets import RECIPES, get_recipe
from gs2d.config.recipe import ALL, Recipe, Stage
from gs2d.contrib.lab.paper_recipes import TABLES


def weights(stage: Stage) -> dict[str, tuple[float | None, int]]:
    return {term.kind: (term.weight, term.start) for term in stage.losses}


def test_every_row_of_every_table_names_a_recipe() -> None:
    assert set(TABLES) == {"regularisation", "benchmark", "k", "freeze", "modules", "absgs"}
    for rows in TABLES.values():
        for name in rows.values():
            assert name in RECIPES


def test_2dgs_60k_trains_as_long_as_2dgs_r() -> None:
    control = get_recipe("2dgs-60k")
    assert control.stages[0] == get_recipe("2dgs").stages[0]
    assert control.iterations == get_recipe("2dgs-r").iterations == 60_000
    more = control.stages[1]
    assert more.moments == "kept"
    assert more.densify is None
    assert more.lr.means_at(1) == pytest.approx(1.6e-6)
    assert weights(more)["normal_consistency"] == (0.05, 0)


@pytest.mark.parametrize(
    ("name", "nc", "distortion"),
    [
        ("2dgs-no-nc", None, None),
        ("2dgs-distortion-no-nc", None, (None, 3000)),
        ("2dgs-distortion", (0.05, 7000), (None, 3000)),
        ("2dgs-nc-0.1", (0.1, 7000), None),
        ("2dgs-nc-0.3", (0.3, 7000), None),
    ],
)
def test_regularizer_rows(name: str, nc: object, distortion: object) -> None:
    (stage,) = get_recipe(name).stages
    assert weights(stage).get("normal_consistency") == nc
    assert weights(stage).get("distortion") == distortion  # weight None: the protocol's


def frozen(stage: Stage) -> set[str]:
    return set(ALL) - set(stage.train)


def test_module_rows() -> None:
    def facts(recipe: Recipe) -> tuple[bool, bool, bool]:
        last = recipe.stages[-1]
        clone = CLONE_IN_PLACE in last.on_enter
        return clone, "opacity_logits" in frozen(last), "normal_consistency" in weights(last)

    rows = {row: get_recipe(name) for row, name in TABLES["modules"].items()}
    assert rows["(I)"].stages == get_recipe("2dgs").stages
    assert facts(rows["(II)"]) == (True, False, False)
    assert facts(rows["(III)"]) == (True, True, False)
    assert facts(rows["(IV)"]) == (True, True, True)
    assert rows["(IV)"].stages == get_recipe("2dgs-r").stages


def test_absgs_rows_densify_in_stage_3_instead_of_the_clone() -> None:
    default, adjusted = (get_recipe(f"2dgs-r-absgs-{x}").stages[2] for x in "da")
    for stage in (default, adjusted):
        assert stage.on_enter == ()
        assert frozen(stage) == set()
        assert stage.densify is not None
        assert stage.densify.absolute
        assert not stage.densify.resets(500, white=True)
    assert default.densify is not None
    assert adjusted.densify is not None
    d = default.densify
    assert (d.grad_threshold, d.abs_threshold, d.percent_dense, d.opacity_cull) == (2e-4, 4e-4, 0.001, 0.005)
    assert (d.cap_every, d.reset_every) == (500, 3000)
    assert adjusted.densify.abs_threshold < d.abs_threshold
    assert adjusted.densify.percent_dense < d.percent_dense
