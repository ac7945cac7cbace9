"""Find files by the names that camera files use: paths of another machine, another case, another Unicode form."""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

IMAGES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".avif", ".heic", ".heif", ".exr")
#: folders below a capture that hold images of the photographs' names, but no photographs
NO_PHOTOGRAPHS = frozenset({"mask", "masks", "depths", "normals", "depthmaps", "undistorted", "thumbnails"})
_SMALLER = re.compile(r"images_\d+")  # of smaller copies of the photographs


@dataclass(frozen=True)
class Match:
    """The file that a name stands for.

    Attributes
    ----------
    path : Path or None
        None if no file fits, or if several fit equally well.
    rank : tuple of int
        How well the path agrees with the name; a longer common end is larger.
    elsewhere : bool
        The folders of the file and of the name differ.
    several : tuple of Path
        The files that fit equally well, if there is more than one.
    """

    path: Path | None = None
    rank: tuple[int, ...] = ()
    elsewhere: bool = False
    several: tuple[Path, ...] = ()


class Files:
    r"""Find files below some folders by the names that a camera file uses; list each folder at most once.

    A name stands for the file at that path: absolute, or relative to ``base`` or one of the folders. If there is no
    such file, the longest end of the path that names one file below a folder counts. ``\\`` and ``/`` are both
    separators, and case and Unicode form (NFC, NFD) matter only if several files differ in nothing else.

    Parameters
    ----------
    folders : sequence of Path
        Where files may be, most likely first; sub-folders count too, except hidden and linked ones. Folders that do
        not exist are passed over.
    base : Path, optional
        Folder that relative paths are relative to; tried before ``folders``.
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
        taken: Collection[Path] = (),
        moved: bool = True,
    ) -> list[Match]:
        """Return the file of each name.

        Names are matched together: no two names get the same file by an end of their paths, because at least one
        would be wrong. For the same reason, a file in a folder that contradicts the name (``left/1.png`` for
        ``right/1.png``) is used only if no name has a file in its own folder.

        Parameters
        ----------
        names : sequence of sequences of str
            The spellings of each name, most likely first.
        not_in : collection of str
            Names of folders, in lower case, whose files do not count unless a name is their path.
        taken : collection of Path
            Files that do not count unless a name is their path.
        moved : bool, optional
            Whether files in folders that contradict their names may count at all.
        """
        found = [self._exact(spellings) for spellings in names]
        owned = {match.path for match in found if match.path is not None} | set(taken)
        found = [
            match if match.path else self._best(spellings, not_in, owned)
            for match, spellings in zip(found, names, strict=True)
        ]
        if not moved or any(match.path and not match.elsewhere for match in found):
            found = [Match() if match.elsewhere else match for match in found]
        owners: dict[Path, dict[str, tuple[int, ...]]] = {}
        for match, spellings in zip(found, names, strict=True):
            if match.path is not None and match.rank:
                owners.setdefault(match.path, {})[spellings[0]] = match.rank
        return [
            Match() if match.path and match.rank and not _owns(spellings[0], owners[match.path]) else match
            for match, spellings in zip(found, names, strict=True)
        ]

    def of_stem(self, name: str, suffixes: Collection[str], not_in: Collection[str] = ()) -> Path | None:
        """Return a file that differs from a name in its extension alone, which is one of ``suffixes``."""
        stem = os.path.splitext(name)[0]
        match = self._best([stem + suffix for suffix in suffixes], not_in, ())
        return None if match.elsewhere else match.path

    def _exact(self, spellings: Sequence[str]) -> Match:
        """Return the file whose path is the name."""
        for base in self._bases:
            for name in spellings:
                path = base / name.replace("\\", "/")
                if self._is_file(path):
                    return Match(path)
        return Match()

    def _is_file(self, path: Path) -> bool:
        """Whether a path is a file; it is asked of the file system only if its folder lists the name."""
        folder, name = os.path.split(path)
        if folder not in self._entries:
            try:
                self._entries[folder] = frozenset(os.listdir(folder))
            except (OSError, ValueError):  # no such folder, or a name that none can have
                self._entries[folder] = frozenset()
        return name in self._entries[folder] and os.path.isfile(path)

    def _best(self, spellings: Sequence[str], not_in: Collection[str], taken: Collection[Path | None]) -> Match:
        """Return the file whose path has the longest end in common with the name."""
        for folder in self._folders:
            for name in spellings:
                parts = _parts(name)
                matches = [
                    match
                    for own in self._below(folder).get(folded(parts[-1]) if parts else "", ())
                    if not any(part.lower() in not_in or _SMALLER.fullmatch(part) for part in own[:-1])
                    and (match := _compare(folder, own, parts)).path not in taken
                ]
                most = max((match.rank for match in matches), default=())
                best = [match for match in matches if match.rank == most]
                if len(best) > 1:
                    return Match(several=tuple(match.path for match in best if match.path))
                if best:
                    return best[0]
        return Match()

    def _below(self, folder: Path) -> Mapping[str, Sequence[tuple[str, ...]]]:
        """Return the files below a folder, as parts of their paths, by their folded names."""
        if folder not in self._listed:
            names: dict[str, list[tuple[str, ...]]] = {}
            for parts in sorted(_walk(folder)):
                names.setdefault(folded(parts[-1]), []).append(parts)
            self._listed[folder] = names
        return self._listed[folder]


def folded(name: str) -> str:
    """Return a file name without differences of case and of Unicode form."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def in_any_case(home: Path, name: str) -> Path:
    """Return the file or folder ``name`` below ``home``; its parts may be in other letters (``Masks``) on the disk.

    An exact match is preferred. If there is none, and not just one that differs in case, this is ``home / name``.
    """
    for part in Path(name).parts:
        if not (home / part).exists() and home.is_dir():
            alike = [entry for entry in os.listdir(home) if folded(entry) == folded(part)]
            part = alike[0] if len(alike) == 1 else part
        home = home / part
    return home


def files_ending(folder: Path, ending: str) -> list[Path]:
    """Return the entries of a folder whose names end in ``ending``, in any case, sorted by name."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() == ending)


def name_below(path: Path, folders: Sequence[Path]) -> str:
    """Return the path of a file below the first of the folders that holds it, else its whole path, with ``/``."""
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
    """Compare the end of a file's path below ``folder`` with that of a name; the last parts are alike."""
    pairs = list(zip(reversed(own), reversed(parts), strict=False))
    agreed = next((i for i, (a, b) in enumerate(pairs) if folded(a) != folded(b)), len(pairs))
    form = sum(unicodedata.normalize("NFC", a) == unicodedata.normalize("NFC", b) for a, b in pairs[:agreed])
    same = sum(a == b for a, b in pairs[:agreed])
    return Match(Path(folder, *own), (agreed, form, same), elsewhere=agreed < len(pairs))


def _owns(name: str, owners: Mapping[str, tuple[int, ...]]) -> bool:
    """Whether a name agrees better with a file than all others that fit it."""
    return all(owners[name] > rank for other, rank in owners.items() if other != name)
