"""What figures of a run mean: from which value on each is good, usable or poor, and why there.

The limits are of photographs of real things without a mask. A picture that is mostly plain background is closer to its
photograph at the same quality of what it shows.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

GOOD, USABLE, POOR = "good", "usable", "poor"
GRADES = (GOOD, USABLE, POOR)


@dataclass(frozen=True)
class Limits:
    """Where a figure stops to be good, and where to be usable.

    Attributes
    ----------
    good, usable : float
        The last value of each grade; with ``good`` above ``usable`` more is better, else less.
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


PLACED = Limits(
    0.95, 0.8, "of the photographs", "a lost photograph or two leave no hole; a fifth of them is a side of the subject"
)
TEST_PSNR = Limits(
    25.0, 20.0, "dB", "at 25 dB one looks for differences, at 20 dB one sees them, below it parts are wrong or foggy"
)
TRAIN_PSNR = Limits(
    27.0, 22.0, "dB", "training views come out about 2 dB above new ones where views are dense: the limits are shifted"
)
WORST_PSNR = Limits(
    21.0, 16.0, "dB", "one view may be harder than the mean; below 16 dB something stands before the camera, or nothing"
)
GAP = Limits(
    3.0, 6.0, "dB", "training views are always better; more than 3 dB says that the scene is learned by heart there"
)
HIDDEN = Limits(
    0.01, 0.03, "of the points", "1 % is what misplaced sparse points make; 3 % are fog or sheets that one sees"
)
THIN = Limits(
    0.05, 0.15, "of the views", "a thin view at an end is normal; one in seven means a side without enough overlap"
)
BLURRED = Limits(
    0.05, 0.15, "of the photographs", "a blurred photograph among twenty is outvoted; one in seven softens the scene"
)
EXPOSURE = Limits(
    0.25, 0.75, "stops", "a quarter of a stop is hardly seen; three quarters are explained by fog and colour if left"
)

WIDE_ANGLE = 20.0  # degrees to the next camera about the subject: matching features gets hard from there on
FEW_POINTS = 100  # sparse points of a view: a capture that fogged in its thin views had from 42 there
FEW_OF_MEDIAN = 0.2  # of what the middle view shows: how many there are depends on texture and on resolution
BLURRED_BY = 1.5  # times the blur of the middle photograph, and more than
BLURRED_PIXELS = 0.5  # px beyond it: a difference of less is one of contents
OFF_STOPS = 0.25  # from the middle photograph, from which one is named
ALL_AROUND = 300.0  # degrees: what is missing is less than a side


def worst(grades: Iterable[str]) -> str | None:
    """Return the worst of some grades; None of none."""
    found = [GRADES.index(grade) for grade in grades]
    return GRADES[max(found)] if found else None
