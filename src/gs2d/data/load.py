"""`load_scene`: find out what a folder holds and read it."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from gs2d.core.memory_limit import cache_bytes as room_for_cache
from gs2d.core.missing import instead, where_it_ends
from gs2d.data.build import Capture, build_scene
from gs2d.data.file_names import IMAGES, in_any_case
from gs2d.data.known_captures import missing_lines
from gs2d.data.masks import Masks, without_masks
from gs2d.data.readers.colmap import MODEL_FOLDERS, model_folder, read_colmap
from gs2d.data.readers.registry import READERS, Reader, register_reader
from gs2d.data.readers.transforms import CAMERAS, TRAIN, read_blender, read_nerfstudio
from gs2d.data.scene import Scene
from gs2d.errors import DataError

FORMATS = READERS.builtin


@dataclass(frozen=True)
class _Reader:
    """One of gs2d's own."""

    holds: Callable[[Path], object]
    make: Callable[[Path], Capture]
    looks_for: str

    def detect(self, path: Path) -> bool:
        return bool(self.holds(path))

    def read(self, path: Path, *, downscale: int) -> Capture:
        return self.make(path)


class _Colmap:
    """COLMAP keeps smaller photographs beside the large ones."""

    looks_for = f"cameras.bin and images.bin (or .txt) in {', '.join(MODEL_FOLDERS)} (COLMAP)"

    def detect(self, path: Path) -> bool:
        return model_folder(path) is not None

    def read(self, path: Path, *, downscale: int) -> Capture:
        return read_colmap(path, downscale)


def _register(name: str, holds: Callable[[Path], object], make: Callable[[Path], Capture], looks_for: str) -> None:
    made: Callable[[], _Reader] = partial(_Reader, holds, make, looks_for)
    made.__module__ = __name__
    register_reader(name)(made)


_register("blender", lambda root: in_any_case(root, TRAIN).is_file(), read_blender, f"{TRAIN} (Blender)")
_register("nerfstudio", lambda root: in_any_case(root, CAMERAS).is_file(), read_nerfstudio, f"{CAMERAS} (nerfstudio)")
register_reader("colmap")(_Colmap)

_PROJECTS = {  # files of other tools that do not hold cameras in the open
    ".psx": "in Metashape, File > Export > Export Cameras as Agisoft XML (cameras.xml)",
    ".mg": "take cameras.sfm of Meshroom's node StructureFromMotion, in its MeshroomCache",
    ".abc": "take cameras.sfm of Meshroom's node StructureFromMotion, which lies beside it",
    ".rcproj": "in RealityCapture, export the registration as COLMAP",
    ".rsproj": "in RealityScan, export the registration as COLMAP",
}
DEFAULT_CACHE_BYTES = 4 << 30  # 4 GiB of decoded pictures, where memory is not limited


def detect_format(path: str | os.PathLike[str]) -> str:
    """Return the format of a folder: one of FORMATS, or of a reader from elsewhere.

    Raises
    ------
    DataError
        Missing or empty folder, or no known layout; lists what was looked for.
    """
    root = _folder(path)
    looked_for = []
    readers = [(name, make()) for name, make in READERS.working()]
    for name, reader in sorted(readers, key=lambda pair: not getattr(pair[1], "before_colmap", False)):
        if reader.detect(root):
            return name
        looked_for.append(getattr(reader, "looks_for", ""))
    held = sorted(entry.name + ("/" if entry.is_dir() else "") for entry in root.iterdir())
    if not held:
        raise DataError(f"{root} must hold a capture, got an empty folder{instead(root, 'capture')}")
    if "run.json" in held:
        raise DataError(f"{root} must hold a capture, got a run{instead(root, 'capture')}")
    project = next((name for name in held if os.path.splitext(name)[1].lower() in _PROJECTS), None)
    if project is not None:
        remedy = _PROJECTS[os.path.splitext(project)[1].lower()]
        raise DataError(f"{root} must hold cameras that are written in the open, got {project}: {remedy}")
    lacking = missing_lines(root)
    hint = f"; as a scene of a known data set: {lacking[0]}" if lacking else ""
    images = next((folder for folder in (root, in_any_case(root, "images")) if _images(folder)), None)
    if images is not None and not lacking:
        raise DataError(
            f"{root} must hold cameras, got {_images(images)} photographs without any{instead(root, 'capture')}"
        )
    *others, last = filter(None, looked_for)
    raise DataError(
        f"{root} must hold {', '.join(others)} or {last}; "
        f"got {', '.join(held[:8])}{' ...' if len(held) > 8 else ''}{hint}"
    )


