"""COLMAP's incremental and global mapping: models from the matches in the database.

Runs in the worker process. Models are written to ``Steps`` as ``NAME-0``, ``NAME-1``, ...
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gs2d.core.atomic_files import atomic_write

CALIBRATED = "calibrated"  # step: the database has focal lengths


class Steps:
    """A folder with the results of finished steps. Each file and each model is complete or absent."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def result(self, name: str) -> Any | None:
        """Return the result of a finished step, or None."""
        try:
            return json.loads((self.folder / f"{name}.json").read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None

    def finish(self, name: str, result: Any) -> None:
        """Record that a step is finished, with its result."""
        with atomic_write(self.folder / f"{name}.json", "w") as file:
            json.dump(result, file)

    def write(self, name: str, model: Any) -> None:
        """Write a model (pycolmap.Reconstruction), replacing one of the same name."""
        whole, part = self.folder / name, self.folder / f"{name}.part"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        model.write(str(part))
        shutil.rmtree(whole, ignore_errors=True)
        os.rename(part, whole)

    def read(self, pycolmap: Any, name: str) -> Any:
        """Read a model. Every step reads its input from disk, so an interruption does not change the result."""
        return pycolmap.Reconstruction(str(self.folder / name))


def map_incrementally(
    pycolmap: Any, database: str, options: Any, steps: Steps, name: str, on_placed: Callable[[int], None]
) -> list[str]:
    """Place images one by one, starting from a pair; images that do not fit start further models.

    Returns the names of the models. ``on_placed``: called with the number of images that were just placed.
    """
    manager = pycolmap.ReconstructionManager()
    _run(pycolmap, database, options, manager, on_placed)
    return _write(steps, name, [manager.get(i) for i in range(manager.size())])


def extend(
    pycolmap: Any, database: str, options: Any, steps: Steps, name: str, on_placed: Callable[[int], None]
) -> Any | None:
    """Place more images in the model ``name`` of ``steps``; returns the larger model, or None if mapping failed.

    COLMAP requires that the cameras of model and database have the same lens, so it gets a copy of the database.
    """
    options.multiple_models = False
    manager = pycolmap.ReconstructionManager()
    manager.read(str(steps.folder / name))
    with tempfile.TemporaryDirectory(dir=steps.folder) as folder:
        copied = str(Path(folder) / "database.db")
        with (
            contextlib.closing(sqlite3.connect(database)) as source,
            contextlib.closing(sqlite3.connect(copied)) as copy,
        ):
            source.backup(copy)
        opened = pycolmap.Database.open(copied)
        for camera in manager.get(0).cameras.values():
            opened.update_camera(camera)
        opened.close()
        _run(pycolmap, copied, options, manager, on_placed)
    return manager.get(0) if manager.size() else None


def _run(pycolmap: Any, database: str, options: Any, manager: Any, on_placed: Callable[[int], None]) -> None:
    opened = pycolmap.Database.open(database)
    try:
        pipeline = pycolmap.IncrementalPipeline(options, opened, manager)
        events = pycolmap.IncrementalPipelineCallback
        pipeline.add_callback(int(events.INITIAL_IMAGE_PAIR_REG_CALLBACK), lambda: on_placed(2))
        pipeline.add_callback(int(events.NEXT_IMAGE_REG_CALLBACK), lambda: on_placed(1))
        pipeline.run()
    finally:
        opened.close()


def map_globally(pycolmap: Any, request: dict[str, Any], steps: Steps, name: str, *, threads: int) -> list[str]:
    """Place all images at once: first their rotations, then positions and points. Returns the names of the models.

    If EXIF does not state every focal length, they are estimated from all pairs first: rotations depend on them.
    """
    database = request["database"]
    if steps.result(CALIBRATED) is None:
        if not _has_all_focal_lengths(database):
            options = pycolmap.ViewGraphCalibrationOptions()
            options.random_seed = request["seed"]
            pycolmap.calibrate_view_graph(database, options)
        steps.finish(CALIBRATED, True)
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = threads
    options.image_path = request["images"]
    options.random_seed = request["seed"]
    mapper = options.mapper
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False  # the wheel has no CUDA
    folder = Path(database).with_name("placed")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    models = pycolmap.global_mapping(database, request["images"], str(folder), options)
    shutil.rmtree(folder)
    return _write(steps, name, list(models.values()))


def _write(steps: Steps, name: str, models: list[Any]) -> list[str]:
    """Write models, in place of those of an interrupted attempt; returns their names."""
    for earlier in steps.folder.glob(f"{name}-*"):
        shutil.rmtree(earlier, ignore_errors=True)
    names = [f"{name}-{i}" for i in range(len(models))]
    for written, model in zip(names, models, strict=True):
        steps.write(written, model)
    return names


def _has_all_focal_lengths(database: str) -> bool:
    """Whether EXIF states the focal length of every camera."""
    with contextlib.closing(sqlite3.connect(database, timeout=60.0)) as connection:
        return connection.execute("SELECT COUNT(*) FROM cameras WHERE prior_focal_length = 0").fetchone()[0] == 0
