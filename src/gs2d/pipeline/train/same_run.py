"""Whether a resumed run has the same definition."""

from __future__ import annotations

import json
from typing import Any

from gs2d.errors import RunError
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.prepare.job import Job, training_facts


def check_same_run(run: RunFolder, job: Job) -> None:
    """Refuse to resume a run with another definition.

    Raises
    ------
    RunError
        Names the first thing that differs.
    """
    before, after = run.definition(), {"init": None, "part": None, **json.loads(json.dumps(job.definition()))}
    after = {"backend": after.pop("backend"), **after}  # first: another processor reads cameras with other last digits
    for name, value in after.items():
        old = before.get(name)
        if name == "protocol" and isinstance(old, dict):
            # The background can follow from the scene: "raster", which comes after it, has it too.
            old, value = ({**training_facts(facts), "background": None} for facts in (old, value))
        if name == "recipe" and isinstance(old, dict):
            was, now = ("off" if facts.get("removal") is None else "on" for facts in (old, value))
            if was != now:
                raise RunError(
                    f"{run.path} was made with --robust {was}, and would go on with {now}; resume with --robust {was}, "
                    "or choose another --out"
                )
        where = ""
        if name == "scene":
            masks = [facts.get("masks", {}) for facts in (old or {}, value)]
            old, value = old and old.get("digest"), value["digest"]
            if masks[0] != masks[1]:
                name, where = "scene: its masks changed", difference(*masks)
            else:
                name = "scene: its photographs, cameras, points or maps changed, or this is another kind of processor"
        elif name == "init":
            name = "--init: another file, or none"
        elif name == "part":
            name = "start: the model that this part is cut of changed"
        else:
            where = difference(old, value)
        if old != value:
            raise RunError(
                f"{run.path} was made with another {name}{where}; resume with the same options, or choose another --out"
            )


def difference(old: Any, new: Any, where: str = "") -> str:
    """Where two JSON values first differ, in words."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in new:
            if old.get(key) != new[key]:
                return difference(old.get(key), new[key], f"{where}.{key}" if where else key)
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for i, (a, b) in enumerate(zip(old, new, strict=True)):
            if a != b:
                name = b.get("name", i) if isinstance(b, dict) else i
                return difference(a, b, f"{where}.{name}" if where else str(name))
    return f" ({where + ': ' if where else ''}{str(old)[:60]}, now {str(new)[:60]})"
