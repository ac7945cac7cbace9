"""The settings of the run, its machine and versions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gs2d.data.subject_box import OBJECT, read_subject
from gs2d.report.html_parts import macro
from gs2d.report.run_record import RunRecord, name_of
from gs2d.report.sections.section_registry import register_section


@register_section("settings", title="Settings")
def settings_section(run: RunRecord) -> str | None:
    """Return the main settings of the run; all of them are in ``run.json``."""
    return macro("macros.html", "definitions", [*_settings(run.definition), *_subject(run)])


def _subject(run: RunRecord) -> list[tuple[str, str]]:
    """Return the subject and its box as an option."""
    subject = read_subject(run.path)
    if subject is None:
        return []
    box = " ".join(f"{value:.4g}" for value in subject.box.ravel())
    why = subject.why if subject.kind == OBJECT else f"the whole scene: {subject.why}"
    return [("Subject", why), ("Subject box", f"--subject-box {box}")]


def _settings(definition: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return names and values of the settings in ``run.json``."""
    scene, backend = definition["scene"], definition.get("backend")
    pairs = [(name.capitalize(), name_of(definition[name])) for name in ("recipe", "protocol") if name in definition]
    pairs.append(("Capture", f"{scene['name']} ({scene['format']})"))
    pairs.append(("Views", f"{scene['train']} training, {scene['test']} test"))
    pairs += [("Skipped", ", ".join(scene["skipped"]))] if scene.get("skipped") else []
    if backend:
        pairs.append(("Backend", backend["name"] + (f" ({backend['details']})" if backend.get("details") else "")))
    for name in ("seed", "downscale", "created"):
        pairs += [(name.capitalize(), str(definition[name]))] if definition.get(name) is not None else []
    for name in ("machine", "versions"):
        text = ", ".join(f"{key} {value}" for key, value in definition.get(name, {}).items())
        pairs.append((name.capitalize(), text))
    return pairs
