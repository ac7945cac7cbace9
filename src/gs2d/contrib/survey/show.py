"""The action of ``gs2d survey``."""

from __future__ import annotations

from typing import Any

from gs2d.cli.console import Console
from gs2d.contrib.survey.export_world import export_world
from gs2d.contrib.survey.find_georeference import SOURCES, georeference_run
from gs2d.contrib.survey.orthophoto import orthophoto_run
from gs2d.contrib.survey.survey_commands import SurveyCommand
from gs2d.errors import RunError
from gs2d.io.run_dir import open_run
from gs2d.pipeline.finish.run_report import show_again


def survey(command: SurveyCommand, console: Console) -> None:
    """Run ``gs2d survey``; write report and page again if the georeference of the run changes."""
    if command.resolution is not None and not command.orthophoto:
        raise RunError("--set resolution needs --orthophoto")
    georeference = georeference_run(command.run, command, console.on_event)
    if command.remove or any(getattr(command, source) not in (None, False) for source in SOURCES):
        show_again(open_run(command.run), console.on_event)
    result: dict[str, Any] = {"run": str(command.run), "georeference": georeference and georeference.to_json()}
    if command.orthophoto:
        options = (command.run, command.out, command, console.on_event)
        result["orthophoto"] = orthophoto_run(*options, threads=command.threads)
    elif command.out is not None:
        result["export"] = export_world(command.run, command.out, command.part)
    none = "no georeference; use --gps, --positions, --control, --known-distance or --markers"
    for line in [none] if georeference is None else georeference.lines():
        console.say(line)
    if "export" in result:
        _show_export(result["export"], console)
    if "orthophoto" in result:
        _show_orthophoto(result["orthophoto"], console)
    console.result(result)


def _show_export(written: dict[str, Any], console: Console) -> None:
    for note in written["notes"]:
        console.say(note)
    offset = " ".join(f"{value:.10g}" for value in written["offset"])
    console.say(f"{written['file']}: metres in {written['frame']}, relative to the offset {offset}")
    console.say(f"also written: {', '.join(written['beside'])}")


def _show_orthophoto(written: dict[str, Any], console: Console) -> None:
    for file in written["files"]:
        console.say(file)
    unseen = written["cells_unseen"] / written["cells"]
    console.say(
        f"{written['rows']:,} x {written['columns']:,} cells of {written['resolution']:g} m, {written['frame']}; "
        f"{unseen:.0%} of the surface is not visible in any photograph and has the colours of the mesh"
    )
