"""The command ``gs2d``. No other package prints. Torch is imported only when a command needs it."""

from __future__ import annotations

import io
import os
import sys
import warnings

TYPE_CHECKING = False  # without importing typing: until `main` runs, Ctrl-C prints a traceback
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import NoReturn

__all__ = ["main", "run"]


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Run the program; from here on Ctrl-C prints one line and exits with code 130."""
    from gs2d.cli.interrupts import ignore, leave_at_once

    leave_at_once()
    # Before torch loads: spinning OpenMP threads take three times as long on shared cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from gs2d.cli.app import leave

    # Pillow warns about damaged EXIF blocks, NumPy about arrays of Python 2; both are read all the same.
    warnings.filterwarnings("ignore", module=r"PIL\.|numpy\.lib")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # None if it is closed
            stream.reconfigure(errors="backslashreplace")  # for names that the terminal cannot show

    code = run(sys.argv[1:] if argv is None else argv)
    ignore()  # only the shutdown of Python is left
    leave(code)


def run(argv: Sequence[str]) -> int:
    """Run one command line and return its exit code; prints every error on stderr."""
    from gs2d.cli.app import run as run_command

    return run_command(argv)
