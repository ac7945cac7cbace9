"""The command ``gs2d demo`` and its options. Imports no torch, so that `--help` is instant."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gs2d.cli.commands import BEGIN, Common, register_command
from gs2d.config.arguments import PYTHON_ONLY, SETTING, Arg
from gs2d.config.presets import DEFAULT_RECIPE
from gs2d.config.recipe import Recipe
from gs2d.pipeline.prepare.options import HowItRuns, ViewerOption


@dataclass(frozen=True, kw_only=True)
class DemoOptions(HowItRuns):
    """Options of the demo."""

    out: Annotated[Path, Arg(metavar="RUN")] = Path("runs/demo")
    """Run folder; an earlier demo there is replaced."""
    recipe: str | Recipe = DEFAULT_RECIPE
    """Recipe. `gs2d recipes` lists them."""
    schedule_scale: float | None = None
    """Fraction of the iterations of the recipe (default: 0.15, two minutes on two cores)."""
    page: Annotated[bool, SETTING] = True
    """Whether to write scene.html, the splats as a page for any browser."""
    viewer: ViewerOption = None
    """Show the training in the browser while it runs, at this port (default: the first free one from 8080)."""
    train_views: Annotated[int, PYTHON_ONLY] = 40
    test_views: Annotated[int, PYTHON_ONLY] = 8
    size: Annotated[int, PYTHON_ONLY] = 256
    """Width and height of the photographs, px."""


@register_command(
    "demo",
    action="gs2d.contrib.demo.show_demo:show_demo",
    group=BEGIN,
    first=("out", "schedule_scale", "viewer", "resume", "overwrite"),
)
@dataclass(frozen=True, kw_only=True)
class DemoCommand(DemoOptions, Common):
    """Render a small synthetic capture, train on it and score the result."""
