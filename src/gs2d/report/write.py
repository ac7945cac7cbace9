"""``report.html``: what a run was, what came out, and pictures of it, in one file that works offline.

Everything is read from the run folder: ``run.json``, ``metrics.json``, ``events.jsonl``, ``renders/``, ``mesh.ply``.
What is not there is said in words.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from gs2d.core.camera import Camera
from gs2d.core.files import atomic_write
from gs2d.io.run_dir import EXPOSURE, LOSSES, MESH, PHOTOMETRY, POSES, RENDERS, REPORT, VERDICT, open_run
from gs2d.report.guard import Guard, OnFailure
from gs2d.report.html import macro, missing, page, render
from gs2d.report.links import links
from gs2d.report.plots import curves, read_history
from gs2d.report.sections.capture import capture_section
from gs2d.report.sections.exposure import exposure_section
from gs2d.report.sections.georeference import georeference_section
from gs2d.report.sections.losses import loss_section, loss_titles
from gs2d.report.sections.photometry import photometry_section
from gs2d.report.sections.pictures import hero, mesh_section, view_sections
from gs2d.report.sections.poses import poses_section
from gs2d.report.sections.subject import subject_section
from gs2d.report.sections.surface import surface_scores
from gs2d.report.sections.verdict import grade_of, scaled, verdict_section
from gs2d.report.terms import glossary, titles_of

_IMAGE_METRICS = (("psnr", "PSNR, dB", 2, 1), ("ssim", "SSIM", 4, 1), ("lpips", "LPIPS", 4, -1))


@dataclass(frozen=True)
class RunRecord:
    """What a run folder says about itself.

    Attributes
    ----------
    path : Path
    definition : dict
        ``run.json``.
    stages : tuple of dict
        Entries of ``metrics.json``; empty before the first stage is finished.
    surface : dict or None
        Surface metrics; ``surface_reason`` says why there are none.
    events : list of dict
        ``events.jsonl``.
    """

    path: Path
    definition: dict[str, Any]
    stages: tuple[dict[str, Any], ...]
    surface: dict[str, Any] | None
    surface_reason: str | None
    events: list[dict[str, Any]]

    @property
    def split(self) -> str:
        """Which views the figures are about: the test views where there are any."""
        return "test" if any(stage.get("test") for stage in self.stages) else "train"


def read_record(folder: Path) -> RunRecord:
    """Read what is needed of a run folder.

    Raises
    ------
    RunError
        Not a run.
    DataError
        A file is not JSON.
    """
    run = open_run(folder)
    metrics = run.metrics()
    return RunRecord(
        path=Path(folder),
        definition=run.definition(),
        stages=tuple(metrics.get("stages") or ()),
        surface=metrics.get("surface"),
        surface_reason=metrics.get("surface_reason"),
        events=run.events.read(),
    )


def write_report(run: Path, *, cameras: Sequence[Camera] = (), on_failure: OnFailure | None = None) -> Path:
    """Write ``report.html`` into a run folder.

    Parameters
    ----------
    run : Path
        A run folder, finished or not.
    cameras : sequence of Camera, optional
        From where the mesh is shown (the first three). Default: around it, taking the third axis as up.
    on_failure : callable, optional
        Is told which section failed and why; the report says so in its place, and has all others.

    Returns
    -------
    Path
        The report.

    Raises
    ------
    RunError
        Not a run folder.
    DataError
        What the run says about itself is broken.
    DiskError
        The report could not be written.
    """
    record = read_record(run)
    title, guard, parts = _title(record), Guard(on_failure), _parts(record, cameras)
    body = render(
        "report.html",
        title=title,
        part=lambda name: guard(name, parts[name]),
        of_views=_of_views(record),
        raw=[
            ("The whole definition (run.json)", _indented(record.definition)),
            ("All figures (metrics.json)", _indented({"stages": record.stages, "surface": record.surface})),
        ],
    )
    target = record.path / REPORT
    with atomic_write(target, "w") as file:
        file.write(page(f"{title}: gs2d report", [body]))
    return target


def _parts(record: RunRecord, cameras: Sequence[Camera]) -> dict[str, Callable[[], Markup]]:
    """Return the parts by their names, which failures are told with; ``templates/report.html`` has their order."""
    path, renders, last = record.path, record.path / RENDERS, record.stages[-1] if record.stages else {}
    stages, titles = [stage["name"] for stage in record.stages], loss_titles(record.stages)
    return {
        "summary": lambda: verdict(record),
        "verdict": lambda: verdict_section(path / VERDICT),
        "pictures at the top": lambda: hero(renders),
        "list of files": lambda: links(path),
        "table of stages": lambda: stage_table(record),
        "glossary": glossary,
        "scores of the surface": lambda: surface_scores(record.surface, record.surface_reason, path),
        "picture of the subject": lambda: subject_section(path),
        "pictures of the mesh": lambda: mesh_section(path / MESH, cameras),
        "pictures of the stages": lambda: view_sections(renders, expected_stages=stages),
        "curves": lambda: curve_section(record),
        "story of the training": lambda: story(record.events),
        "photographs": lambda: capture_section(path, record.definition),
        "place in the world": lambda: georeference_section(path),
        "exposures": lambda: exposure_section(path / EXPOSURE, last),
        "cameras": lambda: poses_section(path / POSES, last),
        "light of the cameras": lambda: photometry_section(path / PHOTOMETRY),
        "facts of the run": lambda: macro("macros.html", "facts", definition_facts(record.definition)),
        **{_of_loss(name): partial(loss_section, renders / LOSSES, record.stages, name) for name in titles},
    }


def _of_views(record: RunRecord) -> list[tuple[str, str]]:
    """Titles and parts about exposures and poses where the recipe has them, and about losses that have a report."""
    recipe = record.definition.get("recipe")
    learned: Mapping[str, Any] = recipe if isinstance(recipe, Mapping) else {}
    wanted = (
        ("Exposure of the photographs", "exposures", learned.get("exposure")),
        ("Vignetting and response of the cameras", "light of the cameras", learned.get("photometry")),
        ("Where the photographs were taken", "cameras", learned.get("poses")),
    )
    of_losses = [(title, _of_loss(name)) for name, title in loss_titles(record.stages).items()]
    return [*((title, part) for title, part, is_learned in wanted if is_learned), *of_losses]


def _of_loss(name: str) -> str:
    return f"what loss {name} says"


def _title(record: RunRecord) -> str:
    if record.definition.get("title"):
        return str(record.definition["title"])
    scene = record.definition.get("scene")
    return str(scene.get("name") if isinstance(scene, Mapping) else scene or record.path.name)


def _name_of(value: Any) -> str:
    return str(value.get("name", "unnamed") if isinstance(value, Mapping) else value)


# -- figures -----------------------------------------------------------------------------------------------------------
def figure(value: Any, digits: int) -> str:
    """Return a number with fixed digits, or a dash."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return "-" if value is None or not isinstance(value, float) else str(value)
    return f"{value:,.{digits}f}"


