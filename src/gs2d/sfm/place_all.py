"""COLMAP's global mapping: rotations of all photographs from those of pairs, then all places and points at once."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
from pathlib import Path
from typing import Any

from gs2d.sfm.steps import Steps

CALIBRATED = "calibrated"  # step: the database has focal lengths


def place_all(pycolmap: Any, request: dict[str, Any], steps: Steps, name: str, *, threads: int) -> None:
    """Place all photographs at once; each connected piece is in ``steps`` as ``NAME-0``, ``NAME-1`` ...

    Where no EXIF tells a focal length, those of all pairs together do first: rotations need it.
    """
    database = request["database"]
    if steps.facts(CALIBRATED) is None:
        if not _all_known(database):
            options = pycolmap.ViewGraphCalibrationOptions()
            options.random_seed = request["seed"]
            pycolmap.calibrate_view_graph(database, options)
        steps.finish(CALIBRATED, True)
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = threads
    options.image_path = request["images"]
    options.random_seed = request["seed"]
    mapper = options.mapper
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False  # which the wheel has not
    folder = Path(database).with_name("placed")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    found = pycolmap.global_mapping(database, request["images"], str(folder), options)
    shutil.rmtree(folder)
    for before in steps.names(f"{name}-"):
        steps.remove(before)
    for i, model in enumerate(found.values()):
        steps.write(f"{name}-{i}", model)


def _all_known(database: str) -> bool:
    """Whether EXIF told the focal length of every camera."""
    with contextlib.closing(sqlite3.connect(database, timeout=60.0)) as connection:
        return connection.execute("SELECT COUNT(*) FROM cameras WHERE prior_focal_length = 0").fetchone()[0] == 0
