"""Positions of photographs in metres, for choosing pairs to match."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gs2d.data.positions import Positions, matched, read_positions, to_enu
from gs2d.errors import DataError
from gs2d.sfm.photos import Photo

Position = tuple[float, float, float]
_MIN_SPREAD = 15.0  # m, root mean square: GPS in phones is off by 5 m and more
_SHOWN = 3


def metric_positions(photos: Sequence[Photo], listed: Path | None) -> tuple[list[Position | None], str]:
    """Return the position of each photograph in a local frame, from a list or from EXIF, and a note.

    Unknown positions are None. Heights are 0 unless all are known.

    Raises
    ------
    DataError
        If the list cannot be read, or names none of the photographs.
    """
    labels = [photo.label for photo in photos]
    if listed is None:
        known = {photo.label: np.array(photo.taken.place) for photo in photos if photo.taken.place is not None}
        positions = Positions(known, None, "GPS in EXIF", in_degrees=True)
    else:
        positions = read_positions(listed)
        known = matched(positions, labels)
        if not known:
            raise DataError(
                f"{listed} names none of the {len(photos)} photographs, such as {labels[0]} (its first is "
                f"{next(iter(positions.places), 'missing')})"
            )
    if len(known) < 2:
        return [None] * len(photos), ""
    metres = np.stack(list(known.values()))
    if positions.in_degrees:
        metres = to_enu(metres, np.append(np.median(metres[:, :2], axis=0), 0.0))
    if not np.isfinite(metres[:, 2]).all():
        metres[:, 2] = 0.0
    spread = float(np.sqrt(((metres - np.median(metres, axis=0)) ** 2).sum(axis=1).mean()))
    if listed is None and spread < _MIN_SPREAD:
        note = f"GPS positions are not used: they spread over {spread:.1f} m (root mean square), the error of receivers"
        return [None] * len(photos), note
    by_label = dict(zip(known, ((float(x), float(y), float(z)) for x, y, z in metres), strict=True))
    note, lost = "", [label for label in labels if label not in by_label]
    if lost:
        names = ", ".join(lost[:_SHOWN]) + (" ..." if len(lost) > _SHOWN else "")
        note = f"{len(lost)} of {len(labels)} photographs have no position ({names}; {positions.source})"
    return [by_label.get(label) for label in labels], note
