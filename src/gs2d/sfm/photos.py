"""The photographs of a folder: which files they are, how they must be turned, and which camera took them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from PIL import Image

from gs2d.core.images import is_twice_as_wide, natural_key
from gs2d.core.missing import belongs_to_run, instead, where_it_ends
from gs2d.data.exif import Taken, read_taken
from gs2d.data.image_files import read_image
from gs2d.data.masks import FOLDER, without_masks
from gs2d.data.photo_formats import AVIF, EXR, HEIF, UNREAD, remedy
from gs2d.errors import DataError
from gs2d.sfm.fisheye import Circle, circle_of, named_fisheye, small_if_dark
from gs2d.sfm.panoramas import PANORAMA, meets_itself
from gs2d.sfm.video_frames import VIDEOS

JPEG, PNG = (".jpg", ".jpeg"), (".png",)
CONVERTED = (".bmp", ".tif", ".tiff", ".webp", *AVIF, *HEIF, *EXR)
_KINDS = {
    suffix: kind
    for kind, suffixes in (("unread", UNREAD), ("video", VIDEOS), ("photo", JPEG + PNG + CONVERTED))
    for suffix in suffixes
}
FISHEYE = "OPENCV_FISHEYE"  # the model of --camera-model
FEWEST = 3  # two photographs give no point that a third confirms
_HIDDEN = (".", "__MACOSX")
_ORIENTATIONS = {  # EXIF 2.32, tag 0x0112: what makes the stored pixels upright
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,  # counter-clockwise: a quarter turn clockwise
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
_SHOOTING = "take 30 or more, each showing most of what the one before shows, from places a step apart"


@dataclass(frozen=True)
class Photo:
    """One photograph.

    Attributes
    ----------
    source : Path
    label : str
        Its path below the user's folder, with ``/``: what messages call it.
    name : str
        Its path below ``images/`` of the capture: UTF-8 without white space, as COLMAP's lists; ``.png`` if converted.
    size : (int, int)
        Width and height as it is seen, px: after its EXIF orientation.
    taken : Taken
        What the file says of how it was taken; its orientation is what is left to be turned.
    is_sphere : bool
        Its picture looks like that of a whole sphere (``panoramas.meets_itself``).
    dark : ndarray float32 [h, w] or None
        Its picture, small and upright, where its corners are dark (``fisheye.small_if_dark``).
    """

    source: Path
    label: str
    name: str
    size: tuple[int, int]
    taken: Taken
    is_sphere: bool = False
    dark: np.ndarray | None = field(default=None, compare=False, repr=False)

    @property
    def orientation(self) -> int:
        """EXIF, 1 (upright) to 8."""
        return self.taken.orientation

    @property
    def is_converted(self) -> bool:
        """Whether it is stored as PNG, because not everybody reads its own format."""
        return self.source.suffix.lower() in CONVERTED

    def size_within(self, max_size: int | None) -> tuple[int, int]:
        """Its size when its longer side may have ``max_size`` px."""
        width, height = self.size
        if max_size is None or max(width, height) <= max_size:
            return self.size
        scale = max_size / max(width, height)
        return max(1, round(width * scale)), max(1, round(height * scale))


def find_photos(root: Path) -> tuple[list[Path], tuple[str, ...], str]:
    """Return the photographs in a folder and its sub-folders, and what is not used.

    Returns
    -------
    list of Path
        The photographs, in the order of people.
    tuple of str
        A line about each kind of files that are no photographs.
    str
        A line about the photographs that cannot be read: how many, why, and what to do; "" without any.

    Raises
    ------
    DataError
        No folder, a video, formats that are not read, or too few photographs.
    """
    if root.is_file():
        other = instead(root, "photographs")
        raise DataError(f"{root} must be a folder of photographs or a video, got another file{other}")
    if not root.is_dir():
        raise DataError(f"{root} must be a folder of photographs, got no such folder{where_it_ends(root)}")
    if belongs_to_run(root):
        raise DataError(f"{root} must be a folder of photographs, got files of a run{instead(root, 'photographs')}")
    sorted_out: dict[str, list[Path]] = {"photo": [], "video": [], "unread": [], "mask": [], "other": []}
    for path in _files(root):
        kind = _KINDS.get(path.suffix.lower(), "other")
        if path.exists() and not path.is_file():  # a pipe, which would be waited for
            kind = "other"
        if FOLDER in path.relative_to(root).parent.as_posix().lower().split("/"):
            kind = "mask"
        sorted_out[kind].append(path)
    photos, videos, unread, _, others = sorted_out.values()
    photos = without_masks(photos)
    notes = []
    if videos:
        notes.append(f"{_some(videos, root)} not read: a video; give it alone, or put frames of it here")
    if others:
        notes.append(f"{_some(others, root)} not read: no photographs")
    warning = _about_unread(unread, len(photos), root)
    if len(photos) < FEWEST:
        got = f"{len(photos)} photographs" if photos else "none"
        why = next((f"; {line}" for line in (warning, *notes) if line), "")
        raise DataError(f"{root} must hold {FEWEST} or more photographs, got {got}{why or '; ' + _SHOOTING}")
    return photos, tuple(notes), warning


def _about_unread(unread: Sequence[Path], read: int, root: Path) -> str:
    """Return one line about the photographs that cannot be read, or ""."""
    kinds: dict[str, list[Path]] = {}
    for path in unread:
        kinds.setdefault(path.suffix.lower(), []).append(path)
    parts = []
    for suffix, paths in kinds.items():
        first = paths[0].relative_to(root).as_posix() + (" ..." if len(paths) > 1 else "")
        parts.append(f"{len(paths)} {suffix[1:].upper()} ({first}): {remedy(suffix)}")
    count = f"{len(unread)} of {read + len(unread)} photographs cannot be read and are left out"
    return f"{count}: {'; '.join(parts)}" if unread else ""


def _files(root: Path) -> Iterator[Path]:
    """Files below a folder that are not hidden, in natural order of their paths."""

    def refuse(error: OSError) -> None:
        raise DataError(f"cannot read the folder {error.filename}: {error.strerror}") from error

    found, entered = [], {os.path.realpath(root)}
    for folder, folders, names in os.walk(root, onerror=refuse, followlinks=True):
        visible = {
            name: os.path.realpath(os.path.join(folder, name)) for name in folders if not name.startswith(_HIDDEN)
        }
        folders[:] = [name for name, place in visible.items() if place not in entered]  # a link to above would not end
        entered.update(visible.values())
        found += [Path(folder, name) for name in names if not name.startswith(".")]
    yield from sorted(found, key=lambda path: natural_key(path.relative_to(root).as_posix()))


def _some(paths: Sequence[Path], root: Path) -> str:
    """``a.heic`` or ``a.heic and 3 more``."""
    first = paths[0].relative_to(root).as_posix()
    return f"{first} was" if len(paths) == 1 else f"{first} and {len(paths) - 1} more were"


def read_photos(paths: Sequence[Path], root: Path, *, threads: int) -> Iterator[Photo]:
    """Yield what each file says about itself; every one is decoded, so that a broken one is found before the slow part.

    Raises
    ------
    DataError
        One that does not decode; names it.
    """
    names = _names([path.relative_to(root).as_posix() for path in paths])
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(lambda path, name: _read(path, root, name), paths, names)


def _read(path: Path, root: Path, name: str) -> Photo:
    image = read_image(path)
    height, width = image.shape[:2]
    taken = read_taken(path)
    orientation = 1 if path.suffix.lower() in (".tif", ".tiff") else taken.orientation  # which Pillow has turned
    size = (height, width) if orientation >= 5 else (width, height)
    taken = replace(taken, orientation=orientation)
    dark = small_if_dark(image)
    if dark is not None:
        dark = np.asarray(turn(Image.fromarray(dark), orientation))
    return Photo(path, path.relative_to(root).as_posix(), name, size, taken, meets_itself(image), dark)


def _names(labels: Sequence[str]) -> list[str]:
    """Names in the capture: white space becomes ``_``, what is not UTF-8 ``?``; names stay different."""
    names: list[str] = []
    taken = set()
    for label in labels:
        name = "_".join(label.split()).encode("utf-8", "replace").decode("utf-8")
        if Path(name).suffix.lower() in CONVERTED:
            name += ".png"
        while name.lower() in taken:  # file systems that do not tell cases apart
            name = str(Path(name).with_name(f"_{Path(name).name}").as_posix())
        taken.add(name.lower())
        names.append(name)
    return names


def turn(image: Image.Image, orientation: int) -> Image.Image:
    """Return the picture as it is meant to be seen."""
    return image if orientation == 1 else image.transpose(_ORIENTATIONS[orientation])


def camera_groups(photos: Sequence[Photo], sizes: Sequence[tuple[int, int]], cameras: str) -> list[list[int]]:
    """Which photographs share a camera: lists of their numbers.

    "auto": same folder, size, camera, lens and focal length; "one": all; "each": none.

    Raises
    ------
    DataError
        "one", but the sizes differ.
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
        groups.setdefault((os.path.dirname(photo.name), size, photo.taken.made_by), []).append(i)
    return list(groups.values())


