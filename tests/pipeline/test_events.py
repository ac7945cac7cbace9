"""Events: what is left of a phase."""

from __future__ import annotations

import pytest

from gs2d.pipeline.events import Phase, Step, counted


def test_the_time_left_of_a_phase_follows_how_its_steps_grow() -> None:
    """A quarter of equal steps in 10 s: 30 s are left. Of steps that grow, it was a sixteenth: 150 s are left."""
    assert Phase("matching pairs", 40).seconds_left(10, 10.0) == pytest.approx(30.0)
    assert Phase("placing cameras", 40, growth=2.0).seconds_left(10, 10.0) == pytest.approx(150.0)
    assert Phase("placing cameras", 40, growth=2.0).seconds_left(40, 99.0) == 0.0


def test_steps_of_before_took_none_of_this_time() -> None:
    assert Phase("training", 100, done=50).seconds_left(75, 5.0) == pytest.approx(5.0)
    assert Phase("training", 100, done=50).seconds_left(50, 5.0) is None
    assert Phase("training", 100).seconds_left(1, 5.0) is None  # too early
    assert Phase("training", 100).seconds_left(1, 100.0) == pytest.approx(9900.0)


def test_steps_of_different_cost_count_by_their_cost() -> None:
    phase = Phase("training", 100, costs=((80, 0.25), (20, 1.0)))  # a quarter of the pixels first
    assert phase.seconds_left(40, 10.0) == pytest.approx(30.0)
    assert phase.seconds_left(80, 20.0) == pytest.approx(20.0)
    assert phase.seconds_left(90, 30.0) == pytest.approx(10.0)


def test_nobody_can_tell_where_nobody_knows_the_number_of_steps() -> None:
    assert Phase("fusing", 0).seconds_left(3, 5.0) is None


def test_more_steps_than_were_said_leave_nothing() -> None:
    assert Phase("reading", 4).seconds_left(9, 5.0) == 0.0


def test_what_is_counted_is_a_phase_and_its_steps() -> None:
    heard: list[object] = []
    assert list(counted("ab", "reading", 2, heard.append)) == ["a", "b"]
    assert heard == [Phase("reading", 2), Step(1), Step(2)]
