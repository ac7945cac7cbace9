"""The command ``gs2d``: the only package that prints. Nothing here imports torch before a command needs it."""

from __future__ import annotations

from gs2d.cli.app import main, run

__all__ = ["main", "run"]
