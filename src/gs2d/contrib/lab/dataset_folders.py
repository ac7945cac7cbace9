"""The paper's data sets as they are distributed: which scenes a folder holds, and every piece that is missing.

A piece that is not there is named by its path, what it is for, and where to get it, one line each. Nothing is decoded
and nothing is downloaded.
"""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from gs2d.config.protocols import Protocol, get_protocol, protocol_for
from gs2d.contrib.lab.datasets import (
    DATASETS,
    DTU_SCENES,
    MIP_NERF_360_SCENES,
    NERF_SYNTHETIC_SCENES,
    TNT_SCENES,
    DataSet,
    SceneFacts,
    get_dataset,
)
from gs2d.core.image_arrays import is_number
from gs2d.core.json_files import read_json
from gs2d.data.known_captures import DATA_SETS
from gs2d.data.readers.colmap import read_images
from gs2d.errors import DataError
from gs2d.evaluation.evaluators import MESH_TRUTHS

# -- what may be missing -----------------------------------------------------------------------------------------------
TRAINING, TESTING, NOTHING = "for training", "for testing", "distributed, but not read by gs2d"
FULL_SIZE = "for its folder, full size"  # photographs that are trained from a folder of smaller ones
_DTU_2DGS = "get it from the preprocessed DTU of 2DGS (linked from github.com/hbb1/2d-gaussian-splatting)"
_DTU_NEUS = "get it from the DTU scans of NeuS (data_DTU, linked from github.com/Totoro97/NeuS)"
_IMAGES = {".png", ".jpg", ".jpeg"}
CAMERA_FILES = ("cameras_sphere.npz", "cameras.npz")  # DTU


@dataclass(frozen=True)
class MissingPiece:
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


def whole_folders(pieces: Iterable[MissingPiece]) -> tuple[MissingPiece, ...]:
    """Return the pieces, with one for a folder that is not there instead of one for each of its files."""
    named = (piece if piece.path.parent.is_dir() else replace(piece, path=piece.path.parent) for piece in pieces)
    return tuple(dict.fromkeys(named))


def has_dtu_cameras(root: Path) -> bool:
    """Whether a folder has the projection matrices of a DTU scan."""
    return any((root / name).is_file() for name in CAMERA_FILES)


def dtu_pieces(root: Path) -> list[MissingPiece]:
    """Check a DTU scan as 2DGS (``images``, ``mask``, ``sparse/0``, both archives) or NeuS (``image``) prepares it.

    With one of the two archives the other is not needed.
    """
    ours = (root / "sparse").is_dir()  # only 2DGS adds a model
    source = _DTU_2DGS if ours else _DTU_NEUS
    archives = [root / name for name in CAMERA_FILES]
    there = [path for path in archives if path.is_file()]
    missing = []
    if not there:
        missing.append(MissingPiece(archives[0], TRAINING, source))
    elif ours:
        missing += [MissingPiece(path, NOTHING, source) for path in archives if path not in there]
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
    except (OSError, ValueError, RuntimeError, zipfile.BadZipFile):
        return set()  # reading it will say what is wrong with it
    return {int(hit.group(1)) for name in names if (hit := re.fullmatch(r"world_mat_([0-9]{1,18})\.npy", name))}


def _numbered(folder: Path, views: set[int], digits: int, purpose: str, source: str) -> list[MissingPiece]:
    """Files named by the number of their view, one for each view."""
    files = [p for p in folder.iterdir() if p.suffix.lower() in _IMAGES] if folder.is_dir() else []
    numbers = {int(p.stem) for p in files if is_number(p.stem)}
    suffix = files[0].suffix if files else ".png"
    width = len(files[0].stem) if files and is_number(files[0].stem) else digits
    if files and not numbers:  # named otherwise: their count is all that can be said
        return []
    return [MissingPiece(folder / f"{n:0{width}}{suffix}", purpose, source) for n in sorted(views - numbers)]


def _model_files(folder: Path, source: str, *, purpose: str = TRAINING) -> list[MissingPiece]:
    """Return the three files of a COLMAP model, binary unless one is text."""
    suffix = ".txt" if any(folder.glob("*.txt")) and not any(folder.glob("*.bin")) else ".bin"
    names = [f"{stem}{suffix}" for stem in ("cameras", "images", "points3D")]
    return [MissingPiece(folder / name, purpose, source) for name in names if not (folder / name).is_file()]


def colmap_pieces(root: Path, folders: Iterable[str], source: str) -> list[MissingPiece]:
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
        missing += [
            MissingPiece(root / folder / n, purpose, source) for n in names if not (root / folder / n).is_file()
        ]
    return missing


