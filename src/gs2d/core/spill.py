"""Values in a temporary file, and a sequence with bounded memory use whose rest is in such a file."""

from __future__ import annotations

import os
import pickle
import tempfile
import weakref
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from typing import IO, Any, Generic, TypeVar, overload

from gs2d.errors import DiskError

T = TypeVar("T")
RECENT = 32  # values from the file that are cached: neighbouring views are requested again soon


class SpillFile:
    """Pickled values in an anonymous file, in the temporary folder (``TMPDIR``); it is deleted with the object."""

    def __init__(self) -> None:
        self._file: IO[bytes] | None = None

    def put(self, packed: bytes) -> tuple[int, int]:
        """Write a pickled value, and return its place in the file.

        Raises
        ------
        DiskError
            If the file cannot be written.
        """
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the object
                weakref.finalize(self, self._file.close)
            place = (self._file.seek(0, os.SEEK_END), len(packed))
            self._file.write(packed)
            return place
        except OSError as error:
            raise DiskError(
                f"cannot write a temporary file for data that does not fit in memory ({error.strerror or error}); free "
                "some space, set TMPDIR to another folder, or allow more --memory",
                error.errno,
            ) from error

    def get(self, place: tuple[int, int]) -> Any:
        """Return the value at a place."""
        assert self._file is not None
        self._file.seek(place[0])
        return pickle.loads(self._file.read(place[1]))  # an anonymous file of this process


class Spilled(Sequence[T], Generic[T]):
    """A sequence whose first values stay in memory up to ``limit_bytes``; later ones are in a ``SpillFile``.

    Parameters
    ----------
    values : iterable
        Consumed one by one.
    limit_bytes : int

    Raises
    ------
    DiskError
        If the file cannot be written.
    """

    def __init__(self, values: Iterable[T], limit_bytes: int) -> None:
        self._kept: list[T] = []
        self._slots: list[tuple[int, int]] = []
        self._recent: OrderedDict[int, T] = OrderedDict()
        self._file = SpillFile()
        room = limit_bytes
        for value in values:
            packed = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)
            if not self._slots and len(packed) <= room:
                room -= len(packed)
                self._kept.append(value)
            else:
                self._slots.append(self._file.put(packed))

    def __len__(self) -> int:
        return len(self._kept) + len(self._slots)

    @property
    def in_memory(self) -> int:
        """Number of values in memory."""
        return len(self._kept)

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[T]: ...
    def __getitem__(self, index: int | slice) -> T | Sequence[T]:
        if isinstance(index, slice):
            return [self[at] for at in range(*index.indices(len(self)))]
        at = range(len(self))[index]
        if at < len(self._kept):
            return self._kept[at]
        if at in self._recent:
            self._recent.move_to_end(at)
            return self._recent[at]
        value: T = self._file.get(self._slots[at - len(self._kept)])
        self._recent[at] = value
        if len(self._recent) > RECENT:
            self._recent.popitem(last=False)
        return value

    def column(self, number: int) -> Sequence[Any]:
        """Return the sequence of one entry of each value; values are tuples."""
        return _Column(self, number)

    def __iter__(self) -> Iterator[T]:
        return (self[at] for at in range(len(self)))


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
