"""Actions of the commands: call the pipeline, show the result. Imported when a command runs."""

from __future__ import annotations

import importlib.metadata
import json
import shlex
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gs2d.cli import commands as c
from gs2d.cli.console import Console, figure
from gs2d.core.extras import FFMPEG, install
from gs2d.core.processes import process_rank
from gs2d.errors import DataError, ProtocolError, RunError
from gs2d.io.run_dir import PAGE, RunFolder, is_run, open_run
from gs2d.pipeline.prepare.options import MeshOptions, TextureOptions, values

WIDTH = 78  # columns of the verdict
_NAMES, _GRADES = 14, 8  # columns of the names and grades of findings
_FILES = ("report.html", "scene.html", "mesh.ply", "mesh.glb", "splats.ply")
EVERYDAY = ("best", "best-fast", "2dgs")  # recipes that `gs2d recipes` shows without --all


# -- tables and lines --------------------------------------------------------------------------------------------------
def show_run(run: RunFolder, console: Console, *, definition: bool = False, **extra: Any) -> None:
    """Print the metrics of a run as a table, its files, and its verdict; with ``--json`` also ``extra``.

    ``definition``: also recipe, scene and views, but not the command to run next.
    """
    from gs2d.report.sections.verdict_section import read_verdict

    path, metrics = run.path, run.metrics()
    result = {"run": str(path), **metrics, **extra}
    if definition:
        result["definition"] = whole = run.definition()
        recipe, scene = whole["recipe"]["name"], whole["scene"]
        views = f"{scene['train']} training and {scene['test']} test views"
        console.say(f"{recipe} on {scene['name']} ({scene['format']}, {views})")
    columns = ["stage", "iter.", "seconds", "splats", "MB", "PSNR train", "test", "SSIM"]
    console.table("", columns, [_stage_row(stage) for stage in metrics["stages"]])
    show_surface(metrics.get("surface"), console)
    for name in _FILES:
        if (path / name).exists():
            console.say(f"{path / name}")
    try:
        verdict = read_verdict(path)
    except (DataError, RunError):  # the report names the error
        verdict = None
    result["verdict"] = verdict
    for line in verdict_lines(verdict) if verdict is not None else ():
        console.say(line)
    if not definition:
        page = f"open {PAGE} in a browser, or " if (path / PAGE).exists() else ""
        console.say(f"look at it: {page}gs2d view {shlex.quote(str(path))}")
    console.result(result)


def _stage_row(stage: dict[str, Any]) -> list[str]:
    train, test = stage.get("train") or {}, stage.get("test") or {}
    return [
        stage["name"],
        f"{stage['iterations']:,}",
        figure(stage["seconds"], 0),
        f"{stage['splats']:,}",
        figure(stage["bytes"] / 1e6, 1),
        figure(train.get("psnr"), 2),
        figure(test.get("psnr"), 2),
        figure((test or train).get("ssim"), 4),
    ]


def verdict_lines(verdict: Mapping[str, Any]) -> list[str]:
    """Return a verdict (that of ``verdict.json``) in lines of at most ``WIDTH`` columns."""
    grade = verdict["grade"]
    lines = textwrap.wrap(f"Verdict: {str(grade or 'none').upper()}. {verdict['headline']}", WIDTH)
    for finding in verdict["findings"]:
        start = f"  {finding['grade'] or '-':<{_GRADES - 1}} {finding['name']:<{_NAMES - 1}} "
        lines += textwrap.wrap(finding["figure"], WIDTH, initial_indent=start, subsequent_indent=" " * len(start))
    advice = [finding["advice"] for finding in verdict["findings"] if finding["advice"]]
    if advice:
        lines.append("What to do next:")
    for text in advice:
        lines += textwrap.wrap(text, WIDTH, initial_indent="- ", subsequent_indent="  ")
    return lines


def score_rows(split: str, metrics: dict[str, Any] | None) -> list[list[str]]:
    """Return two rows of scores: of 8-bit images, as in the official evaluation, and of float images."""
    scores = metrics or {}
    rounded = [figure(scores.get("psnr"), 2), figure(scores.get("ssim"), 4)]
    floats = [figure(scores.get("psnr_float"), 2), figure(scores.get("ssim_float"), 4)]
    lpips = [figure(scores.get(name), 4) for name in ("lpips", "lpips_signed")]
    return [[split, "8 bit", *rounded, *lpips], ["", "floats", *floats, "", ""]]