def blender_pieces(root: Path, source: str) -> list[MissingPiece]:
    """Return a NeRF-Synthetic scene: three splits with the pictures that their lists name."""
    missing = []
    for split, purpose in (("train", TRAINING), ("test", TESTING), ("val", NOTHING)):
        listing = root / f"transforms_{split}.json"
        if not listing.is_file():
            missing.append(MissingPiece(listing, purpose, source))
            continue
        data = read_json(listing)
        try:
            names = [str(frame["file_path"]) for frame in data["frames"]]
        except (KeyError, TypeError) as error:
            raise DataError(f"{listing} must hold frames with a file_path each, got another entry ({error})") from error
        for name in names:
            path = root / (name if Path(name).suffix.lower() in _IMAGES else f"{name}.png")
            if not path.is_file():
                missing.append(MissingPiece(path, purpose, source))
    return missing


# -- the data sets -----------------------------------------------------------------------------------------------------
DEPTH = 3  # folders below the data folder in which scenes are looked for (TNT_GOF/TrainingSet/Barn)
SCORING = "to score the surface"
_BY_NAME = ("tnt", "mip-nerf-360")  # COLMAP models as anyone's: only the names tell them

_TNT_TRUTH = "get it from tanksandtemples.org, Download, Training Data: the files of this scene"
_TRUTH_SOURCES = {
    ("dtu", "scan"): "get it from the archive Points of the DTU Robot Image Data Sets (MVS)",
    ("dtu", "mask"): "get it from the archive SampleSet of the DTU Robot Image Data Sets (MVS)",
    ("dtu", "plane"): "get it from the archive SampleSet of the DTU Robot Image Data Sets (MVS)",
    ("tnt", "scan"): f"{_TNT_TRUTH} (ground truth)",
    ("tnt", "crop"): f"{_TNT_TRUTH} (cropfiles)",
    ("tnt", "transform"): f"{_TNT_TRUTH} (alignment)",
    ("tnt", "log"): f"{_TNT_TRUTH} (camera poses); not the file of the same name in TNT_GOF",
    ("nerf-synthetic", "mesh"): "it is not distributed: export the object of the scene's .blend file, axes unchanged",
}


@dataclass(frozen=True)
class SceneFolder:
    """One scene of a data set in a folder.

    Attributes
    ----------
    dataset, facts : DataSet, SceneFacts
    root : Path
        The capture.
    truth : mapping of str to Path
        The pieces of the ground truth that are there: "scan", "mask", "plane" (DTU), "scan", "crop", "transform", "log"
        (Tanks and Temples), "mesh" (NeRF-Synthetic).
    missing : tuple of MissingPiece
        Of the capture and of the ground truth.
    """

    dataset: DataSet
    facts: SceneFacts
    root: Path
    truth: Mapping[str, Path] = field(default_factory=dict)
    missing: tuple[MissingPiece, ...] = ()

    @property
    def can_train(self) -> bool:
        """Whether nothing that training or testing reads is missing."""
        return not any(piece.purpose in (TRAINING, TESTING) for piece in self.missing)

    @property
    def can_score(self) -> bool:
        """Whether all of the ground truth is there."""
        return bool(self.truth) and not any(piece.purpose == SCORING for piece in self.missing)

    def lines(self) -> tuple[str, ...]:
        """One line for each missing piece."""
        return tuple(piece.line() for piece in self.missing)


def find_scenes(
    data: Path, dataset: str, names: Sequence[str] = (), *, truth: Path | None = None
) -> tuple[SceneFolder, ...]:
    """Return the scenes of a data set under a folder, in the order of the paper's tables.

    Parameters
    ----------
    data : Path
        What was unpacked: the folder of the scenes, one above it, or one scene.
    dataset : str
        A name of ``DATASETS``.
    names : sequence of str
        Only these scenes; each must be there. Empty: all that are.
    truth : Path, optional
        Folder of the ground truth; None: looked for beside the captures.

    Raises
    ------
    DataError
        No such folder, or a scene that was asked for is not there; names it.
    ProtocolError
        No such data set or scene.
    """
    if not data.is_dir():
        raise DataError(f"{data} must be a folder of {get_dataset(dataset).title}, got no such folder")
    valid = get_dataset(dataset)
    wanted = [valid.scene(name) for name in names] or list(valid.scenes)
    folders = list(_folders(data))
    found = []
    for facts in wanted:
        root = next((folder for folder in folders if _is_scene(valid, facts, folder)), None)
        if root is not None:
            found.append(describe(valid, facts, root, truth=truth))
        elif names:
            raise DataError(
                f"{data} must hold the scene {facts.name} of {valid.title}, got no such folder; "
                f"{_capture_source(valid)}"
            )
    return tuple(found)


