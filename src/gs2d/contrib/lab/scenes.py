"""Captures below a folder, with their protocol and ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gs2d.config.protocols import Protocol, get_protocol
from gs2d.contrib.lab.dataset_folders import (
    DEPTH,
    MESH_TRUTHS,
    find_truth,
    missing_lines,
    protocol_of,
    recognise,
    subfolders,
)
from gs2d.contrib.lab.datasets import DATASETS, DataSet, SceneInfo
from gs2d.contrib.lab.paper_tables import DTU, NERF_SYNTHETIC, TNT
from gs2d.data import detect_format
from gs2d.errors import DataError

PAPER_NAMES = {"dtu": DTU, "tnt": TNT, "nerf-synthetic": NERF_SYNTHETIC, "mip-nerf-360": "Mip-NeRF 360"}
OFFICIAL = ("dtu", "tnt")  # evaluators that need several files


@dataclass(frozen=True)
class SweepScene:
    """A capture of a sweep, with its protocol and ground truth."""

    name: str  # name of the folder
    path: Path
    format: str
    protocol: Protocol
    downscale: int  # factor by which the protocol shrinks images
    data_set: str  # name in the paper; "other (PROTOCOL)" for captures that belong to no known data set
    scene: str  # name in the data set, else of the folder
    truth: Path | None  # for the evaluation; None: none, or one that the evaluation finds
    scored: bool  # whether there is a ground truth
    missing: tuple[str, ...]  # one line for each missing file of the capture or its ground truth, for known data sets


def find_scenes(
    data: Path, names: Sequence[str] = (), *, protocol: str = "auto", truths: Path | None = None
) -> tuple[SweepScene, ...]:
    """Return the captures at or under a folder (up to ``DEPTH`` levels down), sorted by name.

    Only ``names``, if there are any; "lego" also finds a folder "nerf_synthetic_lego". ``protocol`` is a name, or
    "auto": by data set and format of each capture. ``truths`` is a folder of ground truths: ``NAME.ply``, ``NAME.obj``,
    ``NAME/mesh_gt.ply``, or the official files of DTU and Tanks and Temples. Raises DataError or ProtocolError if there
    are no captures, or a name is unknown.
    """
    named = None if protocol == "auto" else get_protocol(protocol)
    if not data.is_dir():
        raise DataError(
            f"--data must be a folder of captures, got {'a file' if data.exists() else 'nothing'} at {data}"
        )
    if truths is not None and not truths.is_dir():
        raise DataError(f"--ground-truth must be a folder with ground truths, got none at {truths}")
    captures = dict(sorted(_captures(data, DEPTH).items()))
    broken = unreadable(data)
    if not captures:
        why = f"; {'; '.join(broken.values())}" if broken else ""
        raise DataError(
            f"{data} must be a capture or contain captures (Blender, nerfstudio, DTU, COLMAP), got none{why}"
        )
    if names:
        chosen = dict.fromkeys(_match(want, captures, data, broken) for want in names)
        captures = {name: captures[name] for name in chosen}
    return tuple(_look_at(name, path.resolve(), named, truths) for name, path in captures.items())


def _captures(folder: Path, depth: int) -> dict[str, Path]:
    """Return the captures at or below a folder by name, without searching inside captures."""
    if _is_capture(folder):
        return {folder.resolve().name: folder}
    captures: dict[str, Path] = {}
    for inner in subfolders(folder) if depth else ():
        for name, path in _captures(inner, depth - 1).items():
            if name in captures:
                raise DataError(f"{captures[name]} and {path} have the same name; give --data one of them")
            captures[name] = path
    return captures


def unreadable(folder: Path, depth: int = DEPTH) -> dict[str, str]:
    """Return the first missing file by name, for scenes of known data sets without cameras."""
    if _is_capture(folder):
        return {}
    lines = missing_lines(folder)
    first_missing = {folder.resolve().name: lines[0]} if lines else {}
    for inner in subfolders(folder) if depth else ():
        first_missing |= unreadable(inner, depth - 1)
    return first_missing


def _is_capture(folder: Path) -> bool:
    try:
        detect_format(folder)
    except DataError:
        return False
    return True


def _match(want: str, captures: dict[str, Path], data: Path, broken: dict[str, str]) -> str:
    """Return the name of the capture that a name stands for."""
    close = _named(want, list(captures))
    if len(close) != 1:
        why = "".join(f"; {name}: {broken[name]}" for name in _named(want, list(broken)))
        raise DataError(f"no scene {want!r} in {data}; there is {', '.join(captures)}{why}")
    return close[0]


def _named(want: str, names: Sequence[str]) -> list[str]:
    """Return the names equal to ``want``, else those that end in it."""
    close = [name for name in names if name.lower() == want.lower()]
    return close or [name for name in names if name.lower().endswith(f"_{want.lower()}")]


def _look_at(name: str, path: Path, named: Protocol | None, truths: Path | None) -> SweepScene:
    kind = detect_format(path)
    protocol = named or protocol_of(path, kind, truths)
    match = recognise(path, truths)
    if match is not None and protocol.name not in {scene.protocol for scene in match[0].scenes}:
        match = None  # the name of a scene by coincidence, or another protocol was requested
    if match is None:
        data_set = f"other ({protocol.name})"
        truth = _plain_truth(name, path, truths)
        return SweepScene(name, path, kind, protocol, protocol.downscale, data_set, name, truth, truth is not None, ())
    dataset, info = match
    truth, scored = _truth_of(dataset, info, name, path, truths)
    missing = missing_lines(path)
    if not scored:
        missing += tuple(piece.line() for piece in find_truth(dataset, info, path, truths)[1])
    place = (PAPER_NAMES[dataset.name], info.name)
    downscale = info.downscale if named is None else protocol.downscale
    return SweepScene(name, path, kind, protocol, downscale, *place, truth, scored, missing)


def _truth_of(
    dataset: DataSet, info: SceneInfo, name: str, path: Path, truths: Path | None
) -> tuple[Path | None, bool]:
    """Return the ground truth for the evaluation of a scene, and whether there is any."""
    if dataset.evaluator in OFFICIAL:
        files, missing = find_truth(dataset, info, path, truths)
        if files and not missing:
            return truths, True
    own = _plain_truth(name, path, truths) or _plain_truth(info.name, path, truths)
    return own, own is not None


def _plain_truth(name: str, capture: Path, folder: Path | None) -> Path | None:
    """Return a true mesh or point cloud in a folder or beside the capture."""
    candidates = [capture / file for file in MESH_TRUTHS]
    if folder is not None:
        own = [folder / f"{name}.ply", folder / f"{name}.obj", *(folder / name / file for file in MESH_TRUTHS)]
        candidates = [*own, *candidates]
    return next((path for path in candidates if path.is_file()), None)


def missing_scenes(scenes: Sequence[SweepScene]) -> dict[str, tuple[list[str], int]]:
    """Return the missing scenes and the number of scenes of each data set of which some are present."""
    missing: dict[str, tuple[list[str], int]] = {}
    for key, data_set in PAPER_NAMES.items():
        have = {scene.scene for scene in scenes if scene.data_set == data_set}
        names = [scene.name for scene in DATASETS[key].scenes]
        absent = [name for name in names if name not in have]
        if have and absent:
            missing[data_set] = (absent, len(names))
    return missing
