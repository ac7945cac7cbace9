"""Training initialised from splats: 2D splats unchanged, 3D Gaussians without their smallest scale."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import train_toys
from gs2d.config.protocols import GENERIC
from gs2d.core.splats import Splats
from gs2d.core.transforms import quats_to_matrices
from gs2d.errors import DataError, RunError
from gs2d.io.formats.splat_formats import LAYOUTS, read_surfels, write_layout
from gs2d.io.gaussians import Gaussians
from gs2d.training import events
from gs2d.training.trainer import Trainer


def trainer_from(splats: Splats, **options: object) -> tuple[Trainer, list[events.TrainingEvent]]:
    told: list[events.TrainingEvent] = []
    given = {"backend": "reference", "init": splats, "on_event": told.append} | options
    return Trainer(train_toys.make_scene(), train_toys.short(), GENERIC, **given), told  # type: ignore[arg-type]


def test_training_starts_from_a_copy_of_init() -> None:
    given = train_toys.random_splats(12)
    before = given.clone()
    trainer, told = trainer_from(given)
    assert train_toys.same(trainer.splats, given)
    trainer.run()
    assert told[0] == events.Initialised(12, "splats", 0)
    assert train_toys.same(given, before)
    assert not torch.equal(trainer.splats.means[:1], before.means[:1])


def test_init_gets_the_sh_degree_of_the_recipe() -> None:
    """Higher degrees are dropped; missing degrees start at 0."""
    degree = train_toys.short().sh_degree
    wanted = (degree + 1) ** 2 - 1
    given = train_toys.random_splats(5)
    bare, full = replace(given, shN=given.shN[:, :0]), replace(given, shN=torch.randn(5, 15, 3))
    assert trainer_from(bare)[0].splats.shN.tolist() == torch.zeros(5, wanted, 3).tolist()
    assert torch.equal(trainer_from(full)[0].splats.shN, full.shN[:, :wanted])


def test_empty_or_broken_init_and_init_with_a_state_are_refused() -> None:
    given = train_toys.random_splats(3)
    with pytest.raises(DataError, match="least"):
        trainer_from(given.rows(torch.zeros(0, dtype=torch.int64)))
    given.means[1, 0] = torch.nan
    with pytest.raises(DataError, match="infinity"):
        trainer_from(given)
    state = trainer_from(train_toys.random_splats(3))[0].state
    with pytest.raises(RunError, match="starts"):
        trainer_from(train_toys.random_splats(3), state=state)


def test_a_3d_gaussian_loses_its_smallest_scale_and_its_normal_points_there() -> None:
    """Three Gaussians, each with its smallest scale along another axis: in-plane axes and scales are kept."""
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(3, 4)).astype(np.float32)
    log_scales = np.log(np.array([[0.1, 0.5, 0.9], [0.7, 0.2, 0.4], [0.8, 0.6, 0.3]], np.float32))
    zeros = np.zeros((3, 3), np.float32)
    solid = Gaussians(rng.normal(size=(3, 3)).astype(np.float32), quats, log_scales, zeros[:, 0], zeros, zeros[:, None])
    flat = solid.flattened()
    before = quats_to_matrices(torch.from_numpy(quats))  # columns: the axes
    after = quats_to_matrices(flat.quats)
    for row, (u, v, n) in enumerate([(1, 2, 0), (2, 0, 1), (0, 1, 2)]):
        torch.testing.assert_close(after[row], before[row][:, [u, v, n]], atol=1e-6, rtol=0)
        np.testing.assert_array_equal(flat.log_scales[row].numpy(), log_scales[row, [u, v]])
    assert torch.linalg.det(after).tolist() == pytest.approx([1.0] * 3, abs=1e-5)


@pytest.mark.parametrize("layout", LAYOUTS.builtin)
def test_every_splat_layout_can_start_a_training(layout: str, tmp_path: Path) -> None:
    given = train_toys.random_splats(20)
    path = tmp_path / f"a{LAYOUTS[layout].ending}"
    write_layout(path, given, layout)
    splats, kind = read_surfels(path)
    assert kind == "flat splats"
    assert len(splats) == len(given)
    assert len(trainer_from(splats)[0].splats) == 20
