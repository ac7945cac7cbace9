"""A part of a larger training: its photographs, the splats that it begins with, and those that stay around it."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.config.protocols import Protocol
from gs2d.config.recipe import Recipe
from gs2d.core.atomic_files import atomic_write
from gs2d.core.splats import Splats
from gs2d.data import Scene
from gs2d.data.arrays import read_npz
from gs2d.errors import DataError, RunError
from gs2d.io.splat_ply import read_splats
from gs2d.training.initialize import splats_as_start

ABSENT, FROZEN, OWN = 0, 1, 2  # of a row of the splats that were trained before


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of a larger training, for which the whole has decided recipe and protocol; only splats are written.

    Attributes
    ----------
    recipe, protocol
        As the part is trained.
    views : tuple of str
        Training views, by name, and no test views; () = the views of the capture as they are.
    splats, start : Path or None
        Splats that were trained before; and a file of which of them train, which stay frozen around them, and of the
        exposures of the views (:func:`write_start`).
    region : three tuples, or ()
        Axes, lower and upper ends along them of where the part lies, world units: a dense start is made there.
    extent : float or None
        Of the part, world units, where it is not that of the capture.
    prepared : Path or None
        Where prepared photographs lie, so that parts share them; None: in the run.
    """

    recipe: Recipe
    protocol: Protocol
    views: tuple[str, ...] = ()
    splats: Path | None = None
    start: Path | None = None
    region: tuple[tuple[Any, ...], ...] = ()
    extent: float | None = None
    prepared: Path | None = None


@dataclass(frozen=True, eq=False)
class LoadedPart:
    """What a part begins with.

    Attributes
    ----------
    own : Splats
        That train.
    frozen : Splats
        That are rendered with them and stay.
    exposures : Tensor [V, 3, 4] or None
        Of its training views, where the recipe learns exposures.
    digest : str
        Of all that.
    within : callable or None
        Which places [M, 3] it is of, [M] bool, where training begins with a dense start of those.
    """

    own: Splats
    frozen: Splats
    exposures: Tensor | None
    digest: str
    within: Callable[[Tensor], Tensor] | None = None


def part_scene(scene: Scene, part: Part) -> Scene:
    """Return the scene with the views of a part, and its extent.

    Raises
    ------
    DataError
        The capture lacks one of them.
    """
    scene = scene if part.extent is None else replace(scene, extent=part.extent)
    if not part.views:
        return scene
    by_name = {view.name: view for view in scene.train}
    missing = [name for name in part.views if name not in by_name]
    if missing:
        raise DataError(
            f"{scene.root} must have the training view {missing[0]}, which a part was cut with, got none of this name "
            f"({len(missing)} missing); restore the capture, or begin in another --out"
        )
    return replace(scene, train=tuple(by_name[name] for name in part.views), test=())


def write_start(path: Path, rows: np.ndarray, exposures: np.ndarray | None) -> None:
    """Write which splats train [N] uint8: ``ABSENT``, ``FROZEN`` or ``OWN``; and exposures [V, 3, 4] of the views."""
    packed, none = io.BytesIO(), np.zeros((0, 3, 4), np.float32)
    np.savez_compressed(packed, rows=rows, exposures=none if exposures is None else exposures)
    with atomic_write(path) as file:
        file.write(packed.getvalue())


def read_start(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Return what :func:`write_start` wrote: rows and exposures.

    Raises
    ------
    RunError
        Missing or damaged.
    """
    try:
        found = read_npz(path, "start of a block", lambda name: name in ("rows", "exposures"))
        rows, exposures = found["rows"], found["exposures"]
        if rows.dtype != np.uint8 or rows.ndim != 1 or rows.max(initial=0) > OWN:
            raise ValueError(f"it has {rows.dtype} {rows.shape}")
    except (DataError, KeyError, ValueError) as error:
        raise RunError(
            f"{path} must say which splats a block trains, got {' '.join(str(error).split())[:120]}; delete the folder "
            f"{path.parent} and run the command again"
        ) from error
    return rows, exposures if len(exposures) else None


def load_part(part: Part, scene: Scene, recipe: Recipe) -> LoadedPart:
    """Read what a part begins with."""
    assert part.splats is not None
    assert part.start is not None
    splats = splats_as_start(read_splats(part.splats), sh_degree=recipe.sh_degree)
    rows, given = read_start(part.start)
    if len(rows) != len(splats):
        raise RunError(
            f"{part.start} must be of {len(splats):,} splats, as {part.splats} has, got {len(rows):,}; one of them was "
            "changed: delete the first and run the command again"
        )
    digest, exposures = hashlib.sha256(part.splats.read_bytes() + rows.tobytes()), None
    if given is not None and recipe.exposure is not None:
        exposures = torch.from_numpy(np.ascontiguousarray(given, np.float32))
        digest.update(exposures.numpy().tobytes())
        if exposures.shape != (len(scene.train), 3, 4):
            raise RunError(f"{part.start} must have exposures of {len(scene.train)} views, got {len(exposures)}")
    digest.update(repr(part.region).encode() if part.region else b"")
    found, within = torch.from_numpy(rows), partial(inside, part.region) if part.region else None
    return LoadedPart(splats.rows(found == OWN), splats.rows(found == FROZEN), exposures, digest.hexdigest(), within)


def inside(region: tuple[tuple[Any, ...], ...], places: Tensor) -> Tensor:
    """Return which places [M, 3] lie in a region: axes, lower and upper ends along them."""
    axes, low, high = (np.array(part, np.float64) for part in region)
    along = places.detach().cpu().numpy().astype(np.float64) @ axes.T
    return torch.from_numpy(((along >= low) & (along < high)).all(axis=1)).to(places.device)
