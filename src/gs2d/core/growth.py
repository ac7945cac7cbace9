"""What a file may become in memory: announced sizes are compared with its bytes before anything is unpacked.

A compressor makes a gigabyte of zeros a megabyte, and a header announces what it likes. A photograph, a cloud of splats
or a mask grows too, but not so much: what is small stays allowed whatever its ratio, beyond that the ratio decides.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterable

from gs2d.errors import DataError

SMALL = 128 << 20  # bytes; up to here a file may grow as it likes
RATIO = 400  # of what is larger: unpacked bytes for one of the file
MAX_ENTRIES = 200_000  # in an archive: each takes memory before anything of it is read
PLAIN_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # the others cannot be unpacked bit by bit in bounded memory
_METHODS = {zipfile.ZIP_BZIP2: "bzip2", zipfile.ZIP_LZMA: "LZMA", 93: "Zstandard"}


def check_growth(
    path: str | os.PathLike[str], packed: int, unpacked: int, what: str, *, small: int = SMALL, ratio: int = RATIO
) -> None:
    """Raise for a file of ``packed`` bytes that would take ``unpacked`` bytes, more than ``small`` and ``ratio`` times.

    Raises
    ------
    DataError
        Names the file, ``what`` it announces, and both sizes.
    """
    if unpacked > small and unpacked > ratio * packed:
        raise DataError(
            f"{os.fspath(path)}: {what} of at most {ratio} times the file's {_amount(packed)} was expected, "
            f"got one that would take {_amount(unpacked)}; do not trust the file, or make it again"
        )


def check_entries(path: str | os.PathLike[str], entries: Iterable[zipfile.ZipInfo]) -> list[zipfile.ZipInfo]:
    """Return the entries of a ZIP file, all of them stored or deflated, and not too many."""
    checked = list(entries)
    if len(checked) > MAX_ENTRIES:
        raise DataError(
            f"{os.fspath(path)}: at most {MAX_ENTRIES:,} entries were expected, got {len(checked):,}; pack less"
        )
    for entry in checked:
        if entry.compress_type not in PLAIN_METHODS:
            name = _METHODS.get(entry.compress_type, "an unknown one")
            raise DataError(
                f"{os.fspath(path)}: entries that are stored or deflated were expected, {entry.filename!r} is packed "
                f"by method {entry.compress_type} ({name}); pack it again with deflate"
            )
    return checked


def _amount(count: int) -> str:
    for unit, size in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if count >= size:
            return f"{count / size:.1f} {unit}" if count < 10**15 else f"{count:.1e} bytes"
    return f"{count} bytes"
