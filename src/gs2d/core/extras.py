"""Optional packages: install commands and deferred imports."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from gs2d.errors import BackendError

# Requirements of each extra, as in pyproject.toml (a test compares them).
EXTRAS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "cluster": ("ray>=2.60,<3",),
        "collision": ("coacd>=1.0.5",),
        "cuda12": ("cuda-bindings>=12.8,<13", "nvidia-cuda-nvrtc-cu12>=12.4"),
        "cuda13": ("cuda-bindings>=13,<14", "nvidia-cuda-nvrtc>=13,<14"),
        "geo": ("pyproj>=3.6", "tifffile>=2024.1"),
        "markers": ("opencv-python-headless>=4.7",),
        "sfm": ("pycolmap>=4.2",),
        "spz4": ("zstandard>=0.22",),
        "texture": ("xatlas>=0.0.9",),
        "usd": ("usd-core>=26.3",),
    }
)
FFMPEG = "apt install ffmpeg, brew install ffmpeg, or ffmpeg.org"


def install(extra: str) -> str:
    """Return the command that installs the packages of an extra.

    The packages are listed because ``2dgs-r[...]`` only works if the package index has it.
    """
    return "pip install " + " ".join(f"'{requirement}'" for requirement in EXTRAS[extra])


def required(extra: str, module: str, what: str, otherwise: str = "") -> Any:
    """Import a module of an extra; BackendError if it is not installed.

    The message names ``what`` needs it, a feature, and ``otherwise``, the alternative without it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        remedy = f"{install(extra)}{otherwise and ', or '}{otherwise}"
        raise BackendError(f"{what} needs {error.name}, which is not installed; {remedy}") from error
