"""Options of `gs2d sweep` and `gs2d blocks`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from gs2d.config.arguments import SETTING, Arg
from gs2d.errors import RecipeError
from gs2d.pipeline.prepare.options import CommonTraining, Effort, Options, Overrides, Resources

_PARTITION = "partition."  # prefix of changes of the partition in --set
SWEEP = "sweep"  # the name of a table of chosen recipes
TABLES = ("regularisation", "benchmark", "k", "freeze", "modules", "absgs")  # tables of the paper


@dataclass(frozen=True, kw_only=True)
class SweepOptions(Options):
    """Options of `gs2d sweep`."""

    recipes: Annotated[tuple[str, ...], Arg(metavar="RECIPE [RECIPE ...]", positional=True)]
    """Recipes: names that `gs2d recipes` lists, or files (mine.json, mine.py:name). Or a table of the paper:
    regularisation, benchmark, k, freeze, modules or absgs."""
    data: Annotated[Path, Arg(metavar="DIR")]
    """Capture, or folder of captures."""
    out: Annotated[Path, Arg(metavar="DIR")]
    """Folder for runs, table and page. The same command continues an interrupted one."""
    scenes: tuple[str, ...] = ()
    """Names of the captures to use (default: all)."""
    protocol: str = "auto"
    """Protocol of all captures (default: by the format of each)."""
    downscale: int | None = None
    """Shrink the photographs by this integer factor (default: by protocol)."""
    schedule_scale: float = 1.0
    """Fraction of the iterations of the recipe (default: 1, as for known data sets in `gs2d train`)."""
    seeds: Annotated[tuple[int, ...], Arg(kind=str)] = (0,)
    """Seeds, such as 0,1,2, or a count: 3 means 0,1,2."""
    backend: str = "auto"
    """Rasterizer."""
    slots: Annotated[int | None, SETTING] = None
    """Number of parallel runs (default: one per GPU, else one)."""
    cluster: Annotated[str | None, Arg(metavar="ADDRESS")] = None
    """Run on a Ray cluster that shares the disk of --out: HOST:PORT, or auto for the cluster of this machine."""
    threads: int | None = None
    """CPU threads per run (default: the cores divided by the number of parallel runs)."""
    cache: Annotated[Path | None, Arg(metavar="DIR", setting=True)] = None
    """Folder that keeps finished stages (default: in --out). Tables that share it train common stages once."""
    ground_truth: Annotated[Path | None, Arg(metavar="DIR")] = None
    """Folder of true surfaces, NAME.ply, for captures without mesh_gt.ply."""
    lpips_weights: Path | None = None
    """VGG-16 and LPIPS weights; without them LPIPS is not computed."""
    overrides: Overrides = ()
    """Change the recipes that have this stage; may be repeated."""
    train: bool = True
    """Only write the table of finished runs."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "recipes", _split(self.recipes))
        object.__setattr__(self, "scenes", _split(self.scenes))
        object.__setattr__(self, "seeds", parse_seeds(self.seeds))

    @property
    def table(self) -> str:
        """Return the name of the table: that of the paper, or ``SWEEP``."""
        return self.recipes[0] if len(self.recipes) == 1 and self.recipes[0] in TABLES else SWEEP


def _split(words: Iterable[str]) -> tuple[str, ...]:
    """Split words at commas."""
    return tuple(part for word in words for part in word.split(",") if part)


def parse_seeds(words: Iterable[str | int]) -> tuple[int, ...]:
    """Return seeds from ``0,1,2`` or ``0 1 2``; a single number n > 0 stands for seeds 0 to n - 1."""
    seeds = tuple(words)
    if all(isinstance(seed, int) for seed in seeds):
        return tuple(map(int, seeds))
    parts = _split(map(str, seeds))
    if not parts or not all(part.isdecimal() for part in parts):
        raise RecipeError(
            f"--seeds must be whole numbers like 0,1,2, or a count like 3, got {' '.join(map(str, seeds)) or 'nothing'}"
        )
    numbers = tuple(int(part) for part in parts)
    listed = len(numbers) > 1 or "," in str(seeds[0]) or numbers == (0,)
    return numbers if listed else tuple(range(numbers[0]))


@dataclass(frozen=True, kw_only=True)
class BlocksOptions(CommonTraining, Resources, Effort):
    """Options of `gs2d blocks`."""

    scene: Annotated[Path, Arg(metavar="CAPTURE", positional=True)]
    """Folder of a capture, as in `gs2d train`."""
    out: Annotated[Path, Arg(metavar="JOB")]
    """Run folder of the merged scene. The same command continues an interrupted one."""
    blocks: Annotated[str, Arg(metavar="GRID")] = "auto"
    """Blocks on the ground, such as 3x3, or in space, such as 2x2x2 (auto: as many as --memory requires)."""
    overrides: Overrides = ()
    """Change the recipe, e.g. --set surface.iterations=2000, or the partition, e.g. --set partition.margin=0.3; may be
    repeated."""
    slots: Annotated[int | None, SETTING] = None
    """Number of parallel runs (default: one per GPU, else one)."""
    cluster: Annotated[str | None, Arg(metavar="ADDRESS")] = None
    """Run on a Ray cluster that shares the disk of --out: HOST:PORT, or auto for the cluster of this machine."""
    format: str = "auto"
    """Capture format: blender, nerfstudio, dtu, colmap, opensfm, metashape, alicevision, or one from a package."""
    backend: str = "auto"
    """Rasterizer: auto (the fastest here), cpu, cuda or reference. `gs2d doctor` lists them."""
    seed: int = 0
    """Random seed. The same seed gives the same bytes."""
    threads: int | None = None
    """CPU threads per block (default: the cores divided by the number of parallel runs)."""
    masks: Annotated[Path | None, Arg(metavar="DIR")] = None
    """Folder of masks of the photographs, white = keep (default: where COLMAP, nerfstudio and Metashape put them)."""

    @property
    def partition_changes(self) -> tuple[str, ...]:
        """Return the changes of the partition, ``field=value``."""
        return tuple(text.removeprefix(_PARTITION) for text in self.overrides if text.startswith(_PARTITION))

    @property
    def recipe_changes(self) -> tuple[str, ...]:
        """Return the changes of the recipe."""
        return tuple(text for text in self.overrides if not text.startswith(_PARTITION))
