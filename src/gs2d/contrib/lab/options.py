"""What `gs2d paper` and `gs2d sweep` are asked to do, as `pipeline/prepare/options.py` has it of the other verbs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from gs2d.config.arguments import Arg
from gs2d.errors import RecipeError
from gs2d.pipeline.prepare.options import CommonTraining, Overrides, ReconstructOptions, Resources, paths_of

SWEEP = "sweep"  # the name of a table of chosen recipes


@dataclass(frozen=True, kw_only=True)
class TableOptions:
    """Options of the commands that train and score many runs, and write a table of them."""

    data: Annotated[Path, Arg(metavar="DIR")]
    """A capture, or a folder of captures."""
    out: Annotated[Path, Arg(metavar="DIR")]
    """Folder for runs, table and page. The command can be stopped and started again."""
    scenes: tuple[str, ...] = ()
    """Only these captures, by the names of their folders."""
    protocol: str = "auto"
    """Protocol of all captures (default: by the format of each)."""
    downscale: int | None = None
    """Shrink the photographs by this integer (default: what the protocol says)."""
    schedule_scale: float = 1.0
    """Fraction of the full schedule."""
    seeds: Annotated[tuple[int, ...], Arg(kind=str)] = (0,)
    """Seeds, as 0,1,2; or a count: 3 is 0,1,2."""
    backend: str = "auto"
    """Rasterizer."""
    slots: Annotated[int | None, Arg(alias="--jobs")] = None
    """Runs at the same time (default: one a GPU, else one)."""
    cluster: Annotated[str | None, Arg(metavar="ADDRESS")] = None
    """Let the machines of a Ray cluster work, which share the disk of --out: HOST:PORT, or auto, the one that this
    machine is of."""
    threads: int | None = None
    """CPU threads of each of several runs (default: the cores divided among them)."""
    cache: Annotated[Path | None, Arg(metavar="DIR")] = None
    """Stage cache (default: in --out). Tables that share it train their common stages once."""
    truth: Annotated[Path | None, Arg(metavar="DIR")] = None
    """True surfaces, NAME.ply, for captures that have no mesh_gt.ply beside them."""
    lpips_weights: Path | None = None
    """VGG-16 and LPIPS weights for the LPIPS metric."""
    overrides: Overrides = ()
    """Change the recipes, as in `gs2d train`; reaches those that have the stage."""
    train: bool = True
    """Only write the table of what is there."""

    def __post_init__(self) -> None:
        paths_of(self, "data", "out", "cache", "truth", "lpips_weights")
        object.__setattr__(self, "scenes", _split(self.scenes))
        object.__setattr__(self, "seeds", parse_seeds(self.seeds))


@dataclass(frozen=True, kw_only=True)
class PaperOptions(TableOptions):
    """Which table of the paper, of which scenes, how."""

    table: Annotated[
        Literal["regularisation", "benchmark", "k", "freeze", "modules", "absgs"],
        Arg(metavar="TABLE", positional=True),
    ]
    """Which table: regularisation, benchmark, k, freeze, modules or absgs."""


@dataclass(frozen=True, kw_only=True)
class SweepOptions(TableOptions):
    """Which recipes, on which scenes, how."""

    recipes: Annotated[tuple[str, ...], Arg(metavar="RECIPE [RECIPE ...]", positional=True)]
    """Names that `gs2d recipes` lists, or files: mine.json, mine.py:name. Recipes that --out has already keep their
    rows."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "recipes", _split(self.recipes))

    @property
    def table(self) -> str:
        """The name of the table."""
        return SWEEP


def _split(words: Iterable[str]) -> tuple[str, ...]:
    """``a,b c`` and ``a b c`` alike."""
    return tuple(part for word in words for part in word.split(",") if part)


def parse_seeds(words: Iterable[str | int]) -> tuple[int, ...]:
    """Return seeds: ``0,1,2`` and ``0 1 2`` are seeds; one word n > 0 alone is a count, the seeds 0 to n - 1."""
    given = tuple(words)
    if all(isinstance(seed, int) for seed in given):
        return tuple(map(int, given))
    parts = _split(map(str, given))
    if not parts or not all(part.isdecimal() for part in parts):
        raise RecipeError(
            f"--seeds must be whole numbers like 0,1,2, or a count like 3, got {' '.join(map(str, given)) or 'nothing'}"
        )
    numbers = tuple(int(part) for part in parts)
    listed = len(numbers) > 1 or "," in str(given[0]) or numbers == (0,)
    return numbers if listed else tuple(range(numbers[0]))


@dataclass(frozen=True, kw_only=True)
class BlocksOptions(CommonTraining, Resources):
    """What is trained in blocks, how it is cut, and where."""

    scene: Annotated[Path, Arg(metavar="CAPTURE", positional=True)]
    """Folder of the capture, as in `gs2d train`."""
    out: Annotated[Path, Arg(metavar="JOB")]
    """Job folder, which becomes the run of the merged scene. The command can be stopped and given again."""
    blocks: str = "auto"
    """Blocks along the ground, as 3x3, or in space, as 2x2x2; auto: none where one training of everything fits into
    --memory, else as many as it needs."""
    partition: Annotated[tuple[str, ...], Arg(metavar="FIELD=VALUE", repeated=True)] = ()
    """Change how it is cut, e.g. --partition margin=0.3, --partition coarse.side=800; may be repeated."""
    slots: Annotated[int | None, Arg(alias="--jobs")] = None
    """Runs at the same time (default: one a GPU, else one)."""
    cluster: Annotated[str | None, Arg(metavar="ADDRESS")] = None
    """Let the machines of a Ray cluster work, which share the disk of --out: HOST:PORT, or auto, the one that this
    machine is of."""
    format: str = "auto"
    """Format of the capture: blender, nerfstudio, dtu, colmap, opensfm, metashape, alicevision, or a package's."""
    downscale: int = 1
    """Shrink the photographs by this integer, area-filtered; the coarse model has smaller ones."""
    schedule_scale: float = 1.0
    """Fraction of the full schedule, of each block."""
    backend: str = "auto"
    """Rasterizer, as in `gs2d train`."""
    seed: int = 0
    """Seed of every random choice; the same seed gives the same bytes."""
    threads: int | None = None
    """CPU threads, of each of several blocks (default: the cores divided among them)."""
    masks: Annotated[Path | None, Arg(metavar="DIR")] = None
    """Folder of masks of the photographs, white = keep (default: where COLMAP, nerfstudio and Metashape put them)."""

    def __post_init__(self) -> None:
        paths_of(self, "scene", "out", "masks")


@dataclass(frozen=True, kw_only=True)
class ReconstructAnywhereOptions(ReconstructOptions):
    """From photographs to a mesh, here or on a cluster."""

    cluster: Annotated[str | None, Arg(metavar="ADDRESS")] = None
    """Let the machines of a Ray cluster work, which share the disk of --out: HOST:PORT, or auto, the one that this
    machine is of."""
