"""Options that several commands share. No torch: `--help` is instant."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import arg

from gs2d.errors import RecipeError

Backend = str  # a package may add one
LensModel = Literal["auto", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]
Box = tuple[float, float, float, float, float, float]
Overrides = Annotated[tuple[str, ...], arg(name="set", metavar="STAGE.FIELD=VALUE"), tyro.conf.UseAppendAction]


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of every command."""

    quiet: bool = False
    """No progress and no tables; errors only."""
    json: bool = False
    """Results as JSON on stdout, and nothing else there."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclass(frozen=True, kw_only=True)
class TrainingCommon(Common):
    """Options of the commands that train."""

    backend: Backend = "auto"
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
class Training:
    """What is trained and how: options of `gs2d train`, and of every command that trains on photographs."""

    recipe: str = "2dgs-r"
    """What is trained; `gs2d recipes` lists them."""
    protocol: str = "auto"
    """What depends on the data set: background, depth, near plane, fusion limits."""
    robust: Literal["auto", "on", "off"] = "auto"
    """Keep fog out: a dense start, free space kept free, opacity that decays; auto: for photographs of no data set."""
    exposure: bool = False
    """Learn an exposure and a white balance for each photograph (robust training does where photographs differ)."""
    no_exposure: bool = False
    """Take all photographs to have one exposure."""
    test_every: int | None = None
    """Every so many-th view, by name, is a test view; 0: all train (default: what the protocol says, mostly 8)."""
    refine_poses: bool = False
    """Learn where each photograph was taken from, beginning where the capture says: for poses that are a little off."""
    depth_prior: Literal["auto", "sparse", "sensor", "relative"] | None = None
    """Train with known depths: of sparse points, or of maps in depths/, a sensor's or relative; auto: what is there."""
    normal_prior: bool = False
    """Train with known normals, of maps in normals/."""
    start_from: Annotated[Path | None, arg(name="from", metavar="RUN")] = None
    """Take the stages that this recipe shares with another run from that run."""
    cache: Annotated[Path | None, arg(metavar="DIR")] = None
    """Keep finished stages here, and take them from here when scene, settings and stages are the same."""
    overrides: Overrides = ()
    """Change the recipe, e.g. --set refine.iterations=2000; may be repeated."""
    checkpoint_every: int = 10_000
    """Iterations between checkpoints."""
    checkpoint_seconds: float = 120.0
    """Seconds between checkpoints, whichever comes first."""
    page: bool = True
    """Do not write scene.html, the splats as a page for any browser, at the end."""
    viewer: bool = False
    """Show the training in the browser while it runs; the address is printed, and nothing of the result changes."""
    viewer_port: int | None = None
    """With --viewer: port of the page (default: the first free one from 8080 on)."""
    subject_box: Annotated[Box | None, arg(metavar="X0 Y0 Z0 X1 Y1 Z1")] = None
    """What the photographs are of, as a box (default: what most cameras look at). The mesh is of it."""
    whole_scene: Annotated[bool, arg(name="scene")] = False
    """Mesh everything, not only the subject."""
    stage2_cache_mb: int = 1024
    """MiB for cached views in stage 2, about 5 MiB a view of 400x400 (0 = none; results differ by rounding)."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """How the cameras of photographs are found: options of `gs2d poses`, and of every command that begins with it."""

    cameras: Literal["auto", "one", "each"] = "auto"
    """Which photographs share a camera: same folder, size, camera, lens and focal length; all; none."""
    camera_model: LensModel = "auto"
    """Lens (auto: with one focal length; the simplest that observations held out do not speak against)."""
    matching: Literal["auto", "exhaustive", "sequential", "similar"] = "auto"
    """Pairs to match: all; next ones by name (frames of a video); next and most similar ones. auto: all up to 150."""
    overlap: int = 10
    """Next photographs that each is matched with, where not all pairs are."""
    neighbours: int = 40
    """Similar photographs that each is matched with, where not all pairs are."""
    max_size: int | None = None
    """Shrink the copies to this longer side, px (default: all pixels, the same bytes)."""
    feature_size: int = 1600
    """Longer side on which features are found, px: larger is slower and a little more accurate."""
    frames: int = 100
    """Frames to take of a video, each the sharpest of its stretch (needs ffmpeg); photographs are all taken."""
    link: bool = False
    """Hard links instead of copies of the photographs: no disk is used."""


def values(kind: type[Any], options: Any) -> dict[str, Any]:
    """Return the values that ``options`` has for the fields of a group of options, by name; not those of its own."""
    return {field.name: getattr(options, field.name) for field in fields(kind)}


def training_values(training: Training) -> dict[str, Any]:
    """Return the values of the pipeline's options of training: two flags of the command line are one of its fields.

    Raises
    ------
    RecipeError
        Both flags are given.
    """
    given = values(Training, training)
    if given.pop("no_exposure"):
        if training.exposure:
            raise RecipeError("--exposure and --no-exposure contradict each other, got both; leave one out")
        return {**given, "exposure": False}
    return {**given, "exposure": True if training.exposure else None}
