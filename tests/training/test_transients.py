"""What only one photograph shows takes part in nothing: training, masks, later commands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gs2d.config.protocols import GENERIC
from gs2d.core.image_arrays import at_cells, enlarged
from gs2d.data.scene import Scene, View
from gs2d.errors import RunError
from gs2d.io.run_dir import SHINE, TRANSIENTS, RunFolder
from gs2d.pipeline.prepare.learned_views import with_maps, write_maps
from gs2d.training.events import Notice, TrainingEvent
from gs2d.training.robust.transients import CELLS, transient_maps
from gs2d.training.robust.view_cells import ViewCells
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer
from saved_states import resumed_everywhere
from together import robust
from train_toys import full_state
from wall_scene import HEIGHT, WALL, WIDTH, flat_wall, wall

BLOCK = (slice(30, 50), slice(40, 60))  # cells of a passer-by


def compared(*passers: int, at: tuple[slice, slice] = BLOCK, elsewhere: float = 0.02) -> torch.Tensor:
    """Return the maps of the wall: views whose renderings differ by ``elsewhere``, and by 0.4 in a block of some."""
    views = []
    for row, view in enumerate(wall().train):
        values, depth = np.full((CELLS, CELLS), elsewhere), np.full((CELLS, CELLS), WALL - view.camera.center[2])
        if row in passers:
            values[at] = 0.4
        views.append(ViewCells(view.camera, values, depth))
    return transient_maps(views)


def test_a_block_that_differs_in_one_view_is_transient() -> None:
    maps = compared(2)
    assert maps.shape == (5, CELLS, CELLS)
    assert maps[2][BLOCK].all()
    assert maps[2].sum() < 1.3 * 20 * 20  # and its rim
    assert not maps[[0, 1, 3, 4]].any()


def test_what_all_views_render_badly_stays() -> None:
    assert not compared(elsewhere=0.4).any()
    assert not compared(2, elsewhere=0.15).any()


def test_narrow_parts_and_small_differences_stay() -> None:
    assert not compared(2, at=(slice(20, 70), slice(40, 42))).any()
    assert not compared(elsewhere=0.05).any()


def test_a_surface_that_too_few_views_show_stays() -> None:
    views = [
        ViewCells(view.camera, np.full((CELLS, CELLS), 0.01), np.full((CELLS, CELLS), WALL)) for view in wall().train
    ]
    hidden = [replace(view, depth=np.full((CELLS, CELLS), 1.0)) for view in views[1:]]
    passer = views[0].values.copy()
    passer[BLOCK] = 0.4
    assert transient_maps([replace(views[0], values=passer), *views[1:]])[0].any()
    assert not transient_maps([replace(views[0], values=passer), *hidden])[0].any()


def test_a_photograph_in_another_light_stays_whole() -> None:
    assert compared(2, at=(slice(0, CELLS), slice(0, 40)))[2].any()
    assert not compared(2, at=(slice(0, CELLS), slice(0, 60))).any()


def with_passer(scene: Scene) -> Scene:
    """Put a white block before the wall in the third photograph."""
    views = list(scene.train)
    image = views[2].image().copy()
    image[10:26, 20:34] = 255
    views[2] = View.from_arrays(views[2].name, views[2].camera, image)
    return replace(scene, train=tuple(views))


def painted() -> tuple[Scene, TrainState]:
    """Return the wall in one colour with a passer-by, and splats of that colour."""
    plain = [np.full((HEIGHT, WIDTH, 3), 128, np.uint8) for _ in wall().train]
    views = (View.from_arrays(v.name, v.camera, image) for v, image in zip(wall().train, plain, strict=True))
    splats = flat_wall()
    splats.sh0[:], splats.shN[:] = 0.0, 0.0
    return with_passer(replace(wall(), train=tuple(views))), splats


def test_training_leaves_out_a_passer_by_and_resumes_with_that() -> None:
    scene, splats = painted()
    recipe = replace(robust(), dense_start=None)
    trainer = Trainer(scene, recipe, GENERIC, backend="cpu", init=splats)
    trainer.run()
    maps = trainer.state.maps["transient"]
    assert (enlarged(maps[2].numpy(), HEIGHT, WIDTH)[12:24, 22:32] == 1).mean() > 0.9
    assert maps[[0, 1, 3, 4]].float().mean() < 0.02
    left = trainer.scene_now().train
    mask = left[2].mask()
    assert mask is not None
    assert mask[:, :15].all()
    assert not mask[12:24, 22:32].all(axis=1).any()
    resumed_everywhere(with_passer(wall()), robust(), "cpu", every=4)


def test_the_maps_of_a_run_are_written_and_read(tmp_path: Path) -> None:
    told: list[TrainingEvent] = []
    cells = np.zeros((CELLS, CELLS), bool)
    cells[BLOCK] = True
    scene, shine = wall(), np.arange(16, dtype=np.uint8).reshape(4, 4)
    second = scene.train[1].with_cells(transient=cells, shine=shine)
    marked = replace(scene, train=(scene.train[0], second, *scene.train[2:]))
    write_maps(RunFolder(tmp_path), marked, told.append)
    assert isinstance(told[0], Notice)
    assert "1 of 5 photographs" in told[0].text
    assert sorted(path.name for path in (tmp_path / TRANSIENTS).iterdir()) == ["1.png.png"]
    again = with_maps(RunFolder(tmp_path), scene)
    assert np.array_equal(again.train[1].transient, cells)
    assert np.array_equal(again.train[1].shine, shine)
    assert again.train[0].mask() is None
    assert again.train[0].shine is None
    write_maps(RunFolder(tmp_path), scene, told.append)  # a later training without any
    assert not (tmp_path / TRANSIENTS).exists()
    assert not (tmp_path / SHINE).exists()
    assert with_maps(RunFolder(tmp_path), scene) is scene


def test_cells_and_images() -> None:
    cells = np.arange(16).reshape(4, 4)
    image = enlarged(cells, 12, 20)
    assert image.shape == (12, 20)
    assert np.array_equal(at_cells(image, 4), cells)


def test_the_mask_of_a_view_and_its_cells_are_joined() -> None:
    view, cells = wall().train[0], np.zeros((CELLS, CELLS), bool)
    own = np.ones((HEIGHT, WIDTH), bool)
    own[0] = False
    cells[:, : CELLS // 2] = True
    mask = View.from_arrays(view.name, view.camera, view.image(), own).with_cells(transient=cells).mask()
    assert mask is not None
    assert not mask[0].any()
    assert not mask[:, : WIDTH // 2].any()
    assert mask[1:, WIDTH // 2 :].all()
    kept = view.with_cells(transient=cells).usable(
        masks=False
    )  # protocols that ignore the user's masks leave them out, too
    assert kept is not None
    assert kept[:, WIDTH // 2 :].all()
    assert not kept[:, : WIDTH // 2].any()


def test_maps_of_another_scene_are_refused() -> None:
    state = full_state()
    state.maps["transient"] = torch.zeros((2, CELLS, CELLS), dtype=torch.uint8)
    state.check()
    state.maps["transient"] = torch.zeros((2, CELLS, CELLS))
    with pytest.raises(Exception, match="transient must be torch.uint8"):
        state.check()
    with pytest.raises(RunError):
        TrainState.from_state_dict({"format": 2})
