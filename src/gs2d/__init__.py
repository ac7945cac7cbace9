"""gs2d: posed photographs to a surface mesh and a scene of 2D Gaussian splats (2DGS and 2DGS-R).

The names below are imported on first use (PEP 562), so that ``import gs2d.recipe`` does not load torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gs2d.camera import Camera, look_at
    from gs2d.errors import Gs2dError
    from gs2d.recipe import Recipe, Stage
    from gs2d.render.api import rasterize, splat_errors
    from gs2d.render.backend import backend_report, get_backend
    from gs2d.render.types import RasterSettings, RenderOutput
    from gs2d.splats import Splats
    from gs2d.triangles import Mesh

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Gs2dError",
    "Mesh",
    "RasterSettings",
    "Recipe",
    "RenderOutput",
    "Splats",
    "Stage",
    "__version__",
    "backend_report",
    "get_backend",
    "look_at",
    "rasterize",
    "splat_errors",
]

_HOME = {
    "Camera": "gs2d.camera",
    "Gs2dError": "gs2d.errors",
    "Mesh": "gs2d.triangles",
    "RasterSettings": "gs2d.render.types",
    "Recipe": "gs2d.recipe",
    "RenderOutput": "gs2d.render.types",
    "Splats": "gs2d.splats",
    "Stage": "gs2d.recipe",
    "backend_report": "gs2d.render.backend",
    "get_backend": "gs2d.render.backend",
    "look_at": "gs2d.camera",
    "rasterize": "gs2d.render.api",
    "splat_errors": "gs2d.render.api",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'gs2d' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
