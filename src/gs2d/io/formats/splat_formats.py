"""Read and write splat files by format, with registered writers and readers."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.config.registry import Registry
from gs2d.core.missing import suggestion
from gs2d.core.splats import Splats
from gs2d.errors import DataError
from gs2d.io import splat_ply
from gs2d.io.gaussians import NO_SCALE, Gaussians, Warn, logit
from gs2d.io.splat_ply import ply_kind, read_gaussians

Writer = Callable[[Path, Splats], tuple[str, ...] | None]
Reader = Callable[[str | os.PathLike[str], Warn], tuple[Gaussians, str]]


@dataclass(frozen=True)
class Layout:
    """A format in which splats are written."""

    ending: str  # suffix of the file names. If it begins with /, it is the whole name of a file with others beside it.
    write: Writer  # writes a file and returns a message for each thing that the format cannot store
    # Returns the size in bytes of all files that belong to a written one; None if it is a single file.
    size: Callable[[Path], int] | None = None


@dataclass(frozen=True)
class SplatReader:
    """A format from which splats are read."""

    endings: tuple[str, ...]  # suffixes of the file names; those that begin with / are whole names
    # Reads a path, with a function that receives messages; returns the Gaussians and a description of the kind of file
    # ("2dgs" for flat splats).
    read: Reader
    ply_kind: str | None = None  # kind of PLY files, from ``splat_ply.ply_kind``, that it reads
    # Returns statistics of a file that contains a mesh instead of splats, or None.
    mesh: Callable[[Path], dict[str, Any] | None] | None = None


LAYOUTS: Registry[Layout] = Registry(
    "layout",
    "gs2d.formats",
    builtin=dict.fromkeys(("3dgs", "2dgs"), __name__),
    error=DataError,
)
"""Formats for writing, by name. If two have the same suffix, the first is the default for file names."""

SPLAT_READERS: Registry[SplatReader] = Registry("splat reader", "gs2d.splat_readers", error=DataError)
"""Formats for reading, by name, in addition to PLY files of 2DGS and 3DGS."""


def register_format(
    name: str,
    *,
    ending: str,
    size: Callable[[Path], int] | None = None,
) -> Callable[[Writer], Writer]:
    """Return a decorator that registers an export format, for ``Splats.save`` and ``gs2d export``.

    Parameters
    ----------
    name : str
        Name of the layout, for ``layout=`` and ``gs2d export --format``; must be unique.
    ending : str
        Suffix of the file names, with its dot; if it begins with /, it is the whole file name.
    size : callable, optional
        As in ``Layout``, for formats that consist of several files.

    Returns
    -------
    callable
        Decorates a function ``(path, splats)`` that writes the file. It returns a tuple with a message for each thing
        that the format cannot store, or None.

    Examples
    --------
    >>> import gs2d, numpy as np
    >>> @gs2d.register_format("xyz", ending=".xyz")
    ... def write_xyz(path, splats):
    ...     np.savetxt(path, splats.means.detach().cpu().numpy())
    ...     return ("only the centres were written",)
    """

    def registered(write: Writer) -> Writer:
        LAYOUTS.register(name, module=write.__module__)(Layout(ending, write, size))
        return write

    return registered


def register_splat_reader(
    name: str,
    *,
    endings: tuple[str, ...] = (),
    ply_kind: str | None = None,
    mesh: Callable[[Path], dict[str, Any] | None] | None = None,
) -> Callable[[Reader], Reader]:
    """Return a decorator that registers a reader of splat files, for ``read_splats`` and every command that reads them.

    Parameters
    ----------
    name : str
        Name of the format; must be unique.
    endings : tuple of str
        Suffixes of the file names, with their dots; those that begin with / are whole file names.
    ply_kind, mesh : optional
        As in ``SplatReader``.

    Returns
    -------
    callable
        Decorates a function ``(path, warn)`` that returns ``gs2d.io.gaussians.Gaussians`` and a description of the
        kind of file, and calls ``warn`` with a message about dropped content.
    """

    def registered(read: Reader) -> Reader:
        reader = SplatReader(endings, read, ply_kind, mesh)
        SPLAT_READERS.register(name, module=read.__module__)(reader)
        return read

    return registered


@register_format("3dgs", ending=".ply")
def _write_3dgs(path: Path, splats: Splats) -> None:
    splat_ply.write_splats(path, splats, layout="3dgs")


@register_format("2dgs", ending=".ply")
def _write_2dgs(path: Path, splats: Splats) -> None:
    splat_ply.write_splats(path, splats, layout="2dgs")


def endings() -> tuple[str, ...]:
    """Return the suffixes of the built-in formats for writing."""
    return tuple(dict.fromkeys(layout.ending for _, layout in LAYOUTS.working(LAYOUTS.builtin)))


@dataclass(frozen=True, eq=False)
class SplatFile:
    """Content of a splat file: a description of its kind, the Gaussians, and the disks if they are flat.

    ``notes`` are messages about dropped content.
    """

    kind: str
    gaussians: Gaussians
    surfels: Splats | None
    notes: tuple[str, ...] = ()


def layout_of(path: Path) -> str | None:
    """Return the layout with the longest suffix that matches a file name, built-in layouts first; None without any."""
    name = f"/{path.name}".lower()
    for names in (LAYOUTS.builtin, LAYOUTS.guests()):
        fits = [(key, layout.ending) for key, layout in LAYOUTS.working(names) if name.endswith(layout.ending)]
        if fits:
            return max(fits, key=lambda fit: len(fit[1]))[0]
    return None


def write_layout(path: Path, splats: Splats, layout: str) -> tuple[str, ...]:
    """Write splats in a layout of ``LAYOUTS``, atomically; returns messages about what it cannot store."""
    return LAYOUTS.get(layout).write(path, splats) or ()


def write_splats(path: str | os.PathLike[str], splats: Splats, *, layout: str | None = "2dgs") -> None:
    """Write splats to a file, as ``gs2d export`` does. The file is written completely or not at all.

    Parameters
    ----------
    path : path
    splats : Splats
        On any device.
    layout : str, optional
        "2dgs" (PLY of the official code, exact float32), "3dgs" (PLY for viewers), "compressed", "spz", "spz4",
        "splat", "usd", "gltf", "sog", "streamed", or a registered format. None selects it by the suffix of ``path``,
        where .ply is "3dgs".

    Raises
    ------
    DataError
        If no format has this name or suffix, or the layout needs another suffix.
    DiskError
        If the file could not be written.

    Warns
    -----
    UserWarning
        For each thing that the format cannot store.

    Examples
    --------
    >>> gs2d.write_splats("garden.ply", trained.splats)  # doctest: +SKIP
    >>> gs2d.write_splats("garden.spz", trained.splats, layout=None)  # doctest: +SKIP
    """
    path = Path(path)
    chosen = layout_of(path) if layout is None else layout
    if chosen is None:
        suffixes = ", ".join(endings()).replace("/", "")
        raise DataError(f"splats are written as {suffixes}, got {path}; choose such a name, or set the layout")
    ending = LAYOUTS.get(chosen).ending
    if not f"/{path.name}".lower().endswith(ending):
        raise DataError(
            f"layout {chosen} needs a {ending.removeprefix('/')} file, got {path}; choose such a name, or use "
            "layout=None for the format of the suffix"
        )
    for note in write_layout(path, splats, chosen):
        warnings.warn(f"{path.name}: {note}", stacklevel=2)


def written_bytes(path: Path, layout: str) -> int:
    """Return the size in bytes of a written file, with all files that belong to it."""
    size = LAYOUTS.get(layout).size
    return path.stat().st_size if size is None else size(path)


def _read_ply(path: str | os.PathLike[str], warn: Warn) -> tuple[Gaussians, str]:
    kind = ply_kind(path)
    for _, reader in SPLAT_READERS.working():
        if reader.ply_kind == kind:
            return reader.read(path, warn)
    if kind == "3dgs":
        return read_gaussians(path, warn), "3dgs (three scales, for viewers)"
    return Gaussians.of(splat_ply.read_splats(path, warn)), "2dgs"  # raises for other kinds


def reader_of(path: str | os.PathLike[str]) -> SplatReader | None:
    """Return the reader for the name of a file, or None; PLY files have none."""
    name = str(Path(path).absolute()).lower().replace(os.sep, "/")
    return next((reader for _, reader in SPLAT_READERS.working() if name.endswith(reader.endings)), None)


def is_splat_file(path: str | os.PathLike[str]) -> bool:
    """Return whether the name of a file is that of a splat format other than PLY."""
    return reader_of(path) is not None


def read_splat_file(path: str | os.PathLike[str]) -> SplatFile:
    """Read a splat file of any format.

    A log scale of -inf is a scale of 0; infinite opacity logits are opaque or empty splats. Splats with other
    non-finite numbers are dropped, with a note. Raises DataError if the file is missing, broken, or contains no splats.
    """
    notes: list[str] = []
    reader = reader_of(path)
    gaussians, kind = _read_ply(path, notes.append) if reader is None else reader.read(path, notes.append)
    gaussians = _finite(_mended(gaussians), path, notes.append)
    flat = kind == "2dgs" or gaussians.is_flat
    return SplatFile(kind, gaussians, gaussians.disks() if flat else None, tuple(dict.fromkeys(notes)))


def read_splats(path: str | os.PathLike[str], warn: Warn = warnings.warn) -> Splats:
    """Read flat splats from a file of any format that gs2d writes.

    Parameters
    ----------
    path : path
        PLY (2DGS, 3DGS or compressed), .spz, .splat, .usd, .glb or .sog.
    warn : callable
        Receives a message if splats or SH bands are dropped (default: a Python warning).

    Returns
    -------
    Splats
        float32 on the CPU; exact for a 2DGS PLY.

    Raises
    ------
    DataError
        If the file is missing or broken, or contains no splats or 3D Gaussians with three scales.

    Examples
    --------
    >>> splats = gs2d.read_splats("runs/garden/splats.ply")  # doctest: +SKIP
    """
    if not is_splat_file(path) and Path(path).is_file():
        with open(path, "rb") as opened:
            if opened.read(3) != b"ply":
                raise DataError(f"{path} must be a file of splats or a run folder{suggestion(Path(path), 'run')}")
    file = read_splat_file(path)
    for note in file.notes:
        warn(note)
    return file.gaussians.to_surfels(path) if file.surfels is None else file.surfels


def read_surfels(path: str | os.PathLike[str], warn: Warn = warnings.warn) -> tuple[Splats, str]:
    """Return splats for the start of a training, and a description of them.

    3D Gaussians lose their smallest scale, whose axis becomes the normal
    (:meth:`gs2d.io.gaussians.Gaussians.flattened`). ``warn`` receives messages about dropped content. Raises DataError
    if the file is missing, broken, or contains no splats.
    """
    other = {"mesh": "a mesh", "points": "a point cloud"}.get("" if is_splat_file(path) else ply_kind(path))
    if other is not None:
        raise DataError(
            f"{os.fspath(path)} must contain splats of 2DGS or 3DGS, got {other}; use the splats.ply of a run, or a "
            "file of `gs2d export`"
        )
    file = read_splat_file(path)
    for note in file.notes:
        warn(note)
    if len(file.gaussians) == 0:
        raise DataError(f"{os.fspath(path)} must contain splats, got an empty file; use another file")
    if file.surfels is not None:
        return file.surfels, "flat splats"
    return file.gaussians.flattened(), "3D Gaussians, flattened along their smallest scales"


def _mended(gaussians: Gaussians) -> Gaussians:
    """Replace infinite log scales and logits, which other programs write for scales of 0 and opacities of 0 and 1."""
    logits, scales = gaussians.opacity_logits, gaussians.log_scales
    ends = logit((logits > 0).astype(np.float32))
    return replace(
        gaussians,
        opacity_logits=np.where(np.isinf(logits), ends, logits),
        log_scales=np.where(np.isneginf(scales), np.float32(NO_SCALE), scales),
    )


def _finite(gaussians: Gaussians, path: str | os.PathLike[str], warn: Warn) -> Gaussians:
    """Drop Gaussians with NaN or infinity; ``warn`` receives a message about them."""
    finite = {}
    for field in fields(gaussians):
        values = getattr(gaussians, field.name)
        finite[field.name] = np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    keep = np.logical_and.reduce(list(finite.values()))
    if keep.all():
        return gaussians
    count, among = int((~keep).sum()), ", ".join(name for name, rows in finite.items() if not rows.all())
    problem = f"{count:,} of {len(gaussians):,} splats have NaN or infinity ({among})"
    if not keep.any():
        raise DataError(f"{os.fspath(path)}: expected finite numbers, but {problem}; export the file again")
    warn(f"{Path(path).name}: {problem} and were dropped")
    return gaussians.rows(keep)
