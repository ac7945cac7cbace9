"""Values in a temporary file, and a sequence with bounded memory use whose rest is in such a file."""

from __future__ import annotations

import os
import pickle
import tempfile
import weakref
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from typing import IO, Any, Generic, TypeVar, overload

from gs2d.errors import DiskError

T = TypeVar("T")
RECENT = 32  # values from the file that are cached: neighbouring views are requested again soon


class SpillFile:
    """Pickled values in an anonymous file, in the temporary folder (``TMPDIR``); it is deleted with the object.

    Errors describe the values as ``what``, and name ``remedies`` besides free space.
    """

    def __init__(
        self,
        what: str = "data that does not fit in memory",
        remedies: str = "set TMPDIR to another folder, or allow more --memory",
    ) -> None:
        self._what, self._remedies = what, remedies
        self._file: IO[bytes] | None = None

    def put(self, packed: bytes) -> tuple[int, int]:
        """Write a pickled value, and return its place in the file; DiskError if the file cannot be written."""
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the object
                weakref.finalize(self, self._file.close)
            place = (self._file.seek(0, os.SEEK_END), len(packed))
            self._file.write(packed)
            return place
        except OSError as error:
            raise DiskError(
                f"cannot write a temporary file for {self._what} ({error.strerror or error}); free some space, "
                f"{self._remedies}",
                error.errno,
            ) from error

    def get(self, place: tuple[int, int]) -> Any:
        """Return the value at a place."""
        assert self._file is not None
        self._file.seek(place[0])
        return pickle.loads(self._file.read(place[1]))  # an anonymous file of this process


class Spilled(Sequence[T], Generic[T]):
    """A sequence whose first values stay in memory up to ``limit_bytes``; later ones are in a ``SpillFile``.

    The values are consumed one by one. Raises DiskError if the file cannot be written.
    """

    def __init__(self, values: Iterable[T], limit_bytes: int) -> None:
        self._resident: list[T] = []
        self._slots: list[tuple[int, int]] = []
        self._file = SpillFile()
        self._read: Callable[[tuple[int, int]], T] = lru_cache(RECENT)(self._file.get)
        room = limit_bytes
        for value in values:
            packed = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)
            if not self._slots and len(packed) <= room:
                room -= len(packed)
                self._resident.append(value)
            else:
                self._slots.append(self._file.put(packed))

    def __len__(self) -> int:
        return len(self._resident) + len(self._slots)

    @property
    def in_memory(self) -> int:
        """Number of values in memory."""
        return len(self._resident)

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[T]: ...
    def __getitem__(self, index: int | slice) -> T | Sequence[T]:
        if isinstance(index, slice):
            return [self[at] for at in range(*index.indices(len(self)))]
        at = range(len(self))[index]
        return self._resident[at] if at < len(self._resident) else self._read(self._slots[at - len(self._resident)])

    def column(self, number: int) -> Sequence[Any]:
        """Return the sequence of one entry of each value; values are tuples."""
        return _Column(self, number)


class _Column(Sequence[Any]):
    """One entry of each of the tuples of a sequence."""

    def __init__(self, rows: Sequence[Any], number: int) -> None:
        self._rows, self._number = rows, number

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [row[self._number] for row in self._rows[index]]
        return self._rows[index][self._number]
