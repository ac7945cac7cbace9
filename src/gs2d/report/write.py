"""``report.html``: what a run was, what came out, and pictures of it, in one file that works offline.

Everything is read from the run folder: ``run.json``, ``metrics.json``, ``events.jsonl``, ``renders/``, ``mesh.ply``.
What is not there is said in words.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.files import atomic_write
from gs2d.io.run_dir import EXPOSURE, MESH, POSES, PRIORS, RENDERS, REPORT, VERDICT, open_run
from gs2d.report.guard import Guard, OnFailure
from gs2d.report.html import drawing, escape, facts, missing, page, table
from gs2d.report.links import links
from gs2d.report.plots import curves, read_history
from gs2d.report.sections.capture import capture_section
from gs2d.report.sections.exposure import exposure_section
from gs2d.report.sections.pictures import hero, mesh_section, view_sections
from gs2d.report.sections.poses import poses_section
from gs2d.report.sections.priors import priors_section
from gs2d.report.sections.subject import subject_section
from gs2d.report.sections.surface import surface_scores
from gs2d.report.sections.verdict import graded, scaled, verdict_section
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
    renders, part = record.path / RENDERS, Guard(on_failure)
    title, stages = _title(record), [stage["name"] for stage in record.stages]
    body = [
        f'<div class="eyebrow">gs2d report</div><h1>{escape(title)}</h1>',
        part("summary", lambda: f'<p class="lead">{verdict(record)}</p>'),
        part("verdict", lambda: verdict_section(record.path / VERDICT)),
        part("pictures at the top", lambda: hero(renders)),
        "<h2>Files</h2>",
        part("list of files", lambda: links(record.path)),
        "<h2>Results</h2>",
        part("table of stages", lambda: stage_table(record)),
        glossary(),
        "<h2>Surface</h2>",
        part("scores of the surface", lambda: surface_scores(record.surface, record.surface_reason, record.path)),
        part("picture of the subject", lambda: subject_section(record.path)),
        part("pictures of the mesh", lambda: mesh_section(record.path / MESH, cameras)),
        "<h2>Every stage beside the photographs</h2>",
        part("pictures of the stages", lambda: view_sections(renders, expected_stages=stages)),
        "<h2>Training</h2>",
        part("curves", lambda: curve_section(record)),
        part("story of the training", lambda: story(record.events)),
        *_of_views(record, part),
        "<h2>What was run</h2>",
        part("facts of the run", lambda: facts(definition_facts(record.definition))),
        _raw("The whole definition (run.json)", record.definition),
        _raw("All figures (metrics.json)", {"stages": record.stages, "surface": record.surface}),
    ]
    target = record.path / REPORT
    with atomic_write(target, "w") as file:
        file.write(page(f"{title}: gs2d report", [part for part in body if part]))
    return target


def _of_views(record: RunRecord, part: Guard) -> list[str]:
    """The sections about cameras, exposures, poses and priors, where the capture or the recipe has them."""
    recipe, last = record.definition.get("recipe"), record.stages[-1] if record.stages else {}
    learned: Mapping[str, Any] = recipe if isinstance(recipe, Mapping) else {}
    parts = [part("photographs", lambda: capture_section(record.path, record.definition))]
    if learned.get("exposure"):
        section = part("exposures", lambda: exposure_section(record.path / EXPOSURE, last))
        parts += ["<h2>Exposure of the photographs</h2>", section]
    if learned.get("poses"):
        section = part("cameras", lambda: poses_section(record.path / POSES, last))
        parts += ["<h2>Where the photographs were taken</h2>", section]
    if learned.get("depth_prior") or learned.get("normal_prior"):
        folder = record.path / RENDERS / PRIORS
        section = part("known depths", lambda: priors_section(folder, record.stages))
        parts += ["<h2>What was known of the photographs</h2>", section]
    return parts


def _title(record: RunRecord) -> str:
    if record.definition.get("title"):
        return str(record.definition["title"])
    scene = record.definition.get("scene")
    return str(scene.get("name") if isinstance(scene, Mapping) else scene or record.path.name)


def _name_of(value: Any) -> str:
    return str(value.get("name", "unnamed") if isinstance(value, Mapping) else value)


# -- figures -----------------------------------------------------------------------------------------------------------
def figure(value: Any, digits: int) -> str:
    """A number with fixed digits, or a dash."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return "-" if value is None or not isinstance(value, float) else str(value)
    return f"{value:,.{digits}f}"


def verdict(record: RunRecord) -> str:
    """One sentence (HTML) on what the run shows: quality at its end, and what the later stages changed and cost."""
    recipe = escape(_name_of(record.definition.get("recipe", "an unnamed recipe")))
    split, scored = record.split, [s for s in record.stages if (s.get(record.split) or {}).get("psnr") is not None]
    if not scored:
        return f"No stage of {recipe} is finished and scored yet."
    first, last = scored[0], scored[-1]
    text = f"{recipe} reaches {graded(last[split]['psnr'], split)} PSNR on the {split} views"
    if isinstance(last[split].get("ssim"), int | float):
        text += f" (SSIM {last[split]['ssim']:.4f})"
    if first is not last:
        gain = last[split]["psnr"] - first[split]["psnr"]
        words = "more than" if gain >= 0 else "less than"
        text += f", {abs(gain):.2f} dB {words} after its first stage ({escape(first['name'])})"
        text += _price(first, last, record.stages)
    return text + "." + _surface_sentence(record.surface) + _unfinished(record)


