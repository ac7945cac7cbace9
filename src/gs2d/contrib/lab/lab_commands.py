"""The commands blocks, paper and sweep. Imports no torch, so that `--help` is instant."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass

from gs2d.cli.command_registry import MEASURE, STEPS, register_command
from gs2d.cli.commands import Common
from gs2d.contrib.lab.lab_options import BlocksOptions, PaperOptions, SweepOptions, TableOptions

_ACTIONS = "gs2d.contrib.lab.show_table"


class Continued(TableOptions, Common):
    """A command that another call continues."""

    def after_interrupt(self, words: Sequence[str]) -> str:
        """Return the command that continues."""
        return f"; continue with: gs2d {shlex.join(words)}" if self.train else ""


@register_command(
    "blocks",
    action=f"{_ACTIONS}:show_blocks",
    group=STEPS,
    first=("scene", "out", "blocks", "recipe", "schedule_scale", "downscale", "memory", "slots"),
)
@dataclass(frozen=True, kw_only=True)
class BlocksCommand(BlocksOptions, Common):
    """Train a large capture in blocks and merge them."""


@register_command(
    "sweep",
    action=f"{_ACTIONS}:show_table",
    group=MEASURE,
    first=("recipes", "data", "out", "seeds", "schedule_scale", "train"),
)
@dataclass(frozen=True, kw_only=True)
class SweepCommand(SweepOptions, Continued):
    """Compare recipes on scenes and seeds, as a table."""


@register_command(
    "paper",
    action=f"{_ACTIONS}:show_table",
    group=MEASURE,
    first=("table", "data", "out", "scenes", "schedule_scale", "train"),
)
@dataclass(frozen=True, kw_only=True)
class PaperCommand(PaperOptions, Continued):
    """Reproduce a table of the paper."""