def recognise(root: Path, truth: Path | None = None) -> tuple[DataSet, SceneFacts] | None:
    """Return the data set and scene that a capture's folder is, by its name and its files; None for anyone else's.

    A COLMAP capture needs more than a name, for many have a garden or a truck: Tanks and Temples the camera log beside
    the photographs or an official file, Mip-NeRF 360 its ``poses_bounds.npy``.

    Parameters
    ----------
    truth : Path, optional
        Folder in which official files are looked for; None: beside the capture.
    """
    root = Path(os.path.abspath(root))  # "." has no name; a link keeps its own
    for dataset in DATASETS.values():
        for facts in dataset.scenes:
            if _is_scene(dataset, facts, root) and (
                dataset.name not in _BY_NAME or _is_proven(dataset, facts, root, truth)
            ):
                return dataset, facts
    scan = re.search(r"scan_?(\d+)$", root.name.lower())
    if scan and has_dtu_cameras(root):  # one of the scans that are not in the tables
        number = int(scan.group(1))
        return DTU_SCENES, SceneFacts(f"scan{number}", "dtu", 2, scan=number)
    return None


def describe(dataset: DataSet, facts: SceneFacts, root: Path, *, truth: Path | None = None) -> SceneFolder:
    """Return the pieces of one scene: what of the ground truth is there, and all that is missing."""
    source = _capture_source(dataset)
    pieces = {
        "dtu": lambda: dtu_pieces(root),
        "tnt": lambda: [*colmap_pieces(root, ("images",), source), *_published_log(facts, root)],
        "nerf-synthetic": lambda: blender_pieces(root, source),
        "mip-nerf-360": lambda: colmap_pieces(root, ("images", facts.images), source),
    }[dataset.name]()
    found, lacking = find_truth(dataset, facts, root, truth)
    return SceneFolder(dataset, facts, root, found, (*whole_folders(pieces), *lacking))


def missing_lines(root: Path) -> tuple[str, ...]:
    """One line for each piece that gs2d reads of a capture of a known data set, and that is not there.

    Empty for anyone else's capture, and for one whose lists are broken: reading it says so.
    """
    valid = recognise(root)
    if valid is None:
        return ()
    try:
        pieces = describe(*valid, root).missing
    except DataError:
        return ()
    return tuple(piece.line() for piece in pieces if piece.purpose not in (NOTHING, FULL_SIZE, SCORING))


def find_truth(
    dataset: DataSet, facts: SceneFacts, root: Path, folder: Path | None = None
) -> tuple[dict[str, Path], tuple[MissingPiece, ...]]:
    """Return the pieces of a scene's ground truth that are there, and those that are not.

    Parameters
    ----------
    folder : Path, optional
        Where it is; None: in the capture's folder, in those above it, and in the folders of those.
    """
    above = 2 if dataset.name == "dtu" else 3  # TNT_GOF/TrainingSet/Barn is deeper than DTU/scan24
    places = [folder] if folder is not None else [root, *root.parents[:above]]
    if dataset.name == "dtu":
        names = dtu_truth_files(facts.scan or 0)
        near = [place for base in places for place in (base, *subfolders(base))]
        inside = [place for base in near for place in (base, base / "MVS Data", base / "SampleSet" / "MVS Data")]
        found = {what: path for what, name in names.items() if (path := _first(inside, name)) is not None}
        if found:  # where the others are
            what, path = next(iter(found.items()))
            places = [path.parents[names[what].count("/")]]
    elif dataset.name == "tnt":
        names = tnt_truth_files(facts.name)
        candidates = [
            place
            for base in places
            for place in (base, base / facts.name, *(sub / facts.name for sub in subfolders(base)))
        ]
        best = max(candidates, key=lambda place: _own_pieces(place, names))
        has_any = _own_pieces(best, names) > 0
        found = {what: best / name for what, name in names.items() if has_any and (best / name).is_file()}
        places = [best] if has_any else places
    elif dataset.name == "nerf-synthetic":
        names = {"mesh": MESH_TRUTHS[0]}
        at = folder if folder is not None else root
        mesh = next((at / name for name in MESH_TRUTHS if (at / name).is_file()), None)
        found = {} if mesh is None else {"mesh": mesh}
        places = [at]
    else:
        return {}, ()
    lacking = tuple(
        MissingPiece(places[0] / name, SCORING, _TRUTH_SOURCES[dataset.name, what])
        for what, name in names.items()
        if what not in found
    )
    return found, lacking


def protocol_of(root: Path, scene_format: str, truth: Path | None = None) -> Protocol:
    """Return the protocol of a capture: that of its scene in a known data set, else that of its format."""
    name = known_protocol(root, scene_format, truth)
    return protocol_for(scene_format) if name is None else get_protocol(name)