def show_surface(surface: dict[str, Any] | None, console: Console) -> None:
    """Show the distance of a mesh from the true surface, if it was measured."""
    if not surface:
        return
    rows = [
        [f"{row['threshold']:.4g}", *(figure(row[name], 4) for name in ("precision", "recall", "f_score"))]
        for row in surface.get("thresholds") or []
    ]
    if rows:
        console.table("", ["surface within", "precision", "recall", "F-score"], rows)
    if surface.get("chamfer") is not None:
        console.say(f"Chamfer distance {surface['chamfer']:.5g} {surface.get('unit', 'world units')}")


# -- actions -----------------------------------------------------------------------------------------------------------
def train(command: c.TrainCommand, console: Console) -> None:
    """Run ``gs2d train``."""
    from gs2d.pipeline.train.train_run import train as run_training

    run = run_training(command, console.on_event)
    if process_rank().leads:  # one process of several prints
        show_run(run, console)


def mesh(command: c.MeshCommand, console: Console) -> None:
    """Run ``gs2d mesh``."""
    from gs2d.pipeline.finish.run_mesh import mesh_run
    from gs2d.pipeline.prepare.limits import use_memory

    if command.run is not None and (command.splats, command.cameras) != (None, None):
        raise RunError("--splats and --cameras mesh a file instead of a run, got both; leave one of them out")
    use_memory(command.memory)
    options = MeshOptions(**values(MeshOptions, command))
    if command.run is not None and command.texture:
        _textured_mesh(command.run, command, options, console)
        return
    for name, default in values(TextureOptions, TextureOptions()).items():
        if getattr(command, name) != default:
            raise ProtocolError(f"--set {name} needs --texture; give both")
    out, threads = command.out, command.threads
    if command.run is not None:
        result = mesh_run(command.run, options, console.on_event, out=out, threads=threads)
    elif command.splats is not None and not command.texture:
        from gs2d.pipeline.finish.run_mesh import mesh_file

        result = mesh_file(command.splats, options, console.on_event, out=out, cameras=command.cameras, threads=threads)
    else:
        raise RunError("expected the folder of a run, got none; name one, or give --splats FILE --out MESH")
    console.say(f"{result['file']}: {result['vertices']:,} vertices, {result['faces']:,} triangles")
    if "voxel" in result:
        console.say(f"voxel {result['voxel']:.4g}, truncation {result['truncation']:.4g}, depth {result['depth']}")
    console.result(result)


def _textured_mesh(run: Path, command: c.MeshCommand, mesh_options: Any, console: Console) -> None:
    from gs2d.pipeline.finish.run_texture import texture_run

    if command.collision or command.lods != 1:
        raise ProtocolError("--texture writes neither convex pieces nor lods; run `gs2d mesh` again without --texture")
    result = texture_run(run, command, mesh_options, console.on_event, out=command.out, threads=command.threads)
    size, unseen = result["texture_size"], result["texels_unseen"] / max(result["texels"], 1)
    console.say(f"{result['files'][0]}: {result['faces']:,} triangles, {result['bytes'] / 1e6:.1f} MB")
    console.say(
        f"texture {size}x{size} in {result['charts']:,} charts, {unseen:.2%} of it not visible in any photograph"
    )
    console.result(result)


def view(command: c.ViewCommand, console: Console) -> None:
    """Run ``gs2d view`` until Ctrl-C."""
    from gs2d.pipeline.look.view import open_viewer, serve

    server, shown = open_viewer(command.path, command.port, console.on_event)
    try:
        console.say(f"open in a browser: {server.url}  (Ctrl-C ends it)")
        console.result({"url": server.url, "port": server.port, "shown": shown})
        console.flush()
        serve(server, console.on_event)
    finally:
        server.close()


def evaluate(command: c.EvaluateCommand, console: Console) -> None:
    """Run ``gs2d evaluate``."""
    from gs2d.pipeline.finish.evaluate import evaluate_run
    from gs2d.pipeline.prepare.limits import use_memory

    use_memory(command.memory)
    result = evaluate_run(command.run, command, console.on_event, threads=command.threads)
    rows = [row for split in ("train", "test") for row in score_rows(split, result.get(split))]
    if "exposure" in command.matched:
        rows += score_rows("test, matched", result["test_matched"])
    if "poses" in command.matched:
        rows += score_rows("test, aligned", result["test_aligned"])
    console.table("", ["views", "images", "PSNR dB", "SSIM", "LPIPS 0..1", "LPIPS -1..1"], rows)
    for split in ("train", "test"):
        reason = (result.get(split) or {}).get("lpips_reason") or result.get(f"{split}_reason")
        if reason:
            console.say(f"{split}: {reason}")
    show_surface(result.get("surface"), console)
    console.result(result)


