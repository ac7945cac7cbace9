"""The log of a run, ``events.jsonl``. A resume truncates it to its length at the checkpoint."""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
from typing import Any

from gs2d.core.atomic_files import disk_error
from gs2d.errors import DiskError, RunError


class EventLog:
    """Append-only file with one JSON object per line, flushed after each line."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(self, event: dict[str, Any]) -> None:
        """Write one event.

        Raises DiskError if it could not be written; the log then ends with its last complete line.
        """
        line = (json.dumps(event, allow_nan=False, sort_keys=True) + "\n").encode()
        self.append_text(line)

    def append_text(self, lines: bytes) -> None:
        """Write several lines (the log of a cached stage)."""
        start = self.size
        try:
            with open(self.path, "ab") as file:
                file.write(lines)
        except OSError as error:
            with contextlib.suppress(DiskError):
                self.cut(start)
            raise disk_error(self.path, error) from error

    @property
    def size(self) -> int:
        """Size of the log in bytes."""
        return self.path.stat().st_size if self.path.exists() else 0

    def cut(self, size: int) -> None:
        """Truncate the log to ``size`` bytes, and remove an incomplete last line."""
        if not self.path.exists():
            return
        try:
            with open(self.path, "r+b") as file:
                kept = file.read(size)
                file.truncate(kept.rfind(b"\n") + 1)
        except OSError as error:
            raise disk_error(self.path, error) from error

    def read_bytes(self, size: int) -> bytes:
        """Return the first ``size`` bytes, or all if there are fewer."""
        if not self.path.exists():
            return b""
        with open(self.path, "rb") as file:
            return file.read(size)

    def sync(self) -> None:
        """Flush the log to disk, before a checkpoint refers to its length."""
        if not self.path.exists():
            return
        try:
            with open(self.path, "rb") as file:
                os.fsync(file.fileno())
        except OSError as error:
            raise disk_error(self.path, error) from error

    def read(self) -> list[dict[str, Any]]:
        """Return all complete events.

        Raises RunError if a line is no JSON object.
        """
        if not self.path.exists():
            return []
        text = self.path.read_text(encoding="utf-8", errors="replace")
        events = []
        for number, line in enumerate(text[: text.rfind("\n") + 1].splitlines(), start=1):
            try:
                events.append(dict(json.loads(line)))
            except (ValueError, TypeError, RecursionError) as error:
                raise RunError(
                    f"{self.path} line {number} must be a JSON object, got {line[:40]!r}; "
                    "the log was damaged: remove that line"
                ) from error
        return events