def known_protocol(root: Path, scene_format: str, truth: Path | None = None) -> str | None:
    """Return the name of the protocol of a scene of a known data set; None for other captures."""
    known = recognise(root, truth)
    if known is None or (known[0].name in _BY_NAME) != (scene_format == "colmap"):
        return None
    return known[1].protocol


@DATA_SETS.register("paper")
class PaperCaptures:
    """The four data sets of the paper, for ``gs2d train`` and ``gs2d info``."""

    protocol = staticmethod(known_protocol)
    missing = staticmethod(missing_lines)


def dtu_truth_files(scan: int) -> dict[str, str]:
    """Return the three files of a DTU scan by what they are, relative to the folders that the data set comes in."""
    return {
        "scan": f"Points/stl/stl{scan:03}_total.ply",
        "mask": f"ObsMask/ObsMask{scan}_10.mat",
        "plane": f"ObsMask/Plane{scan}.mat",
    }


def tnt_truth_files(scene: str) -> dict[str, str]:
    """Return the four files of a scene of Tanks and Temples by what they are."""
    return {
        "scan": f"{scene}.ply",
        "crop": f"{scene}.json",
        "transform": f"{scene}_trans.txt",
        "log": f"{scene}_COLMAP_SfM.log",
    }


def published_log(root: Path, scene: str) -> Path:
    """Return the camera log beside the photographs of a scene of TNT_GOF."""
    return root / tnt_truth_files(scene)["log"]


def _published_log(facts: SceneFacts, root: Path) -> list[MissingPiece]:
    path = published_log(root, facts.name)
    return [] if path.is_file() else [MissingPiece(path, "only to check the frame", _capture_source(TNT_SCENES))]


def _own_pieces(place: Path, names: Mapping[str, str]) -> int:
    """Files of the ground truth in a folder; the log alone does not count, for captures come with one."""
    own = sum((place / name).is_file() for what, name in names.items() if what != "log")
    return 2 * own + (place / names["log"]).is_file() if own else 0


def _is_scene(dataset: DataSet, facts: SceneFacts, root: Path) -> bool:
    """By the folder's name (``scan24``, ``dtu_scan24``, ``Barn``, ``nerf_synthetic_lego``) and one telling file."""
    name = root.name.lower()
    if name != facts.name.lower() and not name.endswith(f"_{facts.name.lower()}"):
        return False
    if dataset is DTU_SCENES:
        return has_dtu_cameras(root) or any((root / n).is_dir() for n in ("image", "images"))
    if dataset is NERF_SYNTHETIC_SCENES:
        return any((root / f"transforms_{split}.json").is_file() for split in ("train", "test"))
    if not (root / "sparse").is_dir() and not (root / "images").is_dir():
        return False
    return dataset is not MIP_NERF_360_SCENES or (root / "poses_bounds.npy").is_file() or (root / facts.images).is_dir()


def _is_proven(dataset: DataSet, facts: SceneFacts, root: Path, truth: Path | None) -> bool:
    """Whether a folder of the right name is that scene of a data set of COLMAP models."""
    if root.name.lower() != facts.name.lower():
        return False
    if dataset is TNT_SCENES:
        return published_log(root, facts.name).is_file() or bool(find_truth(dataset, facts, root, truth)[0])
    return (root / "poses_bounds.npy").is_file()


def _capture_source(dataset: DataSet) -> str:
    """Where the capture is distributed."""
    return (
        "get it from "
        + {
            "dtu": "the preprocessed DTU of 2DGS (linked from github.com/hbb1/2d-gaussian-splatting) or NeuS",
            "tnt": "TNT_GOF of the Hugging Face data set ZehaoYu/gaussian-opacity-fields",
            "nerf-synthetic": "nerf_synthetic.zip of the NeRF authors (linked from github.com/bmild/nerf)",
            "mip-nerf-360": "360_v2.zip of the Mip-NeRF 360 project page",
        }[dataset.name]
    )


def _folders(data: Path) -> Iterator[Path]:
    """Yield a folder and those below it, nearest first."""
    level = [data]
    for _ in range(DEPTH + 1):
        yield from level
        level = [sub for folder in level for sub in subfolders(folder)]


def subfolders(folder: Path) -> list[Path]:
    """Return the folders in a folder that are not hidden, by name; none where it cannot be read."""
    try:
        return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))
    except OSError:
        return []  # not ours to read: nothing of the data set is in it


def _first(places: Sequence[Path], name: str) -> Path | None:
    return next((place / name for place in places if (place / name).is_file()), None)
