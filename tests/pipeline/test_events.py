"""Events: the time left of a phase."""

from __future__ import annotations

import pytest

from gs2d.training.events import Phase


def test_the_time_left_accounts_for_growing_steps() -> None:
    """A quarter of equal steps in 10 s: 30 s are left. Of steps that grow, it was a sixteenth: 150 s are left."""
    assert Phase("matching pairs", 40).seconds_left(10, 10.0) == pytest.approx(30.0)
    assert Phase("placing cameras", 40, growth=2.0).seconds_left(10, 10.0) == pytest.approx(150.0)
    assert Phase("placing cameras", 40, growth=2.0).seconds_left(40, 99.0) == 0.0


def test_the_time_left_is_unknown_without_a_number_of_steps() -> None:
    assert Phase("fusing", 0).seconds_left(3, 5.0) is None
