"""What the verbs of gs2d are asked to do: one class for each, in Python and on the command line.

`gs2d.cli` makes the command line of these classes: a field is an option, its docstring the help, its default the
default; `gs2d.config.arguments` has the marks for the rest. Pure Python: `gs2d --help` is instant.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from gs2d.config.arguments import PYTHON_ONLY, Arg
from gs2d.config.presets import DEFAULT_RECIPE
from gs2d.config.protocols import Protocol
from gs2d.config.recipe import Recipe
from gs2d.errors import RecipeError

Robust = Literal["auto", "on", "off"]
Quality = Literal["draft", "normal", "full"]
LensModel = Literal[
    "auto", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "EQUIRECTANGULAR"
]
Box = tuple[float, float, float, float, float, float]  # x0 y0 z0 x1 y1 z1, world units
KnownDistance = tuple[float, float, float, float, float, float, float]  # two points of the run, metres
BoxOption = Annotated[Box | None, Arg(metavar="X0 Y0 Z0 X1 Y1 Z1")]
Overrides = Annotated[tuple[str, ...], Arg(name="set", metavar="STAGE.FIELD=VALUE", repeated=True)]
Photos = Annotated[Path, Arg(metavar="PHOTOS", positional=True)]


def paths_of(options: object, *names: str) -> None:
    """Turn the fields of these names that are strings into paths: in Python people write both."""
    for name in names:
        if isinstance(value := getattr(options, name), str):
            object.__setattr__(options, name, Path(value))


def values(kind: type[Any], options: Any) -> dict[str, Any]:
    """Return the values that ``options`` has for the fields of a class of options, by name."""
    return {entry.name: getattr(options, entry.name) for entry in fields(kind)}


# -- what several verbs share ------------------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class HowItRuns:
    """How training runs: options of every verb that trains."""

    backend: str = "auto"
    """Rasterizer: auto (the fastest that this machine has), cpu, cuda, reference; `gs2d doctor` lists them."""
    seed: int = 0
    """Seed of every random choice; the same seed gives the same bytes."""
    threads: int | None = None
    """CPU threads (default: all cores that this process may use)."""
    resume: bool = False
    """Continue the run in --out from its last checkpoint (or start, if there is none)."""
    overwrite: bool = False
    """Replace the run in --out."""


@dataclass(frozen=True, kw_only=True)
class Resources:
    """What a training may take of the machine."""

    memory: Annotated[float | None, Arg(metavar="GIB")] = None
    """GiB of memory to keep to (default: half of what this machine or container has)."""
    disk: Annotated[float | None, Arg(metavar="GIB")] = None
    """GiB of disk to keep to, for prepared photographs first of all (default: what is free)."""
    prepare: Literal["auto", "always", "never"] = "auto"
    """Keep photographs on the disk, in the run, undistorted and shrunk: any number in the same memory, with the same
    result; auto: where they do not stay in memory."""


@dataclass(frozen=True, kw_only=True)
class CommonTraining:
    """What is trained and how: options of every command that trains on photographs."""

    recipe: str | Recipe = DEFAULT_RECIPE
    """What is trained; `gs2d recipes` lists them."""
    protocol: str | Protocol = "auto"
    """What depends on the data set: background, depth, near plane, fusion limits."""
    robust: Robust = "auto"
    """Keep fog out: a dense start, free space kept free, opacity that decays; auto: for photographs of no data set."""
    exposure: bool = False
    """Learn an exposure and a white balance for each photograph (robust training does where photographs differ)."""
    no_exposure: bool = False
    """Take all photographs to have one exposure."""
    test_every: int | None = None
    """Every so many-th view, by name, is a test view; 0: all train (default: what the protocol says, mostly 8)."""
    depth_prior: Literal["auto", "sparse", "sensor", "relative"] | None = None
    """Train with known depths: of sparse points, or of maps in depths/, a sensor's or relative; auto: what is there."""
    normal_prior: bool = False
    """Train with known normals, of maps in normals/."""
    overrides: Overrides = ()
    """Change the recipe, e.g. --set surface.iterations=2000; may be repeated."""
    checkpoint_every: int = 10_000
    """Iterations between checkpoints."""
    checkpoint_seconds: float = 120.0
    """Seconds between checkpoints, whichever comes first."""
    page: bool = True
    """Do not write scene.html, the splats as a page for any browser, at the end."""
    subject_box: BoxOption = None
    """What the photographs are of, as a box (default: what most cameras look at). The mesh is of it."""
    whole_scene: Annotated[bool, Arg(name="scene")] = False
    """Mesh everything, not only the subject."""
    masked: Literal["ignore", "empty", "off"] | None = None
    """What a black pixel of a mask is: ignored, it takes part in nothing; empty, there is nothing, as an alpha channel
    says; off: masks are not used (default: ignored, but under protocols of data sets)."""
    stage2_cache_mb: int = 1024
    """MiB for cached views in stage 2, about 5 MiB a view of 400x400 (0 = none; results differ by rounding)."""

    @property
    def learns_exposure(self) -> bool | None:
        """Whether exposures are learned; None: in robust training where the photographs differ.

        Raises
        ------
        RecipeError
            Both are asked for.
        """
        if self.exposure and self.no_exposure:
            raise RecipeError("--exposure and --no-exposure contradict each other, got both; leave one out")
        return True if self.exposure else False if self.no_exposure else None


