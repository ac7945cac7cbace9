"""Guard against decompression bombs: the size that a file announces is compared with its bytes, before it is unpacked.

Up to ``SMALL`` bytes anything is allowed; beyond that, at most ``RATIO`` times the bytes of the file.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterable

from gs2d.errors import DataError

SMALL = 128 << 20  # bytes
RATIO = 400
MAX_ENTRIES = 200_000  # in an archive: each takes memory before anything of it is read


def check_growth(path: str | os.PathLike[str], packed: int, unpacked: int, what: str) -> None:
    """Raise for ``packed`` bytes that would take ``unpacked`` bytes, more than ``SMALL`` and more than ``RATIO`` times.

    Raises
    ------
    DataError
        Names the file, ``what`` it announces, and both sizes.
    """
    if unpacked > max(SMALL, RATIO * packed):
        raise DataError(
            f"{os.fspath(path)}: {what} of at most {RATIO} times the file's {packed / 1e6:,.1f} MB was expected, "
            f"got one that would take {unpacked / 1e6:,.0f} MB; do not trust the file, or make it again"
        )


def check_entries(path: str | os.PathLike[str], entries: Iterable[zipfile.ZipInfo]) -> list[zipfile.ZipInfo]:
    """Return the entries of a ZIP file, all of them stored or deflated, and not too many."""
    checked = list(entries)
    if len(checked) > MAX_ENTRIES:
        raise DataError(
            f"{os.fspath(path)}: at most {MAX_ENTRIES:,} entries were expected, got {len(checked):,}; pack less"
        )
    for entry in checked:
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # others need unbounded memory
            raise DataError(
                f"{os.fspath(path)}: entries that are stored or deflated were expected, {entry.filename!r} is packed "
                f"by method {entry.compress_type}; pack it again with deflate"
            )
    return checked
