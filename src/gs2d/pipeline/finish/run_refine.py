"""Refine the mesh of a run with its photographs."""

from __future__ import annotations

import numpy as np

from gs2d.core.mesh import Mesh
from gs2d.kernels.library import ready_library
from gs2d.meshing.refine import Refinement, RefineSettings
from gs2d.meshing.texture import ColorSource
from gs2d.meshing.warped_ncc import GreyImage
from gs2d.pipeline.finish.trusted_depth import usable_pixels
from gs2d.pipeline.prepare.loaded import RenderedScene
from gs2d.training.events import OnEvent, Phase, Step

GREY = (0.299, 0.587, 0.114)  # ITU-R BT.601
LEAST_VIEWS = 2


def refined(
    loaded: RenderedScene,
    mesh: Mesh,
    on_event: OnEvent,
    settings: RefineSettings = RefineSettings(),  # noqa: B008 (frozen)
) -> Mesh:
    """Move the vertices of a mesh until the training views agree; ``mesh`` is not changed.

    Without two views or a surface it is returned as it is.
    """
    views = loaded.scene.train
    if len(views) < LEAST_VIEWS or not len(mesh.faces):
        return mesh

    def read(index: int, factor: int) -> GreyImage:
        view = views[index]
        small = ColorSource(view.camera, view.image(), usable_pixels(view, loaded)).shrunk(factor)
        grey = small.image[..., :3] @ np.asarray(GREY, np.float32) / np.float32(255)
        return GreyImage(small.camera, np.ascontiguousarray(grey, np.float32), small.valid)

    refinement = Refinement(mesh, [view.camera for view in views], read, settings, ready_library())
    on_event(Phase("refining the mesh", refinement.work))
    return refinement.run(lambda done: on_event(Step(done)))
