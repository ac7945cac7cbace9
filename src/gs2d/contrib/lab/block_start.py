"""Read and write the initial state of a block: the coarse splats that it trains, and exposures of its views."""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.config.protocols import Protocol
from gs2d.config.recipe import Recipe, validate
from gs2d.core.atomic_files import atomic_write
from gs2d.core.splats import Splats
from gs2d.data import Scene
from gs2d.data.arrays import read_npz
from gs2d.errors import DataError, RunError
from gs2d.io.splat_ply import read_splats
from gs2d.pipeline.prepare.loaded import LoadedRun, loaded_run, scene_digest, with_priors
from gs2d.pipeline.prepare.open_capture import open_capture, without_masked_points
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.pipeline.prepare.resolve import schedule_scale_of
from gs2d.training.events import OnEvent
from gs2d.training.start.initialize import splats_as_start
from gs2d.training.trainer import TrainerOptions

ABSENT, FROZEN, OWN = 0, 1, 2  # states of a row of the coarse splats


def write_start(path: Path, rows: np.ndarray, exposures: np.ndarray | None) -> None:
    """Write rows [N] uint8 (``ABSENT``, ``FROZEN`` or ``OWN``) and exposures [V, 3, 4] of the views."""
    packed, none = io.BytesIO(), np.zeros((0, 3, 4), np.float32)
    np.savez_compressed(packed, rows=rows, exposures=none if exposures is None else exposures)
    with atomic_write(path) as file:
        file.write(packed.getvalue())


def read_start(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the rows and exposures that :func:`write_start` wrote."""
    try:
        data = read_npz(path, "start of a block", lambda name: name in ("rows", "exposures"))
        rows, exposures = data["rows"], data["exposures"]
        if rows.dtype != np.uint8 or rows.ndim != 1 or rows.max(initial=0) > OWN:
            raise ValueError(f"rows are {rows.dtype} {rows.shape}")
    except (DataError, KeyError, ValueError) as error:
        raise RunError(
            f"{path} is not the start of a block ({' '.join(str(error).split())[:120]}); delete the folder "
            f"{path.parent} and run the command again"
        ) from error
    return rows, exposures if len(exposures) else None


def load_start(
    splats_file: Path, start_file: Path, recipe: Recipe, region: tuple[tuple[Any, ...], ...] = ()
) -> dict[str, Any]:
    """Return the initial state of a block, as fields of ``TrainedPart``.

    ``start_file`` was written by :func:`write_start` for the splats in ``splats_file``, which were trained before.
    ``region`` has the axes of the block, lower and upper limits along them (world units), or is (); a dense start is
    limited to it.
    """
    splats = splats_as_start(read_splats(splats_file), sh_degree=recipe.sh_degree)
    rows, saved = read_start(start_file)
    if len(rows) != len(splats):
        raise RunError(
            f"{start_file} is of {len(rows):,} splats, {splats_file} has {len(splats):,}; delete the first and run the "
            "command again"
        )
    digest, exposures = hashlib.sha256(splats_file.read_bytes() + rows.tobytes()), None
    if saved is not None and recipe.learns("exposure"):
        exposures = torch.from_numpy(np.ascontiguousarray(saved, np.float32))
        digest.update(exposures.numpy().tobytes())
    digest.update(repr(region).encode() if region else b"")
    kinds = torch.from_numpy(rows)
    within = partial(inside, region) if region and recipe.dense_start is not None else None
    options = TrainerOptions(frozen=splats.rows(kinds == FROZEN), exposures=exposures, within=within)
    return {"own": splats.rows(kinds == OWN), "options": options, "digest": digest.hexdigest()}


def inside(region: tuple[tuple[Any, ...], ...], points: Tensor) -> Tensor:
    """Return whether points [M, 3] are in a region, [M] bool."""
    axes, low, high = (np.array(part, np.float64) for part in region)
    along = points.detach().cpu().numpy().astype(np.float64) @ axes.T
    return torch.from_numpy(((along >= low) & (along < high)).all(axis=1)).to(points.device)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainedPart:
    """A part of a scene with its own recipe and protocol; only its splats are written."""

    recipe: Recipe
    protocol: Protocol
    views: tuple[str, ...] = ()  # names of the training views, without test views; (): the split of the capture
    extent: float | None = None  # world units; None: that of the capture
    own: Splats | None = None  # the splats that are trained; None: initialised from points
    # The frozen splats around them, the region of a dense start, and fixed exposures.
    options: TrainerOptions = field(default_factory=TrainerOptions)
    digest: str | None = None  # hash of `own` and `options`

    def scene_of(self, scene: Scene) -> Scene:
        """Return the scene with the views and the extent of the part."""
        scene = scene if self.extent is None else replace(scene, extent=self.extent)
        if not self.views:
            return scene
        by_name = {view.name: view for view in scene.train}
        missing = [name for name in self.views if name not in by_name]
        if missing:
            raise DataError(
                f"{scene.root} has no training view {missing[0]} of this part ({len(missing)} missing); restore the "
                "capture, or use another --out"
            )
        return replace(scene, train=tuple(by_name[name] for name in self.views), test=())

    def prepare(self, options: TrainOptions, on_event: OnEvent) -> LoadedRun:
        """Read the capture and return the run of the part; options of recipe and protocol are not used."""
        capture = open_capture(replace(options, protocol=self.protocol, test_every=None), on_event)
        scene, scale = self.scene_of(capture.scene), schedule_scale_of(options, capture)
        digest = scene_digest(scene, on_event, uses_masks=capture.protocol.use_mask_in_training)
        scene = without_masked_points(scene, capture.protocol, on_event)
        digest = with_priors(digest, scene, validate(self.recipe), on_event)
        capture = replace(capture, scene=scene)
        run = loaded_run(options, self.recipe, capture, digest, schedule_scale=scale, part=self.digest)
        return replace(run, init=self.own, options=self.options)
