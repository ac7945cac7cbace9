"""The commands that ``kill_runs`` interrupts at each file operation: inputs, how they resume, and their results.

Inputs are small, and each run is a fork of a process that has already imported every module the command needs.
Curves are drawn only for the command ``report``: drawing happens in memory and takes most of the time of a training
with 12 iterations. For ``reconstruct``, a real pose search runs once; later runs copy the files of COLMAP's process one
by one.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib
import importlib.metadata
import json
import os
import pickle
import shutil
import sys
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ball_runs import comparable, options
from gs2d.config.registry import Registry
from gs2d.contrib.lab.lab_options import SweepOptions
from gs2d.contrib.lab.paper import paper
from gs2d.errors import DataError, Gs2dError
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.finish.run_mesh import mesh_run
from gs2d.pipeline.finish.run_report import report_run
from gs2d.pipeline.finish.splat_files import export_run
from gs2d.pipeline.look.page import page_run
from gs2d.pipeline.prepare.options import ReconstructOptions
from gs2d.pipeline.train.train_run import train
from room_photos import write_room
from tiny import write_capture

DONE, REFUSED, FAULT = 0, 2, 1  # exit codes of gs2d
FEW = ("init_points=40", "surface.densify.max_splats=60")
SHORT = {  # all three stages with few views: the same kinds of files as in a long run
    "schedule_scale": 0.0002,
    "overrides": FEW,
    "checkpoint_every": 2,
    "page": True,
}
DATED = {"report.html", "run.json", "metrics.json", "verdict.json", "events.jsonl", ".lock", "poses.json"} | {
    "about.json",  # times, folder names
    "index.html",
    *("table.csv", "table.md"),  # contents of table.json, including seconds
}


def started(work: Callable[[], object]) -> int:
    """Start ``work`` in a child and return its process id."""
    child = os.fork()
    if not child:
        code = FAULT
        try:
            work()
            code = DONE
        except Gs2dError as error:
            print(f"refused: {error}", file=sys.stderr)
            code = REFUSED
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    return child


def ended(child: int) -> int:
    """Wait for a child; return its exit code, or minus the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def forked(work: Callable[[], object]) -> int:
    """Run ``work`` in a child and wait for it."""
    return ended(started(work))


def draw_little() -> None:
    """Replace every figure by a dot and the mesh view by a text, which takes no time."""
    import matplotlib.figure
    from PIL import Image

    from gs2d.report import first_screen, plots

    def dot(_figure: Any, file: Any, *, format: str, **_: Any) -> None:
        if format == "svg":
            file.write("<svg></svg>")
        else:
            Image.new("RGB", (1, 1)).save(file, format)

    matplotlib.figure.Figure.savefig = dot
    plots._figure = lambda *_, **__: "<svg></svg>"
    first_screen.mesh_view = lambda *_: "no mesh"


def import_all(names: list[str]) -> None:
    """Import the modules that a child had imported at its end and warm caches, which speeds up later children."""
    from gs2d.report.html_parts import environment

    for name in names:
        with contextlib.suppress(Exception):
            importlib.import_module(name)
    for template in environment().list_templates():
        environment().get_template(template)
    for registry in [thing for thing in gc.get_objects() if type(thing) is Registry]:
        registry.names()
    if not hasattr(importlib.metadata.version, "cache_info"):
        importlib.metadata.version = functools.cache(importlib.metadata.version)


def undated(path: Path) -> Any:
    """Return the contents of a file without times, or None if no content must be reproducible."""
    if path.name in DATED or path.suffix == ".pt" or path.parent.name == "jobs":
        return None
    return without_seconds(json.loads(path.read_text())) if path.name == "table.json" else path.read_bytes()


def without_seconds(value: Any) -> Any:
    """Return a document without entries named "seconds"."""
    if isinstance(value, dict):
        return {key: without_seconds(inner) for key, inner in value.items() if key != "seconds"}
    return [without_seconds(inner) for inner in value] if isinstance(value, list) else value


class Command(ABC):
    """A command: how to start it in a fresh folder, how to resume it after a kill, and its results."""

    name = ""
    draws = False

    def __init__(self, work: Path) -> None:
        self.work, self.capture = work, work / "data" / "ball"
        if not self.capture.exists():
            write_capture(self.capture, train=3, test=1, size=16)
        self.arrange()

    def arrange(self) -> None:  # noqa: B027 (most commands begin with nothing)
        """Create the inputs shared by all runs of the command."""

    def prepare(self, folder: Path) -> None:
        """Set up the folder as it is before the command."""
        folder.mkdir()

    def run(self, folder: Path) -> None:
        """Run or resume the command in its own process."""
        if not self.draws:
            draw_little()
        self.act(folder)

    @abstractmethod
    def act(self, folder: Path) -> None:
        """Execute the command."""

    def leaves(self, folder: Path) -> dict[str, Any]:
        """Return the results that must not depend on interruptions: all names, and contents without times."""
        files = {str(path.relative_to(folder)): path for path in sorted(folder.rglob("*")) if path.is_file()}
        found = {name: undated(path) for name, path in files.items()}
        for path in [path.parent for path in files.values() if path.name == "run.json"]:
            run, where = RunFolder(path), path.relative_to(folder)
            splats, events, stages = comparable(run)
            others = {key: value for key, value in run.metrics().items() if key != "stages"}
            others["mesh"] = {key: value for key, value in others.get("mesh", {}).items() if key != "file"}
            mine = {"the splats": splats, "the log": events, "the scores": stages, "the other facts": others}
            found |= {f"{where}: {what}": value for what, value in mine.items()}
        return found


