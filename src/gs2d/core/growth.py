"""Guard against decompression bombs: limits the unpacked size by the size of the file, before unpacking.

The limit is ``SMALL`` bytes or ``RATIO`` times the size of the file, whichever is larger.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterable

from gs2d.errors import DataError

SMALL = 128 << 20  # bytes
RATIO = 400
MAX_ENTRIES = 200_000  # in an archive


def check_growth(path: str | os.PathLike[str], packed: int, unpacked: int, what: str) -> None:
    """Raise DataError if ``unpacked`` bytes are too many for a file of ``packed`` bytes.

    ``what`` describes the content in the message.
    """
    if unpacked > max(SMALL, RATIO * packed):
        raise DataError(
            f"{os.fspath(path)}: {what} would take {unpacked / 1e6:,.0f} MB, more than {RATIO} times the "
            f"{packed / 1e6:,.1f} MB of the file; do not trust the file, or create it again"
        )


def check_entries(path: str | os.PathLike[str], entries: Iterable[zipfile.ZipInfo]) -> list[zipfile.ZipInfo]:
    """Return the entries of a ZIP file; raises DataError for too many or unusually compressed ones."""
    checked = list(entries)
    if len(checked) > MAX_ENTRIES:
        raise DataError(f"{os.fspath(path)} must have at most {MAX_ENTRIES:,} entries, got {len(checked):,}")
    for entry in checked:
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # others may need unbounded memory
            raise DataError(
                f"{os.fspath(path)}: entries must be stored or deflated, {entry.filename!r} uses method "
                f"{entry.compress_type}; create the archive again with deflate"
            )
    return checked
