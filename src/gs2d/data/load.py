"""`load_scene`: detect the format of a capture and read it."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from gs2d.core.memory_limit import cache_bytes as room_for_cache
from gs2d.core.missing import path_hint, suggestion
from gs2d.data.build import build_scene
from gs2d.data.file_names import IMAGES, in_any_case
from gs2d.data.known_captures import missing_lines
from gs2d.data.masks import Masks, without_masks
from gs2d.data.readers.capture_readers import READERS, Reader
from gs2d.data.scene import Scene
from gs2d.errors import DataError

FORMATS = READERS.builtin


_PROJECTS = {  # project files of other tools, which must be exported first
    ".psx": "in Metashape, use File > Export > Export Cameras as Agisoft XML (cameras.xml)",
    ".mg": "use cameras.sfm of Meshroom's node StructureFromMotion, in its MeshroomCache",
    ".abc": "use cameras.sfm of Meshroom's node StructureFromMotion, in the same folder",
    ".rcproj": "in RealityCapture, export the registration as COLMAP",
    ".rsproj": "in RealityScan, export the registration as COLMAP",
}
DEFAULT_CACHE_BYTES = 4 << 30  # of decoded images, if memory is not limited


def detect_format(path: str | os.PathLike[str]) -> str:
    """Return the format of a folder: one of FORMATS, or that of a third-party reader.

    Raises DataError if the folder is missing, empty or of unknown format; lists the expected files.
    """
    root = _folder(path)
    expected = []
    readers = [(name, make()) for name, make in READERS.working()]
    for name, reader in sorted(readers, key=lambda pair: not getattr(pair[1], "before_colmap", False)):
        if reader.detect(root):
            return name
        expected.append(getattr(reader, "looks_for", ""))
    entries = sorted(entry.name + ("/" if entry.is_dir() else "") for entry in root.iterdir())
    if not entries:
        raise DataError(f"{root} must hold a capture, got an empty folder{suggestion(root, 'capture')}")
    if "run.json" in entries:
        raise DataError(f"{root} must hold a capture, got a run{suggestion(root, 'capture')}")
    project = next((name for name in entries if os.path.splitext(name)[1].lower() in _PROJECTS), None)
    if project is not None:
        remedy = _PROJECTS[os.path.splitext(project)[1].lower()]
        raise DataError(f"{root} must contain exported cameras, got the project file {project}: {remedy}")
    missing = missing_lines(root)
    hint = f"; {missing[0]}" if missing else ""
    images = next((folder for folder in (root, in_any_case(root, "images")) if _images(folder)), None)
    if images is not None and not missing:
        raise DataError(
            f"{root} must contain cameras, got {_images(images)} images without cameras{suggestion(root, 'capture')}"
        )
    *others, last = filter(None, expected)
    raise DataError(
        f"{root} must hold {', '.join(others)} or {last}; "
        f"got {', '.join(entries[:8])}{' ...' if len(entries) > 8 else ''}{hint}"
    )


def _images(folder: Path) -> int:
    """Return the number of images in a folder, by name."""
    paths = [path for path in folder.iterdir() if path.suffix.lower() in IMAGES] if folder.is_dir() else []
    return len(without_masks(paths))


def _folder(path: str | os.PathLike[str]) -> Path:
    root = Path(path)
    try:
        os.listdir(root)
    except (FileNotFoundError, NotADirectoryError) as error:
        actual = f"a file{suggestion(root, 'capture')}" if root.exists() else f"no such folder{path_hint(root)}"
        raise DataError(f"{root} must be the folder of a capture, got {actual}") from error
    except OSError as error:
        raise DataError(f"cannot read the folder {root}: {error.strerror or error}") from error
    return root


def reader_of(format: str) -> Reader:
    """Return the reader of a format.

    Raises DataError if there is no such reader, or its package cannot be imported.
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
    """Read a capture. Only image headers are decoded, and nothing is written.

    Parameters
    ----------
    path : path
        Folder of the capture.
    format : str
        One of FORMATS, the name of a registered reader, or "auto": detected from the files.
    downscale : int
        Downscale the images by this integer factor (COLMAP: ``images_N`` is used if it exists).
    test_every : int or None
        Hold out every n-th view (sorted by name, starting with the first) if the capture has no split of its own;
        0 = train on all views. None: 8; 0 for DTU.
    cache_bytes : int
        Limit on decoded images in memory. None: ``DEFAULT_CACHE_BYTES``, or a fifth of the available memory if that is
        less.
    masks : path, optional
        Folder of masks (white = keep). Masks in the usual folders are found without it.
    masked : str, optional
        Meaning of a black pixel: "ignore", never used; "empty", transparent; "off", masks are not used. None: ignored
        if the protocol uses masks.

    Returns
    -------
    Scene
        Views with cameras and split, and sparse points. Images are decoded on demand.

    Raises
    ------
    DataError
        If a file is missing or invalid; the message says what to do.

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
            raise DataError(f"format {format} has its own masks; leave out masks and masked")
        if downscale > 1:
            raise DataError(f"format {format} does not support downscaling, got downscale {downscale}; use 1")
        return replace(capture, own_split=True)
    return build_scene(capture, root, downscale=downscale, test_every=test_every, cache_bytes=cache_bytes, masks=chosen)
