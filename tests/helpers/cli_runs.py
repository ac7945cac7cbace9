"""Tiny runs for command-line tests, and a check of one-line errors."""

from __future__ import annotations

import subprocess
import sys

TINY = [  # all three stages, within a second
    *("--recipe", "2dgs-r", "--schedule-scale", "0.0005"),
    *("--set", "init_points=100", "--set", "surface.densify.max_splats=150"),
]


def one_line(text: str) -> str:
    """Return the single line of a stderr output, which must be an error."""
    lines = text.splitlines()
    assert len(lines) == 1, text
    assert lines[0].startswith("error: ")
    return lines[0]


def spawn(words: list[str], **kwargs: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "gs2d", *words],
        capture_output=True,
        text=True,
        **kwargs,  # type: ignore[call-overload]
    )