@dataclass(frozen=True, kw_only=True)
class Training(CommonTraining):
    """Options of the commands that train a scene in one piece: `gs2d train` and `gs2d reconstruct`."""

    vignetting: bool = False
    """Learn how much darker each camera's corners are, one falloff for all photographs of a camera."""
    response: bool = False
    """Learn how the curves of several cameras differ, by which each turns light into values (one camera: nothing)."""
    refine_poses: bool = False
    """Learn where each photograph was taken from, beginning where the capture says: for poses that are a little off."""
    refine_cameras: bool = False
    """Learn focal lengths and lenses, too: --refine-poses, and both once for all photographs of a camera."""
    start_from: Annotated[Path | None, Arg(name="from", metavar="RUN")] = None
    """Take the stages that this recipe shares with another run from that run."""
    cache: Annotated[Path | None, Arg(metavar="DIR")] = None
    """Keep finished stages here, and take them from here when scene, settings and stages are the same."""
    viewer: bool = False
    """Show the training in the browser while it runs; the address is printed, and nothing of the result changes."""
    viewer_port: int | None = None
    """With --viewer: port of the page (default: the first free one from 8080 on)."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """How the cameras of photographs are found: options of `gs2d poses`, and of every command that begins with it."""

    cameras: Literal["auto", "one", "each"] = "auto"
    """Which photographs share a camera: same folder, size, camera, lens and focal length; all; none."""
    camera_model: LensModel = "auto"
    """Lens (auto: with one focal length; the simplest that observations held out do not speak against)."""
    matching: Literal["auto", "exhaustive", "sequential", "similar", "spatial"] = "auto"
    """Pairs to match: all; next ones (frames of a video); next and most similar ones; next, nearest in space and most
    similar ones. auto: all up to 150, else spatial where most photographs know where they were taken, else similar."""
    overlap: int = 10
    """Next photographs (by the time in EXIF, else by name) that each is matched with, where not all pairs are."""
    neighbours: int = 40
    """Similar photographs that each is matched with, where not all pairs are; spatial: half as many near ones, and a
    quarter as many similar ones."""
    positions: Annotated[Path | None, Arg(metavar="FILE")] = None
    """Where photographs were taken, to choose pairs by: CSV (name,lat,lon,height or name,x,y,z) or OpenDroneMap's
    geo.txt (default: GPS in their EXIF or XMP)."""
    mapper: Literal["auto", "incremental", "global"] = "auto"
    """How cameras are placed: one after the other, or all at once, which is faster for many (auto: from 500 on)."""
    rig: bool = False
    """Cameras mounted together: each sub-folder is one, and photographs of one name were taken at one moment."""
    max_size: int | None = None
    """Shrink the copies to this longer side, px (default: all pixels, the same bytes)."""
    feature_size: int = 1600
    """Longer side on which features are found, px: larger is slower and a little more accurate."""
    masks: Annotated[Path | None, Arg(metavar="DIR")] = None
    """Folder of masks of the photographs, white = keep (default: where COLMAP, nerfstudio and Metashape put them)."""
    match_masked: bool = False
    """Find features in masked pixels too: of a thing that was cut out, but stood still with its background."""
    frames: int = 100
    """Frames to take of a video, each the sharpest of its stretch (needs ffmpeg); photographs are all taken."""
    link: bool = False
    """Hard links instead of copies of the photographs: no disk is used."""


# -- verbs that make a run ---------------------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class TrainOptions(Training, Resources, HowItRuns):
    """One training run. Overrides are applied after the schedule is scaled: a number means what it says."""

    scene: Annotated[Path, Arg(metavar="SCENE", positional=True)]
    """Folder of the capture, or a .zip of it: COLMAP, Blender or nerfstudio transforms, DTU, OpenSfM or OpenDroneMap,
    Metashape, Meshroom."""
    out: Annotated[Path, Arg(metavar="RUN")]
    """Run folder to make."""
    quality: Quality | None = None
    """How long is trained on how large pictures, as in `gs2d reconstruct`: minutes for a draft (default: all of the
    recipe on pictures of full size, hours on a CPU)."""
    format: str = "auto"
    """Format of the capture: blender, nerfstudio, dtu, colmap, opensfm, metashape, alicevision, or a package's."""
    downscale: int | None = None
    """Shrink the photographs by this integer, area-filtered (default: not, or so much that they fit into memory)."""
    masks: Annotated[Path | None, Arg(metavar="DIR")] = None
    """Folder of masks of the photographs, white = keep (default: where COLMAP, nerfstudio and Metashape put them)."""
    schedule_scale: float | None = None
    """Fraction of the full schedule: 0.1 trains a tenth of the iterations (default: all, or by --quality)."""
    init: Annotated[Path | None, Arg(metavar="FILE")] = None
    """Start from the splats of a file (PLY of 2DGS or 3DGS, .spz, .splat, .usd, .glb, .sog) in the frame of the
    capture, not from points. 3D Gaussians lose their smallest scale, along which the normal then points."""

    def __post_init__(self) -> None:
        paths_of(self, "scene", "out", "masks", "init", "start_from", "cache")


