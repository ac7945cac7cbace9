"""GeoTIFF rasters in a projected coordinate system (OGC 19-008r4), written by tifffile (extra ``geo``)."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.atomic_files import atomic_write
from gs2d.core.extras import required

NO_DATA = -9999.0  # for missing elevations
_TILE = (256, 256)
_DOUBLE, _SHORT, _ASCII = 12, 3, 2  # types of TIFF fields
_PIXEL_SCALE, _TIE_POINT, _KEYS, _KEY_TEXTS, _NO_DATA = 33550, 33922, 34735, 34737, 42113  # TIFF tags
_MODEL, _RASTER, _CITATION, _PROJECTED, _UNITS = 1024, 1025, 1026, 3072, 3076  # GeoKeys
_METRE, _IS_PROJECTED, _PIXEL_IS_AREA, _OF_ITS_OWN = 9001, 1, 1, 32767


def write_geotiff(
    path: Path, raster: np.ndarray, *, corner: tuple[float, float], step: float, epsg: int | None, frame: str
) -> None:
    """Write a raster with rows from north to south and columns from west to east.

    The raster [H, W, 4] uint8 has colours with alpha, or [H, W] float32 elevations in metres with :data:`NO_DATA`.
    ``corner`` (easting, northing) is the upper left one, ``step`` the cell size, both metres. Without ``epsg`` the
    projected coordinate system is a local one, called ``frame``.
    """
    tifffile = required("geo", "tifffile", "a GeoTIFF")
    colored = raster.ndim == 3
    tags = [
        (_PIXEL_SCALE, _DOUBLE, 3, (step, step, 0.0), True),
        (_TIE_POINT, _DOUBLE, 6, (0.0, 0.0, 0.0, corner[0], corner[1], 0.0), True),
        *_key_tags(epsg, frame),
    ]
    if not colored:
        tags.append((_NO_DATA, _ASCII, 0, f"{NO_DATA:g}", True))
    whole = io.BytesIO()
    tifffile.imwrite(
        whole,
        raster,
        photometric="rgb" if colored else "minisblack",
        extrasamples=["unassalpha"] if colored else None,
        tile=_TILE,
        compression="deflate",
        bigtiff=raster.nbytes > 2**31,
        metadata=None,
        extratags=tags,
    )
    with atomic_write(path) as file:
        file.write(whole.getbuffer())


def _key_tags(epsg: int | None, frame: str) -> list[tuple[int, int, int, Any, bool]]:
    """Return the tags of the GeoKey directory and its texts."""
    text = frame.encode("ascii", "replace").decode() + "|"
    keys = [
        (_MODEL, 0, 1, _OF_ITS_OWN if epsg is None else _IS_PROJECTED),
        (_RASTER, 0, 1, _PIXEL_IS_AREA),
        (_CITATION, _KEY_TEXTS, len(text), 0),
    ]
    if epsg is not None:
        keys.append((_PROJECTED, 0, 1, epsg))
    keys.append((_UNITS, 0, 1, _METRE))
    directory = [1, 1, 0, len(keys), *(number for key in keys for number in key)]
    return [(_KEYS, _SHORT, len(directory), directory, True), (_KEY_TEXTS, _ASCII, 0, text, True)]
