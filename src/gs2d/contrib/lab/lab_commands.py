"""The commands blocks and sweep. Imports no torch, so that `--help` is instant."""

from __future__ import annotations

from dataclasses import dataclass

from gs2d.cli.commands import MEASURE, STEPS, Common, register_command
from gs2d.contrib.lab.lab_options import BlocksOptions, SweepOptions

_ACTIONS = "gs2d.contrib.lab.show_table"


@register_command(
    "blocks",
    action=f"{_ACTIONS}:show_blocks",
    group=STEPS,
    first=("scene", "out", "blocks", "quality", "recipe", "downscale", "memory", "slots"),
)
@dataclass(frozen=True, kw_only=True)
class BlocksCommand(BlocksOptions, Common):
    """Train a large capture in blocks and merge them."""


@register_command(
    "sweep",
    action=f"{_ACTIONS}:show_table",
    group=MEASURE,
    first=("recipes", "data", "out", "scenes", "seeds", "schedule_scale", "train"),
)
@dataclass(frozen=True, kw_only=True)
class SweepCommand(SweepOptions, Common):
    """Compare recipes on scenes and seeds, as a table; or reproduce a table of the paper."""