@dataclass(frozen=True, kw_only=True)
class PlanOptions(TrainOptions):
    """A training that is estimated: it takes the options of `gs2d train`."""

    out: Annotated[Path, Arg(metavar="RUN")] = Path("RUN")
    """Run folder of the training; nothing is written."""


@dataclass(frozen=True, kw_only=True)
class PosesOptions(Finding):
    """One run of structure from motion."""

    photos: Photos
    """Folder of photographs, with or without sub-folders, or a video; it is only read."""
    out: Annotated[Path, Arg(metavar="CAPTURE")]
    """Capture folder to make: images/, sparse/0, poses.json, poses.png. It appears when all is done."""
    threads: int | None = None
    """CPU threads (default: all cores that this process may use)."""
    seed: int = 0
    """Seed; the same bytes for up to 50 photographs or with --threads 1, else cameras differ by rounding."""
    overwrite: bool = False
    """Replace the capture in --out, if this command made it."""

    def __post_init__(self) -> None:
        paths_of(self, "photos", "out", "positions", "masks")


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions(Resources, HowItRuns):
    """From photographs to a mesh."""

    photos: Photos
    """Folder of photographs, with or without sub-folders, or a video; it is only read."""
    out: Annotated[Path, Arg(metavar="RUN")]
    """Run folder to make; the photographs with their cameras go to its sub-folder `capture`."""
    quality: Quality = "normal"
    """How long is trained on how large pictures. On a CPU: 1800 iterations at 400 px, 6000 at 800, all of the recipe's
    at 1600; on a GPU 6000 at 800 px, 30000 at 1600, all at 1600. The time it will take is told before it begins."""
    schedule_scale: float | None = None
    """Fraction of the recipe's iterations (default: by --quality)."""
    downscale: int | None = None
    """Shrink the photographs by this integer for training (default: by --quality)."""
    texture: bool = False
    """Also write mesh.glb, with a texture from the photographs."""
    training: Training = field(default_factory=Training)
    """As in `gs2d train`."""
    finding: Finding = field(default_factory=Finding)
    """As in `gs2d poses`."""

    def __post_init__(self) -> None:
        paths_of(self, "photos", "out")


@dataclass(frozen=True, kw_only=True)
class DemoOptions(HowItRuns):
    """Where and how a synthetic capture is made and trained."""

    out: Path = Path("runs/demo")
    """Run folder; the capture goes to its sub-folder `capture`. An earlier demo there is replaced."""
    recipe: str | Recipe = DEFAULT_RECIPE
    """What is trained, as in `gs2d train`."""
    schedule_scale: float | None = None
    """Fraction of the recipe's iterations (default: 0.2, a minute or two on two cores)."""
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
    train_views: Annotated[int, PYTHON_ONLY] = 40
    test_views: Annotated[int, PYTHON_ONLY] = 8
    size: Annotated[int, PYTHON_ONLY] = 256
    """Width and height of the photographs, px."""

    def __post_init__(self) -> None:
        paths_of(self, "out")


