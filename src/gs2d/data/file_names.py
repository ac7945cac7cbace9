"""Find files by the names in camera files, which may have other folders, letter case or Unicode form."""

from __future__ import annotations

import math
import os
import re
import unicodedata
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gs2d.data.image_files import UNREAD, remedy
from gs2d.errors import DataError

IMAGES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".avif", ".heic", ".heif")
#: Folders of a capture whose images have the names of photographs but are something else.
NO_PHOTOGRAPHS = frozenset({"mask", "masks", "depths", "normals", "depthmaps", "undistorted", "thumbnails"})
_SMALLER = re.compile(r"images_\d+")  # downscaled copies


@dataclass(frozen=True)
class Match:
    """The file that matches a name."""

    path: Path | None = None  # None if no file or several files match
    rank: tuple[int, ...] = ()  # quality of the match; larger for a longer common end
    elsewhere: bool = False  # whether the folders of file and name differ
    several: tuple[Path, ...] = ()  # files that match equally well, if more than one


class Files:
    r"""Find files below some folders by the names in a camera file; each folder is listed at most once.

    A name matches the file at that path: absolute, or relative to ``base`` or one of the folders. Otherwise the file
    below a folder with the longest common end of the path is used. ``\\`` and ``/`` are both separators. Letter case
    and Unicode form (NFC, NFD) matter only if several files differ in nothing else.

    ``folders``: folders to search, most likely first, with sub-folders except hidden and linked ones. Missing folders
    are ignored. ``base``: base folder of relative paths; tried before ``folders``.
    """

    def __init__(self, folders: Sequence[Path], base: Path | None = None) -> None:
        self._folders = [folder for folder in dict.fromkeys(folders) if folder.is_dir()]
        self._bases = list(dict.fromkeys([*([base] if base else []), *self._folders]))
        self._listed: dict[Path, dict[str, list[tuple[str, ...]]]] = {}
        self._entries: dict[str, frozenset[str]] = {}

    def match(
        self,
        names: Sequence[Sequence[str]],
        *,
        not_in: Collection[str] = (),
        used: Collection[Path] = (),
        moved: bool = True,
    ) -> list[Match]:
        """Return the file of each name.

        Names are matched together: two names never share a file by a common end, because at least one would be wrong.
        For the same reason, a file in a contradicting folder (``left/1.png`` for ``right/1.png``) is used only if no
        name has a file in its own folder.

        ``names``: spellings of each name, most likely first. ``not_in``: folder names, in lower case, whose files match
        only by their exact path. ``used``: files that match only by their exact path. ``moved``: whether files in
        contradicting folders may match at all.
        """
        matches = [self._exact(spellings) for spellings in names]
        owned = {match.path for match in matches if match.path is not None} | set(used)
        matches = [
            match if match.path else self._best(spellings, not_in, owned)
            for match, spellings in zip(matches, names, strict=True)
        ]
        if not moved or any(match.path and not match.elsewhere for match in matches):
            matches = [Match() if match.elsewhere else match for match in matches]
        owners: dict[Path, dict[str, tuple[int, ...]]] = {}
        for match, spellings in zip(matches, names, strict=True):
            if match.path is not None and match.rank:
                owners.setdefault(match.path, {})[spellings[0]] = match.rank
        return [
            Match() if match.path and match.rank and not _owns(spellings[0], owners[match.path]) else match
            for match, spellings in zip(matches, names, strict=True)
        ]

    def of_stem(self, name: str, suffixes: Collection[str], not_in: Collection[str] = ()) -> Path | None:
        """Return a file that differs from a name only in its suffix, one of ``suffixes``."""
        stem = os.path.splitext(name)[0]
        match = self._best([stem + suffix for suffix in suffixes], not_in, ())
        return None if match.elsewhere else match.path

    def _exact(self, spellings: Sequence[str]) -> Match:
        """Return the file whose path equals the name."""
        for base in self._bases:
            for name in spellings:
                path = base / name.replace("\\", "/")
                if self._is_file(path):
                    return Match(path)
        return Match()

    def _is_file(self, path: Path) -> bool:
        """Whether a path is a file; uses cached folder listings."""
        folder, name = os.path.split(path)
        if folder not in self._entries:
            try:
                self._entries[folder] = frozenset(os.listdir(folder))
            except (OSError, ValueError):  # missing folder or invalid name
                self._entries[folder] = frozenset()
        return name in self._entries[folder] and os.path.isfile(path)

    def _best(self, spellings: Sequence[str], not_in: Collection[str], used: Collection[Path | None]) -> Match:
        """Return the file with the longest common end of its path."""
        for folder in self._folders:
            for name in spellings:
                parts = _parts(name)
                matches = [
                    match
                    for own in self._below(folder).get(folded(parts[-1]) if parts else "", ())
                    if not any(part.lower() in not_in or _SMALLER.fullmatch(part) for part in own[:-1])
                    and (match := _compare(folder, own, parts)).path not in used
                ]
                most = max((match.rank for match in matches), default=())
                best = [match for match in matches if match.rank == most]
                if len(best) > 1:
                    return Match(several=tuple(match.path for match in best if match.path))
                if best:
                    return best[0]
        return Match()

    def _below(self, folder: Path) -> Mapping[str, Sequence[tuple[str, ...]]]:
        """Return the files below a folder, as path parts, by folded name."""
        if folder not in self._listed:
            names: dict[str, list[tuple[str, ...]]] = {}
            for parts in sorted(_walk(folder)):
                names.setdefault(folded(parts[-1]), []).append(parts)
            self._listed[folder] = names
        return self._listed[folder]


