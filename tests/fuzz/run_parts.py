"""What a run, a table, a job of blocks or a search for cameras keeps beside ``run.json``, changed by hand: its readers.

Each file is read by the functions that the commands read it by, without what they then do for seconds.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any
from unittest import mock

import mutations as m
import numpy as np
from commands import JSON_LINE, _curves

from gs2d.core.splats import Splats
from tiny import write_capture

Files = dict[str, bytes]
_POSE = np.eye(4).tolist()
_MOVED = {"pixels": 0.5, "degrees": 0.1, "shift": 0.01}
_VIEW = {"name": "a", "psnr": 20.5, "blur": 1.5, "points": 10, "hidden": 1, "next": "b", "degrees": 12.5}
_MEASURED = {
    "views": [{**_VIEW, "split": "test"}, {**_VIEW, "split": "train", "name": "b"}],
    "placed": 2, "count": 3, "lost": ["c"],
}  # fmt: skip
_CAMERA = {"model": "PINHOLE", "size": [40, 30], "params": [35, 36, 20, 15], "focal_px": 35.5, "photos": 2}
_PHOTO = {"name": "a.png", "source": "a.png", "file": "copied", "features": 900, "placed": True}
_CAPTURE = {
    "photos": "photos", "count": 3, "placed": 2, "points": 1200, "mean_error_px": 0.7, "photos_per_point": 2.5,
    "median_angle_degrees": 9.5, "up": "+z", "cameras": [{**_CAMERA, "about": "2 photographs by one camera"}],
    "lens": {"chosen": "PINHOLE", "about": "a lens without distortion"}, "other_models": [],
    "photographs": [_PHOTO, {**_PHOTO, "source": "c.png", "placed": False, "reason": "too few features"}],
    "asked": {"cameras": "auto"}, "options": {}, "created": "2026-01-01T00:00:00Z", "masks": 2,
}  # fmt: skip
_FOUND: dict[str, Any] = {
    "run/exposure.json": {"format": 1, "photographs": [
        {"name": "a", "transform": np.eye(3, 4).tolist(), "grey": [0.5, 0.4, 0.6]}]},
    "run/photometry.json": {"format": 1, "cameras": [
        {"falloff": [0.1, 0, 0.01], "reach": 1.2, "shift": 0.02, "corner": 0.9, "photographs": ["a", "b"]}]},
    "run/poses.json": {"format": 1, "frames": [
        {"name": "a", "split": "train", "T_cam_world": _POSE, "moved": _MOVED, "zoom": [1.01, 0.001, 0.0]},
        {"name": "b", "split": "test", "T_cam_world": _POSE}]},
    "run/subject.json": {"kind": "object", "min": [0, 0, 0], "max": [1, 2, 3], "center": [0.5, 1, 1.5], "up": [0, 0, 1],
                         "radius": 1.9, "why": "most cameras look at it"},
    "capture/poses.json": _CAPTURE,
}  # fmt: skip


# -- what a run found --------------------------------------------------------------------------------------------------
def found_seeds() -> list[Files]:
    """A run's documents, one of each."""
    from gs2d.pipeline.verdict.judge import judge
    from gs2d.pipeline.verdict.measures import measures_from_json

    verdict = {"format": 1, "verdict": judge(measures_from_json(_MEASURED)).to_json(), "measured": _MEASURED}
    files = {name: json.dumps(value).encode() for name, value in {**_FOUND, "run/verdict.json": verdict}.items()}
    with TemporaryDirectory(prefix="gs2d-seed-") as home:  # what that loads is loaded then
        for name, data in files.items():
            (Path(home) / name).parent.mkdir(exist_ok=True)
            (Path(home) / name).write_bytes(data)
        read_found(Path(home))
    return [files]


