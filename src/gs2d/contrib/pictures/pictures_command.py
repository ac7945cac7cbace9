"""The command ``gs2d render`` and its options. Imports no torch, so that `--help` is instant."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from gs2d.cli.commands import LOOK, Common, RunPath, register_command
from gs2d.config.arguments import Arg
from gs2d.pipeline.prepare.options import Options, Resources


@dataclass(frozen=True, kw_only=True)
class RenderOptions(Options):
    """Which images of a run are rendered."""

    split: Literal["test", "train"] | None = None
    """Views to render (default: test views, or training views where there are none)."""
    orbit: int = 0
    """Render N frames of a circle around the subject, or of an arc if only one side was photographed."""
    width: Annotated[int | None, Arg(metavar="PIXELS")] = None
    """Image width; the height follows (default: as in training)."""
    video: Annotated[Path | None, Arg(metavar="FILE")] = None
    """With --orbit: also write a video with 30 frames a second, .mp4 (H.264, needs ffmpeg) or .webp."""


@register_command(
    "render",
    action="gs2d.contrib.pictures.render_run:show_render",
    group=LOOK,
    first=("run", "split", "orbit", "width", "video", "out"),
)
@dataclass(frozen=True, kw_only=True)
class RenderCommand(RenderOptions, Resources, Common):
    """Render images or a video of a run."""

    run: RunPath
    """Run folder."""
    out: Annotated[Path | None, Arg(metavar="DIR")] = None
    """Folder of the images (default: renders/SPLIT or renders/orbit in the run)."""
    threads: int | None = None
    """CPU threads."""