def folded(name: str) -> str:
    """Return a file name without letter case and Unicode form."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def in_any_case(home: Path, name: str) -> Path:
    """Return the path of ``name`` below ``home``, whose parts may have another letter case on disk (``Masks``).

    Prefers an exact match. Without a unique match, returns ``home / name``.
    """
    for part in Path(name).parts:
        if not (home / part).exists() and home.is_dir():
            alike = [entry for entry in os.listdir(home) if folded(entry) == folded(part)]
            part = alike[0] if len(alike) == 1 else part
        home = home / part
    return home


def name_below(path: Path, folders: Sequence[Path]) -> str:
    """Return the path relative to the first folder that contains it, else the whole path, with ``/``."""
    inside = next((path.relative_to(folder) for folder in folders if path.is_relative_to(folder)), None)
    return (inside or Path(*path.parts[1:])).as_posix()


def _parts(name: str) -> tuple[str, ...]:
    return tuple(part for part in name.replace("\\", "/").split("/") if part not in ("", "."))


def _walk(folder: Path) -> Iterator[tuple[str, ...]]:
    for at, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        above = Path(at).relative_to(folder).parts
        yield from ((*above, name) for name in files)


def _compare(folder: Path, own: Sequence[str], parts: Sequence[str]) -> Match:
    """Compare the end of a path below ``folder`` with a name of equal last part."""
    pairs = list(zip(reversed(own), reversed(parts), strict=False))
    agreed = next((i for i, (a, b) in enumerate(pairs) if folded(a) != folded(b)), len(pairs))
    form = sum(unicodedata.normalize("NFC", a) == unicodedata.normalize("NFC", b) for a, b in pairs[:agreed])
    same = sum(a == b for a, b in pairs[:agreed])
    return Match(Path(folder, *own), (agreed, form, same), elsewhere=agreed < len(pairs))


def _owns(name: str, owners: Mapping[str, tuple[int, ...]]) -> bool:
    """Whether a name matches a file better than all other names."""
    return all(owners[name] > rank for other, rank in owners.items() if other != name)


# -- photographs -------------------------------------------------------------------------------------------------------
_NO_NUMBER = re.compile(r"[+-]?(nan\(\w*\)|1\.#\w+)", re.IGNORECASE)
_BOXES = b"ftyp"  # signature of HEIC and AVIF; other files with such a suffix are read by content
_HEAD = 4096  # bytes that identify a file


def head(path: Path) -> bytes:
    """Return the first bytes of a file; b"" if it cannot be read."""
    try:
        with open(path, "rb") as file:
            return file.read(_HEAD)
    except OSError:
        return b""


def parsed(text: str) -> float:
    """Parse a number. ``-nan(ind)`` and ``1.#INF``, as C programs on Windows write them, are NaN.

    Raises ValueError if the text is not a number.
    """
    return math.nan if _NO_NUMBER.fullmatch(text) else float(text)


@dataclass(frozen=True)
class ImageFile:
    """The image file of a name in a camera file: path and name in the scene, or the reason why there is none."""

    path: Path | None
    name: str = ""
    reason: str = ""


def find_photographs(
    names: Sequence[str],
    folders: Sequence[Path],
    where: Path,
    *,
    base: Path | None = None,
    homes: Sequence[Path] = (),
    reason: str = "",
) -> dict[str, ImageFile]:
    """Find the image file of each name in a camera file; the suffix is optional (see ``Files`` for the rules).

    ``folders``: folders that may contain the images, most likely first. ``where``: the camera file. ``base``: base
    folder of relative paths. ``homes``: base folders of names in the scene; default: ``folders``. ``reason``: reason
    for a missing file; default: names the camera file. Raises DataError if several files fit a name equally well.
    """
    files = Files(folders, base)
    names = list(dict.fromkeys(names))
    matches = files.match([_spellings(name) for name in names], not_in=NO_PHOTOGRAPHS)
    homes = homes or folders
    paths = [match.path for match in matches if match.path is not None]
    if not any(path.is_relative_to(home) for path in paths for home in homes):
        homes = _shared(paths)
    photographs = {}
    for name, match in zip(names, matches, strict=True):
        if match.several:
            raise DataError(
                f"{where} must name one image, got {name}, which may be {match.several[0]} or {match.several[1]}; "
                "keep only one of them in the capture, or include the folder in the name"
            )
        if match.path is None:
            why = reason or f"listed in {where.name}, but there is no such file"
            other = files.of_stem(name, IMAGES, NO_PHOTOGRAPHS)
            if other is not None:
                why += f"; {other.parent.name}/{other.name} exists: use its suffix in the camera file"
            photographs[name] = ImageFile(None, reason=why)
        elif match.path.suffix.lower() in UNREAD and head(match.path)[4:8] == _BOXES:
            suffix = match.path.suffix.lower()
            photographs[name] = ImageFile(None, reason=f"{suffix[1:].upper()} cannot be read; {remedy(suffix)}")
        else:
            photographs[name] = ImageFile(match.path, name_below(match.path, homes))
    return photographs


def _shared(paths: Sequence[Path]) -> list[Path]:
    """Return the common folder of all files, if any."""
    try:
        return [Path(os.path.commonpath([path.parent for path in paths]))]
    except ValueError:  # no files, or on several drives
        return []


def _spellings(name: str) -> list[str]:
    if os.path.splitext(name)[1].lower() in IMAGES:
        return [name]
    return [name, *(name + suffix for suffix in IMAGES)]
