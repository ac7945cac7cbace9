"""The commands: the pipeline's classes of options, and what is printed. No torch: `--help` is instant."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from gs2d.config.arguments import Arg
from gs2d.contrib.lab.options import BlocksOptions, PaperOptions, ReconstructAnywhereOptions, SweepOptions
from gs2d.pipeline.prepare.options import (
    BoxOption,
    DemoOptions,
    EvaluateOptions,
    GeoreferenceOptions,
    MeshOptions,
    OrthophotoOptions,
    Overrides,
    PlanOptions,
    PosesOptions,
    TextureOptions,
    TrainOptions,
)

MemoryOption = Annotated[float | None, Arg(metavar="GIB")]
RunPath = Annotated[Path, Arg(metavar="RUN", positional=True)]


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of every command."""

    quiet: bool = False
    """No progress and no tables; errors only."""
    verbose: bool = False
    """Print every decision; without it those that need no action are in events.jsonl only."""
    json: bool = False
    """Results as JSON on stdout, and nothing else there."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclass(frozen=True, kw_only=True)
class Demo(DemoOptions, Common):
    """Make a small synthetic capture, train on it, extract and score the mesh, write the report."""


@dataclass(frozen=True, kw_only=True)
class Reconstruct(ReconstructAnywhereOptions, Common):
    """A folder of photographs to cameras, splats, a mesh and a report: `gs2d poses` and `gs2d train` in one."""


@dataclass(frozen=True, kw_only=True)
class Poses(PosesOptions, Common):
    """Photographs without cameras to a capture that `gs2d train` reads: structure from motion, by COLMAP."""


@dataclass(frozen=True, kw_only=True)
class Plan(PlanOptions, Common):
    """Estimate what training on a capture takes: splats, memory, disk and hours on this machine. Nothing is trained."""


@dataclass(frozen=True, kw_only=True)
class Train(TrainOptions, Common):
    """Posed photographs to splats, mesh and report."""


@dataclass(frozen=True, kw_only=True)
class Blocks(BlocksOptions, Common):
    """Train a capture in blocks where it is too large for one training; the merged scene is a run as any other."""


@dataclass(frozen=True, kw_only=True)
class Mesh(TextureOptions, MeshOptions, Common):
    """Extract the mesh of a trained run again, with other settings."""

    run: RunPath
    """Run folder."""
    out: Path | None = None
    """Mesh file (default: mesh.ply in the run; with --texture mesh.glb)."""
    splats: Annotated[Path | None, Arg(metavar="FILE")] = None
    """Take the splats of this file, of any format that is read, in the frame of the run; needs --out."""
    texture: bool = False
    """Write it with a texture from the photographs: mesh.glb, or what --out names, .glb or .obj. Without options that
    change the mesh it is the run's mesh.ply."""
    georeferenced: bool = False
    """In metres of the world (`gs2d georeference`), less an offset that is said in the file and beside it."""
    memory: MemoryOption = None
    """GiB of memory to keep to (default: half of what this machine or container has)."""
    threads: int | None = None
    """CPU threads."""


@dataclass(frozen=True, kw_only=True)
class Render(Common):
    """Render a trained run to PNG files, or to a video."""

    run: RunPath
    """Run folder."""
    split: Literal["test", "train"] | None = None
    """Which views (default: the test views, or the training views if the run has no test views)."""
    orbit: int = 0
    """Instead of the views, so many frames of a circle around the subject, or to and fro where only a part of the
    circle was photographed."""
    flight: int = 0
    """Instead of the views, so many frames of a smooth flight along the photographs."""
    width: Annotated[int | None, Arg(metavar="PIXELS")] = None
    """Width of the images; the height follows from the aspect ratio (default: as in training)."""
    out: Path | None = None
    """Folder for the pictures (default: renders/SPLIT, renders/orbit or renders/flight in the run)."""
    video: Annotated[Path | None, Arg(metavar="FILE")] = None
    """With --orbit or --flight: also a video of the frames, .mp4 (H.264, by ffmpeg) or .webp; no ending: what works."""
    fps: float = 30.0
    """Frames a second of the video."""
    exposure_of: Annotated[str | None, Arg(metavar="PHOTOGRAPH")] = None
    """Of a run with --exposure: in the exposure of this training photograph (default: in the mean of all)."""
    splats: Annotated[Path | None, Arg(metavar="FILE")] = None
    """Take the splats of this file, of any format that is read, in the frame of the run; needs --out."""
    memory: MemoryOption = None
    """GiB of memory to keep to (default: half of what this machine or container has)."""
    threads: int | None = None
    """CPU threads."""


@dataclass(frozen=True, kw_only=True)
class View(Common):
    """Look at a trained run in the browser: splats, mesh and cameras, served from this machine only."""

    path: Annotated[Path, Arg(metavar="RUN", positional=True)]
    """Run folder, or a file of flat splats: PLY (compressed too), .spz, .splat, .usd, .glb or .sog."""
    port: int | None = None
    """Port of the page (default: the first free one from 8080 on)."""


