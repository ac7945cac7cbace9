"""The commands and their options, as dataclasses that tyro turns into a command line. No torch: `--help` is instant."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg, subcommand

from gs2d.cli.options import Backend, Box, Common, Finding, Overrides, Training, TrainingCommon

RunPath = Annotated[Positional[Path], arg(metavar="RUN")]


@dataclass(frozen=True, kw_only=True)
class Demo(TrainingCommon):
    """Make a small synthetic capture, train 2DGS-R on it, extract and score the mesh, write the report."""

    out: Path = Path("runs/demo")
    """Run folder; the capture goes to its sub-folder `capture`. An earlier demo there is replaced."""
    schedule_scale: float | None = None
    """Fraction of the full schedule (default: what fits five minutes on two cores)."""
    vary_exposure: bool = False
    """Photograph as a camera on automatic does: training pictures differ in exposure and white balance."""
    exposure: bool = False
    """Learn an exposure and a white balance for each photograph, as in `gs2d train`."""
    vary_poses: bool = False
    """Say wrong places for the cameras: those of training pictures are off by half a degree and half a percent."""
    refine_poses: bool = False
    """Learn where each photograph was taken from, as in `gs2d train`."""
    page: bool = True
    """Do not write scene.html at the end, as in `gs2d train`."""
    viewer: bool = False
    """Show the training in the browser while it runs, as in `gs2d train`."""
    viewer_port: int | None = None
    """With --viewer: port of the page (default: the first free one from 8080 on)."""


@dataclass(frozen=True, kw_only=True)
class Reconstruct(TrainingCommon):
    """A folder of photographs to cameras, splats, a mesh and a report: `gs2d poses` and `gs2d train` in one."""

    photos: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """Folder of photographs, with or without sub-folders, or a video; it is only read."""
    out: Annotated[Path, arg(metavar="RUN")]
    """Run folder to make; the photographs with their cameras go to its sub-folder `capture`."""
    quality: Literal["draft", "normal", "full"] = "normal"
    """How long is trained on how large pictures. On a CPU: 0.03 of the full schedule at 400 px, 0.1 at 800, all at
    1600; on a GPU 0.1 at 800 px, 0.5 at 1600, all at 1600. The time it will take is told before it begins."""
    schedule_scale: float | None = None
    """Fraction of the full schedule (default: by --quality)."""
    downscale: int | None = None
    """Shrink the photographs by this integer for training (default: by --quality)."""
    texture: bool = False
    """Also write mesh.glb, with a texture from the photographs."""
    training: Annotated[Training, OmitArgPrefixes] = field(default_factory=Training)
    """As in `gs2d train`."""
    cameras: Annotated[Finding, OmitArgPrefixes] = field(default_factory=Finding)
    """As in `gs2d poses`."""


@dataclass(frozen=True, kw_only=True)
class Poses(Finding, Common):
    """Photographs without cameras to a capture that `gs2d train` reads: structure from motion, by COLMAP."""

    photos: Annotated[Positional[Path], arg(metavar="PHOTOS")]
    """Folder of photographs, with or without sub-folders, or a video; it is only read."""
    out: Annotated[Path, arg(metavar="CAPTURE")]
    """Capture folder to make: images/, sparse/0, poses.json, poses.png. It appears when all is done."""
    threads: int | None = None
    """CPU threads (default: all cores that this process may use)."""
    seed: int = 0
    """Seed; the same bytes for up to 50 photographs or with --threads 1, else cameras differ by rounding."""
    overwrite: bool = False
    """Replace the capture in --out, if this command made it."""


@dataclass(frozen=True, kw_only=True)
class Train(Training, TrainingCommon):
    """Posed photographs to splats, mesh and report."""

    scene: Annotated[Positional[Path], arg(metavar="SCENE")]
    """Folder of the capture, or a .zip of it: COLMAP, Blender or nerfstudio transforms, DTU, OpenSfM or OpenDroneMap,
    Metashape, Meshroom."""
    out: Annotated[Path, arg(metavar="RUN")]
    """Run folder to make."""
    format: str = "auto"
    """Format of the capture: blender, nerfstudio, dtu, colmap, opensfm, metashape, alicevision, or a package's."""
    downscale: int = 1
    """Shrink the photographs by this integer, area-filtered."""
    schedule_scale: float = 1.0
    """Fraction of the full schedule: 0.1 trains a tenth of the iterations."""


