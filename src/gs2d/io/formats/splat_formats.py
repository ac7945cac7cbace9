"""Splat files by format: the writers and the readers that are registered, and what a file of splats holds."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.config.registry import Registry
from gs2d.core.missing import instead
from gs2d.core.splats import Splats
from gs2d.errors import DataError
from gs2d.io import splat_ply
from gs2d.io.formats.spz import read_spz, write_spz
from gs2d.io.gaussians import NO_SCALE, Gaussians, Tell, logit
from gs2d.io.splat_ply import ply_kind, read_gaussians

Writer = Callable[[Path, Splats], tuple[str, ...] | None]
Reader = Callable[[str | os.PathLike[str], Tell], tuple[Gaussians, str]]


@dataclass(frozen=True)
class Layout:
    """A format in which splats are written.

    Attributes
    ----------
    ending : str
        Ending of the file names. One that begins with / is a whole name, of a file with others beside it.
    write : callable
        Writes a file and returns a sentence for each thing that the format cannot store.
    size : callable or None
        Returns the bytes of all files that belong to a written one; None: it is one file.
    """

    ending: str
    write: Writer
    size: Callable[[Path], int] | None = None


@dataclass(frozen=True)
class SplatReader:
    """A format from which splats are read.

    Attributes
    ----------
    endings : tuple of str
        Endings of the file names; one that begins with / is a whole name.
    read : callable
        Takes a path and a function that receives notes; returns the Gaussians, and the kind of file in words ("2dgs"
        for flat splats).
    ply_kind : str or None
        Reads the PLY files that ``splat_ply.ply_kind`` calls so.
    mesh : callable or None
        Returns the facts of a mesh in a file that holds one instead of splats, or None.
    """

    endings: tuple[str, ...]
    read: Reader
    ply_kind: str | None = None
    mesh: Callable[[Path], dict[str, Any] | None] | None = None


LAYOUTS: Registry[Layout] = Registry(
    "layout",
    "gs2d.formats",
    builtin=dict.fromkeys(("3dgs", "2dgs", "spz", "spz4"), __name__),
    error=DataError,
)
"""Names of formats that splats are written in. Of two with one ending, the first is chosen by a file's name."""

SPLAT_READERS: Registry[SplatReader] = Registry(
    "splat reader", "gs2d.splat_readers", builtin={"spz": __name__}, error=DataError
)
"""Names of formats, other than PLY of 2DGS and 3DGS, that splats are read from."""


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
        Name of the layout, for ``layout=`` and ``gs2d export --format``; must not be taken.
    ending : str
        Ending of the file names, with its dot; one that begins with / is a whole file name.
    size : callable, optional
        As in ``Layout``, for formats that consist of several files.

    Returns
    -------
    callable
        Decorates a function ``(path, splats)`` that writes the file. It returns a tuple with one sentence for each
        thing that the format cannot store, or None.

    Raises
    ------
    DataError
        From the decorator: the name is taken.

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
        Name of the format; must not be taken by another reader.
    endings : tuple of str
        Endings of the file names, with their dots; one that begins with / is a whole file name.
    ply_kind, mesh : optional
        As in ``SplatReader``.

    Returns
    -------
    callable
        Decorates a function ``(path, tell)`` that returns ``gs2d.io.gaussians.Gaussians`` and the kind of file in
        words, and calls ``tell`` with a sentence on each thing that it left out.

    Raises
    ------
    DataError
        From the decorator: the name is taken.
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


@register_format("spz", ending=".spz")
def _write_spz(path: Path, splats: Splats) -> tuple[str, ...]:
    return write_spz(path, Gaussians.of(splats))


@register_format("spz4", ending=".spz")
def _write_spz4(path: Path, splats: Splats) -> tuple[str, ...]:
    return write_spz(path, Gaussians.of(splats), version=4)


@register_splat_reader("spz", endings=(".spz",))
def _read_spz(path: str | os.PathLike[str], tell: Tell) -> tuple[Gaussians, str]:
    gaussians, version = read_spz(path, tell)
    return gaussians, f"SPZ version {version}"


