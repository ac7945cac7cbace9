"""Blocks of a model: which photographs and splats each has, what is left alone, and the merge."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from gs2d.config.presets import get_recipe
from gs2d.config.protocols import GENERIC
from gs2d.config.quantities import EXPOSURE
from gs2d.contrib.lab.block_start import ABSENT, FROZEN, OWN, read_start
from gs2d.contrib.lab.partition import Partition
from gs2d.contrib.lab.settle import block_recipe, budget_of, with_budget
from gs2d.contrib.lab.split import BlockOfSplit, Split, choose_views, merge, read_split, split_model, start_file
from gs2d.core.splats import Splats
from gs2d.pipeline.prepare.loaded import Trained
from gs2d.render.backends import get_backend
from gs2d.render.types import RasterSettings
from gs2d.training.events import Event, Notice, ignore
from train_toys import backends, make_scene, random_splats

SCENE = make_scene()
CPU = get_backend(backends()[-1])


def splits(splats: Splats, folder: Path, partition: Partition, told: list[Event] | None = None) -> Split:
    on_event = ignore if told is None else told.append
    return split_model(Trained(splats, SCENE, GENERIC, RasterSettings(), CPU), partition, folder, on_event)


def test_photographs_that_show_enough_of_a_block_are_its_and_the_best_others_up_to_the_floor() -> None:
    shares = np.array([0.5, 0.02, 0.0, 0.1, 0.05, 0.09])
    chosen, floor = choose_views(shares, Partition(min_share=0.1, min_views=4))
    assert chosen.tolist() == [0, 3, 4, 5]
    assert floor == [5, 4]
    chosen, floor = choose_views(shares, Partition(min_share=0.1, min_views=100))
    assert chosen.tolist() == [0, 1, 3, 4, 5]  # who shows nothing of it never is
    chosen, floor = choose_views(shares, Partition(min_share=0.1, min_views=1))
    assert (chosen.tolist(), floor) == ([0, 3], [])


def test_blocks_overlap_by_their_margin_and_freeze_what_lies_around(tmp_path: Path) -> None:
    splats = random_splats(300, seed=3)
    found = splits(splats, tmp_path, Partition(grid=(2, 2), margin=0.3, min_views=2))
    assert read_split(tmp_path).to_json() == found.to_json()
    places, total = splats.means.numpy(), 0
    for cell, block in enumerate(found.blocks):
        rows, exposures = read_start(start_file(tmp_path, block.name))
        near = found.cells.near(cell, places)
        assert exposures is None
        assert set(rows[near]) <= {ABSENT, OWN}
        assert set(rows[~near]) <= {ABSENT, FROZEN}
        assert 0.25 < block.weight < 0.9
        total += block.own
    assert total > 1.2 * 300 * 0.8  # of those that are seen many are in several
    assert sum(block.core for block in found.blocks) == 300


def test_a_block_without_splats_is_told_and_stays_as_the_coarse_model_has_it(tmp_path: Path) -> None:
    splats = random_splats(80, seed=3)
    splats.means[:] = torch.where(splats.means[:, :1] > 0, 0.4, -0.4)  # in two places: a third cell holds none
    told: list[Event] = []
    found = splits(splats, tmp_path, Partition(grid=(3, 1), margin=0.0, min_views=2), told)
    skipped = [block for block in found.blocks if block.skipped]
    assert skipped
    assert skipped[0].views == ()
    texts = [event.text for event in told if isinstance(event, Notice)]
    assert any(
        text.startswith(f"block {skipped[0].name} is not trained: none of its splats is visible") for text in texts
    )
    trained = {b.name: splats.rows(torch.zeros(80, dtype=torch.bool)) for b in found.blocks if not b.skipped}
    rows = {name: np.full(80, OWN, np.uint8) for name in trained}
    assert len(merge(splats, found, trained, rows)) == sum(block.core for block in skipped)


def test_a_merge_takes_from_each_block_what_lies_in_its_cell_and_the_rest_from_the_coarse_model(tmp_path: Path) -> None:
    splats = random_splats(200, seed=3)
    found = splits(splats, tmp_path, Partition(grid=(2, 1), margin=0.5, min_views=2))
    rows = {block.name: read_start(start_file(tmp_path, block.name))[0] for block in found.blocks}
    trained = {name: splats.rows(torch.from_numpy(row == OWN)) for name, row in rows.items()}
    merged = merge(splats, found, trained, rows)
    assert len(merged) == 200  # none twice, none lost, where nothing moved
    order = np.lexsort(merged.means.numpy().T)
    assert np.array_equal(merged.means.numpy()[order], splats.means.numpy()[np.lexsort(splats.means.numpy().T)])
    beyond = replace(trained["0-0"], means=trained["0-0"].means + 1e3 * torch.from_numpy(found.cells.axes[0]).float())
    assert len(merge(splats, found, {**trained, "0-0": beyond}, rows)) < 200  # what left its cell is cropped


BLOCK = BlockOfSplit("0-0", ("a",), floor=0, own=1, frozen=1, core=1, weight=0.4, extent=1.0)


def test_recipes_of_a_block_have_a_share_of_the_budget_given_exposures_and_all_degrees_from_the_start() -> None:
    recipe = with_budget(get_recipe("best").with_learned(EXPOSURE), 1000)
    assert budget_of(recipe) == 1000
    found = block_recipe(recipe, Partition(grid=(2, 2)), BLOCK)
    assert budget_of(found) == 400
    assert found.dense_start is not None
    assert not found.dense_start.required
    assert block_recipe(recipe, Partition(grid=(2, 2), start="coarse"), BLOCK).dense_start is None
    assert found.quantities["exposure"].options == {"initial": "given"}
    assert [stage.sh_interval for stage in found.stages] == [0]
    assert budget_of(block_recipe(get_recipe("best"), Partition(grid=(2, 2), splats=77), BLOCK)) == 77
