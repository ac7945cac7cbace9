"""What the jobs of the pipeline are asked to do. Pure Python; never imports torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from gs2d.config.protocols import Protocol
from gs2d.config.recipe import Recipe

Box = tuple[float, float, float, float, float, float]  # x0 y0 z0 x1 y1 z1, world units


def paths_of(options: object, *names: str) -> None:
    """Turn the fields of these names that are strings into paths: in Python people write both."""
    for name in names:
        if isinstance(value := getattr(options, name), str):
            object.__setattr__(options, name, Path(value))


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """One training run.

    Attributes
    ----------
    scene : Path
        The capture.
    out : Path
        Run folder.
    recipe : str or Recipe
        A registered name, or the recipe itself.
    protocol : str or Protocol
        A name, "auto" (by the format of the capture), or the protocol itself.
    backend, format : str
        Names, or "auto".
    downscale : int
    schedule_scale : float
        Fraction of the full schedule.
    overrides : tuple of str
        ``stage.field=value``; applied after the schedule is scaled, so that a number means what it says.
    seed : int
    robust : str
        "on", "off", or "auto": a dense start, free space and opacity decay (``recipes.with_robustness``) where the
        protocol says so and the capture tells which sparse points its photographs show.
    exposure : bool or None
        Learn an exposure and a white balance for each photograph (``recipes.with_exposure``); None: in robust training
        where its photographs differ.
    refine_poses : bool
        Learn where each photograph was taken from, beginning where the capture says (``recipes.with_poses``).
    depth_prior : str or None
        Train with known depths (``recipes.with_depth_prior``) of this source: "auto", "sparse", "sensor", "relative".
    normal_prior : bool
        Train with known normals (``recipes.with_normal_prior``).
    resume, overwrite : bool
        What to do with a run that is already in ``out``.
    start_from : Path or None
        Another run, whose stages are taken as far as they are the same.
    cache : Path or None
        Folder of finished stages, shared by runs.
    threads : int or None
        CPU threads; None = all that this process may use.
    checkpoint_every, checkpoint_seconds : int, float
        A checkpoint is written after so many iterations, or so many seconds, whichever comes first.
    stage2_cache_mb : int
        MiB for cached views in stages that train only the colours of a row group (cpu backend); 0 = none. A part of
        the run's definition: which views are cached decides the rounding.
    title : str or None
        Heading of the report; None = the name of the capture.
    shown_views : int
        Views that are rendered after each stage for the report.
    allowed : tuple of str
        Names that may already be in ``out`` (the demo's capture).
    test_every : int or None
        Every n-th view is a test view, 0 = none; None: what the protocol says.
    viewer : bool
        Show the training in the browser while it runs.
    viewer_port : int or None
        Port of that page; None = the first free one from 8080 on.
    estimate : bool
        Tell before training how long it will take and what is held out.
    subject_box : six floats or None
        The box of the subject, world units (``MeshOptions``); None: it is found.
    whole_scene : bool
        Mesh everything, not the subject.
    page : bool
        Write ``scene.html`` at the end.
    """

    scene: Path
    out: Path
    recipe: str | Recipe = "2dgs-r"
    protocol: str | Protocol = "auto"
    backend: str = "auto"
    format: str = "auto"
    downscale: int = 1
    schedule_scale: float = 1.0
    overrides: tuple[str, ...] = ()
    seed: int = 0
    robust: str = "auto"
    exposure: bool | None = None
    refine_poses: bool = False
    depth_prior: str | None = None
    normal_prior: bool = False
    resume: bool = False
    overwrite: bool = False
    start_from: Path | None = None
    cache: Path | None = None
    threads: int | None = None
    checkpoint_every: int = 10_000
    checkpoint_seconds: float = 120.0
    stage2_cache_mb: int = 1024
    title: str | None = None
    shown_views: int = 3
    allowed: tuple[str, ...] = ()
    test_every: int | None = None
    viewer: bool = False
    viewer_port: int | None = None
    estimate: bool = False
    subject_box: Box | None = None
    whole_scene: bool = False
    page: bool = True

    def __post_init__(self) -> None:
        paths_of(self, "scene", "out", "start_from", "cache")


@dataclass(frozen=True, kw_only=True)
class MeshOptions:
    """How the surface is extracted; None is derived from the scene or taken from the run's protocol.

    Attributes
    ----------
    voxel, truncation, depth_limit : float or None
        World units.
    bbox : six floats or None
        Smallest and largest corner of the box that is kept, world units; with ``unbounded`` that of the finest voxels.
    unbounded : bool
        Fuse what lies far away too, in voxels that grow with the distance.
    max_gib : float
        The volume will not grow beyond this.
    depth : str or None
        "mean" or "median".
    keep_components : int or None
        The so many largest connected pieces; 0 = all; None = the protocol's.
    subject_box : six floats or None
        The box of the subject from now on, world units; None: what the run says, or what is found.
    whole_scene : bool
        Everything, not the subject, also where the protocol meshes the subject.
    """

    voxel: float | None = None
    truncation: float | None = None
    depth_limit: float | None = None
    bbox: Box | None = None
    unbounded: bool = False
    max_gib: float = 4.0
    depth: str | None = None
    keep_components: int | None = None
    subject_box: Box | None = None
    whole_scene: bool = False


@dataclass(frozen=True, kw_only=True)
class TextureOptions:
    """How the mesh gets its texture.

    Attributes
    ----------
    faces : int
        A larger mesh is simplified to this many triangles.
    size : int or None
        Side of the texture, texels; None = two texels for each pixel's length, as a power of two, at most 4096.
    source : str
        Where the colours come from: "photographs", or "renders" of the splats from the same cameras.
    downscale : int or None
        Of these photographs; None = as in training.
    """

    faces: int = 50_000
    size: int | None = None
    source: str = "photographs"
    downscale: int | None = None


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """What is measured.

    Attributes
    ----------
    ground_truth : Path or None
        A PLY or OBJ file of the true surface (a mesh or points), or the folder of the official ground truth of DTU or
        Tanks and Temples; None: what lies beside the capture, if anything does.
    thresholds : tuple of float
        Distances at which precision and recall are taken, world units; empty = 0.25, 0.5 and 1 % of the true diagonal.
    lpips_weights : Path or None
    match_exposure : bool
        Score the test views once more, each half of a rendering matched in colour to the other half of its photograph.
    match_poses : bool
        Score the test views once more, each from where the splats look most like its photograph.
    """

    ground_truth: Path | None = None
    thresholds: tuple[float, ...] = field(default=())
    lpips_weights: Path | None = None
    match_exposure: bool = False
    match_poses: bool = False

    def __post_init__(self) -> None:
        paths_of(self, "ground_truth", "lpips_weights")