def endings() -> tuple[str, ...]:
    """Return the endings of file names that gs2d writes splats to, each once."""
    return tuple(dict.fromkeys(layout.ending for _, layout in LAYOUTS.working(LAYOUTS.builtin)))


@dataclass(frozen=True, eq=False)
class SplatFile:
    """What a file of splats holds: the kind of file in words, and its Gaussians (flat where ``surfels`` are there).

    ``notes`` are sentences on what was left out.
    """

    kind: str
    gaussians: Gaussians
    surfels: Splats | None
    notes: tuple[str, ...] = ()


def layout_of(path: Path) -> str | None:
    """Return the layout that a file is written in by the longest ending that fits its name, gs2d's own first."""
    name = f"/{path.name}".lower()
    for names in (LAYOUTS.builtin, LAYOUTS.guests()):
        fits = [(key, layout.ending) for key, layout in LAYOUTS.working(names) if name.endswith(layout.ending)]
        if fits:
            return max(fits, key=lambda fit: len(fit[1]))[0]
    return None


def write_layout(path: Path, splats: Splats, layout: str) -> tuple[str, ...]:
    """Write splats in a layout of ``LAYOUTS``, atomically; what it could not hold, one sentence each."""
    return LAYOUTS.get(layout).write(path, splats) or ()


