"""Learned quantities of views without a photograph, predicted from the photographs; test photographs are not used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch

from gs2d.config.quantities import QUANTITIES
from gs2d.data.scene import Scene, View
from gs2d.pipeline.prepare.loaded import Trained

METERED = 256  # px, longer side of the rendering that is metered; smaller ones widen thin splats
LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601


def brightness(trained: Trained, view: View) -> float:
    """Return the brightness of a view: the mean of its rendering as the scene is, without learned quantities."""
    camera = view.camera
    small = METERED / max(camera.width, camera.height)
    if small < 1:
        camera = camera.resized(max(1, round(small * camera.width)), max(1, round(small * camera.height)))
    color = trained.render(camera).color
    return float((color.clamp_min(0).mean(dim=(0, 1)).double().cpu() * torch.tensor(LUMA).double()).sum())


def predicted(trained: Trained) -> Trained:
    """Return the result of training with predicted quantities of test views (:func:`with_predicted`)."""
    return replace(trained, scene=with_predicted(trained.scene, partial(brightness, trained)))


def with_predicted(scene: Scene, brightness: Callable[[View], float] | None = None) -> Scene:
    """Return a scene with predicted quantities of test views, by those of training views and the brightness of views.

    See :meth:`gs2d.training.learned.quantity.LearnedQuantity.predicted`.
    """
    for name in sorted({name for view in scene.train for name in view.appearance if name in QUANTITIES}):
        predicted = QUANTITIES.get(name).predicted(scene, brightness)
        scene = scene.with_appearance({view: {name: numbers} for view, numbers in predicted.items()})
    return scene
