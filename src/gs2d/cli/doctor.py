"""``gs2d doctor``: what this machine can run, and how to install the rest."""

from __future__ import annotations

import importlib.metadata
import shutil
from typing import Any

from gs2d.cli.commands import DoctorCommand
from gs2d.cli.console import Console
from gs2d.core.extras import FFMPEG, install

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


def doctor(_command: DoctorCommand, console: Console) -> None:
    """Show the machine, the rasterizers and the optional packages and programs."""
    from gs2d.io.run_dir import machine, versions
    from gs2d.render.backends import backend_report

    host, installed, backends = machine(), versions(), backend_report()
    chosen = next((status.name for status in backends if status.available), "none")
    optional = _optional()
    console.say(f"{host['processor']}, {host['cores']} cores, {host['system']}")
    console.say(", ".join(f"{name} {version}" for name, version in installed.items()))
    console.say(f"\nRasterizers (--backend auto takes: {chosen})", style="bold")
    for status in backends:
        _show(console, status.name, status.available, status.details or status.reason, status.remedy)
    console.say("\nFor some commands", style="bold")
    for entry in optional.values():
        _show(console, entry["used_by"], entry["available"], entry["details"], entry["remedy"])
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
    """Return what commands need beyond every installation: whether it is available, its version, how to get it."""
    entries = {}
    for extra, (used_by, packages) in _EXTRAS.items():
        entries[extra] = _entry(used_by, {name: _version(name) for name in packages}, install(extra))
    heic = next((name for name in ("pi-heif", "pillow-heif") if _version(name) is not None), "pi-heif")
    entries["heic"] = _entry("HEIC photographs, as of an iPhone", {heic: _version(heic)}, _HEIC)
    programs = {name: shutil.which(name) for name in ("ffmpeg", "ffprobe")}
    entries["ffmpeg"] = _entry("videos, read and written (gs2d render --video x.mp4)", programs, FFMPEG)
    return entries


def _entry(used_by: str, found: dict[str, str | None], remedy: str) -> dict[str, Any]:
    missing = [name for name, version in found.items() if version is None]
    versions = ", ".join(f"{name} {version}" for name, version in found.items())
    details = f"{', '.join(missing)} missing" if missing else versions
    return {"used_by": used_by, "available": not missing, "details": details, "remedy": remedy if missing else ""}


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