def panorama_groups(
    photos: Sequence[Photo], groups: Sequence[Sequence[int]], camera_model: str
) -> tuple[list[bool], list[str]]:
    """Return which groups of photographs of one camera are panoramas, and lines for people.

    Parameters
    ----------
    groups : sequence of sequences of int
        Numbers of photographs of one camera each, of one size.
    camera_model : str
        As the user asks: "auto" looks, ``PANORAMA`` says that all are, another one that none is.

    Raises
    ------
    DataError
        A panorama that is not whole.
    """
    if camera_model not in ("auto", PANORAMA):
        return [False] * len(groups), []
    found, doubted = [], 0
    for group in groups:
        first = photos[group[0]]
        said = [photos[i].taken.panorama for i in group]
        looks = 2 * sum(photos[i].is_sphere for i in group) >= len(group)
        is_one = camera_model == PANORAMA or "whole" in said or looks
        if "part" in said:
            raise _not_whole(photos[group[said.index("part")]], "as its XMP says")
        if is_one and not is_twice_as_wide(*first.size):
            raise _not_whole(first, "which is not twice as wide as high")
        found.append(is_one)
        doubted += 0 if is_one or not is_twice_as_wide(*first.size) else len(group)
    count = sum(len(group) for group, is_one in zip(groups, found, strict=True) if is_one)
    about = f"{count} photographs are 360-degree panoramas: each has one place, and is trained in faces"
    lines = [about] if count else []
    if doubted:
        lines.append(
            f"{doubted} photographs are twice as wide as high, but their edges do not meet: taken as ordinary ones "
            f"(--camera-model {PANORAMA} if they are panoramas)"
        )
    return found, lines


