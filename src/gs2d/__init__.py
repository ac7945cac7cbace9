"""gs2d: posed photographs to a surface mesh and a scene of 2D Gaussian splats (2DGS and 2DGS-R).

The names below are imported on first use (PEP 562), so that ``import gs2d.config.recipe`` does not load torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gs2d.cli.commands import register_command
    from gs2d.config.actions import register_action
    from gs2d.config.densify import register_densifier
    from gs2d.config.loss_registry import register_loss
    from gs2d.config.presets import get_recipe, list_recipes, register_recipe
    from gs2d.config.protocols import Protocol
    from gs2d.config.quantities import Quantity, register_quantity
    from gs2d.config.recipe import LossTerm, Recipe, Stage
    from gs2d.core.camera import Camera, look_at
    from gs2d.core.mesh import Mesh
    from gs2d.core.sh import rgb_to_sh0
    from gs2d.core.splats import Splats
    from gs2d.core.transforms import perturb_pose
    from gs2d.data.camera_models import register_camera_model
    from gs2d.data.load import load_scene
    from gs2d.data.readers.capture_readers import register_reader
    from gs2d.data.scene import Scene
    from gs2d.errors import Gs2dError
    from gs2d.evaluation.evaluators import register_evaluator
    from gs2d.io.formats.splat_formats import read_splats, register_format, register_splat_reader, write_splats
    from gs2d.io.meshes import write_mesh
    from gs2d.losses.base import Loss, LossView, compute_losses
    from gs2d.losses.formulas import normals_from_depth
    from gs2d.meshing.mesh_methods import register_mesh_method
    from gs2d.pipeline.in_memory import Trained, evaluate, extract_mesh, train
    from gs2d.pipeline.prepare.options import MeshOptions, Training, TrainOptions
    from gs2d.render.api import first_contributors, rasterize, splat_errors, splat_sums
    from gs2d.render.backends import backend_report, get_backend, register_backend
    from gs2d.render.tensor_api import CameraTensors, SplatTensors, rasterize_2dgs
    from gs2d.render.types import Contributors, RasterSettings, RenderOutput
    from gs2d.report.sections.section_registry import register_section
    from gs2d.training.learned.quantity import LearnedQuantity
    from gs2d.training.trainer import Trainer, TrainerOptions

__version__ = "0.2.0"  # the one place: pyproject.toml reads it from here

__all__ = [
    "Camera",
    "CameraTensors",
    "Contributors",
    "Gs2dError",
    "LearnedQuantity",
    "Loss",
    "LossTerm",
    "LossView",
    "Mesh",
    "MeshOptions",
    "Protocol",
    "Quantity",
    "RasterSettings",
    "Recipe",
    "RenderOutput",
    "Scene",
    "SplatTensors",
    "Splats",
    "Stage",
    "TrainOptions",
    "Trained",
    "Trainer",
    "TrainerOptions",
    "Training",
    "__version__",
    "backend_report",
    "compute_losses",
    "evaluate",
    "extract_mesh",
    "first_contributors",
    "get_backend",
    "get_recipe",
    "list_recipes",
    "load_scene",
    "look_at",
    "normals_from_depth",
    "perturb_pose",
    "rasterize",
    "rasterize_2dgs",
    "read_splats",
    "register_action",
    "register_backend",
    "register_camera_model",
    "register_command",
    "register_densifier",
    "register_evaluator",
    "register_format",
    "register_loss",
    "register_mesh_method",
    "register_quantity",
    "register_reader",
    "register_recipe",
    "register_section",
    "register_splat_reader",
    "rgb_to_sh0",
    "splat_errors",
    "splat_sums",
    "train",
    "write_mesh",
    "write_splats",
]

_HOME = {
    "Camera": "gs2d.core.camera",
    "CameraTensors": "gs2d.render.tensor_api",
    "Contributors": "gs2d.render.types",
    "Gs2dError": "gs2d.errors",
    "Loss": "gs2d.losses.base",
    "LearnedQuantity": "gs2d.training.learned.quantity",
    "LossTerm": "gs2d.config.recipe",
    "LossView": "gs2d.losses.base",
    "Mesh": "gs2d.core.mesh",
    "MeshOptions": "gs2d.pipeline.prepare.options",
    "Protocol": "gs2d.config.protocols",
    "Quantity": "gs2d.config.quantities",
    "RasterSettings": "gs2d.render.types",
    "Recipe": "gs2d.config.recipe",
    "RenderOutput": "gs2d.render.types",
    "Scene": "gs2d.data.scene",
    "SplatTensors": "gs2d.render.tensor_api",
    "Splats": "gs2d.core.splats",
    "Stage": "gs2d.config.recipe",
    "TrainOptions": "gs2d.pipeline.prepare.options",
    "Trained": "gs2d.pipeline.in_memory",
    "Training": "gs2d.pipeline.prepare.options",
    "Trainer": "gs2d.training.trainer",
    "TrainerOptions": "gs2d.training.trainer",
    "backend_report": "gs2d.render.backends",
    "compute_losses": "gs2d.losses.base",
    "evaluate": "gs2d.pipeline.in_memory",
    "extract_mesh": "gs2d.pipeline.in_memory",
    "first_contributors": "gs2d.render.api",
    "get_backend": "gs2d.render.backends",
    "get_recipe": "gs2d.config.presets",
    "list_recipes": "gs2d.config.presets",
    "load_scene": "gs2d.data.load",
    "look_at": "gs2d.core.camera",
    "normals_from_depth": "gs2d.losses.formulas",
    "perturb_pose": "gs2d.core.transforms",
    "rasterize": "gs2d.render.api",
    "rasterize_2dgs": "gs2d.render.tensor_api",
    "read_splats": "gs2d.io.formats.splat_formats",
    "register_action": "gs2d.config.actions",
    "register_backend": "gs2d.render.backends",
    "register_camera_model": "gs2d.data.camera_models",
    "register_command": "gs2d.cli.commands",
    "register_densifier": "gs2d.config.densify",
    "register_evaluator": "gs2d.evaluation.evaluators",
    "register_format": "gs2d.io.formats.splat_formats",
    "register_mesh_method": "gs2d.meshing.mesh_methods",
    "register_loss": "gs2d.config.loss_registry",
    "register_quantity": "gs2d.config.quantities",
    "register_reader": "gs2d.data.readers.capture_readers",
    "register_recipe": "gs2d.config.presets",
    "register_section": "gs2d.report.sections.section_registry",
    "register_splat_reader": "gs2d.io.formats.splat_formats",
    "rgb_to_sh0": "gs2d.core.sh",
    "splat_errors": "gs2d.render.api",
    "splat_sums": "gs2d.render.api",
    "train": "gs2d.pipeline.in_memory",
    "write_mesh": "gs2d.io.meshes",
    "write_splats": "gs2d.io.formats.splat_formats",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'gs2d' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
