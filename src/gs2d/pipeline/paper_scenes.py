"""The scenes under a folder, the protocol of each, and the ground truth that lies beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gs2d.data import detect_format
from gs2d.errors import DataError
from gs2d.paper_tables import DTU, NERF_SYNTHETIC, SCENES, TNT
from gs2d.protocols import Protocol, get_protocol, protocol_for

DEPTH = 3  # folders below the data folder in which captures are looked for (TNT_GOF/TrainingSet/Barn)
TRUTHS = ("mesh_gt.ply", "mesh_gt.obj", "points_gt.ply")
_DATA_SETS = {"dtu": DTU, "tnt": TNT, "tnt-large": TNT, "nerf-synthetic": NERF_SYNTHETIC}


@dataclass(frozen=True)
class FoundScene:
    """A capture.

    Attributes
    ----------
    name : str
        Its folder's name.
    path : Path
    format : str
    protocol : Protocol
    truth : Path or None
        The true surface, if one lies beside it.
    """

    name: str
    path: Path
    format: str
    protocol: Protocol
    truth: Path | None

    @property
    def data_set(self) -> str:
        """The data set by the paper's name; the protocol's own name for those the paper does not have."""
        return _DATA_SETS.get(self.protocol.name, self.protocol.name)


def find_scenes(
    data: Path, names: Sequence[str] = (), *, protocol: str = "auto", truths: Path | None = None
) -> tuple[FoundScene, ...]:
    """The captures at or under a folder, sorted by name.

    Parameters
    ----------
    data : Path
        A capture, or a folder that holds captures (up to ``DEPTH`` levels down).
    names : sequence of str
        Only these; "lego" also finds a folder "nerf_synthetic_lego".
    protocol : str
        A name, or "auto": by the format of each capture.
    truths : Path, optional
        Folder of ground truths: ``NAME.ply``, ``NAME.obj`` or ``NAME/mesh_gt.ply``.

    Raises
    ------
    DataError, ProtocolError
        No captures, or a name that is not there.
    """
    named = None if protocol == "auto" else get_protocol(protocol)
    if not data.is_dir():
        raise DataError(
            f"--data must be a folder of captures, got {'a file' if data.exists() else 'nothing'} at {data}"
        )
    if truths is not None and not truths.is_dir():
        raise DataError(f"--truth must be a folder of true surfaces, found none at {truths}")
    captures = dict(sorted(_captures(data, DEPTH).items()))
    if not captures:
        raise DataError(f"{data} must be a capture or hold captures (Blender, nerfstudio, DTU, COLMAP), found none")
    if names:
        captures = {name: captures[name] for name in dict.fromkeys(_match(want, captures, data) for want in names)}
    scenes = []
    for name, path in captures.items():
        kind = detect_format(path)
        scenes.append(FoundScene(name, path, kind, named or protocol_for(kind), _truth(name, path, truths)))
    return tuple(scenes)


def _captures(folder: Path, depth: int) -> dict[str, Path]:
    """Name -> folder of the captures at or below a folder; a capture's own folders are not searched."""
    try:
        detect_format(folder)
    except DataError:
        found: dict[str, Path] = {}
        if depth:
            for inner in sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".")):
                for name, path in _captures(inner, depth - 1).items():
                    if name in found:
                        raise DataError(
                            f"{found[name]} and {path} have the same name; give --data one of them"
                        ) from None
                    found[name] = path
        return found
    return {folder.resolve().name: folder}


def _match(want: str, captures: dict[str, Path], data: Path) -> str:
    """The capture that a name means."""
    close = [name for name in captures if name.lower() == want.lower()]
    close = close or [name for name in captures if name.lower().endswith(f"_{want.lower()}")]
    if len(close) != 1:
        raise DataError(f"no scene {want!r} in {data}; there is {', '.join(captures)}")
    return close[0]


def _truth(name: str, capture: Path, folder: Path | None) -> Path | None:
    candidates = [capture / file for file in TRUTHS]
    if folder is not None:
        own = [folder / f"{name}.ply", folder / f"{name}.obj", *(folder / name / file for file in TRUTHS)]
        candidates = [*own, *candidates]
    return next((path for path in candidates if path.is_file()), None)


def missing_scenes(scenes: Sequence[FoundScene]) -> dict[str, list[str]]:
    """Data set -> the scenes of the paper's protocol that were not given, for the data sets of which some were."""
    found: dict[str, list[str]] = {}
    for data_set in dict.fromkeys(scene.data_set for scene in scenes):
        have = [scene.name.lower() for scene in scenes if scene.data_set == data_set]
        missing = [
            name
            for name in SCENES.get(data_set, ())
            if not any(n == name.lower() or n.endswith("_" + name.lower()) for n in have)
        ]
        if missing:
            found[data_set] = missing
    return found
