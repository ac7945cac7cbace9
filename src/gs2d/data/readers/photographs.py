"""Photographs of a capture whose cameras are in another tool's file, which names them in its own way."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from gs2d.errors import DataError

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".avif", ".heic")
_NO_IMAGES = {"mask", "masks", "depths", "normals", "depthmaps", "undistorted", "thumbnails"}  # of the same names


class ImageFiles:
    """Finds photographs by what a camera file calls them: a path of another machine, a name, a name without its ending.

    Parameters
    ----------
    folders : sequence of Path
        Where they may be, most likely first; sub-folders count too. Folders that do not exist are passed over.
    """

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders = [folder for folder in dict.fromkeys(folders) if folder.is_dir()]
        self._known: dict[Path, dict[str, list[Path]]] = {}

    def find(self, name: str, where: str) -> tuple[str, Path] | None:
        """(path below the folder of photographs with ``/``, file) of a photograph, or None.

        Of several files of that name the one whose folders agree with those of ``name``.

        Raises
        ------
        DataError
            Two files fit equally well.
        """
        parts = [part.lower() for part in name.replace("\\", "/").split("/") if part not in ("", ".")]
        if not parts:
            return None
        for folder in self._folders:
            known = self._index(folder)
            found = known.get(parts[-1]) or [p for end in SUFFIXES for p in known.get(parts[-1] + end, ())]
            if not found:
                continue
            fit = [_agreement(path.relative_to(folder), parts) for path in found]
            best = [path for path, agreed in zip(found, fit, strict=True) if agreed == max(fit)]
            if len(best) > 1:
                raise DataError(
                    f"{where} must name one photograph, got {name}, which may be {best[0]} or {best[1]}; "
                    "keep only one of them below the capture, or let the camera's name tell its folder"
                )
            return best[0].relative_to(folder).as_posix(), best[0]
        return None

    def _index(self, folder: Path) -> dict[str, list[Path]]:
        """Photographs below a folder by their names in lower case."""
        if folder not in self._known:
            names: dict[str, list[Path]] = {}
            for path in sorted(_below(folder)):
                names.setdefault(path.name.lower(), []).append(path)
            self._known[folder] = names
        return self._known[folder]


def _below(folder: Path) -> Iterator[Path]:
    for at, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".") and name.lower() not in _NO_IMAGES]
        yield from (Path(at, name) for name in files if os.path.splitext(name)[1].lower() in SUFFIXES)


def _agreement(path: Path, parts: Sequence[str]) -> int:
    """Folders above the file that both have, counted from the file upwards; the file as it was named is more."""
    own = [part.lower() for part in path.parts]
    agreed = 0
    for a, b in zip(reversed(own[:-1]), reversed(parts[:-1]), strict=False):
        if a != b:
            break
        agreed += 1
    return agreed
