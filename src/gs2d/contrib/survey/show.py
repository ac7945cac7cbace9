"""Output of the commands georeference and orthophoto."""

from __future__ import annotations

import shlex

from gs2d.cli.console import Console
from gs2d.contrib.survey.export_world import export_world
from gs2d.contrib.survey.find_georeference import georeference_run
from gs2d.contrib.survey.orthophoto import orthophoto_run
from gs2d.contrib.survey.survey_commands import GeoreferenceCommand, Orthophoto


def show_georeference(command: GeoreferenceCommand, console: Console) -> None:
    """``gs2d georeference``."""
    found = georeference_run(command.run, command, console.on_event)
    written = None if command.out is None else export_world(command.run, command.out, command.part)
    console.close()
    if found is None:
        console.say("no georeference; --gps, --positions, --control, --known-distance or --markers finds one")
    else:
        for line in found.lines():
            console.say(line)
        run = shlex.quote(str(command.run))
        console.say(f"to show it in report and page: gs2d report {run}; gs2d page {run}")
    if written is not None:
        for note in written["notes"]:
            console.say(note)
        offset = " ".join(f"{value:.10g}" for value in written["offset"])
        console.say(f"{written['file']}: metres in {written['frame']}, relative to the offset {offset}")
        console.say(f"beside it: {', '.join(written['beside'])}")
    georeference = None if found is None else found.to_json()
    console.result({"run": str(command.run), "georeference": georeference, "export": written})


def show_orthophoto(command: Orthophoto, console: Console) -> None:
    """``gs2d orthophoto``."""
    result = orthophoto_run(command.run, command.out, command, console.on_event, threads=command.threads)
    console.close()
    for file in result["files"]:
        console.say(file)
    unseen = result["cells_unseen"] / result["cells"]
    console.say(
        f"{result['rows']:,} x {result['columns']:,} cells of {result['resolution']:g} m, {result['frame']}; "
        f"{unseen:.0%} of the surface is not visible in any photograph and has the colours of the mesh"
    )
    console.result(result)
