"""Text for a terminal of any width: lines broken between words, and tables as records."""

from __future__ import annotations

import re
import shutil
import textwrap
from collections.abc import Sequence

WIDEST = 100  # columns of running text; longer lines are hard to read
_COMMAND, _HELD = re.compile(r"`[^`]*`"), "\0"  # text that stays on one line; stands for its spaces


def terminal_width() -> int:
    """Return the number of columns for running text: of ``COLUMNS``, else of the terminal, else 80."""
    return max(20, min(shutil.get_terminal_size().columns, WIDEST))


def wrapped(text: str, width: int, *, first: str = "", rest: str = "", keep_spaces: bool = False) -> list[str]:
    """Return the lines of a text, broken between words; longer words stay whole, to be copied."""
    if keep_spaces and len(text) <= width:
        return [text]
    begin = " " * (len(text) - len(text.lstrip())) if keep_spaces else ""
    return textwrap.wrap(
        text.lstrip() if keep_spaces else text,
        width,
        initial_indent=first + begin,
        subsequent_indent=rest,
        break_long_words=False,
        break_on_hyphens=False,
    ) or [first.rstrip()]


def message(text: str, width: int, *, rest: str = "  ") -> list[str]:
    """Return the lines of a message, broken between words; commands in backticks stay whole, to be copied."""
    held = _COMMAND.sub(lambda found: found[0].replace(" ", _HELD), text)
    return [line.replace(_HELD, " ") for line in wrapped(held, width, rest=rest)]


def records(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a table that is too wide for the terminal as one block per row, with one line per cell."""
    wide = max((len(column) for column in columns[1:]), default=0)
    lines = []
    for row in rows:
        cells = [
            f"  {column:<{wide}}  {cell}".rstrip() for column, cell in zip(columns[1:], row[1:], strict=True) if cell
        ]
        lines += [f"{columns[0]} {row[0]}".strip(), *cells]
    return lines
