"""The action of ``gs2d demo``."""

from __future__ import annotations

from gs2d.cli.console import Console
from gs2d.cli.handlers import show_run
from gs2d.contrib.demo.demo_command import DemoCommand
from gs2d.contrib.demo.run_demo import demo


def show_demo(command: DemoCommand, console: Console) -> None:
    """Run the demo and print its results."""
    run = demo(command, console.on_event)
    show_run(run, console)
    console.say("your own photographs: gs2d reconstruct PHOTOS --out RUN --quality draft")