def read_found(root: Path) -> None:
    """As reports, pictures and whatever goes on with a run read them."""
    from gs2d.cli.verdict import say_verdict
    from gs2d.core.json_files import read_json
    from gs2d.data.subject import read_subject
    from gs2d.io.run_dir import RunFolder
    from gs2d.pipeline.exposure import read_exposures
    from gs2d.pipeline.photometry import with_found_photometries
    from gs2d.pipeline.refined_poses import read_poses
    from gs2d.pipeline.verdict.file import _measured_before
    from gs2d.pipeline.verdict.judge import judge
    from gs2d.pipeline.verdict.measures import placed_images
    from gs2d.report.sections.capture import capture_section
    from gs2d.report.sections.exposure import exposure_section
    from gs2d.report.sections.photometry import photometry_section
    from gs2d.report.sections.poses import poses_section
    from gs2d.report.sections.verdict import verdict_section
    from gs2d.sfm.workspace import _has_masks_of_ours

    run, path = RunFolder(root / "run"), root / "run"
    recipe: Any = SimpleNamespace(exposure=1, photometry=1, poses=1, intrinsics=1)
    scene: Any = SimpleNamespace(train=[SimpleNamespace(name="a")], with_photometries=dict)
    with _curves(drawn=False):
        _each_of(
            partial(read_exposures, run, recipe),
            partial(with_found_photometries, run, recipe, scene),
            partial(read_poses, run, recipe),
            partial(read_subject, path),
            lambda: judge(_measured_before(run)),
            partial(placed_images, root / "capture"),
            partial(_has_masks_of_ours, root / "capture"),
            lambda: _reconstructed(read_json(root / "capture" / "poses.json"), root),
            partial(exposure_section, path / "exposure.json", {}),
            partial(photometry_section, path / "photometry.json"),
            partial(poses_section, path / "poses.json", {}),
            partial(verdict_section, path / "verdict.json"),
            partial(capture_section, path, {"scene": {"path": str(root / "capture")}}),
            partial(say_verdict, path, _silent()),
        )


def _reconstructed(poses: Any, root: Path) -> None:
    """As `gs2d reconstruct --resume` does, which looks whether these photographs and options made the cameras."""
    from gs2d.pipeline.options import ReconstructOptions
    from gs2d.pipeline.reconstruct import _same_poses, _tell, asked_for, poses_options

    options = ReconstructOptions(photos=root / "photos", out=root / "run")
    if isinstance(poses, dict):  # the folder has another name each time, and what was asked is what is asked now
        poses = {**poses, **({"photos": str((root / "photos").resolve())} if "photos" in poses else {})}
        if isinstance(poses.get("asked"), dict):
            poses["asked"] = {**asked_for(poses_options(options)), **poses["asked"], "cameras": "auto"}
    with mock.patch("gs2d.pipeline.reconstruct.read_json", return_value=poses):
        _tell(_same_poses(root / "capture", options), root / "capture", lambda _event: None)


# -- tables ------------------------------------------------------------------------------------------------------------
def _table_options(root: Path, **changes: Any) -> Any:
    from gs2d.experiments.options import SweepOptions

    few = ("init_points=100", "surface.densify.max_splats=150")
    given: dict[str, Any] = {"data": root / "data", "out": root / "out", "overrides": few, "schedule_scale": 0.0005}
    return SweepOptions(recipes=("2dgs",), threads=1, backend="cpu", **given, **changes)


def table_seeds() -> list[Files]:
    """A table of one run."""
    from gs2d.experiments.paper import paper

    with TemporaryDirectory(prefix="gs2d-seed-") as home, _curves(drawn=False):
        root = Path(home)
        write_capture(root / "data" / "ball", train=3, test=1, size=16)
        assert not paper(_table_options(root)).failures
        files = {p.relative_to(root).as_posix(): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}
    dropped = (".pt", ".html", "mesh.ply", "splats.ply", "/.lock")
    return [{name: data for name, data in files.items() if not name.endswith(dropped)}]


def read_table(root: Path) -> None:
    """As `gs2d sweep` does where all is trained."""
    from gs2d.experiments.paper import paper

    with _curves(drawn=False):
        paper(_table_options(root, train=False))


TABLE_FILES = {
    "out/about.json": JSON_LINE,
    ".json": m.either(m.of_json, m.of_json, m.of_text, m.of_bytes),
    "events.jsonl": m.of_json_lines,
}


# -- jobs of blocks ----------------------------------------------------------------------------------------------------
def block_seeds() -> list[Files]:
    """What a job of four blocks keeps of its partition."""
    from gs2d.config.partition import Partition
    from gs2d.config.partition import to_json as partition_json
    from gs2d.config.presets import get_recipe
    from gs2d.config.protocols import GENERIC
    from gs2d.config.serialize import to_json
    from gs2d.pipeline.blocks.cells import Cells
    from gs2d.pipeline.blocks.split import Block, Split
    from gs2d.pipeline.part import write_start

    inf = np.inf
    low, high = np.array([[-inf, -inf], [0, -inf]]), np.array([[0, inf], [inf, inf]])
    cells = Cells(np.eye(3)[:2], low, high, 0.5, 2.0, ("1-1", "2-1"))
    blocks = tuple(Block(name, ("a", "b"), 0, 10, 5, 8, 0.5, 3.0) for name in cells.names)
    document = {
        "recipe": to_json(get_recipe("2dgs")), "protocol": asdict(GENERIC), "capture": {"digest": "a" * 64},
        "partition": partition_json(Partition(grid=(2, 1))),
    }  # fmt: skip
    with TemporaryDirectory(prefix="gs2d-seed-") as home:
        write_start(Path(home, "a.npz"), np.arange(30, dtype=np.uint8) % 3, np.zeros((2, 3, 4), np.float32))
        start = Path(home, "a.npz").read_bytes()
    values = {
        "blocks.json": document,
        "partition/cells.json": Split(cells, blocks).to_json(),
        "seams.json": {"views": ["a", "b"]},
        "jobs/1-1.json": {"state": "done", "time": 1.0, "at": "now"},
    }
    return [{**{name: json.dumps(value).encode() for name, value in values.items()}, "partition/1-1.npz": start}]


