"""What is mutated beside foreign files: run folders changed by hand, and command lines."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import mutations as m
from PIL import Image

from cli_runs import TINY
from tiny import write_capture

# -- runs --------------------------------------------------------------------------------------------------------------
_RARE = 25  # one of 25 run folders is reported and resumed, which takes a second
_DRAWN = 8  # of these, one of 8 has its curves drawn, which takes several seconds; otherwise each curve is one dot


@contextlib.contextmanager
def _curves(drawn: bool) -> Iterator[None]:
    """Matplotlib lays out and writes a figure, or the figure is made and its file is one dot."""
    import matplotlib.figure

    def dot(_figure: object, file: Any, *, format: str, **_: object) -> None:
        file.write("<svg></svg>") if format == "svg" else Image.new("RGB", (1, 1)).save(file, format)

    with contextlib.nullcontext() if drawn else mock.patch.object(matplotlib.figure.Figure, "savefig", dot):
        yield


@contextlib.contextmanager
def _in(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def write_run(root: Path) -> None:
    """A run of a few iterations, and its capture beside it."""
    from gs2d.cli import run

    with _in(root):
        write_capture(Path("capture"), train=3, test=1)
        words = ["train", "capture", "--out", "run", *TINY, "--quiet", "--threads", "1", "--downscale", "2"]
        assert run([*words, "--backend", "cpu"]) in (0, 3)
        path = Path("run/run.json")
        definition = json.loads(path.read_text())
        definition["scene"]["path"] = "capture"
        path.write_text(json.dumps(definition, indent=2))
        for made in ("report.html", "mesh.ply", "run/verdict.json"):
            Path("run", made).unlink(missing_ok=True)


def run_seeds() -> list[dict[str, bytes]]:
    with TemporaryDirectory(prefix="gs2d-seed-") as home:
        write_run(Path(home))
        return [{p.relative_to(home).as_posix(): p.read_bytes() for p in sorted(Path(home).rglob("*")) if p.is_file()}]


def read_run(root: Path) -> None:
    """Run `gs2d info`, `export`, and a page or `render`; on some folders also `evaluate` and `train --resume`."""
    from gs2d.errors import Gs2dError

    changed = sum((root / "run" / name).stat().st_size for name in ("run.json", "metrics.json", "events.jsonl"))
    commands = [["info", "run"], ["export", "run", "--out", "out.spz"]]
    commands += [["export", "run", "--out", "out.html"] if changed % 2 else ["render", "run", "--out", "out"]]
    if changed % _RARE == 0:
        commands += [["evaluate", "run"]]
    if changed % _RARE == 1:
        commands += [["train", "capture", "--out", "run", "--resume", *TINY, "--threads", "1", "--downscale", "2"]]
    refused: Gs2dError | None = None
    with _in(root), _curves(changed // _RARE % _DRAWN == 0):
        for words in commands:
            try:
                execute([*words, "--quiet"])
            except Gs2dError as error:
                refused = error
    if refused is not None:
        raise refused


def execute(words: list[str]) -> None:
    """As the command line, without its net for exceptions."""
    from gs2d.cli.app import execute as act
    from gs2d.cli.console import Console

    act(_parsed(tuple(words)), Console(quiet=True, as_json=False))


@cache  # the words are the same for every run folder, and the parser has a family of its own
def _parsed(words: tuple[str, ...]) -> Any:
    from gs2d.cli.parser import parse

    return parse(words)


# -- command lines -----------------------------------------------------------------------------------------------------
LINES = (
    "train CAPTURE --out RUN --recipe 2dgs-r --schedule-scale 0.1 --set init_points=100 --downscale 2 --seed 3",
    "train CAPTURE --out RUN --set surface.densify.max_splats=150 --threads 2 --checkpoint-every 100 --resume",
    "mesh RUN --set voxel=0.01 --set depth=median --texture --set texture_size=512",
    "render RUN --split test --out FOLDER --orbit 30",
    "export RUN --out a.spz --format spz",
    "edit RUN --merge OTHER --transform 2 90 0 0 0 0 1.5 --out b.ply",
    "evaluate RUN --mesh-gt a.ply --json",
    "poses PHOTOS --out CAPTURE",
    "sweep A B --recipes 2dgs,2dgs-r --out TABLE",
    "recipes 2dgs-r --json",
    "view RUN --port 8080",
)


def line_seeds() -> list[dict[str, bytes]]:
    return [{"words.json": json.dumps(line.split()).encode()} for line in LINES]


def read_line(root: Path) -> None:
    """The parser, and what is checked of a recipe and of what is set in it before anything is read."""
    from gs2d.cli.parser import UsageError, parse
    from gs2d.config.presets import get_recipe
    from gs2d.config.serialize import apply_overrides
    from gs2d.errors import DataError

    try:
        words = json.loads((root / "words.json").read_text(encoding="utf-8", errors="surrogatepass"))
    except (ValueError, RecursionError):
        return  # no command line
    words = [word for word in words if isinstance(word, str) and "\0" not in word] if isinstance(words, list) else []
    if not words:
        return
    try:
        command = parse(words)
    except UsageError as error:
        raise DataError(" ".join(str(error).split())) from error
    if hasattr(command, "overrides"):
        apply_overrides(get_recipe(getattr(command, "recipe", None) or "2dgs-r"), command.overrides)


JSON_LINE = m.either(m.of_json, m.of_json, m.of_text)
RUN_FILES = {
    "run/run.json": m.either(m.of_json, m.of_json, m.of_text, m.of_bytes),
    "run/metrics.json": m.either(m.of_json, m.of_json, m.of_text, m.of_bytes),
    "run/events.jsonl": m.of_json_lines,
    "renders/index.json": m.of_json,
    "run/subject.json": m.of_json,
}