def _price(first: Mapping[str, Any], last: Mapping[str, Any], stages: Sequence[Mapping[str, Any]]) -> str:
    """What the stages after the first cost in storage and time."""
    parts = []
    if first.get("bytes") and last.get("bytes"):
        parts.append(f"{100 * (last['bytes'] / first['bytes'] - 1):+.1f} % storage")
    later = [s.get("seconds") for s in stages[list(stages).index(first) + 1 :]]
    if first.get("seconds") and later and all(isinstance(s, int | float) for s in later):
        parts.append(f"{100 * sum(s for s in later if s is not None) / first['seconds']:+.0f} % training time")
    return f", for {' and '.join(parts)}" if parts else ""


def _surface_sentence(surface: Mapping[str, Any] | None) -> str:
    rows = [row for row in (surface or {}).get("thresholds") or [] if isinstance(row.get("f_score"), int | float)]
    if not rows:
        return ""
    middle = rows[len(rows) // 2]  # neither the strictest nor the kindest
    return f" The mesh has an F-score of {middle['f_score']:.3f} within {middle['threshold']:.3g} (units of the truth)."


def _unfinished(record: RunRecord) -> str:
    recipe = record.definition.get("recipe")
    planned = [_name_of(s) for s in recipe.get("stages", ())] if isinstance(recipe, Mapping) else []
    done = [stage["name"] for stage in record.stages]
    left = [name for name in planned if name not in done]
    return f" Not finished: {escape(', '.join(left))}." if left else ""


def stage_table(record: RunRecord) -> str:
    """One row a stage: quality, size, time."""
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
    columns += ["Splats", "MB", "Seconds", "Peak memory, MB"]
    rows = []
    for stage in record.stages:
        rows.append([_stage_name(stage), figure(stage.get("iterations"), 0)])
        rows[-1] += [_metric_cell(stage.get(split) or {}, key, digits, best) for split, key, _, digits, best in shown]
        rows[-1] += [
            figure(stage.get("splats"), 0),
            figure(scaled(stage.get("bytes"), 1e-6), 2),
            figure(stage.get("seconds"), 1),
            figure(scaled(stage.get("peak_memory_bytes"), 1e-6), 0),
        ]
    words = "PSNR and SSIM: means over the views, of pictures rounded to 8 bits. Higher is better, the best is bold."
    legend = f'<p class="soft">{words}{_other_conventions(record)}</p>' if shown else ""
    notes = [legend, _reasons(record.stages, splits), _clone_note(record)]
    return table(columns, rows, titles=titles_of(columns)) + "".join(notes)


def _stage_name(stage: Mapping[str, Any]) -> str:
    source = stage.get("reused_from")  # a file of the stage cache, or a run; metrics.json has the whole path
    reused = f'<span class="why">trained before ({escape(Path(source).name[:12])})</span>' if source else ""
    return f"<td>{escape(stage['name'])}{reused}</td>"


def _best(stages: Sequence[Mapping[str, Any]], split: str, key: str, sign: int) -> float | None:
    values = [(stage.get(split) or {}).get(key) for stage in stages]
    numbers = [sign * value for value in values if isinstance(value, int | float)]
    return sign * max(numbers) if len(numbers) > 1 else None


def _metric_cell(scores: Mapping[str, Any], key: str, digits: int, best: float | None) -> str:
    value = scores.get(key)
    style = ' class="best"' if value is not None and value == best else ""
    return f"<td{style}>{figure(value, digits)}</td>"


def _reasons(stages: Sequence[Mapping[str, Any]], splits: Sequence[str]) -> str:
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
    return "".join(missing(text) for text in said)


def _clone_note(record: RunRecord) -> str:
    """PSNR just before and just after splats were cloned in place."""
    split, lines = record.split, []
    for before, stage in zip(record.stages, record.stages[1:], strict=False):
        after = ((stage.get("after_clone") or {}).get(split) or {}).get("psnr")
        earlier = (before.get(split) or {}).get("psnr")
        if isinstance(after, int | float) and isinstance(earlier, int | float):
            lines.append(
                f"Cloning in place at the start of {stage['name']} changed PSNR on the {split} views "
                f"from {earlier:.2f} to {after:.2f} dB."
            )
    return "".join(f'<p class="soft">{escape(line)}</p>' for line in lines)


def _other_conventions(record: RunRecord) -> str:
    """The last stage's figures by the other conventions: from floats, and LPIPS fed with [-1, 1]."""
    scores = record.stages[-1].get(record.split) or {}
    psnr, ssim, signed = (scores.get(name) for name in ("psnr_float", "ssim_float", "lpips_signed"))
    text = ""
    if isinstance(psnr, int | float) and isinstance(ssim, int | float):
        text += f" From floats, unrounded, the last stage has {psnr:.2f} dB and {ssim:.4f} ({record.split} views)."
    if isinstance(signed, int | float):
        text += f" LPIPS is fed with pictures in [0, 1]; fed with [-1, 1], as its authors do, it is {signed:.4f}."
    return text


# -- training ----------------------------------------------------------------------------------------------------------
def curve_section(record: RunRecord) -> str:
    """Curves from the log."""
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
    return '<div class="curves">' + "".join(drawing(svg, title) for title, svg in drawn.items()) + "</div>"


def story(events: Sequence[Mapping[str, Any]]) -> str:
    """The log's turning points as a list."""
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
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>" if lines else ""


# -- the definition ----------------------------------------------------------------------------------------------------
def definition_facts(definition: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The definition in short; the whole of it follows in the report."""
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


def _raw(title: str, value: Any) -> str:
    text = json.dumps(value, indent=2, ensure_ascii=False)
    return f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>"
