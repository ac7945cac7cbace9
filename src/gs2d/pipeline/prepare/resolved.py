"""A training run as a value, which ``run.json`` holds: what determines its result, and how it is executed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from gs2d.config.protocols import Protocol
from gs2d.config.recipe import Recipe, validate
from gs2d.config.registry import absent_guests
from gs2d.config.serialize import decode, encode
from gs2d.data import Scene
from gs2d.data.masks import Masks
from gs2d.errors import DataError, RecipeError, RunError, ShapeError
from gs2d.io.run_dir import RUN_JSON, RunFolder
from gs2d.render.api import check_settings
from gs2d.render.types import RasterSettings


@dataclass(frozen=True, kw_only=True)
class CaptureRecord:
    """The capture of a run."""

    name: str
    path: Path  # absolute
    format: str
    train: int  # number of training views
    test: int
    extent: float  # world units
    skipped: tuple[str, ...] = ()  # photographs that were skipped, with the reason
    masks: Masks = field(default_factory=Masks)
    digest: str = ""  # hash of all decoded images, masks, cameras, points and priors

    @classmethod
    def of(cls, scene: Scene, digest: str) -> CaptureRecord:
        """Return the record of a loaded capture."""
        folder = scene.masks.folder
        return cls(
            name=scene.name,
            path=Path(scene.root or ".").resolve(),
            format=scene.format,
            train=len(scene.train),
            test=len(scene.test),
            extent=scene.extent,
            skipped=tuple(scene.skipped),
            masks=replace(scene.masks, folder=None if folder is None else folder.resolve()),
            digest=digest,
        )


@dataclass(frozen=True, kw_only=True)
class Execution:
    """How a run is executed: the fields of ``TrainOptions`` that may differ when the run is resumed."""

    threads: int | None = None
    memory: float | None = None
    checkpoint_every: str = "2m"
    cache: Path | None = None
    page: bool = True
    viewer: int | None = None


@dataclass(frozen=True, kw_only=True)
class ResolvedRun:
    """Everything that defines a run; names and defaults are replaced by values."""

    recipe: Recipe  # as trained, with its seed
    protocol: Protocol
    scene: CaptureRecord
    downscale: int  # factor by which the photographs are smaller than their files
    raster: RasterSettings
    backend: Mapping[str, Any]  # what determines its results (`Backend.facts`)
    schedule_scale: float = 1.0  # trained fraction of the full schedule
    title: str = ""  # heading of the report; empty: the name of the capture
    init: str | None = None  # hash of the file of initial splats
    part: str | None = None  # hash of the initial state of a part of a scene
    execution: Execution = field(default_factory=Execution)

    def to_json(self) -> dict[str, Any]:
        """Return the run as plain JSON values."""
        return {**encode(self), "raster": self.raster.facts(), "seed": self.recipe.seed}

    def decisive_facts(self) -> dict[str, Any]:
        """Return what determines the bytes of the splats, as JSON values.

        The background is part of ``raster``. Fused depth and subject affect the mesh only.
        """
        data = self.to_json()
        fusion = {name: value for name, value in data["protocol"]["fusion"].items() if name not in ("depth", "subject")}
        protocol = {name: value for name, value in data["protocol"].items() if name not in ("robust", "background")}
        return {
            "backend": data["backend"],  # first: cameras differ by rounding between CPUs
            "recipe": data["recipe"],
            "protocol": {**protocol, "fusion": fusion},
            "downscale": self.downscale,
            "scene": {"masks": data["scene"]["masks"], "digest": self.scene.digest},
            "raster": data["raster"],
            **{name: data[name] for name in ("init", "part")},
        }


def read_resolved(run: RunFolder) -> ResolvedRun:
    """Return the run that ``run.json`` holds. Raises RunError if another version wrote it, or it was edited."""
    data = run.definition()
    known = {entry.name: data[entry.name] for entry in fields(ResolvedRun) if entry.name in data}
    try:
        with absent_guests():
            resolved: ResolvedRun = decode(known, ResolvedRun, "run")
        validate(resolved.recipe)
        check_settings(resolved.raster)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError, RecipeError, DataError, ShapeError) as e:
        raise RunError(
            f"{run.file(RUN_JSON)} is not a run as this version writes it ({e}); restore it, or train again with "
            "--overwrite"
        ) from e
    protocol = resolved.protocol
    return replace(resolved, raster=resolved.raster.for_depths(protocol.depth, protocol.fused_depth))


def check_same_run(run: RunFolder, resolved: ResolvedRun) -> None:
    """Raise RunError with the first difference, if the run in a folder cannot be resumed as ``resolved``."""
    old, new = read_resolved(run).decisive_facts(), resolved.decisive_facts()
    name = next((name for name in new if old[name] != new[name]), None)
    if name is None:
        return
    what = f"{name}{difference(old[name], new[name])}"
    if name == "scene" and old[name]["masks"] == new[name]["masks"]:
        what = "scene: its photographs, cameras, points or maps changed, or the CPU is of another kind"
    elif name == "init":
        what = "--init file"
    elif name == "part":
        what = "start of this part"
    raise RunError(f"{run.path} was made with another {what}; resume with the same options, or choose another --out")


def difference(old: Any, new: Any, where: str = "") -> str:
    """Return the first difference of two JSON values, as text."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in new:
            if old.get(key) != new[key]:
                return difference(old.get(key), new[key], f"{where}.{key}" if where else key)
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for i, (a, b) in enumerate(zip(old, new, strict=True)):
            if a != b:
                name = b.get("name", i) if isinstance(b, dict) else i
                return difference(a, b, f"{where}.{name}" if where else str(name))
    return f" ({where + ': ' if where else ''}{str(old)[:60]}, now {str(new)[:60]})"
