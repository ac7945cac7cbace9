"""The command ``gs2d edit`` and its options. Imports no torch, so that `--help` is instant."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gs2d.cli.commands import LOOK, Common, RunPath, register_command
from gs2d.config.arguments import Arg
from gs2d.pipeline.prepare.options import BoxOption, Options

Transform = tuple[float, float, float, float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class EditOptions(Options):
    """The edit of splats; one of the options, or ``merge`` with ``transform``."""

    keep_box: BoxOption = None
    """Delete the splats whose centre is outside this box. `gs2d view` shows its numbers."""
    delete_box: BoxOption = None
    """Delete the splats whose centre is in this box."""
    merge: Annotated[Path | None, Arg(metavar="OTHER")] = None
    """Add the splats of another run or file, in the same coordinates, or moved there by --transform."""
    transform: Annotated[Transform | None, Arg(metavar="SCALE RX RY RZ X Y Z")] = None
    """Scale, rotate about x, then y, then z (degrees), then move. Needs --out; with --merge, moves OTHER."""
    undo: bool = False
    """Restore the splats of the run before the last edit; may be repeated."""


@register_command("edit", action="gs2d.contrib.edit.edit_splats:show_edit", group=LOOK)
@dataclass(frozen=True, kw_only=True)
class EditCommand(EditOptions, Common):
    """Delete, merge or move splats of a run, with undo, or of a file."""

    run: RunPath
    """Run folder, or a file of splats: PLY, .spz, .splat, .usd, .glb or .sog."""
    out: Annotated[Path | None, Arg(metavar="FILE")] = None
    """Write the edited splats to this file, in the format of its ending, and leave the run as it is."""
