"""Models from the places of others: pieces that share photographs become one, cameras of a rig become one.

Places are taken over; all points are found anew from the matches, and all is adjusted.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gs2d.sfm.lens import adjust, drop_outliers

SHARED = 3  # photographs that two pieces must share: fewer do not tell scale, turn and place against chance
AGREE = 0.3  # of the observations in them must agree, as COLMAP's own merging asks
FARTHEST = 8.0  # px
WORSE, LEAST = 1.5, 0.5  # times the error of the worse piece, px at least: more, and the pieces are not one


def merged(
    pycolmap: Any, request: dict[str, Any], options: Any, pieces: Sequence[Any], *, threads: int
) -> tuple[list[Any], list[tuple[int, int]]]:
    """Return the pieces with those joined that fit, the largest first, and how many photographs each two had.

    Parameters
    ----------
    pieces : sequence of pycolmap.Reconstruction
        The largest first.
    options : pycolmap.IncrementalPipelineOptions
    """
    left = list(pieces)
    joined: list[tuple[int, int]] = []
    i = 0
    while i < len(left):
        for other in left[i + 1 :]:
            one = _join(pycolmap, request, options, left[i], other, threads=threads)
            if one is not None:
                joined.append((left[i].num_reg_images(), other.num_reg_images()))
                left.remove(other)
                left[i] = one
                break
        else:
            i += 1
    left.sort(key=lambda piece: (-piece.num_reg_images(), -piece.num_points3D()))
    return left, joined


def _join(pycolmap: Any, request: dict[str, Any], options: Any, piece: Any, other: Any, *, threads: int) -> Any | None:
    """Return one model of two, or None where they do not fit."""
    shared = set(piece.reg_image_ids()) & set(other.reg_image_ids())
    if len(shared) < SHARED or set(other.reg_image_ids()) <= shared:
        return None
    moved = pycolmap.align_reconstructions_via_reprojections(other, piece, AGREE, FARTHEST)
    if moved is None:
        return None
    there = pycolmap.Reconstruction(other)
    there.transform(moved)
    one = assembled(pycolmap, request, options, (there, piece), threads=threads)
    worse = max(LEAST, piece.compute_mean_reprojection_error(), other.compute_mean_reprojection_error())
    if one is None or set(one.reg_image_ids()) != set(piece.reg_image_ids()) | set(other.reg_image_ids()):
        return None
    return one if one.compute_mean_reprojection_error() < WORSE * worse else None


def mount(pycolmap: Any, request: dict[str, Any], options: Any, piece: Any, *, threads: int) -> Any:
    """Return a model whose cameras are mounted together as ``rig`` of the request says: by the names of folders.

    How they are mounted is taken from the places that the model has; then a photograph that had none gets that of its
    rig. The database learns the rig too, so that what is added later keeps to it.
    """
    cameras = [
        pycolmap.RigConfigCamera(ref_sensor=i == 0, image_prefix=f"{folder}/")
        for i, folder in enumerate(request["rig"])
    ]
    opened = pycolmap.Database.open(request["database"])
    try:
        pycolmap.apply_rig_config([pycolmap.RigConfig(cameras=cameras)], opened, piece)
    finally:
        opened.close()
    return assembled(pycolmap, request, options, (piece,), threads=threads) or piece


def assembled(
    pycolmap: Any, request: dict[str, Any], options: Any, sources: Sequence[Any], *, threads: int
) -> Any | None:
    """Return a model with the places and lenses of others, all points found anew and adjusted; None without points.

    Parameters
    ----------
    sources : sequence of pycolmap.Reconstruction
        In one frame; of photographs in several of them the last one decides.
    """
    one = _empty(pycolmap, request["database"], options)
    for source in sources:
        for number in source.reg_frame_ids():
            one.frame(number).rig_from_world = source.frame(number).rig_from_world
            if number not in one.reg_frame_ids():
                one.register_frame(number)
        for number, camera in source.cameras.items():
            one.camera(number).params = camera.params
    folder = Path(request["database"]).with_name("joined")
    folder.mkdir(exist_ok=True)
    database, images = request["database"], request["images"]
    one = pycolmap.triangulate_points(one, database, images, str(folder), clear_points=True, options=options)
    if not one.num_points3D():
        return None
    adjust(pycolmap, one, tied=False, threads=threads)
    drop_outliers(pycolmap, one)
    return one


def _empty(pycolmap: Any, database: str, options: Any) -> Any:
    """Return a model of all photographs of the database, none of which has a place."""
    from_database = pycolmap.DatabaseCacheOptions()
    from_database.min_num_matches = options.min_num_matches
    opened = pycolmap.Database.open(database)
    try:
        model = pycolmap.Reconstruction()
        model.load(pycolmap.DatabaseCache.create(opened, from_database))
        return model
    finally:
        opened.close()
