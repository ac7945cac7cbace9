"""Options of each command, for Python and the command line.

`gs2d.cli` derives the command line from these classes: a field is an option, its docstring is the help.
`gs2d.config.arguments` marks what differs. This module imports no torch, so that `gs2d --help` is fast.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from gs2d.config.arguments import SETTING, Arg
from gs2d.config.presets import DEFAULT_RECIPE
from gs2d.config.protocols import Protocol
from gs2d.config.quantities import QUANTITIES
from gs2d.config.recipe import Recipe
from gs2d.errors import RecipeError

MATCHED = ("exposure", "poses")  # of EvaluateOptions
Robust = Literal["auto", "on", "off"]
Quality = Literal["auto", "draft", "normal", "full"]
LensModel = Literal[
    "auto", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "EQUIRECTANGULAR"
]
Box = tuple[float, float, float, float, float, float]  # x0 y0 z0 x1 y1 z1, world units
BoxOption = Annotated[Box | None, Arg(metavar="X0 Y0 Z0 X1 Y1 Z1")]
Overrides = Annotated[tuple[str, ...], Arg(name="set", metavar="STAGE.FIELD=VALUE", repeated=True)]
ViewerOption = Annotated[int | None, Arg(metavar="[PORT]", bare="0")]  # 0: the first free port
Photos = Annotated[Path, Arg(metavar="PHOTOS", positional=True)]


def values(kind: type[Any], options: Any) -> dict[str, Any]:
    """Return the values of ``options`` for the fields of a class of options, by name."""
    return {entry.name: getattr(options, entry.name) for entry in fields(kind)}


def check_choices(options: object) -> None:
    """Raise RecipeError for a value that is none of the choices of its field."""
    for name, hint in get_type_hints(type(options)).items():
        choices = [one for kind in (hint, *get_args(hint)) if get_origin(kind) is Literal for one in get_args(kind)]
        if choices and (value := getattr(options, name)) not in (*choices, None):
            raise RecipeError(f"--{name.replace('_', '-')} must be one of {', '.join(choices)}, got {value}")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Base class of options: in fields that hold paths, text becomes a path."""

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(type(self)).items():
            if Path in (hint, *get_args(hint)) and isinstance(value := getattr(self, name), str):
                object.__setattr__(self, name, Path(value))


# -- shared by several commands ----------------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class HowItRuns(Options):
    """How training runs: options of every command that trains one run."""

    out: Annotated[Path, Arg(metavar="RUN")]
    """Run folder to create."""
    backend: str = "auto"
    """Rasterizer: auto (the fastest here), cpu, cuda or reference. `gs2d doctor` lists them."""
    seed: int = 0
    """Random seed. The same seed gives the same bytes."""
    threads: int | None = None
    """CPU threads (default: all available cores)."""
    resume: bool = False
    """Continue the run in --out from its last checkpoint."""
    overwrite: bool = False
    """Replace the run in --out."""


@dataclass(frozen=True, kw_only=True)
class Resources(Options):
    """Limits of this machine."""

    memory: Annotated[float | None, Arg(metavar="GIB")] = None
    """Memory limit in GiB (default: half of the memory of this machine or container)."""


@dataclass(frozen=True, kw_only=True)
class Effort(Options):
    """Training length and image size, with the same defaults in `gs2d train` and `gs2d reconstruct`."""

    quality: Quality = "auto"
    """Training length and image size. On a CPU: draft is 1800 iterations at 400 px, normal 6000 at 800 px, full the
    whole recipe at 1600 px; on a GPU: 6000 at 800 px, 30000 or the whole recipe at 1600 px. auto: normal, except for
    known data sets: the whole recipe on full-size images."""
    schedule_scale: float | None = None
    """Fraction of the iterations of the recipe (default: by --quality)."""
    downscale: int | None = None
    """Shrink the photographs by this integer factor (default: by --quality, or more if memory needs it)."""


