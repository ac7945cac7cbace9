"""The command ``gs2d``: the only package that prints. Nothing here imports torch before a command needs it."""

from __future__ import annotations

import io
import os
import sys
import warnings

TYPE_CHECKING = False  # of typing, which is not imported: until `main` runs, Ctrl-C shows Python's own traceback
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import NoReturn

__all__ = ["main", "run"]


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Entry point of the command; from its first line Ctrl-C is one line and exit code 130."""
    from gs2d.cli.interrupts import ignore, leave_at_once

    leave_at_once()
    # Before torch loads: its OpenMP threads would spin at every barrier, which costs 3x where the cores are shared.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from gs2d.cli.app import leave

    # What Pillow says of a damaged EXIF block, and NumPy of arrays of Python 2, both of which are read, helps nobody.
    warnings.filterwarnings("ignore", module=r"PIL\.|numpy\.lib")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # None if it is closed
            stream.reconfigure(errors="backslashreplace")  # a terminal that cannot show a name shows its numbers

    code = run(sys.argv[1:] if argv is None else argv)
    ignore()  # the result is known; Python only has to shut down
    leave(code)


def run(argv: Sequence[str]) -> int:
    """Run one command line and return its exit code; prints every error on stderr."""
    from gs2d.cli.app import run as run_command

    return run_command(argv)