def export(command: c.ExportCommand, console: Console) -> None:
    """Run ``gs2d export``."""
    from gs2d.pipeline.finish.splat_files import export_run
    from gs2d.pipeline.look.page import SUFFIXES, page_run

    if command.format == "html" or (command.out is not None and command.out.suffix.lower() in SUFFIXES):
        if command.format not in (None, "html"):
            raise RunError("an .html page takes no other --format; leave it out")
        page = page_run(command.run, command.out, on_event=console.on_event)
        console.say(f"{page['file']}: {page['splats']:,} splats, {page['bytes'] / 1e6:.1f} MB; open it in a browser")
        console.result(page)
        return
    if command.out is None:
        raise RunError("gs2d export needs --out FILE, whose ending selects the format")
    result = export_run(command.run, command.out, command.format)
    console.say(
        f"{result['file']}: {result['splats']:,} splats, {result['bytes'] / 1e6:.1f} MB, format {result['layout']}"
    )
    for note in result["notes"]:
        console.say(note)
    console.result(result)


def recipes(command: c.RecipesCommand, console: Console) -> None:
    """Run ``gs2d recipes``."""
    from gs2d.config.presets import RECIPES, about_recipe, get_recipe
    from gs2d.config.serialize import to_json

    if command.name:
        shown = to_json(get_recipe(command.name))
        console.say(json.dumps(shown, indent=2))
        console.result(shown)
        return
    names = {name: about_recipe(name) for name, _ in RECIPES.working()}
    shown = {name: about for name, about in names.items() if command.all or name in (*EVERYDAY, *RECIPES.guests())}
    width = max(map(len, shown))
    for name, about in shown.items():
        console.say(f"{name:<{width}}  {about}")
    if len(shown) < len(names):
        console.say(f"{len(names) - len(shown)} more recipes: --all")
    console.result(names)


def reconstruct(command: c.ReconstructCommand, console: Console) -> None:
    """Run ``gs2d reconstruct``; print metrics, files and the next command."""
    from gs2d.core.json_files import read_json
    from gs2d.pipeline.reconstruct import CAPTURE
    from gs2d.pipeline.reconstruct import reconstruct as run_all
    from gs2d.sfm.workspace import POSES_JSON

    run = run_all(command, console.on_event)
    show_run(run, console, poses=read_json(run.path / CAPTURE / POSES_JSON))


def poses(command: c.PosesCommand, console: Console) -> None:
    """Run ``gs2d poses``; print photographs with and without a camera, and the next command."""
    from gs2d.pipeline.prepare.pose_finding import find_poses, lost_lines, placed_line

    result = find_poses(command, console.on_event)
    cameras, capture = result["cameras"], result["capture"]
    lines = [placed_line(result), *(f"camera: {camera['about']}" for camera in cameras[:4])]
    if len(cameras) > 4:
        lines.append(f"and {len(cameras) - 4} more cameras, in poses.json")
    lines += lost_lines(result)
    for other in result["other_models"]:
        lines.append(
            f"{other['folder']} holds a separate piece: {len(other['photos'])} photographs, {other['points']:,} points"
        )
    lines.append(f"look at {capture}/poses.png, then: gs2d train {shlex.quote(capture)} --out RUN")
    for line in lines:
        console.say(line)
    console.result(result)


def info(command: c.InfoCommand, console: Console) -> None:
    """Run ``gs2d info``."""
    from gs2d.pipeline.look.info import describe_capture, describe_file

    path: Path = command.path
    if is_run(path):
        show_run(open_run(path), console, definition=True)
        return
    description = describe_capture(path) if path.is_dir() else describe_file(path)
    for name, value in description.items():
        for part in value if isinstance(value, list) else [value]:
            console.say(f"{name}: {part}")
    console.result(description)


