r"""Text that may contain file names: conversion to bytes, and to text that is safe to print.

File names that are not UTF-8 become strings with surrogates (``os.fsdecode``); escape sequences in a name could control
the terminal.
"""

from __future__ import annotations

import re

# Controls (C0, C1), lone surrogates, and characters that change text direction or break lines.
_HIDDEN = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff\u2028\u2029\u202a-\u202e\u2066-\u2069]")
_HIDDEN_IN_LINES = re.compile(_HIDDEN.pattern.replace(r"\x00-\x1f", r"\x00-\x08\x0b-\x1f"))


def name_bytes(text: str) -> bytes:
    """Encode text as UTF-8; surrogates become the original bytes of the file name."""
    try:
        return text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:  # surrogates that do not stand for a byte, as from JSON
        return text.encode("utf-8", "surrogatepass")


def printable(text: str, *, lines: bool = False) -> str:
    r"""Return text that is safe to print: control characters are escaped, such as ``\x1b``.

    With ``lines``, line ends and tabs are kept.
    """
    return (_HIDDEN_IN_LINES if lines else _HIDDEN).sub(_spelled, text)


def _spelled(match: re.Match[str]) -> str:
    code = ord(match[0])
    if 0xDC80 <= code <= 0xDCFF:  # a byte
        code -= 0xDC00
    named = {0x09: "\\t", 0x0A: "\\n", 0x0D: "\\r"}
    return named.get(code) or (f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}")


def first_line(error: BaseException) -> str:
    """Return the first line of an error message, or the class name if it is empty."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def duration(seconds: float) -> str:
    """Format a duration: "40 s", "12 min", "3.5 h", "2.1 days"."""
    for unit, size, until in (("s", 1, 90), ("min", 60, 90 * 60), ("h", 3600, 48 * 3600)):
        if seconds < until:
            digits = 1 if unit == "h" and seconds < 10 * size else 0
            return f"{seconds / size:.{digits}f} {unit}"
    return f"{seconds / 86400:.1f} days"
