"""The exposures that a run found: its file ``exposure.json``, and pictures in the exposure of a photograph."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from types import MappingProxyType

import numpy as np
import torch
from torch import Tensor

from gs2d.config.recipe import Recipe
from gs2d.core.json_files import read_json, write_json
from gs2d.data import View
from gs2d.errors import DataError, RunError
from gs2d.io.run_dir import EXPOSURE, RunFolder
from gs2d.pipeline.events import Notice, OnEvent
from gs2d.pipeline.prepare.loaded import LoadedRun
from gs2d.render.exposure import expose, fit_exposure
from gs2d.render.photometry import remove_photometry
from gs2d.render.types import RenderOutput
from gs2d.training.learned.appearance import shown
from gs2d.training.learned.quantity import ImagePoints

Transforms = Mapping[str, Tensor]
"""Transform [3, 4] by the name of the training view; empty where a run learns none."""

NONE: Transforms = MappingProxyType({})
ABOUT = (
    "color as photographed = A c + b for the scene's color c (sRGB values in [0, 1]), transform = [A | b]; "
    "the mean over the photographs is the identity; grey: what the scene's (0.5, 0.5, 0.5) becomes"
)
GREY = 0.5


def write_exposures(run: RunFolder, transforms: Transforms, on_event: OnEvent) -> None:
    """Write ``exposure.json`` beside the splats, where there are any, and say how far they differ."""
    if not transforms:
        return
    images = []
    for name, transform in transforms.items():
        grey = GREY * transform[:, :3].sum(dim=1) + transform[:, 3]
        images.append({"name": name, "transform": transform.tolist(), "grey": grey.tolist()})
    write_json(run.file(EXPOSURE), {"format": 1, "about": ABOUT, "photographs": images})
    gains = {entry["name"]: sum(entry["grey"]) / (3 * GREY) for entry in images}
    low, high = min(gains, key=gains.__getitem__), max(gains, key=gains.__getitem__)
    on_event(Notice(f"exposures: {gains[low]:.2f} ({low}) to {gains[high]:.2f} ({high}) times the mean: {EXPOSURE}"))


def read_exposures(run: RunFolder, recipe: Recipe) -> Transforms:
    """Return what :func:`write_exposures` wrote; none where the recipe learns none.

    Raises
    ------
    RunError
        The file is gone or damaged.
    """
    if recipe.exposure is None:
        return NONE
    remedy = f"continue with `gs2d train ... --out {run.path} --resume`, which writes it again"
    try:
        found = read_json(run.file(EXPOSURE))["photographs"]
        transforms = {entry["name"]: torch.tensor(entry["transform"], dtype=torch.float32) for entry in found}
    except (DataError, KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise RunError(
            f"{run.file(EXPOSURE)} must hold the exposures that this run found, got: {error}; {remedy}"
        ) from error
    for name, transform in transforms.items():
        if transform.shape != (3, 4) or not bool(transform.isfinite().all()):
            raise RunError(f"{run.file(EXPOSURE)} must hold 3x4 numbers for {name}, got others; {remedy}")
    return transforms


def photographed(view: View, color: Tensor, transforms: Transforms, background: tuple[float, float, float]) -> Tensor:
    """Return a picture [H, W, 3] rendered from a view as its photograph was taken, as far as that is known.

    In the exposure of the photograph, and with the vignetting and the response of its camera.
    """
    numbers = numbers_of(view, transforms, color)
    return shown(color, numbers, ImagePoints(view.camera, *over(view, color, background))) if numbers else color


def numbers_of(view: View, transforms: Transforms, like: Tensor) -> dict[str, Tensor]:
    """Return what is known of the photograph of a view, by the name of the quantity."""
    exposure = {"exposure": transforms[view.name].to(like)} if view.name in transforms else {}
    if view.photometry is None:
        return exposure
    (a, b, c), reach, shift = view.photometry
    falloff = like.new_tensor([a / reach**2, b / reach**4, c / reach**6])
    return {"vignetting": falloff, **exposure, "response": like.new_tensor([shift])}


def as_scene(view: View, transforms: Transforms) -> np.ndarray:
    """Return the photograph of a view, uint8 [H, W, 3 or 4], in the colours of the scene, as far as that is known."""
    transform = transforms[view.name].numpy() if view.name in transforms else None
    return remove_photometry(view.image(), transform, view.photometry, view.camera)


def exposure_named(name: str, transforms: Transforms) -> Tensor:
    """Return the transform [3, 4] of a training photograph.

    Raises
    ------
    RunError
        None was found, or not of a photograph of this name.
    """
    if not transforms:
        raise RunError(f"the exposure of {name} was asked for, and this run learned none; train with --exposure")
    if name not in transforms:
        near = get_close_matches(name, transforms, n=3) or list(transforms)[:3]
        raise RunError(f"no training photograph {name!r}; there is {', '.join(near)}, ...: {EXPOSURE} lists all")
    return transforms[name]


def exposed(output: RenderOutput, transform: Tensor | None, loaded: LoadedRun) -> Tensor:
    """Return the picture of any view [H, W, 3], in an exposure if one is given.

    Where the photographs have an alpha channel, the background is none of them and stays as it is.
    """
    if transform is None:
        return output.color
    cut_out = loaded.scene.train[0].alpha() is not None
    background = torch.tensor(loaded.settings.background, dtype=output.color.dtype, device=output.color.device)
    cover = (output.alpha, background) if cut_out else ()
    return expose(output.color, transform.to(output.color), *cover)


def matched_by_halves(
    view: View, color: Tensor, target: Tensor, mask: Tensor | None, background: tuple[float, float, float]
) -> Tensor:
    """Return a rendered picture whose colours are matched to the photograph, no pixel by itself.

    The left half gets the transform that fits the right half best (least squares), the right half that of the left. So
    the photograph is looked at, but nothing is scored that was fitted to: not a score of the scene alone.

    Parameters
    ----------
    view : View
    color, target : Tensor [H, W, 3]
        Rendering and photograph, over the background.
    mask : Tensor [H, W] bool or None
        False = ignore this pixel.
    background : three floats
    """
    color, cover = photographed(view, color, NONE, background), over(view, color, background)
    usable = torch.ones_like(color[..., 0], dtype=torch.bool) if mask is None else mask.clone()
    if cover:
        usable &= cover[0] > 0
    left = torch.zeros_like(usable)
    left[:, : color.shape[1] // 2] = True
    to_right = expose(color, fit_exposure(color, target, usable & left, *cover), *cover)
    to_left = expose(color, fit_exposure(color, target, usable & ~left, *cover), *cover)
    return torch.where(left[..., None], to_left, to_right)


def over(view: View, color: Tensor, background: tuple[float, float, float]) -> tuple[Tensor, ...]:
    """Coverage and background for ``expose``, where the view's photograph has an alpha channel."""
    alpha = view.alpha()
    if alpha is None:
        return ()
    return torch.from_numpy(alpha).to(color), torch.tensor(background, dtype=color.dtype, device=color.device)