# -- gs2d doctor: available backends and packages, and how to install others -------------------------------------------
_EXTRAS = {  # extra -> (the commands that need it, its packages)
    "sfm": ("cameras of photographs (gs2d reconstruct, poses)", ("pycolmap",)),
    "geo": ("maps (gs2d survey --gps, --orthophoto)", ("pyproj", "tifffile")),
    "markers": ("printed markers (gs2d survey --markers)", ("opencv-python-headless",)),
    "collision": ("convex pieces (gs2d mesh --collision)", ("coacd",)),
    "texture": ("textured meshes (--texture)", ("xatlas",)),
    "spz4": ("SPZ of version 4 (gs2d export --format spz4)", ("zstandard",)),
    "usd": ("OpenUSD files (gs2d export --out x.usd)", ("usd-core",)),
    "cluster": ("several machines (gs2d sweep, blocks --cluster)", ("ray",)),
}
_HEIC = "pip install pi-heif (its wheel holds LGPL code), or convert to JPEG"


def doctor(_command: c.DoctorCommand, console: Console) -> None:
    """Show the machine, the rasterizers and the optional packages and programs."""
    from gs2d.io.run_dir import machine, versions
    from gs2d.render.backends import backend_report

    host, installed, backends = machine(), versions(), backend_report()
    chosen = next((status.name for status in backends if status.available), "none")
    optional = _optional()
    console.say(f"{host['processor']}, {host['cores']} cores, {host['system']}")
    console.say(", ".join(f"{name} {version}" for name, version in installed.items()))
    console.say(f"\nRasterizers (--backend auto takes: {chosen})", style="bold")
    for status in sorted(backends, key=lambda status: not status.available):
        _show(console, status.name, status.available, status.details or status.reason, status.remedy)
    console.say("\nFor some commands", style="bold")
    for entry in optional.values():
        _show(console, entry["used_by"], entry["available"], entry["details"], entry["remedy"])
    remedy = next((status.remedy for status in backends if status.name == "cpu"), "")
    if chosen == "reference":
        console.say("\nNot ready for gs2d train: only the slow reference rasterizer runs", style="bold")
        console.say(f"First: {remedy}")
    else:
        console.say(f"\nReady for gs2d train ({chosen}). Try it: gs2d demo", style="bold")
    fields = ("name", "available", "reason", "remedy", "details")
    console.result(
        {
            "machine": host,
            "versions": installed,
            "auto": chosen,
            "backends": [{field: getattr(status, field) for field in fields} for status in backends],
            "optional": optional,
        }
    )


def _show(console: Console, name: str, available: bool, details: str, remedy: str) -> None:
    console.say(f"  {'yes' if available else 'no ':<3}  {name}: {details}")
    if not available and remedy:
        console.say(f"       to get it: {remedy}")


def _optional() -> dict[str, dict[str, Any]]:
    """Return optional packages and programs: whether they are available, their versions, how to install them."""
    entries = {}
    for extra, (used_by, packages) in _EXTRAS.items():
        entries[extra] = _entry(used_by, {name: _version(name) for name in packages}, install(extra))
    if entries["sfm"]["available"]:
        entries["sfm"]["details"] += f"; features on the {_colmap_device()}"
    heic = next((name for name in ("pi-heif", "pillow-heif") if _version(name) is not None), "pi-heif")
    entries["heic"] = _entry("HEIC photographs (iPhone)", {heic: _version(heic)}, _HEIC)
    programs = {name: shutil.which(name) for name in ("ffmpeg", "ffprobe")}
    entries["ffmpeg"] = _entry("videos, read and written (gs2d render --video x.mp4)", programs, FFMPEG)
    return entries


def _colmap_device() -> str:
    """Return where COLMAP finds features; asked in a process of its own, as pycolmap loads another OpenMP library."""
    words = [sys.executable, "-c", "import pycolmap; print(pycolmap.has_cuda)"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return "GPU, or the CPU if that fails" if done.stdout.strip() == "True" else "CPU (this pycolmap has no CUDA)"


def _entry(used_by: str, installed: dict[str, str | None], remedy: str) -> dict[str, Any]:
    missing = [name for name, version in installed.items() if version is None]
    versions = ", ".join(f"{name} {version}" for name, version in installed.items())
    details = f"{', '.join(missing)} missing" if missing else versions
    return {"used_by": used_by, "available": not missing, "details": details, "remedy": remedy if missing else ""}


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
