"""The commands of ``gs2d`` by name, and those of the core with their options. No torch: `--help` is instant."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from gs2d.config.arguments import Arg
from gs2d.config.registry import Register, Registry
from gs2d.pipeline.prepare.options import (
    EvaluateOptions,
    MeshOptions,
    PosesOptions,
    ReconstructOptions,
    Resources,
    TextureOptions,
    TrainOptions,
)

BEGIN = "To begin with"
STEPS = "Step by step"
LOOK = "Look, keep and share"
MEASURE = "Measure and compare"
GROUPS = (BEGIN, STEPS, LOOK, MEASURE)  # the order of the help; other groups follow


@dataclass(frozen=True)
class Command:
    """A command of ``gs2d``, as :func:`register_command` describes it; ``options`` is the decorated dataclass."""

    name: str
    options: type
    action: str
    group: str
    first: tuple[str, ...] = ()

    def run(self, options: Any, console: Any) -> None:
        """Run the command."""
        module, _, function = self.action.partition(":")
        getattr(importlib.import_module(module), function)(options, console)


_CORE = "doctor reconstruct view poses train mesh info export evaluate recipes"
COMMANDS: Registry[Command] = Registry("command", "gs2d.commands", builtin=dict.fromkeys(_CORE.split(), __name__))


def register_command(
    name: str, *, action: str, group: str, first: tuple[str, ...] = ()
) -> Callable[[Register], Register]:
    """Return a decorator that registers a command of ``gs2d``.

    Parameters
    ----------
    name : str
        Name on the command line; must be unused.
    action : str
        "module:function" that runs the command, called with the options and the console. The module is imported when
        the command runs. The module of the options should import neither torch nor NumPy, so that help stays fast.
    group : str
        Heading in ``gs2d --help``, such as "Measure and compare".
    first : tuple of str
        Fields that ``gs2d COMMAND --help`` explains, the most used first; (): all of this command alone.

    Returns
    -------
    callable
        Decorates a frozen dataclass of ``gs2d.cli.commands.Common``, whose fields are the options.
    """

    def registered(options: Register) -> Register:
        kind: Any = options
        COMMANDS.register(name, module=kind.__module__)(Command(name, kind, action, group, first))
        return options

    return registered


def _core(name: str, group: str, *first: str) -> Callable[[Register], Register]:
    """Register a command of the core; its action is the function of its name in ``handlers``."""
    return register_command(name, action=f"gs2d.cli.handlers:{name}", group=group, first=first)


RunPath = Annotated[Path, Arg(metavar="RUN", positional=True)]


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of every command."""

    quiet: bool = False
    """Print errors only."""
    verbose: bool = False
    """Print every decision, and the traceback of an error. Without it, most decisions are only in events.jsonl."""
    json: bool = False
    """Print the result as JSON on stdout."""


# -- the commands of the core ------------------------------------------------------------------------------------------
@_core("reconstruct", BEGIN, "photos", "out", "quality", "texture", "viewer", "resume", "overwrite")
@dataclass(frozen=True, kw_only=True)
class ReconstructCommand(ReconstructOptions, Common):
    """Turn photographs or a video into splats, mesh and report."""


@_core("poses", STEPS, "photos", "out", "frames", "camera_model", "matching", "overwrite")
@dataclass(frozen=True, kw_only=True)
class PosesCommand(PosesOptions, Common):
    """Find the cameras of photographs, with COLMAP."""


@_core("train", STEPS, "scene", "out", "quality", "recipe", "downscale", "viewer", "resume", "overwrite")
@dataclass(frozen=True, kw_only=True)
class TrainCommand(TrainOptions, Common):
    """Train on photographs whose cameras are known."""


@_core("mesh", STEPS, "run", "out", "texture", "method", "refine", "voxel", "bbox")
@dataclass(frozen=True, kw_only=True)
class MeshCommand(TextureOptions, MeshOptions, Resources, Common):
    """Extract the mesh of a run with other settings, or the mesh of a splat file."""

    run: Annotated[Path | None, Arg(metavar="RUN", positional=True)] = None
    """Run folder."""
    out: Annotated[Path | None, Arg(metavar="FILE")] = None
    """Mesh file (default: mesh.ply in the run, or mesh.glb with --texture)."""
    splats: Annotated[Path | None, Arg(metavar="FILE")] = None
    """Mesh the splats of this file instead of a run. Needs --out."""
    cameras: Annotated[Path | None, Arg(metavar="CAPTURE")] = None
    """With --splats: capture with the cameras of the splats (default: viewpoints around the subject)."""
    texture: bool = False
    """Write a textured mesh, as .glb or .obj, from the photographs. Without options that change the mesh, uses
    mesh.ply."""
    threads: int | None = None
    """CPU threads."""


@_core("view", BEGIN)
@dataclass(frozen=True, kw_only=True)
class ViewCommand(Common):
    """Show splats, mesh and cameras of a run in the browser."""

    path: Annotated[Path, Arg(metavar="RUN", positional=True)]
    """Run folder, or a file of splats: PLY, .spz, .splat, .usd, .glb or .sog."""
    port: int | None = None
    """Port of the page (default: the first free port from 8080)."""


@_core("evaluate", MEASURE, "run", "ground_truth", "lpips_weights")
@dataclass(frozen=True, kw_only=True)
class EvaluateCommand(EvaluateOptions, Resources, Common):
    """Score images (PSNR, SSIM, LPIPS) and the mesh of a run."""

    run: RunPath
    """Run folder."""
    threads: int | None = None
    """CPU threads."""


@_core("export", LOOK)
@dataclass(frozen=True, kw_only=True)
class ExportCommand(Common):
    """Write the splats of a run in another format, or as a web page."""

    run: RunPath
    """Run folder, or a file of splats: PLY, .spz, .splat, .usd, .glb or .sog."""
    out: Annotated[Path | None, Arg(metavar="FILE")] = None
    """File to write. Its ending selects the format (default: scene.html in the run, with --format html)."""
    format: str | None = None
    """Format: html (a page that works offline in any browser), 2dgs (of the 2DGS paper), 3dgs (opens in common
    viewers), compressed, spz, spz4, splat, usd, gltf, sog, streamed, or one from a package (default: by the ending of
    --out; .ply is 3dgs)."""


@_core("recipes", MEASURE)
@dataclass(frozen=True, kw_only=True)
class RecipesCommand(Common):
    """List recipes, or print one as JSON."""

    name: Annotated[str, Arg(positional=True)] = ""
    """Recipe to print."""
    all: bool = False
    """List all recipes, not only the three for everyday use."""


@_core("doctor", BEGIN)
@dataclass(frozen=True, kw_only=True)
class DoctorCommand(Common):
    """Check what this machine can run, and what is missing."""


@_core("info", LOOK)
@dataclass(frozen=True, kw_only=True)
class InfoCommand(Common):
    """Describe a run, a capture, or a file of splats, mesh or points."""

    path: Annotated[Path, Arg(metavar="PATH", positional=True)]
    """Run folder, capture, or file: PLY, .spz, .splat, .usd, .glb or .sog."""
