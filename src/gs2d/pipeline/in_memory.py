"""Train, score and mesh from Python without a run folder: ``gs2d.train``, ``gs2d.evaluate``, ``gs2d.extract_mesh``.

The same pieces as behind the commands, in the same order and with the same defaults; nothing is written.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

from gs2d.config.presets import DEFAULT_RECIPE
from gs2d.config.protocols import Protocol
from gs2d.config.recipe import Recipe
from gs2d.core.mesh import Mesh
from gs2d.core.splats import Splats
from gs2d.data import Scene, load_scene
from gs2d.data.subject_box import OBJECT
from gs2d.errors import DataError, ProtocolError
from gs2d.evaluation.image_metrics import ImageMetrics, mean_metrics
from gs2d.evaluation.lpips import Lpips
from gs2d.pipeline.finish.run_mesh import fused
from gs2d.pipeline.finish.run_subject import subject_in, wants_subject
from gs2d.pipeline.finish.scoring import score_views
from gs2d.pipeline.prepare.open_capture import capture_in_memory
from gs2d.pipeline.prepare.options import MeshOptions, Robust, Training
from gs2d.pipeline.prepare.predicted_exposure import metered, with_predicted
from gs2d.pipeline.prepare.resolve import resolve
from gs2d.pipeline.train.progress_bar import progress_bar
from gs2d.render.backends import Backend
from gs2d.render.types import RasterSettings
from gs2d.training.events import ignore
from gs2d.training.trainer import Trainer, raster_settings

__all__ = ["Trained", "evaluate", "extract_mesh", "train"]

OnAnyEvent = Callable[[Any], None]


@dataclass(frozen=True, eq=False)
class Trained:
    """A finished scene of splats with what it was trained with: what scoring and meshing need to know.

    Attributes
    ----------
    splats : Splats
    scene : Scene
        With what was learned of images and cameras: poses, ``View.appearance``.
    protocol : Protocol
    settings : RasterSettings
        The rasterizer's constants in training: near, far, background.
    backend : Backend
    recipe : Recipe or None
        As it was trained; None for splats from elsewhere.
    """

    splats: Splats
    scene: Scene
    protocol: Protocol
    settings: RasterSettings
    backend: Backend
    recipe: Recipe | None = None


def train(
    scene: Scene | str | os.PathLike[str],
    recipe: str | Recipe = DEFAULT_RECIPE,
    *,
    protocol: str | Protocol = "auto",
    backend: str = "auto",
    iterations: int | None = None,
    schedule_scale: float = 1.0,
    overrides: tuple[str, ...] = (),
    seed: int = 0,
    robust: Robust = "auto",
    exposure: bool | None = None,
    progress: bool = False,
    on_event: OnAnyEvent = ignore,
) -> Trained:
    """Train splats in memory, as ``gs2d train`` does, without writing a run folder.

    ``gs2d.pipeline.train.train_run.train`` writes one, with checkpoints, metrics, a mesh and a report;
    :class:`gs2d.Trainer` is the loop alone, one iteration at a time.

    Parameters
    ----------
    scene : Scene or path
        A capture: what :func:`gs2d.load_scene` returns, or its folder.
    recipe : str or Recipe
        A name of :func:`gs2d.list_recipes`, or a recipe.
    protocol : str or Protocol
        "auto": by the capture.
    backend : str
        "auto", "cpu", "cuda" or "reference".
    iterations : int, optional
        Total iterations of the schedule; all of it is scaled. Excludes ``schedule_scale``. None: the recipe's own.
    schedule_scale : float
        Length of the schedule as a fraction of the recipe's; 0.1 is a tenth.
    overrides : tuple of str
        ``stage.field=value``, applied after the schedule is scaled.
    seed : int
    robust : str
        "auto", "on" or "off": help for captures that have sparse points (``gs2d train --robust``).
    exposure : bool, optional
        Learn an exposure for each image; None: where the images differ.
    progress : bool
        Show notices and a progress bar on stderr.
    on_event : callable
        Gets the events of :mod:`gs2d.training.events`, and Notices of what was decided before.

    Returns
    -------
    Trained
        ``.splats``, and all that :func:`gs2d.evaluate` and :func:`gs2d.extract_mesh` need.

    Raises
    ------
    Gs2dError
        If an argument, the recipe or the capture is wrong; the message says what to do.

    Examples
    --------
    >>> scene = gs2d.load_scene("captures/garden", downscale=4)  # doctest: +SKIP
    >>> trained = gs2d.train(scene, iterations=3000, progress=True)  # doctest: +SKIP
    >>> trained.splats.save("garden.ply")  # doctest: +SKIP
    """
    scene = scene if isinstance(scene, Scene) else load_scene(scene)
    training = Training(
        recipe=recipe,
        overrides=overrides,
        robust=robust,
        exposure=exposure is True,
        no_exposure=exposure is False,
    )
    with progress_bar(on_event) if progress else nullcontext(on_event) as tell:
        capture = capture_in_memory(scene, protocol, backend, tell)
        fitted, opened = resolve(
            training, capture, tell, seed=seed, schedule_scale=schedule_scale, iterations=iterations
        )
        scene, rules, chosen = opened.scene, opened.protocol, opened.backend
        trainer = Trainer(scene, fitted, rules, backend=chosen, on_event=tell)
        trainer.run()
    return Trained(trainer.splats, trainer.scene_now(), rules, trainer.settings, chosen, trainer.recipe)


def _finished(
    trained: Trained | Splats, scene: Scene | None, protocol: str | Protocol, backend: str, on_event: OnAnyEvent
) -> Trained:
    """Return what was trained, or splats from elsewhere with the scene and the protocol that they belong to."""
    if isinstance(trained, Trained):
        if scene is not None:
            raise DataError("what gs2d.train returned has a scene of its own, got another; give its .splats instead")
        return trained
    if scene is None:
        raise DataError("splats must come with the scene that they are of, got none; give it as the second argument")
    opened = capture_in_memory(scene, protocol, backend, on_event)
    settings = raster_settings(opened.protocol, scene.extent, trained.sh_degree)
    return Trained(trained.to(opened.backend.device), scene, opened.protocol, settings, opened.backend)


def evaluate(
    trained: Trained | Splats,
    scene: Scene | None = None,
    *,
    split: str = "test",
    protocol: str | Protocol = "auto",
    backend: str = "auto",
    lpips: Lpips | None = None,
    on_event: OnAnyEvent = ignore,
) -> ImageMetrics:
    """Return the mean PSNR, SSIM and LPIPS of views, as ``gs2d evaluate`` measures them.

    Surfaces are scored by :func:`gs2d.evaluation.surface_score.evaluate_surface`.

    Parameters
    ----------
    trained : Trained or Splats
        What :func:`gs2d.train` returned; or splats, with ``scene``.
    scene : Scene, optional
        The capture of splats from elsewhere.
    split : str
        "test" or "train": the views that are scored.
    protocol, backend
        Of splats from elsewhere; as for :func:`gs2d.train`.
    lpips : Lpips, optional
        The network (``gs2d.evaluation.lpips.load_lpips``); without it LPIPS is absent, with the reason.
    on_event : callable
        Gets Phase and Step events.

    Returns
    -------
    ImageMetrics

    Raises
    ------
    DataError
        No such views, or no scene for splats.
    """
    finished = _finished(trained, scene, protocol, backend, on_event)
    if split not in ("test", "train"):
        raise DataError(f"split must be 'test' or 'train', got {split!r}")
    scene = with_predicted(finished.scene, metered(finished.splats, finished.settings, finished.backend))
    views = scene.test if split == "test" else scene.train
    if not views:
        raise DataError(
            f"scene {finished.scene.name} has no {split} views to score; load it with test_every=8, or take "
            "split='train'"
        )
    scores = score_views(
        finished.splats,
        views,
        finished.settings,
        finished.backend,
        name=f"scoring {split} views",
        on_event=on_event,
        lpips=lpips,
        split=split,
    )
    return mean_metrics(list(scores.values()))


def extract_mesh(
    trained: Trained | Splats,
    scene: Scene | None = None,
    *,
    voxel: float | None = None,
    options: MeshOptions = MeshOptions(),  # noqa: B008 (frozen)
    protocol: str | Protocol = "auto",
    backend: str = "auto",
    on_event: OnAnyEvent = ignore,
) -> Mesh:
    """Fuse the depth that the training cameras see into a triangle mesh, as ``gs2d mesh`` does.

    Parameters
    ----------
    trained : Trained or Splats
        What :func:`gs2d.train` returned; or splats, with ``scene``.
    scene : Scene, optional
        The capture of splats from elsewhere.
    voxel : float, optional
        Voxel size, world units; the same as ``options.voxel``. None: from the scene.
    options : MeshOptions
        Box, depth and so on; what is None comes from the scene and the protocol.
    protocol, backend
        Of splats from elsewhere; as for :func:`gs2d.train`.
    on_event : callable
        Gets Phase, Step and Notice events.

    Returns
    -------
    Mesh
        In the capture's frame, with colours; of the subject where the protocol meshes the subject and there is one.
    """
    if voxel is not None:
        if options.voxel is not None:
            raise ProtocolError(f"voxel was given twice, as {voxel} and in options as {options.voxel}; leave one out")
        options = replace(options, voxel=voxel)
    finished = _finished(trained, scene, protocol, backend, on_event)
    subject = None
    if wants_subject(finished, options):
        found = subject_in(finished, finished.splats, options.subject_box)
        subject = found if found.kind == OBJECT else None
    return fused(finished, finished.splats, options, on_event, subject=subject).mesh
