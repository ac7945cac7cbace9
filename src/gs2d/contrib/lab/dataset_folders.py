"""The paper's data sets as they are distributed: recognises their scenes, and lists missing files with their source."""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gs2d.config.protocols import Protocol, get_protocol
from gs2d.contrib.lab.datasets import (
    DATASETS,
    DTU_SCENES,
    MIP_NERF_360_SCENES,
    NERF_SYNTHETIC_SCENES,
    TNT_SCENES,
    DataSet,
    SceneInfo,
)
from gs2d.contrib.lab.visible_surface import MESH_TRUTHS
from gs2d.core.image_arrays import is_number
from gs2d.core.json_files import read_json
from gs2d.data.file_names import Files, in_any_case
from gs2d.data.known_captures import DATA_SETS, protocol_for
from gs2d.data.readers.colmap import read_images
from gs2d.errors import DataError

# -- missing files -----------------------------------------------------------------------------------------------------
TRAINING, TESTING, SCORING = "for training", "for testing", "to score the surface"
_DTU_2DGS = "get it from the preprocessed DTU of 2DGS (linked from github.com/hbb1/2d-gaussian-splatting)"
_DTU_NEUS = "get it from the DTU scans of NeuS (data_DTU, linked from github.com/Totoro97/NeuS)"
_IMAGES = {".png", ".jpg", ".jpeg"}
CAMERA_FILES = ("cameras_sphere.npz", "cameras.npz")  # DTU


@dataclass(frozen=True)
class MissingPiece:
    """A missing file of a scene."""

    path: Path
    purpose: str  # use of the file, such as "for training"
    source: str  # how to get the file, as a clause

    def line(self) -> str:
        """Return path, purpose and source in one line."""
        return f"{self.path} is missing ({self.purpose}): {self.source}"


def has_dtu_cameras(root: Path) -> bool:
    """Return whether a folder has the projection matrices of a DTU scan."""
    return any((root / name).is_file() for name in CAMERA_FILES)


def _dtu_pieces(root: Path) -> list[MissingPiece]:
    """Return missing files of a DTU scan as prepared by 2DGS (``images``, ``sparse/0``) or NeuS (``image``)."""
    of_2dgs = (root / "sparse").is_dir()  # only 2DGS adds a model
    source = _DTU_2DGS if of_2dgs else _DTU_NEUS
    archive = next((root / name for name in CAMERA_FILES if (root / name).is_file()), None)
    missing = [MissingPiece(root / CAMERA_FILES[0], TRAINING, source)] if archive is None else []
    views = set() if archive is None else _archive_views(archive)
    images = next((root / name for name in ("image", "images") if (root / name).is_dir()), root / "images")
    missing += _numbered(images, views, 6 if images.name == "images" else 3, TRAINING, source)
    masks = next((root / name for name in ("mask", "masks") if (root / name).is_dir()), root / "mask")
    missing += _numbered(masks, views, 3, "to cull the surface", source)
    if of_2dgs:
        missing += _model_files(root / "sparse" / "0", source, purpose="points to start from")
    return missing