# -- verbs on a run that is there --------------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class MeshOptions:
    """How the surface is extracted; what is None is derived from the scene or taken from the run's protocol."""

    voxel: float | None = None
    """Voxel size in world units (default: from the scene)."""
    truncation: float | None = None
    """Truncation distance in world units (default: from the voxel size)."""
    depth_limit: float | None = None
    """Ignore depth beyond this, in world units (default: from the scene)."""
    bbox: BoxOption = None
    """Keep only this box, not the subject's. With --unbounded: where the voxels are finest."""
    subject_box: BoxOption = None
    """What the photographs are of, from now on (default: what the run says, or what most cameras look at)."""
    whole_scene: Annotated[bool, Arg(name="scene")] = False
    """Mesh everything, not only the subject."""
    unbounded: bool = False
    """Mesh what lies far away too, in voxels that grow with the distance."""
    max_gib: float | None = None
    """Size of the fused volume, of which a slab at a time is in memory (default: by --memory); more is an error that
    names a voxel that fits."""
    depth: Literal["mean", "median", "transmittance"] | None = None
    """Depth that is fused (default: the run's protocol)."""
    keep_components: int | None = None
    """Keep the so many largest connected pieces (default: all that are not small)."""


@dataclass(frozen=True, kw_only=True)
class TextureOptions:
    """How the mesh gets its texture."""

    faces: int = 50_000
    """With --texture: simplify a larger mesh to so many triangles."""
    texture_size: int | None = None
    """With --texture: its side in texels (default: two for each pixel's length, at most 4096)."""
    texture_from: Literal["photographs", "renders"] = "photographs"
    """With --texture: colours from the photographs, or from the splats as they look from there."""
    texture_downscale: int | None = None
    """With --texture: shrink the photographs by this integer (default: as in training; 1 = their full size)."""


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """What is measured."""

    ground_truth: Annotated[Path | None, Arg(metavar="MESH_OR_POINTS")] = None
    """True surface (PLY, OBJ) in the capture's frame (DTU: mm), or the official folder of DTU or Tanks and Temples."""
    thresholds: tuple[float, ...] = ()
    """Distances at which precision and recall are taken, world units, the headline's first (default: 0.25, 0.5, 1 % of
    its size)."""
    lpips_weights: Path | None = None
    """VGG-16 and LPIPS weights for the LPIPS metric."""
    match_exposure: bool = False
    """Score test views once more, each half of a rendering matched in colour to the other half of its photograph."""
    match_poses: bool = False
    """Score test views once more, each camera moved to where the splats look most like its photograph."""

    def __post_init__(self) -> None:
        paths_of(self, "ground_truth", "lpips_weights")


@dataclass(frozen=True, kw_only=True)
class GeoreferenceOptions:
    """Where a run is in the world; one source at a time, none: what the run says is shown."""

    gps: bool = False
    """From the positions in the EXIF of the photographs."""
    positions: Annotated[Path | None, Arg(metavar="FILE")] = None
    """From a file of positions of photographs: CSV (name,lat,lon,height or name,x,y,z), or OpenDroneMap's geo.txt."""
    control: Annotated[Path | None, Arg(metavar="FILE")] = None
    """From control points: CSV with name,x,y,z,photo,u,v (pixels) or name,x,y,z,run_x,run_y,run_z, or gcp_list.txt."""
    check_points: tuple[str, ...] = ()
    """With --control: names of points that are held out and only measured (also by a column `check`)."""
    known_distance: Annotated[KnownDistance | None, Arg(metavar="X0 Y0 Z0 X1 Y1 Z1 METRES")] = None
    """From the distance between two points in coordinates of the run, as a mesh viewer shows them of mesh.ply."""
    markers: Annotated[float | None, Arg(metavar="METRES")] = None
    """From printed ArUco markers with a side of so many metres, found in the photographs."""
    marker_dictionary: str = "4x4_50"
    """With --markers: which ones: 4x4_50 to 7x7_1000, aruco_original, apriltag_36h11."""
    epsg: int | None = None
    """The world's projected coordinate system, in metres (default: as the file says, or the UTM zone)."""
    enu: bool = False
    """With --gps or --positions: metres east, north and up of their middle, not a map projection; needs no package."""
    up: Annotated[tuple[float, float, float] | None, Arg(metavar="X Y Z")] = None
    """What is up in the run (default: by the places if they tell it well, else by how the cameras were held)."""
    remove: bool = False
    """Forget where the run is."""

    def __post_init__(self) -> None:
        paths_of(self, "positions", "control")


@dataclass(frozen=True, kw_only=True)
class OrthophotoOptions:
    """How the view from above is made."""

    resolution: Annotated[float | None, Arg(metavar="METRES")] = None
    """Side of a cell (default: that of the photographs' pixels on the surface, rounded up to 1, 2, 2.5 or 5)."""
