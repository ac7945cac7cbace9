"""Events: the time left of a phase."""

from __future__ import annotations

import pytest

from gs2d.training.events import Phase


def test_the_time_left_follows_from_the_steps_since_the_beginning_or_a_resume() -> None:
    assert Phase("matching pairs", 40).seconds_left(10, 10.0) == pytest.approx(30.0)
    assert Phase("training", 40, done=20).seconds_left(30, 10.0) == pytest.approx(10.0)
    assert Phase("matching pairs", 40).seconds_left(40, 99.0) == 0.0
    assert Phase("matching pairs", 40).seconds_left(1, 1.0) is None  # too early


def test_the_time_left_is_unknown_without_a_number_of_steps() -> None:
    assert Phase("fusing", 0).seconds_left(3, 5.0) is None
