"""gs2d: posed photographs to a surface mesh and a scene of 2D Gaussian splats (2DGS and 2DGS-R).

The names below are imported on first use (PEP 562), so that ``import gs2d.config.recipe`` does not load torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gs2d.config.recipe import Recipe, Stage
    from gs2d.core.camera import Camera, look_at
    from gs2d.core.mesh import Mesh
    from gs2d.core.splats import Splats
    from gs2d.errors import Gs2dError
    from gs2d.render.api import rasterize, splat_errors
    from gs2d.render.backends import backend_report, get_backend
    from gs2d.render.tensor_api import rasterize_2dgs
    from gs2d.render.types import RasterSettings, RenderOutput

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
    "rasterize_2dgs",
    "splat_errors",
]

_HOME = {
    "Camera": "gs2d.core.camera",
    "Gs2dError": "gs2d.errors",
    "Mesh": "gs2d.core.mesh",
    "RasterSettings": "gs2d.render.types",
    "Recipe": "gs2d.config.recipe",
    "RenderOutput": "gs2d.render.types",
    "Splats": "gs2d.core.splats",
    "Stage": "gs2d.config.recipe",
    "backend_report": "gs2d.render.backends",
    "get_backend": "gs2d.render.backends",
    "look_at": "gs2d.core.camera",
    "rasterize": "gs2d.render.api",
    "rasterize_2dgs": "gs2d.render.tensor_api",
    "splat_errors": "gs2d.render.api",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'gs2d' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
