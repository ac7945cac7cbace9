"""What the doctor looks for beside the rasterizers: packages and programs that single commands need."""

from __future__ import annotations

import importlib.metadata
import shutil
from collections.abc import Callable
from dataclasses import dataclass

from gs2d.core.extras import FFMPEG, install

CPU_TORCH = "pip install torch --index-url https://download.pytorch.org/whl/cpu"  # as pytorch.org has it


@dataclass(frozen=True)
class Found:
    """Whether something is here; ``details`` is its version or what is missing, ``remedy`` how to get it."""

    available: bool
    details: str
    remedy: str = ""


@dataclass(frozen=True)
class Wanted:
    """What a command needs beside what every installation has."""

    name: str
    command: str
    look: Callable[[], Found]


def _packages(extra: str, *names: str) -> Callable[[], Found]:
    """Look for the packages of an extra."""

    def look() -> Found:
        versions = {name: _version(name) for name in names}
        if missing := [name for name, version in versions.items() if version is None]:
            return Found(False, f"{', '.join(missing)} missing", install(extra))
        return Found(True, ", ".join(f"{name} {version}" for name, version in versions.items()))

    return look


def _programs(remedy: str, *names: str) -> Callable[[], Found]:
    """Look for programs on the PATH."""

    def look() -> Found:
        if missing := [name for name in names if shutil.which(name) is None]:
            return Found(False, f"no {' and no '.join(missing)} on the PATH", remedy)
        return Found(True, str(shutil.which(names[0])))

    return look


def _heic() -> Found:
    """Look for one of the two packages that decode HEIC."""
    for name in ("pi-heif", "pillow-heif"):
        if (version := _version(name)) is not None:
            return Found(True, f"{name} {version}")
    return Found(False, "pi-heif missing", "pip install pi-heif (its wheel holds LGPL code), or convert to JPEG")


OPTIONAL = (
    Wanted("sfm", "cameras of photographs (gs2d reconstruct, poses)", _packages("sfm", "pycolmap")),
    Wanted(
        "ffmpeg",
        "videos, read and made (gs2d render --video x.mp4)",
        _programs(FFMPEG, "ffmpeg", "ffprobe"),
    ),
    Wanted("heic", "HEIC photographs, as of an iPhone", _heic),
    Wanted("exr", "photographs of floats, OpenEXR depth maps", _packages("exr", "OpenEXR", "tifffile")),
    Wanted("geo", "maps (gs2d georeference --gps, orthophoto)", _packages("geo", "pyproj", "tifffile")),
    Wanted(
        "markers",
        "printed markers (gs2d georeference --markers)",
        _packages("markers", "opencv-python-headless"),
    ),
    Wanted("texture", "textured meshes (--texture)", _packages("texture", "xatlas")),
    Wanted("spz4", "SPZ of version 4 (gs2d export --layout spz4)", _packages("spz4", "zstandard")),
    Wanted("usd", "OpenUSD files (gs2d export --out x.usd)", _packages("usd", "usd-core")),
    Wanted("cluster", "several machines (gs2d sweep, paper, blocks --cluster)", _packages("cluster", "ray")),
)


def torch_advice() -> str:
    """Return what to do about a torch that brought CUDA to a machine without a GPU; nothing where all is well."""
    import torch

    if torch.version.cuda is None or torch.cuda.is_available():
        return ""
    return (
        f"this torch was built for CUDA {torch.version.cuda}, gigabytes of it, and there is no GPU that "
        f"it can use. Without one torch's CPU build is enough, in a fresh environment: {CPU_TORCH}"
    )


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
