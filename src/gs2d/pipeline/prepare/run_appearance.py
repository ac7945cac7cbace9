"""Learned appearance of photographs, such as exposure: its file, and its effect on images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gs2d.config.quantities import QUANTITIES
from gs2d.config.recipe import Recipe
from gs2d.core.json_files import read_json, write_json
from gs2d.data import Scene, View
from gs2d.errors import DataError, RunError
from gs2d.io.run_dir import LEARNED, SPLATS, RunFolder
from gs2d.render.exposure_transform import expose, fit_exposure
from gs2d.training.events import Notice, OnEvent
from gs2d.training.learned.appearance import numbers_of, shown, unshown
from gs2d.training.learned.image_exposure import exposure_gain
from gs2d.training.learned.quantity import ImagePoints

ABOUT = (
    "learned quantities of each view, by name (docs/math.md). exposure [A | b]: colour in the photograph = A c + b "
    "for colour c of the scene, sRGB values in [0, 1]; the mean over the photographs is the identity"
)


def write_appearance(run: RunFolder, scene: Scene, on_event: OnEvent) -> None:
    """Write ``learned.json``, the learned appearance of photographs, and report it."""
    known = {view.name: view.appearance for view in scene.views if view.appearance}
    if not known:
        return
    views = {view: {name: numbers.tolist() for name, numbers in found.items()} for view, found in known.items()}
    write_json(run.file(LEARNED), {"format": 2, "about": ABOUT, "views": views})
    exposures = {view.name: view.appearance["exposure"] for view in scene.train if "exposure" in view.appearance}
    if exposures:
        gains = {name: exposure_gain(transform) for name, transform in exposures.items()}
        low, high = min(gains, key=gains.__getitem__), max(gains, key=gains.__getitem__)
        on_event(Notice(f"exposures: {gains[low]:.2f} ({low}) to {gains[high]:.2f} ({high}) times the mean: {LEARNED}"))


def with_learned_appearance(run: RunFolder, recipe: Recipe, scene: Scene) -> Scene:
    """Return a scene with its learned appearance; unchanged if the run learns none, or is unfinished.

    Raises
    ------
    RunError
        If the file is missing, damaged or of other photographs.
    """
    names = recipe.quantities.keys() - {"poses", "intrinsics"}
    if not names or not (run.file(LEARNED).exists() or run.file(SPLATS).exists()):
        return scene
    remedy = f"continue with `gs2d train ... --out {run.path} --resume`, which writes it again"
    try:
        views = read_json(run.file(LEARNED))["views"]
        found = {view: {name: _numbers(name, values) for name, values in views[view].items()} for view in views}
    except (DataError, LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise RunError(f"{run.file(LEARNED)} does not hold the appearance of this run ({error}); {remedy}") from error
    for view in scene.train:
        missing = (names & set(QUANTITIES.builtin)) - found.get(view.name, {}).keys()
        if missing:
            raise RunError(f"{run.file(LEARNED)} lacks the {min(missing)} of {view.name}; {remedy}")
    return scene.with_appearance(found)


def _numbers(name: str, values: list[float]) -> np.ndarray:
    """Return the numbers of a quantity; raise ValueError for impossible ones."""
    numbers = np.array(values, dtype=np.float64)
    if not np.isfinite(numbers).all() or np.abs(numbers).max(initial=0) > 1e6:
        raise ValueError(f"{name} that is not finite")
    if name in QUANTITIES.builtin and numbers.shape != QUANTITIES.get(name).shape:
        raise ValueError(f"{name} of shape {list(numbers.shape)}")
    return numbers


def photographed(view: View, color: Tensor, background: tuple[float, float, float]) -> Tensor:
    """Return a rendering [H, W, 3] of a view with the appearance of its photograph, if known."""
    if not view.appearance:
        return color
    return shown(color, numbers_of(view, color), ImagePoints(view.camera, *over(view, color, background)))


def as_scene(view: View) -> np.ndarray:
    """Return the photograph of a view, uint8 [H, W, 3 or 4], with its appearance removed, if known."""
    image = view.image()
    if not view.appearance:
        return image
    color = torch.from_numpy(image[..., :3] / 255.0)
    back, result = unshown(color, numbers_of(view, color), ImagePoints(view.camera)), image.copy()
    result[..., :3] = np.rint(255 * np.clip(back.numpy(), 0, 1))
    return result


def matched_by_halves(
    view: View, color: Tensor, target: Tensor, mask: Tensor | None, background: tuple[float, float, float]
) -> Tensor:
    """Return a rendering with its colours matched to the photograph.

    Each half gets the transform that fits the other half best (least squares), so that no pixel is matched to itself.

    Parameters
    ----------
    view : View
    color, target : Tensor [H, W, 3]
        Rendering and photograph, over the background.
    mask : Tensor [H, W] bool or None
        False = ignore this pixel.
    background : three floats
    """
    camera = replace(view, appearance={k: found for k, found in view.appearance.items() if k != "exposure"})
    color, cover = photographed(camera, color, background), over(view, color, background)
    usable = torch.ones_like(color[..., 0], dtype=torch.bool) if mask is None else mask.clone()
    if cover:
        usable &= cover[0] > 0
    left = torch.zeros_like(usable)
    left[:, : color.shape[1] // 2] = True
    to_right = expose(color, fit_exposure(color, target, usable & left, *cover), *cover)
    to_left = expose(color, fit_exposure(color, target, usable & ~left, *cover), *cover)
    return torch.where(left[..., None], to_left, to_right)


def over(view: View, color: Tensor, background: tuple[float, float, float]) -> tuple[Tensor, ...]:
    """Return alpha and background for ``expose``, or () if the photograph of the view has no alpha channel."""
    alpha = view.alpha()
    if alpha is None:
        return ()
    return torch.from_numpy(alpha).to(color), torch.tensor(background, dtype=color.dtype, device=color.device)