@dataclass(frozen=True, kw_only=True)
class Mesh(Common):
    """Extract the mesh of a trained run again, with other settings."""

    run: RunPath
    """Run folder."""
    out: Path | None = None
    """Mesh file (default: mesh.ply in the run; with --texture mesh.glb)."""
    voxel: float | None = None
    """Voxel size in world units (default: from the scene)."""
    truncation: float | None = None
    """Truncation distance in world units (default: from the voxel size)."""
    depth_limit: float | None = None
    """Ignore depth beyond this, in world units (default: from the scene)."""
    bbox: Annotated[Box | None, arg(metavar="X0 Y0 Z0 X1 Y1 Z1")] = None
    """Keep only this box, not the subject's. With --unbounded: where the voxels are finest."""
    subject_box: Annotated[Box | None, arg(metavar="X0 Y0 Z0 X1 Y1 Z1")] = None
    """What the photographs are of, from now on (default: what the run says, or what most cameras look at)."""
    whole_scene: Annotated[bool, arg(name="scene")] = False
    """Mesh everything, not only the subject."""
    unbounded: bool = False
    """Mesh what lies far away too, in voxels that grow with the distance."""
    max_gib: float = 4.0
    """Memory for the fused volume; more is an error that names a voxel that fits."""
    depth: Literal["mean", "median"] | None = None
    """Depth that is fused (default: the run's protocol)."""
    keep_components: int | None = None
    """Keep the so many largest connected pieces (default: all that are not small)."""
    texture: bool = False
    """Write it with a texture from the photographs: mesh.glb, or what --out names, .glb or .obj. Without options that
    change the mesh it is the run's mesh.ply."""
    faces: int = 50_000
    """With --texture: simplify a larger mesh to so many triangles."""
    texture_size: int | None = None
    """With --texture: its side in texels (default: two for each pixel's length, at most 4096)."""
    texture_from: Literal["photographs", "renders"] = "photographs"
    """With --texture: colours from the photographs, or from the splats as they look from there."""
    texture_downscale: int | None = None
    """With --texture: shrink the photographs by this integer (default: as in training; 1 = their full size)."""
    threads: int | None = None
    """CPU threads."""


@dataclass(frozen=True, kw_only=True)
class Render(Common):
    """Render a trained run to PNG files, or to a video."""

    run: RunPath
    """Run folder."""
    split: Literal["test", "train"] = "test"
    """Which views."""
    orbit: int = 0
    """Instead of the views, so many frames of a circle around the subject, or to and fro where only a part of the
    circle was photographed."""
    flight: int = 0
    """Instead of the views, so many frames of a smooth flight along the photographs."""
    out: Path | None = None
    """Folder for the pictures (default: renders/SPLIT, renders/orbit or renders/flight in the run)."""
    video: Annotated[Path | None, arg(metavar="FILE")] = None
    """With --orbit or --flight: also a video of the frames, .mp4 (H.264, by ffmpeg) or .webp; no ending: what works."""
    fps: float = 30.0
    """Frames a second of the video."""
    exposure_of: Annotated[str | None, arg(metavar="PHOTOGRAPH")] = None
    """Of a run with --exposure: in the exposure of this training photograph (default: in the mean of all)."""
    threads: int | None = None
    """CPU threads."""


@dataclass(frozen=True, kw_only=True)
class View(Common):
    """Look at a trained run in the browser: splats, mesh and cameras, served from this machine only."""

    path: Annotated[Positional[Path], arg(metavar="RUN")]
    """Run folder, or a file of flat splats: PLY (compressed too), .spz or .splat."""
    port: int | None = None
    """Port of the page (default: the first free one from 8080 on)."""
    host: str = "127.0.0.1"
    """Address that is listened on; 0.0.0.0 lets other machines in, and there is no password."""
    threads: int | None = None
    """CPU threads."""


@dataclass(frozen=True, kw_only=True)
class Page(Common):
    """Write the splats as one HTML file that any browser draws exactly: no server, no network, to mail or to host."""

    path: Annotated[Positional[Path], arg(metavar="RUN")]
    """Run folder, or a file of flat splats: PLY (compressed too), .spz or .splat."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """HTML file (default: scene.html in the run, or beside the file)."""
    sh_degree: int = 3
    """How far colours may depend on the direction; less is a smaller file: 80, 64, 48 or 32 bytes a splat."""


@dataclass(frozen=True, kw_only=True)
class Evaluate(Common):
    """Score a trained run: PSNR, SSIM, LPIPS; with a ground truth also Chamfer distance and F-score of the mesh."""

    run: RunPath
    """Run folder."""
    ground_truth: Annotated[Path | None, arg(metavar="MESH_OR_POINTS")] = None
    """True surface (PLY, OBJ) in the capture's frame (DTU: mm), or the official folder of DTU or Tanks and Temples."""
    thresholds: tuple[float, ...] = ()
    """Distances at which precision and recall are taken, world units (default: 0.25, 0.5, 1 % of its size)."""
    lpips_weights: Path | None = None
    """VGG-16 and LPIPS weights for the LPIPS metric."""
    match_exposure: bool = False
    """Score test views once more, each half of a rendering matched in colour to the other half of its photograph."""
    match_poses: bool = False
    """Score test views once more, each camera moved to where the splats look most like its photograph."""
    threads: int | None = None
    """CPU threads."""


