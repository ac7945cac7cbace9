"""Photographs of a folder: files, orientation, and which of them share a camera."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from PIL import Image

from gs2d.core.image_arrays import is_twice_as_wide, natural_key
from gs2d.core.missing import belongs_to_run, path_hint, suggestion
from gs2d.data.exif import Metadata, read_metadata
from gs2d.data.image_files import AVIF, HEIF, UNREAD, read_image, remedy
from gs2d.data.masks import FOLDER, without_masks
from gs2d.errors import DataError
from gs2d.sfm.lens import PANORAMA
from gs2d.sfm.video_frames import VIDEOS

JPEG, PNG = (".jpg", ".jpeg"), (".png",)
CONVERTED = (".bmp", ".tif", ".tiff", ".webp", *AVIF, *HEIF)
_KINDS = {
    suffix: kind
    for kind, suffixes in (("unread", UNREAD), ("video", VIDEOS), ("photo", JPEG + PNG + CONVERTED))
    for suffix in suffixes
}
FEWEST = 3  # a point that two images show must be confirmed by a third
_HIDDEN = (".", "__MACOSX")
_ORIENTATIONS = {  # EXIF 2.32, tag 0x0112: operation that makes the stored pixels upright
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,  # counter-clockwise: a quarter turn clockwise
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
_SHOOTING = "take 30 or more, a step apart, with much overlap"


@dataclass(frozen=True)
class Photo:
    """One photograph."""

    source: Path
    label: str  # path relative to the user's folder, with ``/``; used in messages
    # Path relative to ``images/`` of the capture: UTF-8 without white space, which COLMAP's lists need; ``.png`` if
    # converted.
    name: str
    size: tuple[int, int]  # width and height of the upright image, px
    metadata: Metadata  # ``orientation`` is the rotation that remains to be applied

    @property
    def orientation(self) -> int:
        """EXIF orientation, 1 (upright) to 8."""
        return self.metadata.orientation

    @property
    def is_converted(self) -> bool:
        """Whether the copy is a PNG, because the original format is not widely supported."""
        return self.source.suffix.lower() in CONVERTED

    def size_within(self, max_size: int | None) -> tuple[int, int]:
        """Return the size after downscaling the longer side to at most ``max_size`` px."""
        width, height = self.size
        if max_size is None or max(width, height) <= max_size:
            return self.size
        scale = max_size / max(width, height)
        return max(1, round(width * scale)), max(1, round(height * scale))


def find_photos(root: Path) -> tuple[list[Path], tuple[str, ...], str]:
    """Return the photographs in a folder and its sub-folders, in natural order, and messages about other files.

    There is one message for each kind of other files, and one about the photographs that cannot be read: how many, why,
    and the remedy; "" if there are none. Raises DataError if ``root`` is no folder, or holds too few photographs.
    """
    if root.is_file():
        other = suggestion(root, "photographs")
        raise DataError(f"{root} must be a folder of photographs or a video, got another file{other}")
    if not root.is_dir():
        raise DataError(f"{root} must be a folder of photographs, got no such folder{path_hint(root)}")
    if belongs_to_run(root):
        raise DataError(f"{root} must be a folder of photographs, got files of a run{suggestion(root, 'photographs')}")
    sorted_out: dict[str, list[Path]] = {"photo": [], "video": [], "unread": [], "mask": [], "other": []}
    for path in _files(root):
        kind = _KINDS.get(path.suffix.lower(), "other")
        if path.exists() and not path.is_file():  # reading a pipe would block
            kind = "other"
        if FOLDER in path.relative_to(root).parent.as_posix().lower().split("/"):
            kind = "mask"
        sorted_out[kind].append(path)
    photos, videos, unread, _, others = sorted_out.values()
    photos = without_masks(photos)
    notes = []
    if videos:
        notes.append(f"{_some(videos, root)} ignored: a video; use it as the input, or copy frames of it here")
    if others:
        notes.append(f"{_some(others, root)} ignored: no photographs")
    warning = _about_unread(unread, len(photos), root)
    if len(photos) < FEWEST:
        got = str(len(photos) or "none")
        why = next((f"; {line}" for line in (warning, *notes) if line), "")
        raise DataError(f"{root} must hold {FEWEST} or more photographs, got {got}{why or '; ' + _SHOOTING}")
    return photos, tuple(notes), warning


def _about_unread(unread: Sequence[Path], read: int, root: Path) -> str:
    """Describe the photographs that cannot be read; "" if there are none."""
    kinds: dict[str, list[Path]] = {}
    for path in unread:
        kinds.setdefault(path.suffix.lower(), []).append(path)
    parts = []
    for suffix, paths in kinds.items():
        first = paths[0].relative_to(root).as_posix() + (" ..." if len(paths) > 1 else "")
        parts.append(f"{len(paths)} {suffix[1:].upper()} ({first}): {remedy(suffix)}")
    count = f"{len(unread)} of {read + len(unread)} photographs cannot be read and are ignored"
    return f"{count}: {'; '.join(parts)}" if unread else ""


def _files(root: Path) -> Iterator[Path]:
    """Yield the files below a folder that are not hidden, in natural order of their paths."""

    def refuse(error: OSError) -> None:
        raise DataError(f"cannot read the folder {error.filename}: {error.strerror}") from error

    files, entered = [], {os.path.realpath(root)}
    for folder, folders, names in os.walk(root, onerror=refuse, followlinks=True):
        visible = {
            name: os.path.realpath(os.path.join(folder, name)) for name in folders if not name.startswith(_HIDDEN)
        }
        folders[:] = [name for name, path in visible.items() if path not in entered]  # avoid cycles of links
        entered.update(visible.values())
        files += [Path(folder, name) for name in names if not name.startswith(".")]
    yield from sorted(files, key=lambda path: natural_key(path.relative_to(root).as_posix()))


def _some(paths: Sequence[Path], root: Path) -> str:
    """Return ``a.heic was`` or ``a.heic and 3 more were``."""
    first = paths[0].relative_to(root).as_posix()
    return f"{first} was" if len(paths) == 1 else f"{first} and {len(paths) - 1} more were"


def read_photos(paths: Sequence[Path], root: Path, *, threads: int) -> Iterator[Photo]:
    """Read and decode each file, so that a broken one is reported before the slow steps.

    Raises DataError if a file cannot be decoded.
    """
    names = _names([path.relative_to(root).as_posix() for path in paths])
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(lambda path, name: _read(path, root, name), paths, names)


def _read(path: Path, root: Path, name: str) -> Photo:
    height, width = read_image(path).shape[:2]
    metadata = read_metadata(path)
    orientation = 1 if path.suffix.lower() in (".tif", ".tiff") else metadata.orientation  # Pillow rotates TIFF itself
    size = (height, width) if orientation >= 5 else (width, height)
    metadata = replace(metadata, orientation=orientation)
    return Photo(path, path.relative_to(root).as_posix(), name, size, metadata)


def _names(labels: Sequence[str]) -> list[str]:
    """Return unique names for the capture: white space becomes ``_``, invalid UTF-8 ``?``."""
    names: list[str] = []
    used = set()
    for label in labels:
        name = "_".join(label.split()).encode("utf-8", "replace").decode("utf-8")
        if Path(name).suffix.lower() in CONVERTED:
            name += ".png"
        while name.lower() in used:  # some file systems ignore case
            name = str(Path(name).with_name(f"_{Path(name).name}").as_posix())
        used.add(name.lower())
        names.append(name)
    return names


def turn(image: Image.Image, orientation: int) -> Image.Image:
    """Rotate an image upright, by its EXIF orientation."""
    return image if orientation == 1 else image.transpose(_ORIENTATIONS[orientation])


def camera_groups(photos: Sequence[Photo], sizes: Sequence[tuple[int, int]], cameras: str) -> list[list[int]]:
    """Group photographs (by index) that share a camera.

    "auto": equal folder, size, camera, lens and focal length; "one": all; "each": none. Raises DataError for "one", if
    the sizes differ.
    """
    if cameras == "each":
        return [[i] for i in range(len(photos))]
    if cameras == "one":
        for photo, size in zip(photos, sizes, strict=True):
            if size != sizes[0]:
                raise DataError(
                    f"--cameras one needs photographs of one size, got {photos[0].label} {_by(sizes[0])} and "
                    f"{photo.label} {_by(size)}; use --cameras auto"
                )
        return [list(range(len(photos)))]
    groups: dict[tuple[object, ...], list[int]] = {}
    for i, (photo, size) in enumerate(zip(photos, sizes, strict=True)):
        groups.setdefault((os.path.dirname(photo.name), size, photo.metadata.camera_tags), []).append(i)
    return list(groups.values())


def panorama_groups(
    photos: Sequence[Photo], groups: Sequence[Sequence[int]], camera_model: str
) -> tuple[list[bool], list[str]]:
    """Return whether each group of photographs consists of panoramas, and messages.

    ``groups``: indices of photographs, one group per camera. ``camera_model``: "auto" reads the XMP of the images,
    ``PANORAMA`` means that all are panoramas, other values that none is. Raises DataError if a panorama does not cover
    the whole sphere.
    """
    if camera_model not in ("auto", PANORAMA):
        return [False] * len(groups), []
    flags, doubted = [], 0
    for group in groups:
        first = photos[group[0]]
        tags = [photos[i].metadata.panorama for i in group]
        is_one = camera_model == PANORAMA or "whole" in tags
        if "part" in tags:
            raise _not_whole(photos[group[tags.index("part")]], "as its XMP says")
        if is_one and not is_twice_as_wide(*first.size):
            raise _not_whole(first, "which is not twice as wide as high")
        flags.append(is_one)
        doubted += 0 if is_one or not is_twice_as_wide(*first.size) else len(group)
    count = sum(len(group) for group, is_one in zip(groups, flags, strict=True) if is_one)
    about = f"{count} photographs are 360-degree panoramas: each has one pose, and is trained as several faces"
    lines = [about] if count else []
    if doubted:
        lines.append(
            f"{doubted} photographs have an aspect ratio of 2:1, but no XMP tag of panoramas: not treated as panoramas "
            f"(use --camera-model {PANORAMA} if they are)"
        )
    return flags, lines


def _not_whole(photo: Photo, why: str) -> DataError:
    width, height = photo.size
    return DataError(
        f"{photo.label} must be a full panorama, 360 by 180 degrees in 2:1, got a part of one, {width}x{height}, "
        f"{why}; export the full sphere (with a mask for missing parts), or set the lens (--camera-model)"
    )


def chronological_order(photos: Sequence[Photo]) -> tuple[list[int], str]:
    """Return the indices of the photographs in chronological order, and the source of the order: "time" or "name".

    Times are used if every photograph has one and most of them differ.
    """
    times = [photo.metadata.seconds for photo in photos if photo.metadata.seconds is not None]
    if len(times) < len(photos) or 2 * len(set(times)) < len(photos):
        return list(range(len(photos))), "name"
    return sorted(range(len(photos)), key=lambda i: (times[i], i)), "time"


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
