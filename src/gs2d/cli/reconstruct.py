"""``gs2d reconstruct``: from arguments to options, and what a person does next."""

from __future__ import annotations

import shlex
from typing import Any

from gs2d.cli import commands as c
from gs2d.cli.console import Console
from gs2d.cli.options import Finding, training_values, values
from gs2d.cli.tables import show_run
from gs2d.core.json_files import read_json
from gs2d.io.run_dir import PAGE
from gs2d.pipeline.reconstruct import CAPTURE, ReconstructOptions
from gs2d.pipeline.reconstruct import reconstruct as run_all
from gs2d.sfm.workspace import POSES_JSON


def reconstruct(command: c.Reconstruct, console: Console) -> None:
    """Run it; then the figures, the files and the next command."""
    run = run_all(reconstruct_options(command), console.on_event)
    console.close()
    show_run(run.path, run.metrics(), console, extra={"poses": read_json(run.path / CAPTURE / POSES_JSON)})
    console.say(f"look at it: open {PAGE} in a browser, or gs2d view {shlex.quote(str(run.path))}")


def reconstruct_options(command: c.Reconstruct) -> ReconstructOptions:
    """Return the pipeline's options."""
    own = ("photos", "out", "quality", "schedule_scale", "downscale", "texture")
    both = ("threads", "seed", "resume", "overwrite")
    fields: dict[str, Any] = {name: getattr(command, name) for name in (*own, *both)}
    return ReconstructOptions(
        **fields,
        training={**training_values(command.training), "backend": command.backend},
        finding=values(Finding, command.cameras),
    )