def _archive_views(path: Path) -> set[int]:
    """Return the numbers of the views in an archive of cameras, from its table of contents."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (OSError, ValueError, RuntimeError, zipfile.BadZipFile):
        return set()  # the reader of the archive reports the error
    return {int(hit.group(1)) for name in names if (hit := re.fullmatch(r"world_mat_([0-9]{1,18})\.npy", name))}


def _numbered(folder: Path, views: set[int], digits: int, purpose: str, source: str) -> list[MissingPiece]:
    """Return missing files that are named by the number of their view."""
    files = [p for p in folder.iterdir() if p.suffix.lower() in _IMAGES] if folder.is_dir() else []
    numbers = {int(p.stem) for p in files if is_number(p.stem)}
    suffix = files[0].suffix if files else ".png"
    width = len(files[0].stem) if files and is_number(files[0].stem) else digits
    if files and not numbers:  # other names
        return []
    return [MissingPiece(folder / f"{n:0{width}}{suffix}", purpose, source) for n in sorted(views - numbers)]


def _model_files(folder: Path, source: str, *, purpose: str = TRAINING) -> list[MissingPiece]:
    """Return the missing files of a COLMAP model, binary unless one is text."""
    suffix = ".txt" if any(folder.glob("*.txt")) and not any(folder.glob("*.bin")) else ".bin"
    names = [f"{stem}{suffix}" for stem in ("cameras", "images", "points3D")]
    return [MissingPiece(folder / name, purpose, source) for name in names if not (folder / name).is_file()]


def _colmap_pieces(root: Path, folder: str, source: str) -> list[MissingPiece]:
    """Return missing files of the COLMAP model in ``sparse/0`` or ``sparse``, and of its images in a folder."""
    model, flat = root / "sparse" / "0", root / "sparse"
    if not model.is_dir() and any((*flat.glob("*.bin"), *flat.glob("*.txt"))):
        model = flat
    missing = _model_files(model, source)
    kind = "bin" if (model / "images.bin").is_file() else "txt" if (model / "images.txt").is_file() else None
    names = [] if kind is None else sorted(image.name for image in read_images(model, kind))
    return missing + _missing_images(in_any_case(root, folder), names, TRAINING, source)


def _missing_images(folder: Path, names: Sequence[str], purpose: str, source: str) -> list[MissingPiece]:
    """Return the images without a file, by the rules of the readers: letter case and Unicode form may differ."""
    matches = Files([folder]).match([[name] for name in names], moved=False)
    return [
        MissingPiece(folder / name, purpose, source)
        for name, match in zip(names, matches, strict=True)
        if match.path is None
    ]


def _blender_pieces(root: Path, source: str) -> list[MissingPiece]:
    """Return missing files of a NeRF-Synthetic scene: its lists of training and test views, and their images."""
    missing = []
    for split, purpose in (("train", TRAINING), ("test", TESTING)):
        listing = root / f"transforms_{split}.json"
        if not listing.is_file():
            missing.append(MissingPiece(listing, purpose, source))
            continue
        data = read_json(listing)
        try:
            names = [str(frame["file_path"]) for frame in data["frames"]]
        except (KeyError, TypeError) as error:
            raise DataError(f"{listing} must hold frames with a file_path each, got another entry ({error})") from error
        files = [name if Path(name).suffix.lower() in _IMAGES else f"{name}.png" for name in names]
        missing += _missing_images(root, files, purpose, source)
    return missing


# -- the data sets -----------------------------------------------------------------------------------------------------
DEPTH = 3  # levels of folders below the data folder that are searched (TNT_GOF/TrainingSet/Barn)
_COLMAP = ("tnt", "mip-nerf-360")  # data sets of COLMAP captures, which are recognised by name

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


def recognise(root: Path, truth: Path | None = None) -> tuple[DataSet, SceneInfo] | None:
    """Return the data set and scene of a capture, by the name of its folder and its files; None for other captures.

    COLMAP captures need more than a name, as many are called garden or truck: Tanks and Temples the camera log beside
    the images or an official file, Mip-NeRF 360 its ``poses_bounds.npy``. ``truth`` is the folder of official files;
    None: beside the capture.
    """
    root = Path(os.path.abspath(root))  # "." has no name; a link keeps its own
    for dataset in DATASETS.values():
        for info in dataset.scenes:
            if _is_scene(dataset, info, root) and (
                dataset.name not in _COLMAP or _is_proven(dataset, info, root, truth)
            ):
                return dataset, info
    scan = re.search(r"scan_?(\d+)$", root.name.lower())
    if scan and has_dtu_cameras(root):  # a scan that is not in the tables
        number = int(scan.group(1))
        return DTU_SCENES, SceneInfo(f"scan{number}", "dtu", 2, scan=number)
    return None


def missing_lines(root: Path) -> tuple[str, ...]:
    """Return one line for each missing file, or missing folder, that gs2d reads of a capture of a known data set.

    Returns () for other captures, and for lists of views that are broken, which their reader reports.
    """
    match = recognise(root)
    if match is None:
        return ()
    dataset, info = match
    source = _capture_source(dataset)
    try:
        if dataset is DTU_SCENES:
            pieces = _dtu_pieces(root)
        elif dataset is NERF_SYNTHETIC_SCENES:
            pieces = _blender_pieces(root, source)
        else:
            pieces = _colmap_pieces(root, info.images, source)
    except DataError:
        return ()
    if dataset is TNT_SCENES and not (log := published_log(root, info.name)).is_file():
        pieces.append(MissingPiece(log, "only to check the frame", source))
    folders = (piece if piece.path.parent.is_dir() else replace(piece, path=piece.path.parent) for piece in pieces)
    return tuple(dict.fromkeys(piece.line() for piece in folders))


def find_truth(
    dataset: DataSet, info: SceneInfo, root: Path, folder: Path | None = None
) -> tuple[dict[str, Path], tuple[MissingPiece, ...]]:
    """Return the files of a scene's ground truth, and the missing ones.

    They are searched in ``folder``; None: in the capture, the folders above it, and their subfolders.
    """
    above = 2 if dataset.name == "dtu" else 3  # TNT_GOF/TrainingSet/Barn is deeper than DTU/scan24
    places = [folder] if folder is not None else [root, *root.parents[:above]]
    if dataset.name == "dtu":
        names = dtu_truth_files(info.scan or 0)
        near = [place for base in places for place in (base, *subfolders(base))]
        inside = [place for base in near for place in (base, base / "MVS Data", base / "SampleSet" / "MVS Data")]
        files = {kind: path for kind, name in names.items() if (path := _first(inside, name)) is not None}
        if files:  # the missing ones belong beside it
            kind, path = next(iter(files.items()))
            places = [path.parents[names[kind].count("/")]]
    elif dataset.name == "tnt":
        names = tnt_truth_files(info.name)
        candidates = [
            place
            for base in places
            for place in (base, base / info.name, *(sub / info.name for sub in subfolders(base)))
        ]
        best = max(candidates, key=lambda place: _own_pieces(place, names))
        has_any = _own_pieces(best, names) > 0
        files = {kind: best / name for kind, name in names.items() if has_any and (best / name).is_file()}
        places = [best] if has_any else places
    elif dataset.name == "nerf-synthetic":
        names = {"mesh": MESH_TRUTHS[0]}
        at = folder if folder is not None else root
        mesh = next((at / name for name in MESH_TRUTHS if (at / name).is_file()), None)
        files = {} if mesh is None else {"mesh": mesh}
        places = [at]
    else:
        return {}, ()
    lacking = tuple(
        MissingPiece(places[0] / name, SCORING, _TRUTH_SOURCES[dataset.name, kind])
        for kind, name in names.items()
        if kind not in files
    )
    return files, lacking


def protocol_of(root: Path, scene_format: str, truth: Path | None = None) -> Protocol:
    """Return the protocol of a capture: that of its scene in a known data set, else that of its format."""
    name = known_protocol(root, scene_format, truth)
    return protocol_for(scene_format) if name is None else get_protocol(name)


def known_protocol(root: Path, scene_format: str, truth: Path | None = None) -> str | None:
    """Return the name of the protocol of a scene of a known data set; None for other captures."""
    match = recognise(root, truth)
    if match is None or (match[0].name in _COLMAP) != (scene_format == "colmap"):
        return None
    return match[1].protocol


@DATA_SETS.register("paper")
class PaperCaptures:
    """The four data sets of the paper, for ``gs2d train`` and ``gs2d info``."""

    protocol = staticmethod(known_protocol)
    missing = staticmethod(missing_lines)


def dtu_truth_files(scan: int) -> dict[str, str]:
    """Return the ground truth files of a DTU scan by kind, relative to the folders of the data set."""
    return {
        "scan": f"Points/stl/stl{scan:03}_total.ply",
        "mask": f"ObsMask/ObsMask{scan}_10.mat",
        "plane": f"ObsMask/Plane{scan}.mat",
    }


def tnt_truth_files(scene: str) -> dict[str, str]:
    """Return the ground truth files of a scene of Tanks and Temples by kind."""
    return {
        "scan": f"{scene}.ply",
        "crop": f"{scene}.json",
        "transform": f"{scene}_trans.txt",
        "log": f"{scene}_COLMAP_SfM.log",
    }


def published_log(root: Path, scene: str) -> Path:
    """Return the path of the camera log beside the images of a scene of TNT_GOF."""
    return root / tnt_truth_files(scene)["log"]


def _own_pieces(place: Path, names: Mapping[str, str]) -> int:
    """Return a score of the ground truth in a folder. The log alone does not count: captures contain one."""
    own = sum((place / name).is_file() for what, name in names.items() if what != "log")
    return 2 * own + (place / names["log"]).is_file() if own else 0


def _is_scene(dataset: DataSet, info: SceneInfo, root: Path) -> bool:
    """Return whether a folder is a scene, by name (``scan24``, ``nerf_synthetic_lego``) and one characteristic file."""
    name = root.name.lower()
    if name != info.name.lower() and not name.endswith(f"_{info.name.lower()}"):
        return False
    if dataset is DTU_SCENES:
        return has_dtu_cameras(root) or any((root / n).is_dir() for n in ("image", "images"))
    if dataset is NERF_SYNTHETIC_SCENES:
        return any((root / f"transforms_{split}.json").is_file() for split in ("train", "test"))
    if not (root / "sparse").is_dir() and not (root / "images").is_dir():
        return False
    return dataset is not MIP_NERF_360_SCENES or (root / "poses_bounds.npy").is_file() or (root / info.images).is_dir()


def _is_proven(dataset: DataSet, info: SceneInfo, root: Path, truth: Path | None) -> bool:
    """Return whether a folder with the name of a scene is that scene of a data set of COLMAP captures."""
    if root.name.lower() != info.name.lower():
        return False
    if dataset is TNT_SCENES:
        return published_log(root, info.name).is_file() or bool(find_truth(dataset, info, root, truth)[0])
    return (root / "poses_bounds.npy").is_file()


def _capture_source(dataset: DataSet) -> str:
    """Return how to get the captures of a data set."""
    return (
        "get it from "
        + {
            "dtu": "the preprocessed DTU of 2DGS (linked from github.com/hbb1/2d-gaussian-splatting) or NeuS",
            "tnt": "TNT_GOF of the Hugging Face data set ZehaoYu/gaussian-opacity-fields",
            "nerf-synthetic": "nerf_synthetic.zip of the NeRF authors (linked from github.com/bmild/nerf)",
            "mip-nerf-360": "360_v2.zip of the Mip-NeRF 360 project page",
        }[dataset.name]
    )


def subfolders(folder: Path) -> list[Path]:
    """Return the folders in a folder, without hidden ones, by name; [] if it cannot be read."""
    try:
        return sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))
    except OSError:
        return []


def _first(places: Sequence[Path], name: str) -> Path | None:
    return next((place / name for place in places if (place / name).is_file()), None)