def verdict(record: RunRecord) -> Markup:
    """Return one sentence on what the run shows: quality at its end, what the later stages changed and cost."""
    split, scored = record.split, [s for s in record.stages if (s.get(record.split) or {}).get("psnr") is not None]
    values: dict[str, Any] = {"recipe": _name_of(record.definition.get("recipe", "an unnamed recipe")), "last": None}
    if scored:
        first, last = scored[0], scored[-1]
        values |= {
            "last": {"psnr": last[split]["psnr"], "ssim": last[split].get("ssim")},
            "grade": grade_of(last[split]["psnr"], split),
            "split": split,
            "first": first["name"],
            "gain": None if first is last else last[split]["psnr"] - first[split]["psnr"],
            "price": _price(first, last, record.stages),
            "surface": _first_score(record.surface),
            "unfinished": _unfinished(record),
        }
    return render("summary.html", **values)


def _price(first: Mapping[str, Any], last: Mapping[str, Any], stages: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what the stages after the first cost in storage and time."""
    parts = []
    if first.get("bytes") and last.get("bytes"):
        parts.append(f"{100 * (last['bytes'] / first['bytes'] - 1):+.1f} % storage")
    later = [s.get("seconds") for s in stages[list(stages).index(first) + 1 :]]
    if first.get("seconds") and later and all(isinstance(s, int | float) for s in later):
        parts.append(f"{100 * sum(s for s in later if s is not None) / first['seconds']:+.0f} % training time")
    return parts


def _first_score(surface: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """Return the row of scores at the first threshold, that of the headline."""
    rows = [row for row in (surface or {}).get("thresholds") or [] if isinstance(row.get("f_score"), int | float)]
    return rows[0] if rows else None


def _unfinished(record: RunRecord) -> list[str]:
    """Names of the stages that are planned and not done."""
    recipe = record.definition.get("recipe")
    planned = [_name_of(s) for s in recipe.get("stages", ())] if isinstance(recipe, Mapping) else []
    done = [stage["name"] for stage in record.stages]
    return [name for name in planned if name not in done]


def stage_table(record: RunRecord) -> Markup:
    """Return a table with one row a stage: quality, size, time."""
    if not record.stages:
        return missing("metrics.json has no finished stage yet.")
    splits = [name for name in ("test", "train") if any(stage.get(name) for stage in record.stages)]
    columns = ["Stage", "Iterations"]
    shown = [  # a figure that no stage has gets no column; why is said below the table
        (split, key, label, digits, _best(record.stages, split, key, sign))
        for split in splits
        for key, label, digits, sign in _IMAGE_METRICS
        if any((stage.get(split) or {}).get(key) is not None for stage in record.stages)
    ]
    columns += [f"{label} ({split})" for split, _, label, _, _ in shown]
    opaque = any(stage.get("transparent") for stage in record.stages)  # photographs have no alpha channel
    columns += ["Transparent, %"] * opaque + ["Splats", "MB", "Seconds", "Peak memory, MB"]
    rows: list[list[str]] = []
    marked: list[tuple[int, int]] = []
    for stage in record.stages:
        values = [(stage.get(split) or {}).get(key) for split, key, *_ in shown]
        marked += [
            (len(rows), 2 + k)
            for k, (value, (*_, best)) in enumerate(zip(values, shown, strict=True))
            if value is not None and value == best
        ]
        rows.append(
            [
                _stage_name(stage),
                figure(stage.get("iterations"), 0),
                *(figure(value, digits) for value, (*_, digits, _) in zip(values, shown, strict=True)),
                *[figure(scaled((stage.get("transparent") or {}).get("part"), 100), 1)] * opaque,
                figure(stage.get("splats"), 0),
                figure(scaled(stage.get("bytes"), 1e-6), 2),
                figure(stage.get("seconds"), 1),
                figure(scaled(stage.get("peak_memory_bytes"), 1e-6), 0),
            ]
        )
    return render(
        "stages.html",
        columns=columns,
        rows=rows,
        titles=titles_of(columns),
        best=marked,
        is_scored=bool(shown),
        split=record.split,
        other=_other_conventions(record),
        transparent=record.stages[-1].get("transparent"),
        reasons=_reasons(record.stages, splits),
        clones=_clones(record),
    )


def _stage_name(stage: Mapping[str, Any]) -> str | Markup:
    source = stage.get("reused_from")  # a file of the stage cache, or a run; metrics.json has the whole path
    if not source:
        return str(stage["name"])
    return Markup('{}<span class="why">trained before ({})</span>').format(stage["name"], Path(source).name[:12])


def _best(stages: Sequence[Mapping[str, Any]], split: str, key: str, sign: int) -> float | None:
    values = [(stage.get(split) or {}).get(key) for stage in stages]
    numbers = [sign * value for value in values if isinstance(value, int | float)]
    return sign * max(numbers) if len(numbers) > 1 else None


def _reasons(stages: Sequence[Mapping[str, Any]], splits: Sequence[str]) -> list[str]:
    """Why figures are missing, once each."""
    said: dict[str, None] = {}
    for stage in stages:
        for split in ("test", "train"):
            if stage.get(f"{split}_reason"):
                said[f"{split} views: {stage[f'{split}_reason']}"] = None
        for split in splits:
            for key, label, _, _ in _IMAGE_METRICS:
                scores = stage.get(split) or {}
                if scores.get(f"{key}_reason"):
                    said[f"{label.partition(',')[0]}: {scores[f'{key}_reason']}"] = None
    return list(said)


def _clones(record: RunRecord) -> list[dict[str, Any]]:
    """PSNR just before and just after splats were cloned in place."""
    split, found = record.split, []
    for before, stage in zip(record.stages, record.stages[1:], strict=False):
        after = ((stage.get("after_clone") or {}).get(split) or {}).get("psnr")
        earlier = (before.get(split) or {}).get("psnr")
        if isinstance(after, int | float) and isinstance(earlier, int | float):
            found.append({"stage": stage["name"], "before": earlier, "after": after})
    return found


def _other_conventions(record: RunRecord) -> dict[str, float | None]:
    """Return the last stage's figures by the other conventions: floats, and LPIPS fed with [-1, 1]; None: unknown."""
    scores = record.stages[-1].get(record.split) or {}
    psnr, ssim, signed = (
        value if isinstance(value, int | float) else None
        for value in (scores.get(name) for name in ("psnr_float", "ssim_float", "lpips_signed"))
    )
    return {"psnr": None if ssim is None else psnr, "ssim": ssim, "signed": signed}


# -- training ----------------------------------------------------------------------------------------------------------
def curve_section(record: RunRecord) -> Markup:
    """Return curves from the log."""
    if not record.events:
        return missing("events.jsonl is missing or empty: there are no curves.")
    split = record.split
    ends = {
        stage["name"]: float(stage[split]["psnr"])
        for stage in record.stages
        if isinstance((stage.get(split) or {}).get("psnr"), int | float) and np.isfinite(stage[split]["psnr"])
    }
    drawn = curves(read_history(record.events), ends, split)
    if not drawn:
        return missing("events.jsonl holds no figures of training steps: there are no curves.")
    return macro("lists.html", "curves", drawn)


def story(events: Sequence[Mapping[str, Any]]) -> Markup:
    """Return the log's turning points as a list."""
    lines: list[str] = []
    densified: dict[str, list[int]] = {}
    resets: dict[str, int] = {}
    for event in events:
        kind, stage = str(event.get("kind", event.get("event", ""))), str(event.get("stage", ""))
        if kind == "initialised":
            lines.append(f"Started from {figure(event.get('splats'), 0)} splats ({event.get('source', 'unknown')}).")
        elif kind in ("densify", "densified"):
            counts = densified.setdefault(stage, [0, 0, 0])
            counts[0] += int(event.get("cloned", 0))
            counts[1] += int(event.get("split", 0))
            counts[2] += sum(
                int(event.get(name, 0)) for name in ("pruned", "pruned_faint", "pruned_by_opacity", "pruned_large")
            )
        elif kind == "opacity_limited" and event.get("reset"):
            resets[stage] = resets.get(stage, 0) + 1
        elif kind == "ranked":
            fraction = event.get("fraction", event.get("share"))
            held = (
                f", which hold {100 * fraction:.1f} % of the summed colour error" if isinstance(fraction, float) else ""
            )
            lines.append(f"{stage}: ranked by colour error; the worst {figure(event.get('count'), 0)} splats{held}.")
        elif kind == "cloned":
            lines.append(
                f"{stage}: cloned {figure(event.get('count'), 0)} splats in place "
                f"(opacity: {event.get('opacity', 'not said')}), {figure(event.get('splats'), 0)} after it."
            )
    grown = [
        f"{stage}: densification cloned {clone:,}, split {split:,} and pruned {prune:,} splats"
        + (f"; {resets[stage]} opacity reset{'s' * (resets[stage] != 1)}." if stage in resets else ".")
        for stage, (clone, split, prune) in densified.items()
    ]
    lines = [*lines[:1], *grown, *lines[1:]]
    return macro("lists.html", "story", lines)


# -- the definition ----------------------------------------------------------------------------------------------------
def definition_facts(definition: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the definition in short; the whole of it follows in the report."""
    scene, machine = definition.get("scene"), definition.get("machine")
    backend = definition.get("backend")
    pairs = [("Recipe", _name_of(definition.get("recipe", "not said")))]
    pairs.append(("Protocol", _name_of(definition.get("protocol", "not said"))))
    if isinstance(scene, Mapping):
        pairs.append(("Scene", f"{scene.get('name')} ({scene.get('format', 'format not said')})"))
        pairs.append(("Views", f"{scene.get('train', '?')} train, {scene.get('test', '?')} test"))
        pairs += [("Skipped", ", ".join(map(str, scene["skipped"])))] if scene.get("skipped") else []
    details = f" ({backend['details']})" if isinstance(backend, Mapping) and backend.get("details") else ""
    pairs.append(("Backend", _name_of(definition.get("backend", "not said")) + details))
    pairs.append(("Seed", str(definition.get("seed", "not said"))))
    pairs += [("Downscale", str(definition["downscale"]))] if definition.get("downscale") else []
    if isinstance(machine, Mapping):
        pairs.append(("Machine", ", ".join(f"{name}: {value}" for name, value in machine.items())))
    versions = definition.get("versions")
    if isinstance(versions, Mapping):
        pairs.append(("Versions", ", ".join(f"{name} {version}" for name, version in versions.items())))
    pairs += [("Made", str(definition["created"]))] if definition.get("created") else []
    return pairs


def _indented(value: Any) -> str:
    return json.dumps(value, indent=2, ensure_ascii=False)
