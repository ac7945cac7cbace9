"""Measure how much of a run's mesh belongs to the subject, using masks.

::

    python -m benchmarks.subject RUN --masks FOLDER [--mesh FILE.ply] [--out FILE.json]

FOLDER has a mask, white on the subject, for some of the photographs: ``NAME_mask.png``, or named like COLMAP's masks.
Face centres are projected into the masked photographs, which are undistorted and downscaled as in training. A face is
inside if at least half of the photographs that have it in frame have it in the mask. A face that is in no frame is
outside. Occlusion is ignored: floaters in front of and behind the subject count as inside; objects beside it do not, if
at least half of the photographs separate them.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.mesh import Mesh
from gs2d.data import View
from gs2d.data.build import Decoder
from gs2d.data.masks import find_masks_in
from gs2d.errors import DataError, Gs2dError
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import MESH, open_run
from gs2d.pipeline.prepare.loaded import reload_run

HALF = 0.5  # share of the photographs with a face in frame that must have it in the mask
GOAL = 0.98  # share of the area


@dataclass(frozen=True)
class Fraction:
    """Share of a mesh that lies in the masks of its subject.

    Attributes
    ----------
    masks : int
        Number of photographs with a mask.
    faces, inside_faces : int
    area : float
        world units^2.
    inside, unseen : float
        Shares of the area: inside the masks, and in no frame.
    """

    masks: int
    faces: int
    inside_faces: int
    area: float
    inside: float
    unseen: float


def fraction_inside(mesh: Mesh, masks: Iterable[tuple[Camera, np.ndarray]]) -> Fraction:
    """Return the share of a mesh's area that lies in the masks (bool [H, W]) of the cameras.

    Raises
    ------
    DataError
        If there is no mask or no area.
    """
    corners = np.asarray(mesh.vertices, np.float64)[mesh.faces]  # [F, 3, 3]
    middles = corners.mean(axis=1)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    framed, within = np.zeros(len(middles), np.int64), np.zeros(len(middles), np.int64)
    count = 0
    for camera, mask in masks:
        count += 1
        pixels, depth = camera.project(middles)
        seen = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
        column, row = pixels[seen].astype(np.int64).T
        framed += seen
        within[seen] += mask[row, column]
    if not count or not areas.sum() > 0:
        raise DataError(f"masks and a mesh with an area were expected, got {count} masks and {len(areas):,} faces")
    inside = (framed > 0) & (within >= HALF * framed)
    whole = float(areas.sum())
    parts = (float(areas[chosen].sum()) / whole for chosen in (inside, framed == 0))
    return Fraction(count, len(areas), int(inside.sum()), whole, *parts)


def masks_of(views: Iterable[View], folder: Path) -> list[tuple[Camera, np.ndarray]]:
    """Return the cameras of the photographs with a mask in a folder, and the masks bool [H, W] for these cameras."""
    found = []
    views = list(views)
    for view, file in zip(views, find_masks_in([folder], [view.name for view in views]), strict=True):
        if file is None or not isinstance(view.decode, Decoder):
            continue
        masked = replace(view.decode, frame=replace(view.decode.frame, object_mask=file))()
        assert masked.object_mask is not None
        found.append((view.camera, masked.object_mask))
    return found


def measure(run: Path, folder: Path, mesh: Path | None = None) -> dict[str, Any]:
    """Return the figures of a run.

    Raises
    ------
    Gs2dError
        If the run, its mesh or the masks cannot be read.
    """
    file = run / MESH if mesh is None else mesh
    job = reload_run(open_run(run), lambda event: None)
    fraction = fraction_inside(read_mesh(file), masks_of(job.scene.views, folder))
    return {"run": run.name, "mesh": file.name, **vars(fraction)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the arguments, print a line and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--masks", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--mesh", type=Path, help="mesh file (default: the run's mesh)")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args(arguments)
    try:
        found = measure(args.run, args.masks, args.mesh)
    except Gs2dError as error:
        raise SystemExit(f"error: {error}") from error
    print(
        f"{found['run']}: {found['inside']:.1%} of the mesh's area is in the masks of {found['masks']} photographs "
        f"(goal: {GOAL:.0%}), {found['unseen']:.1%} in no frame; {found['inside_faces']:,} of {found['faces']:,} faces"
    )
    if args.out is not None:
        args.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
