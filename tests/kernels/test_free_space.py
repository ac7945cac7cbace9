"""Native counting of splats in free space against torch."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gs2d.config.recipe import DenseStart
from gs2d.core.splats import Splats
from gs2d.training.robust import free_space_maps as free_space
from gs2d.training.robust.free_space_maps import FreeSpaceMaps
from gs2d.training.start.plane_sweep import sweep_views
from train_toys import random_splats
from wall_scene import WALL, wall

pytestmark = pytest.mark.usefixtures("native")


@pytest.fixture(scope="module")
def maps() -> FreeSpaceMaps:
    return FreeSpaceMaps(sweep_views(wall(), DenseStart(side=48, min_angle=1.0)))


def scattered(count: int, seed: int = 0) -> Splats:
    """Return splats in front of, inside and behind the wall, outside all images, and behind cameras; any scale."""
    splats = random_splats(count, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    splats.means.copy_((torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor([10.0, 8.0, 3.0 * WALL]))
    splats.log_scales.copy_(torch.rand(count, 2, generator=generator) * 6 - 5)
    return splats


def counted(maps: FreeSpaceMaps, splats: Splats, *, reference: bool) -> tuple[Tensor, Tensor]:
    ends = maps._ends(splats)
    reach = (ends - ends[0]).norm(dim=2).amax(dim=0)
    against, support = (torch.zeros(len(splats), dtype=torch.int32) for _ in range(2))
    for view in maps._views:
        limit = torch.maximum(view.limit, view.nearest)
        if reference:
            free_space.look_at_free_space_reference(view, ends, limit, view.radius, against, support)
        else:
            free_space._look(view, ends, reach, limit, view.radius, against, support)
    return against, support


def test_counts_agree_with_torch(maps: FreeSpaceMaps, monkeypatch: pytest.MonkeyPatch) -> None:
    splats = scattered(20_000)
    found, true = (counted(maps, splats, reference=reference) for reference in (False, True))
    assert 0.02 < (true[0] > 1).float().mean() < 0.9
    assert 0.001 < (true[1] > 0).float().mean() < 0.9
    for ours, theirs in zip(found, true, strict=True):
        assert int((ours != theirs).sum()) <= 10  # points on the border between two pixels
        assert int((ours - theirs).abs().max()) <= 1
    inside = maps.against(splats)
    monkeypatch.setattr(free_space, "look_at_free_space", lambda *_, **__: False)
    assert int((maps.against(splats) != inside).sum()) <= 10
    assert 0 < int((inside > 0).sum()) < len(splats)


def test_the_result_is_the_same_for_any_number_of_threads(maps: FreeSpaceMaps) -> None:
    splats, results = scattered(10_000, seed=1), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            results.append(counted(maps, splats, reference=False))
    finally:
        torch.set_num_threads(1)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
