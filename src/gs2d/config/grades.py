"""Thresholds of the verdict on a run, with reasons.

They are calibrated on real captures; ``tests/pipeline/test_verdict.py`` has the measurements.
"""

from __future__ import annotations

from dataclasses import dataclass

GOOD, USABLE, POOR = "good", "usable", "poor"
GRADES = (GOOD, USABLE, POOR)


@dataclass(frozen=True)
class Limits:
    """Limits of good and usable values of a measure. If ``good`` exceeds ``usable``, higher values are better."""

    good: float
    usable: float

    def grade(self, value: float) -> str:
        """Return the grade of a value."""
        sign = 1.0 if self.good > self.usable else -1.0
        if sign * value >= sign * self.good:
            return GOOD
        return USABLE if sign * value >= sign * self.usable else POOR


NEW_VIEWS = Limits(25.0, 20.0)  # dB: differences are hard to find from 25 dB; parts are wrong or foggy below 20
TRAINING_VIEWS = Limits(27.0, 22.0)  # dB: training views are about 2 dB better than new ones in dense captures
FLOATERS = Limits(0.02, 0.3)  # of the sparse points: clean scenes hide up to 0.5 %, visible fog 5 to 20 %
BEHIND = Limits(0.15, 0.3)  # if every new view is good: a reflecting table has 10 % of its points behind it
# Share of opaque pixels of the subject whose surface is unclear, mean over views: 0 to 14 % where the mesh is whole,
# 19 to 41 % in views of one that a veil tore. Images can still be good, so it never makes a run poor.
SPREAD = Limits(0.2, 1.0)
OVERFIT = 3.0  # dB that training views exceed new views by, from which longer training does not help
TRANSPARENT = 0.01  # of the pixels of training views: edges and gaps between leaves have less
PLACED = 0.8  # of the photographs have a camera: with fewer, a side of the subject is missing


def worst(grades: list[str]) -> str | None:
    """Return the worst of some grades; None of none."""
    return max(grades, key=GRADES.index) if grades else None
