"""Train, score and mesh without a run folder: ``gs2d.train``, ``gs2d.evaluate`` and ``gs2d.extract_mesh``."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from gs2d.config.presets import DEFAULT_RECIPE
from gs2d.config.protocols import Protocol
from gs2d.config.recipe import Recipe
from gs2d.core.mesh import Mesh
from gs2d.core.splats import Splats
from gs2d.core.text import printable
from gs2d.data import Scene, load_scene
from gs2d.errors import DataError, ProtocolError
from gs2d.evaluation.image_metrics import ImageMetrics, mean_metrics
from gs2d.evaluation.lpips import Lpips
from gs2d.pipeline.finish.run_mesh import fused
from gs2d.pipeline.finish.run_subject import meshed_subject
from gs2d.pipeline.finish.scoring import score_views
from gs2d.pipeline.prepare.loaded import Trained, trained_elsewhere
from gs2d.pipeline.prepare.open_capture import capture_in_memory
from gs2d.pipeline.prepare.options import MeshOptions, Training
from gs2d.pipeline.prepare.predicted_views import predicted
from gs2d.pipeline.prepare.resolve import recipe_of, resolve
from gs2d.training.events import Event, Notice, OnEvent, Progress, StageStarted, ignore
from gs2d.training.trainer import Trainer

__all__ = ["Trained", "evaluate", "extract_mesh", "train"]


def train(
    scene: Scene | str | os.PathLike[str],
    recipe: str | Recipe = DEFAULT_RECIPE,
    *,
    iterations: int | None = None,
    schedule_scale: float = 1.0,
    backend: str = "auto",
    progress: bool = False,
    on_event: OnEvent = ignore,
    options: Training = Training(),  # noqa: B008 (frozen)
) -> Trained:
    """Train splats in memory, without a run folder.

    ``gs2d.pipeline.train.train_run.train`` writes a run folder with checkpoints, metrics, a mesh and a report;
    :class:`gs2d.Trainer` is the training loop alone. Unlike ``gs2d train``, this function trains the whole recipe on
    the images of ``scene`` as they are loaded, unless ``iterations`` or ``schedule_scale`` shorten it.

    Parameters
    ----------
    scene : Scene or path
        A capture: the result of :func:`gs2d.load_scene`, or its folder.
    recipe : str or Recipe
        A name of :func:`gs2d.list_recipes`, or a recipe. Its ``seed`` is used.
    iterations : int, optional
        Total iterations, to which all stages are scaled. Excludes ``schedule_scale``.
    schedule_scale : float
        Fraction of the recipe's iterations.
    backend : str
        "auto", "cpu", "cuda" or "reference".
    progress : bool
        Show notices and a progress bar on stderr.
    on_event : callable
        Receives the events of :mod:`gs2d.training.events`.
    options : gs2d.Training
        Further options of ``gs2d train``: protocol, robust, learn, overrides and so on. Its recipe is
        not used, nor are options of run folders and of loading the capture.

    Returns
    -------
    Trained
        ``.splats``, and the input of :func:`gs2d.evaluate` and :func:`gs2d.extract_mesh`.

    Raises
    ------
    Gs2dError
        If an argument, the recipe or the capture is invalid; the message says what to do.

    Examples
    --------
    >>> scene = gs2d.load_scene("captures/garden", downscale=4)  # doctest: +SKIP
    >>> trained = gs2d.train(scene, iterations=3000, progress=True)  # doctest: +SKIP
    >>> trained.splats.save("garden.ply")  # doctest: +SKIP
    """
    scene = scene if isinstance(scene, Scene) else load_scene(scene)
    options, seed = replace(options, recipe=recipe), recipe_of(recipe).seed
    with progress_bar(on_event) if progress else nullcontext(on_event) as listen:
        capture = capture_in_memory(scene, options.protocol, backend, listen)
        trained_recipe, capture = resolve(
            options, capture, listen, seed=seed, schedule_scale=schedule_scale, iterations=iterations
        )
        protocol, chosen = capture.protocol, capture.backend
        trainer = Trainer(capture.scene, trained_recipe, protocol, backend=chosen, on_event=listen)
        trainer.run()
    return Trained(trainer.splats, trainer.scene_now(), protocol, trainer.settings, chosen, trainer.recipe)


def _finished(
    trained: Trained | Splats, scene: Scene | None, protocol: str | Protocol, backend: str, on_event: OnEvent
) -> Trained:
    """Return the result of training, or splats from elsewhere with their scene and protocol."""
    if isinstance(trained, Trained):
        if scene is not None:
            raise DataError("the result of gs2d.train has a scene of its own, got another; pass its .splats instead")
        return trained
    if scene is None:
        raise DataError("splats need the scene that they belong to; pass it as the second argument")
    return trained_elsewhere(trained, scene, protocol, backend, on_event)


def evaluate(
    trained: Trained | Splats,
    scene: Scene | None = None,
    *,
    split: str = "test",
    protocol: str | Protocol = "auto",
    backend: str = "auto",
    lpips: Lpips | None = None,
    on_event: OnEvent = ignore,
) -> ImageMetrics:
    """Return the mean PSNR, SSIM and LPIPS of views, as ``gs2d evaluate`` measures them.

    Surfaces are scored by :func:`gs2d.contrib.lab.surface_score.evaluate_surface`.

    Parameters
    ----------
    trained : Trained or Splats
        The result of :func:`gs2d.train`; or splats, with ``scene``.
    scene : Scene, optional
        The capture of splats from elsewhere.
    split : str
        "test" or "train".
    protocol : str or Protocol
        For splats from elsewhere.
    backend : str
        For splats from elsewhere.
    lpips : Lpips, optional
        The network (``gs2d.evaluation.lpips.load_lpips``); without it LPIPS is absent, with the reason.
    on_event : callable
        Receives Phase and Step events.

    Returns
    -------
    ImageMetrics

    Raises
    ------
    DataError
        If there are no such views, or splats have no scene.
    """
    finished = _finished(trained, scene, protocol, backend, on_event)
    if split not in ("test", "train"):
        raise DataError(f"split must be 'test' or 'train', got {split!r}")
    scene = predicted(finished).scene
    views = scene.test if split == "test" else scene.train
    if not views:
        raise DataError(f"scene {scene.name} has no {split} views; load it with test_every=8, or use split='train'")
    scores = score_views(finished, views, on_event, split=split, lpips=lpips)
    return mean_metrics(list(scores.values()))


def extract_mesh(
    trained: Trained | Splats,
    scene: Scene | None = None,
    *,
    voxel: float | None = None,
    options: MeshOptions = MeshOptions(),  # noqa: B008 (frozen)
    protocol: str | Protocol = "auto",
    backend: str = "auto",
    on_event: OnEvent = ignore,
) -> Mesh:
    """Fuse rendered depth maps of the training cameras into a triangle mesh, as ``gs2d mesh`` does.

    Parameters
    ----------
    trained : Trained or Splats
        The result of :func:`gs2d.train`; or splats, with ``scene``.
    scene : Scene, optional
        The capture of splats from elsewhere.
    voxel : float, optional
        Voxel size in world units, the same as ``options.voxel``. None: from the scene.
    options : MeshOptions
        Box, depth and so on. None values are derived from the scene and the protocol.
    protocol : str or Protocol
        For splats from elsewhere.
    backend : str
        For splats from elsewhere.
    on_event : callable
        Receives Phase, Step and Notice events.

    Returns
    -------
    Mesh
        In the frame of the capture, with colours; of the subject, if the protocol meshes the subject and finds one.
    """
    if voxel is not None:
        if options.voxel is not None:
            raise ProtocolError(f"voxel is set twice, to {voxel} and by options to {options.voxel}; leave one out")
        options = replace(options, voxel=voxel)
    finished = _finished(trained, scene, protocol, backend, on_event)
    subject = meshed_subject(None, finished, options, ignore)
    return fused(finished, options, on_event, subject=subject).mesh


@contextmanager
def progress_bar(on_event: OnEvent) -> Iterator[OnEvent]:
    """Yield a listener that shows notices and a bar per stage on stderr, and forwards events."""
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bars(*columns, console=Console(stderr=True, highlight=False)) as bars:
        task = bars.add_task("preparing", total=None)

        def shown(event: Event) -> None:
            nonlocal task
            if isinstance(event, Notice):
                bars.console.print(f"note {printable(event.text)}", markup=False, soft_wrap=True)
            elif isinstance(event, StageStarted):
                if bars.tasks[-1].total is None:
                    bars.remove_task(task)
                task = bars.add_task(event.stage, total=event.iterations)
            elif isinstance(event, Progress):
                text = f"{event.stage}, loss {event.loss:.4f}, {event.splats:,} splats"
                bars.update(task, completed=event.iteration, description=text)
            on_event(event)

        yield shown