@dataclass(frozen=True, kw_only=True)
class Page(Common):
    """Write the splats as one HTML file that any browser draws exactly: no server, no network, to mail or to host."""

    path: Annotated[Path, Arg(metavar="RUN", positional=True)]
    """Run folder, or a file of flat splats: PLY (compressed too), .spz, .splat, .usd, .glb or .sog."""
    out: Annotated[Path | None, Arg(metavar="FILE")] = None
    """HTML file (default: scene.html in the run, or beside the file)."""
    sh_degree: int = 3
    """How far colours may depend on the direction; less is a smaller file: 80, 64, 48 or 32 bytes a splat."""


@dataclass(frozen=True, kw_only=True)
class Evaluate(EvaluateOptions, Common):
    """Score a trained run: PSNR, SSIM, LPIPS; with a ground truth also Chamfer distance and F-score of the mesh."""

    run: RunPath
    """Run folder."""
    memory: MemoryOption = None
    """GiB of memory to keep to (default: half of what this machine or container has)."""
    threads: int | None = None
    """CPU threads."""


@dataclass(frozen=True, kw_only=True)
class Export(Common):
    """Write the splats of a run in another layout."""

    run: RunPath
    """Run folder, or a file of flat splats: PLY (compressed too), .spz, .splat, .usd, .glb or .sog."""
    out: Annotated[Path, Arg(metavar="FILE")]
    """File to write; by its ending .ply is 3dgs, .compressed.ply compressed, .spz spz, .splat splat, .usd usd, .glb
    gltf, .sog sog, lod-meta.json streamed (in a folder of its own)."""
    layout: str | None = None
    """2dgs: two scales, the official 2DGS layout; 3dgs: a third, tiny scale, which common viewers open; compressed:
    PlayCanvas's and SuperSplat's PLY; spz: Niantic's, the smallest; splat: antimatter15's, one colour a splat;
    usd: OpenUSD, to the bit; gltf: Khronos' KHR_gaussian_splatting, as flat 3D Gaussians;
    sog: PlayCanvas's pictures, for the web; streamed: the same in levels of detail, for large scenes."""
    bbox: BoxOption = None
    """Only the splats with their centres in this box (`gs2d view` and subject.json have numbers)."""
    georeferenced: bool = False
    """In metres of the world (`gs2d georeference`), less an offset that is said in the file and beside it."""


@dataclass(frozen=True, kw_only=True)
class Georeference(GeoreferenceOptions, Common):
    """Find where a run is in the world: scale, up and place, from GPS, control points, a distance or markers."""

    run: RunPath
    """Run folder."""


@dataclass(frozen=True, kw_only=True)
class Orthophoto(OrthophotoOptions, Common):
    """Write a georeferenced run from straight above: orthophoto and elevation model, as GeoTIFF."""

    run: RunPath
    """Run folder, with mesh.ply and `gs2d georeference`."""
    out: Annotated[Path | None, Arg(metavar="FILE.tif")] = None
    """The orthophoto (default: orthophoto.tif in the run); heights go to NAME_elevation.tif beside it."""
    threads: int | None = None
    """CPU threads."""


@dataclass(frozen=True, kw_only=True)
class Report(Common):
    """Write report.html of a run again."""

    run: RunPath
    """Run folder."""
    memory: MemoryOption = None
    """GiB of memory to keep to (default: half of what this machine or container has)."""


@dataclass(frozen=True, kw_only=True)
class Recipes(Common):
    """List the recipes, or show one: `gs2d recipes show NAME`."""

    action: Annotated[Literal["list", "show"], Arg(positional=True)] = "list"
    """What to do."""
    name: Annotated[str, Arg(positional=True)] = ""
    """Name of the recipe to show."""
    schedule_scale: float = 1.0
    """As in `gs2d train`."""
    overrides: Overrides = ()
    """As in `gs2d train`."""


@dataclass(frozen=True, kw_only=True)
class Paper(PaperOptions, Common):
    """Train what one of the paper's tables needs, score it, and write the table beside the paper's figures."""


@dataclass(frozen=True, kw_only=True)
class Sweep(SweepOptions, Common):
    """Train and score recipes on every scene and seed, and write a table with a row for each recipe."""


@dataclass(frozen=True, kw_only=True)
class Doctor(Common):
    """Say what this machine can run, and why not the rest."""


@dataclass(frozen=True, kw_only=True)
class Completion(Common):
    """Print what completes commands, options and values in a shell: source <(gs2d completion bash)."""

    shell: Annotated[Literal["bash", "zsh", "fish"], Arg(positional=True)]
    """The shell; the first line of what is printed says where it goes."""


@dataclass(frozen=True, kw_only=True)
class Info(Common):
    """Show what a run folder, a capture or a file of splats, mesh or points holds."""

    path: Annotated[Path, Arg(metavar="PATH", positional=True)]
    """Run folder, capture (folder or .zip), or file: PLY, .spz, .splat, .usd, .glb or .sog."""


COMMANDS: tuple[type[Common], ...] = (
    Demo, Reconstruct, Poses, Plan, Train, Blocks, Mesh, Render, View, Page, Evaluate, Export, Georeference, Orthophoto,
    Report, Recipes, Paper, Sweep, Doctor, Info, Completion
)  # fmt: skip