@dataclass(frozen=True, kw_only=True)
class CommonTraining(Options):
    """Options of every command that trains on photographs."""

    recipe: str | Recipe = DEFAULT_RECIPE
    """Recipe. `gs2d recipes` lists them."""
    protocol: str | Protocol = "auto"
    """Settings that depend on the data set: background, depth, near plane, fusion limits."""
    robust: Robust = "auto"
    """Robust training for real captures: dense start, removal of floaters. auto: except for known data sets."""
    learn: Annotated[str | tuple[str, ...], Arg(metavar="NAMES")] = "auto"
    """Also learn exposure, poses, intrinsics or quantities of packages (separated by commas), or none. auto: exposure
    if photographs differ, in robust training; auto,poses adds poses."""
    test_every: int | None = None
    """Hold out every N-th view (sorted by name) for testing; 0 trains on all (default: 8, or by
    protocol; 0 for captures of `gs2d poses` with fewer than 24 photographs)."""
    depth_prior: Literal["auto", "sparse", "sensor", "relative"] | None = None
    """Train with known depths: sparse points, or sensor or relative maps in depths/. auto: whatever exists."""
    normal_prior: bool = False
    """Train with known normals, from maps in normals/."""
    overrides: Overrides = ()
    """Change the recipe, e.g. --set surface.iterations=2000; may be repeated."""
    checkpoint_every: Annotated[str | int, Arg(metavar="N|TIME")] = "2m"
    """Iterations (500) or time (90s, 10m) between checkpoints."""
    page: Annotated[bool, SETTING] = True
    """Whether to write scene.html, the splats as a page for any browser."""
    masked: Literal["ignore", "empty", "off"] | None = None
    """Meaning of black mask pixels: ignore (not used), empty (transparent), or off (masks are not used) (default:
    ignore, or by protocol)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "checkpoint_every", str(self.checkpoint_every))

    @property
    def learned(self) -> tuple[str, ...]:
        """Return the names in ``learn``, checked. "none" is (); "auto" is exposure if the photographs differ."""
        names = tuple(self.learn.split(",")) if isinstance(self.learn, str) else self.learn
        for name in names if names != ("none",) else ():
            if name != "auto" and name not in QUANTITIES:
                raise RecipeError(f"--learn: {QUANTITIES.unknown(name, also=('auto', 'none'))}")
        return names if names != ("none",) else ()


@dataclass(frozen=True, kw_only=True)
class Training(CommonTraining):
    """Options of the commands that train a scene in one piece: `gs2d train` and `gs2d reconstruct`."""

    cache: Annotated[Path | None, Arg(metavar="DIR", setting=True)] = None
    """Folder that keeps finished stages for reuse by runs with the same scene and settings."""
    viewer: ViewerOption = None
    """Show the training in the browser while it runs, at this port (default: the first free one from 8080)."""


@dataclass(frozen=True, kw_only=True)
class PoseEstimation(Options):
    """How the cameras of photographs are estimated: options of `gs2d poses` and `gs2d reconstruct`."""

    cameras: Annotated[Literal["auto", "one", "each"], SETTING] = "auto"
    """Photographs that share a camera: those with equal folder, size, camera, lens and focal length (auto), all, or
    none."""
    camera_model: LensModel = "auto"
    """Lens model (auto: radial distortion, with two coefficients from 8 photographs of a camera on)."""
    matching: Literal["auto", "exhaustive", "sequential", "similar", "spatial"] = "auto"
    """Image pairs to match: all (exhaustive), consecutive, similar, or spatially near ones. auto: all up to 150
    photographs, else spatial if most have positions, else similar."""
    overlap: Annotated[int, SETTING] = 10
    """Consecutive photographs that each one is matched with, unless all pairs are matched."""
    neighbours: Annotated[int, SETTING] = 40
    """Similar photographs that each one is matched with, unless all pairs are matched."""
    positions: Annotated[Path | None, Arg(metavar="FILE")] = None
    """Positions of photographs, for choosing pairs: CSV (name,lat,lon,height or name,x,y,z) or OpenDroneMap's geo.txt
    (default: GPS in EXIF)."""
    mapper: Annotated[Literal["auto", "incremental", "global"], SETTING] = "auto"
    """Estimate cameras one by one (incremental) or all at once (global). auto: global from 500 photographs."""
    max_size: Annotated[int | None, SETTING] = None
    """Shrink the copies to this longer side, px (default: full size)."""
    feature_size: Annotated[int, SETTING] = 1600
    """Longer side for feature detection, px. Larger is slower and slightly more accurate."""
    masks: Annotated[Path | None, Arg(metavar="DIR")] = None
    """Folder of masks of the photographs, white = keep (default: where COLMAP, nerfstudio and Metashape put them)."""
    match_masked: Annotated[bool, SETTING] = False
    """Also use features in masked pixels, for an object that did not move relative to its background."""
    frames: int = 100
    """Number of frames to take from a video; each is the sharpest of its interval (needs ffmpeg)."""


# -- commands that create a run ----------------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class TrainOptions(Training, Effort, Resources, HowItRuns):
    """Options of a training run. Overrides are applied after the schedule is scaled."""

    scene: Annotated[Path, Arg(metavar="CAPTURE", positional=True)]
    """Folder of a capture: COLMAP, Blender, nerfstudio, DTU, OpenSfM, OpenDroneMap, Metashape or Meshroom."""
    format: str = "auto"
    """Capture format: blender, nerfstudio, dtu, colmap, opensfm, metashape, alicevision, or one from a package."""
    masks: Annotated[Path | None, Arg(metavar="DIR")] = None
    """Folder of masks of the photographs, white = keep (default: where COLMAP, nerfstudio and Metashape put them)."""
    init: Annotated[Path | None, Arg(metavar="FILE")] = None
    """Start from the splats of a file (PLY, .spz, .splat, .usd, .glb, .sog) instead of points, in the frame of the
    capture. 3D Gaussians are flattened along their smallest scale."""


@dataclass(frozen=True, kw_only=True)
class PosesOptions(PoseEstimation):
    """Options of structure from motion."""

    photos: Photos
    """Folder of photographs, or a video. It is only read."""
    out: Annotated[Path, Arg(metavar="CAPTURE")]
    """Capture folder to create: images/, sparse/0, poses.json, poses.png."""
    threads: int | None = None
    """CPU threads (default: all available cores)."""
    seed: int = 0
    """Random seed. Same bytes for up to 50 photographs or with --threads 1, else cameras differ by rounding."""
    overwrite: bool = False
    """Replace the capture in --out, if this command created it."""


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions(Training, PoseEstimation, Effort, Resources, HowItRuns):
    """Options of a reconstruction, from photographs to a mesh."""

    photos: Photos
    """Folder of photographs, or a video. It is only read."""
    out: Annotated[Path, Arg(metavar="RUN")]
    """Run folder to create. Photographs and cameras go to its sub-folder `capture`."""
    texture: bool = False
    """Also write mesh.glb, textured from the photographs."""


# -- commands that need a finished run ---------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class MeshOptions(Options):
    """How the surface is extracted. None: derived from the scene, or taken from the protocol of the run."""

    method: Annotated[str, Arg(metavar="METHOD")] = "tsdf"
    """tsdf fuses the depth maps in voxels. delaunay cuts tetrahedra: fewer false pieces, but thin parts are lost."""
    watertight: bool = False
    """Close the surface where no photograph shows it, too. Implies --method delaunay."""
    voxel: Annotated[float | None, SETTING] = None
    """Voxel size in world units (default: from the scene)."""
    truncation: Annotated[float | None, SETTING] = None
    """Truncation distance in world units (default: from the voxel size)."""
    depth_limit: Annotated[float | None, SETTING] = None
    """Ignore depth beyond this, in world units (default: from the scene)."""
    bbox: BoxOption = None
    """Mesh this box instead of the subject. With --scene: the box of the finest voxels."""
    subject_box: BoxOption = None
    """Box of the subject, from now on (default: that of the run, or what most cameras look at)."""
    whole_scene: Annotated[bool, Arg(name="scene")] = False
    """Mesh everything, not only the subject, in voxels that grow with distance."""
    error: Annotated[float | None, Arg(metavar="PIXELS")] = None
    """Merge faces while the surface moves less than this in the nearest image (default: 0.25; data sets: keep all)."""
    refine: bool = True
    """Keep the fused surface, as for data sets; otherwise it moves until neighbouring photographs agree."""
    collision: bool = False
    """Also write convex pieces for collision tests: NAME-collision.obj beside the mesh (extra `collision`)."""
    lods: Annotated[int, SETTING] = 1
    """With --out FILE.glb: number of levels of detail in the file, each with four times the error (MSFT_lod)."""
    depth: Annotated[Literal["mean", "median", "transmittance"] | None, SETTING] = None
    """Depth maps to fuse (default: by protocol)."""
    keep_components: Annotated[int | None, SETTING] = None
    """Keep only the N largest connected components (default: drop small ones)."""


@dataclass(frozen=True, kw_only=True)
class TextureOptions(Options):
    """How the mesh is textured."""

    faces: Annotated[int, SETTING] = 50_000
    """With --texture: simplify a larger mesh to this number of triangles."""
    texture_size: Annotated[int | None, SETTING] = None
    """With --texture: side of the texture in texels (default: two per image pixel, at most 4096)."""
    texture_downscale: Annotated[int | None, SETTING] = None
    """With --texture: shrink the photographs by this integer factor (default: as in training)."""


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(Options):
    """What `gs2d evaluate` measures."""

    ground_truth: Annotated[Path | None, Arg(metavar="MESH_OR_POINTS")] = None
    """True surface (PLY or OBJ) in the frame of the capture, or the official folder of DTU or Tanks and Temples."""
    thresholds: Annotated[tuple[float, ...], SETTING] = ()
    """Thresholds for precision and recall, world units (default: 0.25, 0.5 and 1 % of the size of the true surface)."""
    lpips_weights: Path | None = None
    """VGG-16 and LPIPS weights; without them LPIPS is not computed."""
    match: Annotated[str | tuple[str, ...], Arg(metavar="NAMES")] = ()
    """Also score test views after matching exposure, poses, or exposure,poses to the photographs."""

    @property
    def matched(self) -> tuple[str, ...]:
        """Return the names in ``match``, checked."""
        names = tuple(self.match.split(",")) if isinstance(self.match, str) else self.match
        if set(names) - set(MATCHED):
            raise RecipeError(f"--match must name {' or '.join(MATCHED)}, got {','.join(names)}")
        return names