class Train(Command):
    """``gs2d train``."""

    name = "train"

    def act(self, folder: Path) -> None:
        """Train, resuming from existing files."""
        train(options(self.capture, folder / "run", resume=True, **SHORT))


class OfRun(Command):
    """A command on a trained run."""

    def arrange(self) -> None:
        """Train the run."""
        finished = self.work / "finished"
        if not finished.exists() and forked(lambda: train(options(self.capture, finished, **SHORT))) != DONE:
            raise SystemExit("the training before the command failed")

    def prepare(self, folder: Path) -> None:
        """Copy the run."""
        shutil.copytree(self.work / "finished", folder / "run")


class Mesh(OfRun):
    """``gs2d mesh``."""

    name = "mesh"

    def act(self, folder: Path) -> None:
        """Mesh the run."""
        mesh_run(folder / "run")


class Export(OfRun):
    """``gs2d export``, twice."""

    name = "export"

    def act(self, folder: Path) -> None:
        """Export the splats in two layouts."""
        export_run(folder / "run", folder / "out.spz")
        export_run(folder / "run", folder / "out.splat")


class Page(OfRun):
    """``gs2d export --format html``."""

    name = "page"

    def act(self, folder: Path) -> None:
        """Export the page."""
        page_run(folder / "run")


class Report(OfRun):
    """The report, which several commands write."""

    name, draws = "report", True

    def act(self, folder: Path) -> None:
        """Write the report."""
        report_run(folder / "run")


class Sweep(Command):
    """``gs2d sweep`` of two recipes; the second continues from a stage of the first.

    A table of the paper has other recipes.
    """

    name = "sweep"

    def act(self, folder: Path) -> None:
        """Compute the table."""
        result = paper(
            SweepOptions(
                recipes=("2dgs", "2dgs-r"),
                data=self.work / "data",
                out=folder / "out",
                schedule_scale=0.0002,
                overrides=FEW,
                threads=1,
                backend="cpu",
            )
        )
        if result.failures:
            raise Gs2dError(f"of the runs failed: {result.failures}")


class Reconstruct(Command):
    """``gs2d reconstruct`` with the recorded output of one COLMAP run."""

    name = "reconstruct"

    def arrange(self) -> None:
        """Write six images and estimate their poses once."""
        self.photos, self.searched = self.work / "photos", self.work / "searched"
        if not self.searched.exists():
            write_room(self.photos, 6)
            if forked(self._search) != DONE:
                raise SystemExit("the search for the cameras failed")

    def _search(self) -> None:
        from gs2d.pipeline.prepare import pose_finding as sfm

        real = sfm.solve

        def kept(request: Any, *rest: Any) -> Any:
            solved = real(request, *rest)
            work, part = Path(request.database).parent, self.searched.with_suffix(".part")
            shutil.copytree(request.output, part / "models")
            shutil.copyfile(request.database, part / "database.db")
            (part / "solved").write_bytes(pickle.dumps(solved))
            (part / "place").write_text(str(Path(request.output).relative_to(work)))
            part.rename(self.searched)
            return solved

        sfm.solve = kept
        self._reconstruct(self.work / "first")

    def _reconstruct(self, out: Path) -> None:
        from gs2d.pipeline.reconstruct import reconstruct

        reconstruct(
            ReconstructOptions(
                photos=self.photos,
                out=out,
                resume=True,
                threads=1,
                schedule_scale=0.0005,
                downscale=8,
                backend="cpu",
                overrides=FEW,
            )
        )

    def act(self, folder: Path) -> None:
        """Write the capture and the run."""
        from gs2d.pipeline.prepare import pose_finding as sfm

        def again(request: Any, *_: Any) -> Any:
            try:
                shutil.copyfile(self.searched / "database.db", request.database)
                shutil.copytree(self.searched / "models", request.output, dirs_exist_ok=True)
            except OSError as error:  # the process that replaces COLMAP's fails: report it as COLMAP's failure
                raise DataError("COLMAP ended") from error
            return pickle.loads((self.searched / "solved").read_bytes())

        sfm.solve = again
        self._reconstruct(folder / "run")


COMMANDS = {command.name: command for command in (Train, Mesh, Export, Page, Report, Sweep, Reconstruct)}
