"""Photographs as training wants them: which stay in memory."""

from __future__ import annotations

from gs2d.training.targets import Targets
from train_toys import make_scene

BLACK = (0.0, 0.0, 0.0)


def test_targets_stay_where_at_least_half_of_them_fit() -> None:
    views = make_scene().train
    bytes_of_all = sum(view.camera.width * view.camera.height * 3 * 4 for view in views)
    whole = Targets(views, BLACK, use_masks=False, limit_bytes=bytes_of_all)
    assert all(whole[index] is whole[index] for index in range(len(views)))
    half = Targets(views, BLACK, use_masks=False, limit_bytes=bytes_of_all // 2)
    for index in range(len(views)):
        _ = half[index]
    stay = sum(half[index] is half[index] for index in range(len(views)))
    assert stay == len(views) // 2
    less = Targets(views, BLACK, use_masks=False, limit_bytes=bytes_of_all // 2 - 1)
    assert not any(less[index] is less[index] for index in range(len(views)))
