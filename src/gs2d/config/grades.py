"""The thresholds of the verdict on a run: one table, with the reason for each.

They are calibrated on captures of real scenes (``tests/pipeline/test_verdict.py`` has their measurements).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

GOOD, USABLE, POOR = "good", "usable", "poor"
GRADES = (GOOD, USABLE, POOR)
NEW, TRAINED, FLOATERS, PLACED = "new views", "training views", "floaters", "placed"  # these are graded
GAP, ANGLE, BLUR = "gap", "overlap", "blur"  # these decide on advice only
BEHIND = "behind"  # takes the place of FLOATERS where every new view is good


@dataclass(frozen=True)
class Limits:
    """The last good and the last usable value of a measure.

    Attributes
    ----------
    good, usable : float
        With ``good`` above ``usable`` more is better, else less.
    unit : str
    why : str
        The reason for these values.
    """

    good: float
    usable: float
    unit: str
    why: str

    def grade(self, value: float) -> str:
        """Return the grade of a value."""
        sign = 1.0 if self.good > self.usable else -1.0
        if sign * value >= sign * self.good:
            return GOOD
        return USABLE if sign * value >= sign * self.usable else POOR


LIMITS: Mapping[str, Limits] = MappingProxyType(
    {
        NEW: Limits(25.0, 20.0, "dB", "differences are hard to find from 25 dB, and parts are wrong or foggy below 20"),
        TRAINED: Limits(27.0, 22.0, "dB", "training views are about 2 dB better than new ones in dense captures"),
        FLOATERS: Limits(0.02, 0.3, "of the points", "clean scenes hide up to 0.5 %, visible fog 5 to 20 %"),
        BEHIND: Limits(
            0.15, 0.3, "of the points", "a reflecting table has 10 % of its points behind it, a misplaced wall 24 %"
        ),
        PLACED: Limits(0.8, 0.0, "of the photographs", "a fifth of the photographs is a side of the subject"),
        GAP: Limits(3.0, math.inf, "dB", "beyond it, three times the iterations gained 0.1 dB at most"),
        ANGLE: Limits(20.0, math.inf, "degrees", "matching features gets hard from there on"),
        BLUR: Limits(1.5, math.inf, "of the usual width", "sharp photographs of seven captures stay below 1.4"),
    }
)


def worst(grades: Iterable[str]) -> str | None:
    """Return the worst of some grades; None of none."""
    found = [GRADES.index(grade) for grade in grades]
    return GRADES[max(found)] if found else None