def fisheye_hints(
    photos: Sequence[Photo], groups: Sequence[Sequence[int]], panoramas: Sequence[bool], camera_model: str
) -> tuple[list[tuple[str, Circle | None]], list[str]]:
    """Return what tells that each group of photographs of one camera is a fisheye's, with its circle; lines for people.

    Parameters
    ----------
    panoramas : sequence of bool
        Which groups are panoramas.
    camera_model : str
        As the user asks: "auto" looks, "OPENCV_FISHEYE" says that all are, another one that none is.

    Returns
    -------
    list of (str, Circle or None)
        The first is a hint as of :class:`gs2d.sfm.colmap_process.Group`.
    list of str
    """
    if camera_model not in ("auto", FISHEYE):
        return [("", None)] * len(groups), []
    hints: list[tuple[str, Circle | None]] = []
    round_ones = 0
    for group, is_panorama in zip(groups, panoramas, strict=True):
        circle = None if is_panorama else circle_of([photos[i].dark for i in group])
        named = not is_panorama and named_fisheye(photos[group[0]].taken.made_by)
        hint = "asked" if camera_model == FISHEYE else "circle" if circle else "name" if named else ""
        hints.append((hint, circle))
        round_ones += len(group) if circle else 0
    line = f"{round_ones} photographs are round: what is beyond their circle is masked, and teaches nothing"
    return hints, [line] if round_ones else []


def _not_whole(photo: Photo, why: str) -> DataError:
    width, height = photo.size
    return DataError(
        f"{photo.label} must be a whole panorama, 360 by 180 degrees in 2:1, got a part of one, {width}x{height}, "
        f"{why}; export it whole (what is missing in black, with a mask), or say what lens it is (--camera-model)"
    )


def rig_folders(photos: Sequence[Photo], groups: Sequence[Sequence[int]]) -> tuple[str, ...]:
    """Return the folders whose photographs of one name were taken at one moment by cameras that are mounted together.

    Parameters
    ----------
    groups : sequence of sequences of int
        Which photographs share a camera.

    Raises
    ------
    DataError
        Fewer than two folders, names that most photographs have alone, or a folder of several cameras.
    """
    names: dict[str, set[str]] = {}
    for photo in photos:
        names.setdefault(os.path.dirname(photo.name), set()).add(os.path.basename(photo.name))
    expected = "--rig needs a sub-folder for each camera, with the same names for the same moments"
    if len(names) < 2 or "" in names:
        raise DataError(f"{expected}; got photographs in {', '.join(sorted(names)) or 'one folder'}")
    often = Counter(name for those in names.values() for name in those)
    alone = sorted((name for name, number in often.items() if number == 1), key=natural_key)
    if 2 * len(alone) > len(often):
        raise DataError(f"{expected}; got {len(alone)} of {len(often)} names in one folder alone, such as {alone[0]}")
    folders = {frozenset(os.path.dirname(photos[i].name) for i in group) for group in groups}
    if len(groups) != len(names) or len(folders) != len(names) or any(len(those) != 1 for those in folders):
        raise DataError(
            f"--rig needs one camera a folder, got {len(groups)} cameras for {len(names)} folders: photographs of one "
            "size and lens in each, and --cameras auto"
        )
    return tuple(sorted(names, key=lambda folder: (-len(names[folder]), natural_key(folder))))


def in_order_taken(photos: Sequence[Photo]) -> tuple[list[int], str]:
    """Return the numbers of the photographs in the order in which they were taken, and by what: "time" or "name".

    By their clocks where each has one that runs: where most of the times differ.
    """
    times = [photo.taken.seconds for photo in photos]
    known = [seconds for seconds in times if seconds is not None]
    if len(known) < len(photos) or 2 * len(set(known)) < len(photos):
        return list(range(len(photos))), "name"
    return sorted(range(len(photos)), key=lambda i: (known[i], i)), "time"


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