@dataclass(frozen=True, kw_only=True)
class Export(Common):
    """Write the splats of a run in another layout."""

    run: RunPath
    """Run folder, or a file of flat splats: PLY (compressed too), .spz or .splat."""
    out: Annotated[Path, arg(metavar="FILE")]
    """File to write; by its ending .ply is 3dgs, .compressed.ply compressed, .spz spz, .splat splat."""
    layout: str | None = None
    """2dgs: two scales, the official 2DGS layout; 3dgs: a third, tiny scale, which common viewers open; compressed:
    PlayCanvas's and SuperSplat's PLY; spz: Niantic's, the smallest; splat: antimatter15's, one colour a splat."""
    bbox: Annotated[Box | None, arg(metavar="X0 Y0 Z0 X1 Y1 Z1")] = None
    """Only the splats with their centres in this box (`gs2d view` and subject.json have numbers)."""


@dataclass(frozen=True, kw_only=True)
class Report(Common):
    """Write report.html of a run again."""

    run: RunPath
    """Run folder."""


@dataclass(frozen=True, kw_only=True)
class Recipes(Common):
    """List the recipes, or show one: `gs2d recipes show NAME`."""

    action: Positional[Literal["list", "show"]] = "list"
    """What to do."""
    name: Positional[str] = ""
    """Name of the recipe to show."""
    schedule_scale: float = 1.0
    """As in `gs2d train`."""
    overrides: Overrides = ()
    """As in `gs2d train`."""


@dataclass(frozen=True, kw_only=True)
class TableCommon(Common):
    """Options of the commands that train and score many runs, and write a table of them."""

    data: Annotated[Path, arg(metavar="DIR")]
    """A capture, or a folder of captures."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for runs, table and page. The command can be stopped and started again."""
    scenes: tuple[str, ...] = ()
    """Only these captures, by the names of their folders."""
    protocol: str = "auto"
    """Protocol of all captures (default: by the format of each)."""
    downscale: int | None = None
    """Shrink the photographs by this integer (default: what the protocol says)."""
    schedule_scale: float = 1.0
    """Fraction of the full schedule."""
    seeds: tuple[str, ...] = ("0",)
    """Seeds, as 0,1,2; or a count: 3 is 0,1,2."""
    backend: Backend = "auto"
    """Rasterizer."""
    slots: Annotated[int | None, arg(aliases=["--jobs"])] = None
    """Runs at the same time (default: one a GPU, else one)."""
    threads: int | None = None
    """CPU threads of each of several runs (default: the cores divided among them)."""
    cache: Annotated[Path | None, arg(metavar="DIR")] = None
    """Stage cache (default: in --out). Tables that share it train their common stages once."""
    truth: Annotated[Path | None, arg(metavar="DIR")] = None
    """True surfaces, NAME.ply, for captures that have no mesh_gt.ply beside them."""
    lpips_weights: Path | None = None
    """VGG-16 and LPIPS weights for the LPIPS metric."""
    overrides: Overrides = ()
    """Change the recipes, as in `gs2d train`; reaches those that have the stage."""
    no_train: bool = False
    """Only write the table of what is there."""


@dataclass(frozen=True, kw_only=True)
class Paper(TableCommon):
    """Train what one of the paper's tables needs, score it, and write the table beside the paper's figures."""

    table: Annotated[
        Positional[Literal["regularisation", "benchmark", "k", "freeze", "modules", "absgs"]], arg(metavar="TABLE")
    ]
    """Which table: regularisation, benchmark, k, freeze, modules or absgs."""


@dataclass(frozen=True, kw_only=True)
class Sweep(TableCommon):
    """Train and score recipes on every scene and seed, and write a table with a row for each recipe."""

    recipes: Annotated[Positional[tuple[str, ...]], arg(metavar="RECIPE [RECIPE ...]")]
    """Names that `gs2d recipes` lists. Recipes that --out has already keep their rows."""


@dataclass(frozen=True, kw_only=True)
class Doctor(Common):
    """Say what this machine can run, and why not the rest."""


@dataclass(frozen=True, kw_only=True)
class Info(Common):
    """Show what a run folder, a capture or a file of splats, mesh or points holds."""

    path: Annotated[Positional[Path], arg(metavar="PATH")]
    """Run folder, capture (folder or .zip), or file: PLY, .spz or .splat."""


COMMANDS: tuple[type[Common], ...] = (
    Demo, Reconstruct, Poses, Train, Mesh, Render, View, Page, Evaluate, Export, Report, Recipes, Paper, Sweep, Doctor,
    Info
)  # fmt: skip
Command = (
    Annotated[Demo, subcommand("demo")]
    | Annotated[Reconstruct, subcommand("reconstruct")]
    | Annotated[Poses, subcommand("poses")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Mesh, subcommand("mesh")]
    | Annotated[Render, subcommand("render")]
    | Annotated[View, subcommand("view")]
    | Annotated[Page, subcommand("page")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Report, subcommand("report")]
    | Annotated[Recipes, subcommand("recipes")]
    | Annotated[Paper, subcommand("paper")]
    | Annotated[Sweep, subcommand("sweep")]
    | Annotated[Doctor, subcommand("doctor")]
    | Annotated[Info, subcommand("info")]
)