def _images(folder: Path) -> int:
    """Files of a folder that are photographs by their names."""
    paths = [path for path in folder.iterdir() if path.suffix.lower() in IMAGES] if folder.is_dir() else []
    return len(without_masks(paths))


def _folder(path: str | os.PathLike[str]) -> Path:
    root = Path(path)
    try:
        os.listdir(root)
    except (FileNotFoundError, NotADirectoryError) as error:
        got = f"a file{instead(root, 'capture')}" if root.exists() else f"no such folder{where_it_ends(root)}"
        raise DataError(f"{root} must be the folder of a capture, got {got}") from error
    except OSError as error:
        raise DataError(f"cannot read the folder {root}: {error.strerror or error}") from error
    return root


def reader_of(format: str) -> Reader:
    """Return the reader of a format.

    Raises
    ------
    DataError
        There is none of this name, or its package cannot be imported.
    """
    if format not in READERS:
        raise DataError(READERS.unknown(format, also=("auto",)))
    return READERS.get(format)()


def load_scene(
    path: str | os.PathLike[str],
    *,
    format: str = "auto",
    downscale: int = 1,
    test_every: int | None = None,
    cache_bytes: int | None = None,
    masks: str | os.PathLike[str] | None = None,
    masked: str | None = None,
) -> Scene:
    """Read a capture; nothing is decoded but image headers, and nothing is ever written.

    Parameters
    ----------
    path : path
        The capture's folder.
    format : str
        One of FORMATS, that of a reader from elsewhere, or "auto": by the files that are there.
    downscale : int
        Area-filter the photographs by this whole factor (COLMAP: ``images_N`` is used where it exists).
    test_every : int or None
        Every n-th view (sorted by name, from the first) is a test view where the data set has no split of its own;
        0 = all views train. None: 8, and 0 for DTU (whose protocol trains on all views).
    cache_bytes : int
        Bound on decoded pictures held in memory. None: ``DEFAULT_CACHE_BYTES``, or a fifth of what the limits in force
        (control group, address space, the machine) leave this process.
    masks : path, optional
        Folder of masks (white = keep) of another place than tools put them; those are found without it.
    masked : str, optional
        What a black pixel of a mask is: "ignore", it takes part in nothing; "empty", nothing is there, as an alpha
        channel says; "off", masks are not used. None: ignored, where the protocol uses masks.

    Returns
    -------
    Scene
        Views with their cameras and splits, and the sparse points; images are decoded when they are used.

    Raises
    ------
    DataError
        If a file is missing or wrong; the message says what to do.

    Examples
    --------
    >>> scene = gs2d.load_scene("captures/garden", downscale=4)  # doctest: +SKIP
    >>> len(scene.train), len(scene.test)  # doctest: +SKIP
    (161, 24)
    """
    root = _folder(path)
    if format == "auto":
        format = detect_format(root)
    reader = reader_of(format)
    if downscale < 1:
        raise DataError(f"downscale must be a whole number >= 1, got {downscale}")
    if cache_bytes is None:
        cache_bytes = room_for_cache(DEFAULT_CACHE_BYTES)
    chosen = Masks(None if masks is None else _folder(masks), masked)
    capture = reader.read(root, downscale=downscale)
    if isinstance(capture, Scene):
        if masks is not None or masked is not None:
            raise DataError(f"format {format} has masks of its own, got masks or masked; leave them out")
        if downscale > 1:
            raise DataError(f"format {format} cannot be shrunk when it is read, got downscale {downscale}; use 1")
        return replace(capture, own_split=True)
    return build_scene(capture, root, downscale=downscale, test_every=test_every, cache_bytes=cache_bytes, masks=chosen)
