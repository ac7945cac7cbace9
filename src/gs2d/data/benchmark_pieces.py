"""The pieces of one capture in each distributed layout: what is missing, file by file."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from gs2d.core.json_files import read_json
from gs2d.data.readers.colmap_model import read_images
from gs2d.data.readers.dtu import CAMERA_FILES
from gs2d.errors import DataError

TRAINING, TESTING, NOTHING = "for training", "for testing", "distributed, but not read by gs2d"
FULL_SIZE = "for its folder, full size"  # photographs that are trained from a folder of smaller ones
_DTU_2DGS = "get it from the preprocessed DTU of 2DGS (linked from github.com/hbb1/2d-gaussian-splatting)"
_DTU_NEUS = "get it from the DTU scans of NeuS (data_DTU, linked from github.com/Totoro97/NeuS)"
_IMAGES = {".png", ".jpg", ".jpeg"}


@dataclass(frozen=True)
class MissingFile:
    """A file that is not there.

    Attributes
    ----------
    path : Path
    purpose : str
        What it is for.
    source : str
        Where to get it, as a clause.
    """

    path: Path
    purpose: str
    source: str

    def line(self) -> str:
        """Return the file, what it is for and what to do, in one line."""
        return f"{self.path} is missing ({self.purpose}): {self.source}"


def whole_folders(pieces: Iterable[MissingFile]) -> tuple[MissingFile, ...]:
    """Return the pieces, with one for a folder that is not there instead of one for each of its files."""
    named = (piece if piece.path.parent.is_dir() else replace(piece, path=piece.path.parent) for piece in pieces)
    return tuple(dict.fromkeys(named))


def has_dtu_cameras(root: Path) -> bool:
    """Whether a folder has the projection matrices of a DTU scan."""
    return any((root / name).is_file() for name in CAMERA_FILES)


def dtu_pieces(root: Path) -> list[MissingFile]:
    """Check a DTU scan as 2DGS (``images``, ``mask``, ``sparse/0``, both archives) or NeuS (``image``) prepares it.

    With one of the two archives the other is not needed.
    """
    ours = (root / "sparse").is_dir()  # only 2DGS adds a model
    source = _DTU_2DGS if ours else _DTU_NEUS
    archives = [root / name for name in CAMERA_FILES]
    there = [path for path in archives if path.is_file()]
    missing = []
    if not there:
        missing.append(MissingFile(archives[0], TRAINING, source))
    elif ours:
        missing += [MissingFile(path, NOTHING, source) for path in archives if path not in there]
    views = _archive_views(there[0]) if there else set()
    images = next((root / name for name in ("image", "images") if (root / name).is_dir()), root / "images")
    missing += _numbered(images, views, 6 if images.name == "images" else 3, TRAINING, source)
    masks = next((root / name for name in ("mask", "masks") if (root / name).is_dir()), root / "mask")
    missing += _numbered(masks, views, 3, "to cull the surface", source)
    if ours:
        missing += _model_files(root / "sparse" / "0", source, purpose="points to start from")
    return missing


def _archive_views(path: Path) -> set[int]:
    """Numbers of the views whose world_mat an archive holds; nothing is read but its table of contents."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return set()  # reading it will say what is wrong with it
    return {int(hit.group(1)) for name in names if (hit := re.fullmatch(r"world_mat_(\d+)\.npy", name))}


def _numbered(folder: Path, views: set[int], digits: int, purpose: str, source: str) -> list[MissingFile]:
    """Files named by the number of their view, one for each view."""
    files = [p for p in folder.iterdir() if p.suffix.lower() in _IMAGES] if folder.is_dir() else []
    numbers = {int(p.stem) for p in files if p.stem.isdigit()}
    suffix = files[0].suffix if files else ".png"
    width = len(files[0].stem) if files and files[0].stem.isdigit() else digits
    if files and not numbers:  # named otherwise: their count is all that can be said
        return []
    return [MissingFile(folder / f"{n:0{width}}{suffix}", purpose, source) for n in sorted(views - numbers)]


def _model_files(folder: Path, source: str, *, purpose: str = TRAINING) -> list[MissingFile]:
    """Return the three files of a COLMAP model, binary unless one is text."""
    suffix = ".txt" if any(folder.glob("*.txt")) and not any(folder.glob("*.bin")) else ".bin"
    names = [f"{stem}{suffix}" for stem in ("cameras", "images", "points3D")]
    return [MissingFile(folder / name, purpose, source) for name in names if not (folder / name).is_file()]


def colmap_pieces(root: Path, folders: Iterable[str], source: str) -> list[MissingFile]:
    """Return a COLMAP model in ``sparse/0`` and the photographs that it names, in each of the folders."""
    model, flat = root / "sparse" / "0", root / "sparse"
    if not model.is_dir() and any((*flat.glob("*.bin"), *flat.glob("*.txt"))):
        model = flat
    missing = _model_files(model, source)
    kind = "bin" if (model / "images.bin").is_file() else "txt" if (model / "images.txt").is_file() else None
    if kind is None:
        return missing
    names = sorted(image.name for image in read_images(model, kind))
    last = tuple(folders)
    for folder in last:
        purpose = TRAINING if folder == last[-1] else FULL_SIZE
        missing += [MissingFile(root / folder / n, purpose, source) for n in names if not (root / folder / n).is_file()]
    return missing


def blender_pieces(root: Path, source: str) -> list[MissingFile]:
    """Return a NeRF-Synthetic scene: three splits with the pictures that their lists name."""
    missing = []
    for split, purpose in (("train", TRAINING), ("test", TESTING), ("val", NOTHING)):
        listing = root / f"transforms_{split}.json"
        if not listing.is_file():
            missing.append(MissingFile(listing, purpose, source))
            continue
        data = read_json(listing)
        try:
            names = [str(frame["file_path"]) for frame in data["frames"]]
        except (KeyError, TypeError) as error:
            raise DataError(f"{listing} must hold frames with a file_path each, got another entry ({error})") from error
        for name in names:
            path = root / (name if Path(name).suffix.lower() in _IMAGES else f"{name}.png")
            if not path.is_file():
                missing.append(MissingFile(path, purpose, source))
    return missing
