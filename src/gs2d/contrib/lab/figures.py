"""Draws the figures of the paper from finished runs: K_a and opacity, E_i maps."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.config.actions import RANK_BY_ERROR, Action
from gs2d.config.recipe import Recipe
from gs2d.config.serialize import from_json
from gs2d.contrib.lab.compared_plot import Panel, compared_runs
from gs2d.core.atomic_files import atomic_write
from gs2d.core.splats import Splats
from gs2d.data import View
from gs2d.errors import Gs2dError
from gs2d.io.run_dir import RunFolder, load_tensors, make_folder, open_run
from gs2d.pipeline.finish.run_images import choose_views, render_view, splatted
from gs2d.pipeline.prepare.loaded import LoadedRun, finished_splats, reload_run
from gs2d.pipeline.prepare.run_appearance import photographed
from gs2d.pipeline.train.resume import stage_end
from gs2d.render.api import splat_errors
from gs2d.report.color_maps import ERROR_TOP, error_image, error_scale, highlight_image, valid_image
from gs2d.report.plots import read_history
from gs2d.training.actions.rank_by_error import RankByError, worst
from gs2d.training.events import Notice, OnEvent, counted, ignore
from gs2d.training.learned.appearance import numbers_of, shown_splats
from gs2d.training.state import TrainState

TRACES = (
    Panel("mean_area", r"Mean $K_a = s_u s_v$, square world units", log=True),
    Panel("mean_opacity", "Mean opacity"),
)
MAP_PERCENTILES = (50.0, 99.9)  # of E_i: the ends of the colour scale, which is logarithmic
SMALLEST_TOP = 0.01  # least coverage of a coloured pixel
DEFAULT_RANK = RANK_BY_ERROR  # of runs whose recipe ranks nothing


def write_figures(
    runs: Mapping[str, Path],
    out: Path,
    on_event: OnEvent = ignore,
    *,
    maps: Sequence[str] | None = None,
    views: int = 3,
    backend: str = "auto",
) -> tuple[Path, ...]:
    """Draw the paper's figures from finished runs.

    ``traces.svg``: mean K_a and mean opacity over the iterations, a line for each run. ``errors-LABEL.png``: for a few
    views the photograph, the rendering, its error, E_i splatted, and the high-error splats. A figure without data, or
    whose capture cannot be read, is omitted with a notice.

    Parameters
    ----------
    runs : mapping of label to Path
        Run folders; the labels name the lines.
    out : Path
        Folder; made if it does not exist.
    on_event : callable
        Gets notices and progress.
    maps : sequence of str, optional
        Labels of the runs to draw E_i maps of; default: those whose recipe ranks splats by error.
    views : int
        How many views each map shows: test views where there are any.
    backend : str
        Renders the maps; "auto" is the run's own.

    Returns
    -------
    tuple of Path
        The files, in the order above.
    """
    folders = {label: open_run(path) for label, path in runs.items()}
    make_folder(out)
    histories = {label: read_history(run.events.read()) for label, run in folders.items()}
    files = []
    drawing = compared_runs(histories, TRACES) if histories else None
    if drawing is None:
        on_event(Notice("no figure traces.svg: the logs of these runs do not hold its numbers"))
    else:
        with atomic_write(out / "traces.svg", "w") as file:
            file.write(drawing)
        files.append(out / "traces.svg")
    for label, run in folders.items():
        if label not in maps if maps is not None else not _ranks(run):
            continue
        path = out / f"errors-{re.sub(r'[^A-Za-z0-9._-]+', '-', label)}.png"
        try:
            draw_error_maps(run, path, on_event, title=label, views=views, backend=backend)
        except Gs2dError as error:
            on_event(Notice(f"no E_i map of {label}: {error}"))
            continue
        files.append(path)
    return tuple(files)


def coverage(runs: Mapping[str, Path]) -> dict[str, tuple[float, ...]]:
    """Return mean K_a and opacity of each run after its first stage, and both at its end.

    Runs without these numbers in their log are omitted.
    """
    found = {}
    for label, path in runs.items():
        history = read_history(open_run(path).events.read())
        if {"mean_area", "mean_opacity"} <= history.series.keys():
            ends = (history.stages[0].stop, history.stages[-1].stop)
            names = ("mean_area", "mean_opacity")
            found[label] = tuple(_value_at(*history.series[name], end) for end in ends for name in names)
    return found


def _value_at(iterations: np.ndarray, values: np.ndarray, end: int) -> float:
    """Return the last logged value up to an iteration."""
    return float(values[max(0, int((iterations <= end).sum()) - 1)])


def _ranks(run: RunFolder) -> bool:
    stages = from_json(run.definition()["recipe"]).stages
    return any(action.name == "rank_by_error" for stage in stages for action in stage.on_enter)


# -- E_i maps ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Ranking:
    """Splats with their E_i.

    Attributes
    ----------
    splats : Splats
        Splats when the recipe ranked them, if that checkpoint exists (in the run, or in the source of the stage); else
        after the stage for which they were ranked; else the final splats.
    errors : Tensor [N] float64
        E_i over all training views.
    worst : Tensor [N] bool
        The high-error splats.
    when : str
        Time of these splats, in words.
    """

    splats: Splats
    errors: Tensor
    worst: Tensor
    when: str


def rank_run(run: RunFolder, loaded: LoadedRun, on_event: OnEvent = ignore) -> Ranking:
    """Return E_i (paper Eq. 8) of the ranked splats, summed over all training views.

    Raises
    ------
    RunError
        If the run is not finished, or its checkpoint is broken.
    """
    index, action = _first_ranking(loaded.recipe)
    splats, group, when = _ranked(run, loaded, index, action)
    ranking = RankByError(**action.options)
    splats = splats.to(loaded.backend.device)
    total = torch.zeros(len(splats), dtype=torch.float64, device=splats.device)
    views = loaded.scene.train
    for view in counted(views, "errors of each splat", len(views), on_event):
        seen, settings = splats, loaded.settings
        if view.appearance:  # at the end, as it hardly changes after stage 1
            numbers = numbers_of(view, splats.means)
            seen = shown_splats(splats, view.camera, numbers, settings.sh_degree)
            settings = replace(settings, sh_degree=0)
        image = torch.from_numpy(view.target(loaded.settings.background)).to(splats.means)
        mask = view.usable(masks=loaded.protocol.use_mask_in_training)
        errors = splat_errors(
            seen,
            view.camera,
            image,
            settings,
            backend=loaded.backend,
            mask=None if mask is None else torch.from_numpy(mask).to(splats.device),
            occlusion=ranking.occlusion,
        )
        total += errors
    if group is None:
        group = torch.zeros(len(splats), dtype=torch.bool)
        group[worst(total, ranking.top_percent).cpu()] = True
    return Ranking(splats, total, group.to(splats.device), when)


def _ranked(run: RunFolder, loaded: LoadedRun, index: int, action: Action) -> tuple[Splats, Tensor | None, str]:
    """Return the splats nearest to those that stage ``index`` ranked, their group if known, and the time."""
    stages = loaded.recipe.stages
    before = stage_end(run, loaded, index - 1) if index else None
    if before is not None:
        return before.splats, None, f"after {stages[index - 1].name}"
    own = [c.path for c in run.checkpoints() if (c.stage_index, c.iteration) == (index, None)]
    if own and stages[index].on_enter == (action,):  # without clones since: the same rows
        state = TrainState.from_state_dict(load_tensors(own[0])["state"])
        return state.splats, state.groups.get(str(action.writes)), f"after {stages[index].name}"
    return finished_splats(run), None, "final splats"


def _first_ranking(recipe: Recipe) -> tuple[int, Action]:
    """Return the first stage that ranks, and its action; (0, default) without one."""
    for index, stage in enumerate(recipe.stages):
        for action in stage.on_enter:
            if action.name == "rank_by_error":
                return index, action
    return 0, DEFAULT_RANK


def map_limits(errors: Tensor) -> tuple[float, float]:
    """Return E_i at the ends of the colour scale: median and 99.9th percentile of values above 0."""
    seen = errors[errors > 0].cpu().numpy()
    if not len(seen):
        return 1.0, 10.0
    low, high = (float(value) for value in np.percentile(seen, MAP_PERCENTILES))
    return low, max(high, low * (1 + 1e-6))


def error_positions(errors: Tensor, limits: tuple[float, float]) -> Tensor:
    """Return the position [N] of each E_i on the logarithmic scale, in [0, 1]."""
    low, high = limits
    return ((errors.clamp(min=1e-300) / low).log() / np.log(high / low)).clamp(0, 1)


def map_image(splats: Splats, positions: Tensor, view: View, loaded: LoadedRun, alpha: np.ndarray) -> np.ndarray:
    """Return an image [H, W, 3] of E_i: the colour of the mean position of the splats of a pixel, over white."""
    weighted = splatted(splats, positions, view, loaded.settings, loaded.backend)
    steps = error_scale(256)
    where = np.clip(weighted / np.maximum(alpha, 1e-6), 0, 1)
    cover = np.clip(alpha, 0, 1)[..., None]
    return np.asarray(cover * steps[np.rint(255 * where).astype(int)] + (1 - cover), np.float32)


def draw_error_maps(
    run: RunFolder, path: Path, on_event: OnEvent = ignore, *, title: str = "", views: int = 3, backend: str = "auto"
) -> None:
    """Write the E_i map of one run as a PNG: a row for each view."""
    loaded = reload_run(run, on_event, backend=backend)
    ranking = rank_run(run, loaded, on_event)
    limits = map_limits(ranking.errors)
    positions = error_positions(ranking.errors, limits)
    shown = choose_views(loaded.scene, views)
    fractions = [splatted(ranking.splats, ranking.worst, v, loaded.settings, loaded.backend) for _, v in shown]
    top = max(
        SMALLEST_TOP, *(float(np.percentile(fraction, 99.9)) for fraction in fractions)
    )  # as these splats are often faint
    rows: list[tuple[str, list[np.ndarray]]] = []
    for (split, view), fraction in zip(shown, fractions, strict=True):
        output = render_view(ranking.splats, view, loaded.settings, loaded.backend)
        own = photographed(view, output.color, loaded.settings.background)
        color, alpha = np.clip(own.cpu().numpy(), 0, 1), output.alpha.cpu().numpy()
        photo = view.target(loaded.settings.background)
        images = [
            valid_image(photo, view.valid()),
            color,
            error_image(color, photo, view.mask()),
            map_image(ranking.splats, positions, view, loaded, alpha),
            highlight_image(color, np.clip(fraction / top, 0, 1)),
        ]
        rows.append((f"{Path(view.name).stem} ({split})", images))
    count = int(ranking.worst.sum())
    fraction_of_all = float(ranking.errors[ranking.worst].sum() / ranking.errors.sum().clamp(min=1e-300))
    head = (
        f"{title}: $E_i$ {ranking.when}; {count:,} of {len(ranking.splats):,} splats are high-error, "
        f"with {fraction_of_all:.0%} of the sum"
    )
    _write_grid(path, rows, head, limits, top)


COLUMNS = (
    "photograph",
    "rendering",
    f"error of the pixel, 0 to {ERROR_TOP}",
    "$E_i$ of the splats",
    "high-error splats, full at {top:.0%} of a pixel",
)


def _write_grid(
    path: Path, rows: Sequence[tuple[str, Sequence[np.ndarray]]], head: str, limits: tuple[float, float], top: float
) -> None:
    """Return images in rows under their names, with the scale of E_i."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, LogNorm
    from matplotlib.figure import Figure

    height, width = rows[0][1][0].shape[:2]
    tall = 2.4 * height / width
    figure = Figure(figsize=(2.4 * len(COLUMNS), tall * len(rows) + 0.9), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    grid: Any = figure.subplots(len(rows), len(COLUMNS), squeeze=False)
    for i, (name, images) in enumerate(rows):
        for j, (axes, image) in enumerate(zip(grid[i], images, strict=True)):
            axes.imshow(np.clip(image, 0, 1), interpolation="none" if height > 100 else "nearest")
            axes.set_xticks([])
            axes.set_yticks([])
            axes.spines[:].set_visible(False)
            if i == 0:
                axes.set_title(COLUMNS[j].format(top=top), fontsize=8)
            if j == 0:
                axes.set_ylabel(name, fontsize=7)
    scale = ScalarMappable(LogNorm(*limits), ListedColormap(error_scale(256)))
    bar = figure.colorbar(scale, ax=grid, location="bottom", shrink=0.4, aspect=50, pad=0.02)
    bar.set_label("$E_i$: colour error summed over the footprint in all training views", fontsize=7)
    ticks = np.geomspace(*limits, 5).tolist()
    bar.set_ticks(ticks, labels=[f"{value:.3g}" for value in ticks])
    bar.ax.minorticks_off()
    bar.ax.tick_params(labelsize=7)
    figure.suptitle(head, fontsize=9)
    with atomic_write(path) as file:
        figure.savefig(file, format="png", metadata={"Software": None})
