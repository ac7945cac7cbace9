"""Files with errors that name them: JSON, and bytes."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from gs2d.core.atomic_files import atomic_write
from gs2d.errors import DataError


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write JSON atomically: UTF-8, two spaces of indent, keys in the order of the mapping.

    Raises DiskError if the file could not be written, ValueError for NaN or infinity, which JSON does not have.
    """
    text = json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False)
    with atomic_write(path, "w") as file:
        file.write(text + "\n")


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Read a file, or raise DataError."""
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise DataError(f"cannot read {os.fspath(path)}: {error.strerror or error}") from error


def read_json(path: str | os.PathLike[str]) -> Any:
    """Read a JSON file; a DataError for one that is missing or not JSON names the file and the line."""
    name, data = os.fspath(path), read_bytes(path)
    try:
        text = data.decode("utf-8-sig")  # Windows tools write a byte-order mark
    except UnicodeDecodeError as error:
        raise DataError(f"{name} must be JSON in UTF-8, got an invalid byte at offset {error.start}") from error
    try:
        return json.loads(text)
    except ValueError as error:
        raise DataError(f"{name} must be JSON, got: {error}; is the file complete?") from error
    except RecursionError as error:
        raise DataError(f"{name} must be JSON, got brackets nested too deeply") from error