def read_blocks(root: Path) -> None:
    """As the tasks of `gs2d blocks` read what the ones before them settled."""
    from gs2d.experiments.blocks import BlockTask, check_capture, check_same_job, settled_of
    from gs2d.pipeline.blocks.merged import read_seam_views
    from gs2d.pipeline.blocks.split import read_split, start_file
    from gs2d.pipeline.options import TrainOptions
    from gs2d.pipeline.part import read_start

    options = TrainOptions(scene=root / "capture", out=root)
    task = BlockTask(name="1-1", record=root / "jobs" / "1-1.json", options=options, block="1-1")
    before = json.loads(block_seeds_once()[0]["blocks.json"])

    def whole() -> None:
        split = read_split(root / "partition")
        for cell in range(len(split.cells)):
            split.cells.region(cell)

    _each_of(
        partial(check_same_job, root, {name: before[name] for name in ("recipe", "capture", "partition")}),
        task.training, task.partition, task.outcome, task.is_done, whole,
        lambda: check_capture(root, settled_of(root), "a" * 64),
        partial(read_seam_views, root),
        partial(read_start, start_file(root / "partition", "1-1")),
    )  # fmt: skip


@cache
def block_seeds_once() -> list[Files]:
    """The seeds of blocks, made once a process."""
    return block_seeds()


# -- streams of SOG ----------------------------------------------------------------------------------------------------
def write_stream(root: Path, make: Callable[[int], Splats]) -> None:
    """A tree of a few leaves in some levels."""
    from gs2d.io.formats import sog_streamed
    from gs2d.io.formats.registry import write_layout

    with mock.patch.object(sog_streamed, "_LEAF", 20), mock.patch.object(sog_streamed, "_FILE", 30):
        write_layout(root / "lod-meta.json", make(60), "streamed")


def read_stream(root: Path) -> None:
    """As `gs2d info`, and `--init`, do."""
    from gs2d.io.formats.registry import read_splat_file
    from gs2d.pipeline.info import describe_file

    _each_of(partial(describe_file, root / "lod-meta.json"), partial(read_splat_file, root / "lod-meta.json"))


# -- searches for cameras ----------------------------------------------------------------------------------------------
_LAYERS = {"photographs": {"files": [["a.png", 10, 20]]}, "features": {"size": 800}, "pairs": [1, 2], "mapping": None}


def search_seeds() -> list[Files]:
    """What an interrupted search leaves: what it was made of, pairs, steps, and a database as COLMAP makes them."""
    import contextlib
    import sqlite3

    with TemporaryDirectory(prefix="gs2d-seed-") as home:
        path = Path(home, "database.db")
        with contextlib.closing(sqlite3.connect(path)) as connection, connection:
            for table in ("keypoints", "matches", "two_view_geometries", "images"):
                connection.execute(f"CREATE TABLE {table} (id INTEGER PRIMARY KEY, rows INTEGER, data BLOB)")
                connection.execute(f"INSERT INTO {table} VALUES (1, 2, ?)", (bytes(40),))
        data = path.read_bytes()
    return [{"search.json": json.dumps(_LAYERS).encode(), "mapping/cameras.json": b'{"models": 1, "refused": []}',
             "alike.json": b"[[0, 1], [0, 2]]", "database.db": data}]  # fmt: skip


def read_search(root: Path) -> None:
    """As `gs2d poses` does when it is given again."""
    from gs2d.sfm.search import go_on, is_of

    is_of(root, "features", {"size": 800})
    go_on(root, {**_LAYERS, "mapping": {"new": 1}}, ours=("staged",))
    go_on(root, {**_LAYERS, "features": {"size": 900}}, ours=("staged",))


# -- helpers -----------------------------------------------------------------------------------------------------------
def _each_of(*reads: Callable[[], object]) -> None:
    """Read in turn; what the user can mend is raised at the end, anything else at once."""
    from gs2d.errors import Gs2dError

    refused: Exception | None = None
    for read in reads:
        try:
            read()
        except Gs2dError as error:
            refused = error
    if refused is not None:
        raise refused


@cache
def _silent() -> Any:
    from gs2d.cli.console import Console

    return Console(quiet=True, as_json=False)
