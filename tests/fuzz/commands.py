"""What is mutated beside foreign files: run folders changed by hand, command lines, and the numbers of splats."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

import mutations as m
import numpy as np
import torch
from PIL import Image

from cli_runs import TINY
from gs2d.core.splats import Splats
from render_scenes import IMAGES, random_camera, random_splats
from tiny import write_capture

# -- runs --------------------------------------------------------------------------------------------------------------
_RARE = 25  # one in so many run folders is reported and resumed, which takes a second
_DRAWN = 8  # one in so many of those has its curves drawn, which takes several; else each is one dot


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
    """`gs2d info`, `export`, and `page` or `render`; `report` and `train --resume` for one in so many."""
    from gs2d.errors import Gs2dError

    changed = sum((root / "run" / name).stat().st_size for name in ("run.json", "metrics.json", "events.jsonl"))
    commands = [["info", "run"], ["export", "run", "--out", "out.spz"]]
    commands += [["page", "run", "--out", "out.html"] if changed % 2 else ["render", "run", "--out", "out"]]
    if changed % _RARE == 0:
        commands += [["report", "run"]]
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
    from gs2d.cli.console import Console
    from gs2d.cli.handlers import execute as act

    act(_parsed(tuple(words)), Console(quiet=True, as_json=False))


@cache  # the words are the same for every run folder, and the parser has a family of its own
def _parsed(words: tuple[str, ...]) -> Any:
    from gs2d.cli.parser import parse

    return parse(words)


# -- command lines -----------------------------------------------------------------------------------------------------
LINES = (
    "train CAPTURE --out RUN --recipe 2dgs-r --schedule-scale 0.1 --set init_points=100 --downscale 2 --seed 3",
    "train CAPTURE --out RUN --set surface.densify.max_splats=150 --threads 2 --checkpoint-every 100 --resume",
    "mesh RUN --voxel 0.01 --depth median --texture --texture-size 512",
    "render RUN --split test --out FOLDER --fps 24 --orbit 30",
    "export RUN --out a.spz --layout spz --bbox -1 -1 -1 1 1 1",
    "evaluate RUN --mesh-gt a.ply --json",
    "poses PHOTOS --out CAPTURE",
    "sweep A B --recipes 2dgs,2dgs-r --out TABLE",
    "recipes show 2dgs-r --json",
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


# -- splats ------------------------------------------------------------------------------------------------------------
_SHAPES = {"means": (3,), "quats": (4,), "log_scales": (2,), "opacity_logits": (), "sh0": (1, 3), "shN": (3, 3)}
_EDGES = (*(float("nan"), float("inf"), -float("inf"), 0.0, -0.0, 1e-45, -1e-38, 1e18, -1e19, 1e20, 3.4e38, -3.4e38),
          *(1.0, -1.0, 88.0, 89.0, -88.0, -104.0, 16777216.0, 0.2, 1000.0))  # fmt: skip


def scene_seeds() -> list[dict[str, bytes]]:
    """Random scenes of every kind: rows of 28 float32 each, and the seed of the camera in the name."""
    seeds = []
    for number in range(40):
        rng = np.random.default_rng(number)
        splats = random_splats(rng, random_camera(rng), int(rng.integers(1, 30)))
        rows = [tensor.reshape(len(splats), -1) for _, tensor in splats.items()]
        rows[-1] = torch.randn(len(splats), 9, generator=torch.Generator().manual_seed(number)) * 0.3
        seeds.append({f"{number}.splats": torch.cat(rows, dim=1).float().numpy().tobytes()})
    return seeds


def of_floats(rng: Random, data: bytes) -> bytes:
    """A few numbers become edges of float32."""
    values = np.frombuffer(bytearray(data), np.float32)
    for _ in range(rng.choice((0, 1, 1, 2, 5))):
        values[rng.randrange(len(values))] = rng.choice(_EDGES)
    return values.tobytes()


def splats_of(data: bytes) -> Splats:
    rows, parts, at = torch.from_numpy(np.frombuffer(bytearray(data), np.float32).reshape(-1, 22)), {}, 0
    for name, shape in _SHAPES.items():
        size = int(np.prod(shape, dtype=int))
        parts[name], at = rows[:, at : at + size].reshape(-1, *shape).contiguous(), at + size
    return Splats(**parts)


def draw(root: Path) -> None:
    """The CPU kernels against the reference: finite, and the same alpha and colours but for pixels on an edge."""
    from gs2d.render.api import rasterize
    from gs2d.render.types import RasterSettings

    (path,) = root.iterdir()
    rng = np.random.default_rng(int(path.stem))
    camera, splats = random_camera(rng), splats_of(path.read_bytes())
    settings = RasterSettings(background=(0.2, 0.5, 0.9))
    low = rasterize(splats, camera, settings, backend="cpu")
    high = rasterize(splats.to(dtype=torch.float64), camera, settings, backend="reference")
    for name in IMAGES:
        assert bool(getattr(low, name).isfinite().all()), f"{name} of the CPU is not finite"
    colors = (low.color - high.color).abs() / high.color.abs().clamp_min(1)  # SH of 1e7 are rounded to 1e-7 of that
    apart = torch.maximum((low.alpha - high.alpha).abs().reshape(-1), colors.amax(-1).reshape(-1))
    share = float((apart > 0.02).double().mean())
    assert share <= 0.01, f"{share:.1%} of the pixels differ by more than 0.02 (of their colour, where that is above 1)"


JSON_LINE = m.either(m.of_json, m.of_json, m.of_text)
RUN_FILES = {
    "run/run.json": m.either(m.of_json, m.of_json, m.of_text, m.of_bytes),
    "run/metrics.json": m.either(m.of_json, m.of_json, m.of_text, m.of_bytes),
    "run/events.jsonl": m.of_json_lines,
    "renders/index.json": m.of_json,
    "run/subject.json": m.of_json,
}
