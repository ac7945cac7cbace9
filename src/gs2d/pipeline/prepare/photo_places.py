"""Where photographs were taken, in metres, as far as it helps to choose which of them to compare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gs2d.data.positions import Positions, matched, read_positions, to_enu
from gs2d.errors import DataError
from gs2d.sfm.photos import Photo

Place = tuple[float, float, float]
_LEAST_SPREAD = 15.0  # m; root mean square from their middle: receivers in phones are off by 5 m and more
_NAMED = 3  # photographs without a place that are named


@dataclass(frozen=True)
class Places:
    """Places of photographs.

    Attributes
    ----------
    metres : tuple of Place or None
        Of each photograph, in a local frame; None: nobody knows. A height is 0 where not all are known.
    notes : tuple of str
        What is to be said about them.
    """

    metres: tuple[Place | None, ...]
    notes: tuple[str, ...] = ()

    @property
    def known(self) -> int:
        """How many photographs have a place."""
        return sum(place is not None for place in self.metres)


def places_of(photos: Sequence[Photo], listed: Path | None) -> Places:
    """Return the places of photographs: by a list, else by GPS in their EXIF or XMP.

    Raises
    ------
    DataError
        The list cannot be read, or names none of them.
    """
    labels = [photo.label for photo in photos]
    if listed is None:
        told = {photo.label: np.array(photo.taken.place) for photo in photos if photo.taken.place is not None}
        positions, found = Positions(told, None, "GPS in EXIF or XMP", in_degrees=True), told
    else:
        positions = read_positions(listed)
        found = matched(positions, labels)
        if not found:
            raise DataError(
                f"{listed} must name the photographs, got none of {len(photos)}, such as {labels[0]} (its first is "
                f"{next(iter(positions.places), 'nothing')})"
            )
    if len(found) < 2:
        return Places((None,) * len(photos))
    metres = _metres(np.stack(list(found.values())), positions)
    if listed is None and (spread := _spread(metres)) < _LEAST_SPREAD:
        note = (
            f"positions of photographs are not used: they are within {spread:.1f} m (root mean square) of each other, "
            "which is what receivers are off by"
        )
        return Places((None,) * len(photos), (note,))
    by_label = dict(zip(found, (_place(row) for row in metres), strict=True))
    return Places(tuple(by_label.get(label) for label in labels), _said(labels, by_label, positions.source))


def _metres(places: np.ndarray, positions: Positions) -> np.ndarray:
    """Places [P, 3] in metres; heights are 0 where one of them is not known."""
    metres = to_enu(places, np.append(np.median(places[:, :2], axis=0), 0.0)) if positions.in_degrees else places.copy()
    if not np.isfinite(metres[:, 2]).all():
        metres[:, 2] = 0.0
    return metres


def _spread(metres: np.ndarray) -> float:
    return float(np.sqrt(((metres - np.median(metres, axis=0)) ** 2).sum(axis=1).mean()))


def _place(row: np.ndarray) -> Place:
    return float(row[0]), float(row[1]), float(row[2])


def _said(labels: Sequence[str], known: dict[str, Place], source: str) -> tuple[str, ...]:
    lost = [label for label in labels if label not in known]
    if not lost:
        return ()
    named = ", ".join(lost[:_NAMED]) + (" ..." if len(lost) > _NAMED else "")
    return (
        f"{len(lost)} of {len(labels)} photographs have no position ({named}; {source}): they are compared with those "
        "next to them and those that look alike",
    )