def write_splats(path: str | os.PathLike[str], splats: Splats, *, layout: str | None = "2dgs") -> None:
    """Write splats to a file, as ``gs2d export`` does: the whole file, or nothing.

    Parameters
    ----------
    path : path
    splats : Splats
        On any device.
    layout : str, optional
        "2dgs" (the PLY of the official code: float32 bit for bit), "3dgs" (the PLY that viewers open), "compressed",
        "spz", "spz4", "splat", "usd", "gltf", "sog", "streamed", or a registered format. None: by the ending of
        ``path``, where .ply is "3dgs".

    Raises
    ------
    DataError
        If no format has this name or ending, or the layout needs another ending.
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
        known = ", ".join(endings()).replace("/", "")
        raise DataError(f"splats are written as {known}, got {path}; choose such a name, or give a layout")
    ending = LAYOUTS.get(chosen).ending
    if not f"/{path.name}".lower().endswith(ending):
        raise DataError(
            f"layout {chosen} is a {ending.removeprefix('/')} file, got {path}; choose such a name, or layout=None for "
            "the format of the ending"
        )
    for note in write_layout(path, splats, chosen):
        warnings.warn(f"{path.name}: {note}", stacklevel=2)


def written_bytes(path: Path, layout: str) -> int:
    """Return the bytes of what was written, of all files that belong to it."""
    size = LAYOUTS.get(layout).size
    return path.stat().st_size if size is None else size(path)


def _read_ply(path: str | os.PathLike[str], tell: Tell) -> tuple[Gaussians, str]:
    kind = ply_kind(path)
    for _, reader in SPLAT_READERS.working():
        if reader.ply_kind == kind:
            return reader.read(path, tell)
    if kind == "3dgs":
        return read_gaussians(path, tell), "3dgs (three scales, for viewers)"
    return Gaussians.of(splat_ply.read_splats(path, tell)), "2dgs"  # names another kind


def reader_of(path: str | os.PathLike[str]) -> SplatReader | None:
    """Return the reader of a file that is no PLY by its name, or None."""
    name = str(Path(path).absolute()).lower().replace(os.sep, "/")
    return next((reader for _, reader in SPLAT_READERS.working() if name.endswith(reader.endings)), None)


def is_splat_file(path: str | os.PathLike[str]) -> bool:
    """Whether a file is one of splats that are no PLY, by its ending."""
    return reader_of(path) is not None


def read_splat_file(path: str | os.PathLike[str]) -> SplatFile:
    """Read splats of any format that is written here, and 3DGS.

    A log scale of -inf is a scale of 0, an infinite opacity logit an opaque or an empty splat. Splats with any other
    number that is not finite are left out, which the notes say.

    Raises
    ------
    DataError
        Missing, broken, or no splats.
    """
    notes: list[str] = []
    reader = reader_of(path)
    gaussians, kind = _read_ply(path, notes.append) if reader is None else reader.read(path, notes.append)
    gaussians = _finite(_mended(gaussians), path, notes.append)
    flat = kind == "2dgs" or gaussians.is_flat
    return SplatFile(kind, gaussians, gaussians.disks() if flat else None, tuple(dict.fromkeys(notes)))


def read_splats(path: str | os.PathLike[str], tell: Tell = warnings.warn) -> Splats:
    """Read flat splats from a file of any format that gs2d writes.

    Parameters
    ----------
    path : path
        PLY (2DGS, 3DGS or compressed), .spz, .splat, .usd, .glb or .sog.
    tell : callable
        Receives a sentence on splats or SH bands that were left out (default: a Python warning).

    Returns
    -------
    Splats
        float32 on the CPU; those of a 2DGS PLY are the stored numbers.

    Raises
    ------
    DataError
        If the file is missing, broken, holds no splats, or holds 3D Gaussians with three scales.

    Examples
    --------
    >>> splats = gs2d.read_splats("runs/garden/splats.ply")  # doctest: +SKIP
    """
    if not is_splat_file(path) and Path(path).is_file():
        with open(path, "rb") as opened:
            if opened.read(3) != b"ply":
                raise DataError(f"{path} must be a file of splats or a run folder{instead(Path(path), 'run')}")
    file = read_splat_file(path)
    for note in file.notes:
        tell(note)
    return file.gaussians.to_surfels(path) if file.surfels is None else file.surfels


def read_surfels(path: str | os.PathLike[str], tell: Tell = warnings.warn) -> tuple[Splats, str]:
    """Read the splats of a file to start a training from, and say in words what they were.

    Flat ones are as they are. 3D Gaussians lose their smallest scale, whose axis becomes the normal
    (:meth:`gs2d.io.gaussians.Gaussians.flattened`). ``tell`` is that of ``read_splats``.

    Raises
    ------
    DataError
        Missing, broken, or without splats.
    """
    found = {"mesh": "a mesh", "points": "a point cloud"}.get("" if is_splat_file(path) else ply_kind(path))
    if found is not None:
        raise DataError(
            f"{os.fspath(path)} must hold splats to start from, of 2DGS or 3DGS, got {found}; give the splats.ply of a "
            "run, or what `gs2d export` writes"
        )
    file = read_splat_file(path)
    for note in file.notes:
        tell(note)
    if len(file.gaussians) == 0:
        raise DataError(f"{os.fspath(path)} must hold splats to start from, got none; give a file with some")
    if file.surfels is not None:
        return file.surfels, "flat splats"
    return file.gaussians.flattened(), "3D Gaussians without their smallest scales, whose axes are the normals now"


def _mended(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians whose scales of 0, and opaque and empty opacities, have finite logarithms and logits.

    Other programs write these as infinite numbers (SplatTransform: the logits of bytes of 255 and 0).
    """
    logits, scales = gaussians.opacity_logits, gaussians.log_scales
    ends = logit((logits > 0).astype(np.float32))
    return replace(
        gaussians,
        opacity_logits=np.where(np.isinf(logits), ends, logits),
        log_scales=np.where(np.isneginf(scales), np.float32(NO_SCALE), scales),
    )


def _finite(gaussians: Gaussians, path: str | os.PathLike[str], tell: Tell) -> Gaussians:
    """Return the Gaussians without those with NaN or infinity, of which ``tell`` hears."""
    finite = {}
    for field in fields(gaussians):
        values = getattr(gaussians, field.name)
        finite[field.name] = np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    kept = np.logical_and.reduce(list(finite.values()))
    if kept.all():
        return gaussians
    count, among = int((~kept).sum()), ", ".join(name for name, rows in finite.items() if not rows.all())
    got = f"{count:,} of {len(gaussians):,} splats have NaN or infinity ({among})"
    if not kept.any():
        raise DataError(f"{os.fspath(path)}: finite numbers were expected, {got}; export the file again")
    tell(f"{Path(path).name}: {got} and were left out")
    return gaussians.rows(kept)
