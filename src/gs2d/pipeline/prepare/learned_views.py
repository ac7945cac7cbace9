"""Learned cameras and appearance of photographs: ``poses.json``, ``learned.json``, and their effect on images."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gs2d.config.quantities import QUANTITIES
from gs2d.config.recipe import Recipe
from gs2d.core.camera import Camera, Zoom
from gs2d.core.json_files import read_json, write_json
from gs2d.core.transforms import focus_point
from gs2d.data import Scene, View
from gs2d.data.image_files import read_image, read_mask, write_image
from gs2d.errors import DataError, RunError, ShapeError
from gs2d.io.run_dir import LEARNED, POSES, SHINE, SPLATS, TRANSIENTS, RunFolder
from gs2d.training.events import Notice, OnEvent
from gs2d.training.learned.learned_table import numbers_of, shown, unshown
from gs2d.training.learned.quantity import ImagePoints

APPEARANCE = (
    "learned quantities of each view, by name (docs/math.md). exposure [A | b]: colour in the photograph = A c + b "
    "for colour c of the scene, sRGB values in [0, 1]; the mean over the photographs is the identity"
)
CAMERAS = (
    "refined cameras of the training photographs and original cameras of the test photographs, in the layout of "
    "nerfstudio's transforms.json (OpenGL camera to world), for undistorted images of size w x h; T_cam_world: the "
    "same for OpenCV, world to camera; moved: from the original pose, shift as a fraction of the extent; zoom: factor "
    "of the original focal lengths, then shift of the principal point to the right and down (focal lengths)"
)
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
GRID = 5  # points along each side of an image, by which motion is measured


# -- appearance --------------------------------------------------------------------------------------------------------
def write_appearance(run: RunFolder, scene: Scene, on_event: OnEvent) -> None:
    """Write ``learned.json``, the learned appearance of photographs, and report it."""
    appearances = {view.name: view.appearance for view in scene.views if view.appearance}
    if not appearances:
        return
    views = {view: {name: numbers.tolist() for name, numbers in values.items()} for view, values in appearances.items()}
    write_json(run.file(LEARNED), {"format": 2, "about": APPEARANCE, "views": views})
    for name in sorted({name for numbers in views.values() for name in numbers if name in QUANTITIES}):
        report = QUANTITIES.get(name).report(name, {"views": views, "frames": []})
        if report is not None:
            on_event(Notice(f"{name}: {report.text.partition('. ')[0].rstrip('.')}: {LEARNED}"))


def with_learned_appearance(run: RunFolder, recipe: Recipe, scene: Scene) -> Scene:
    """Return a scene with its learned appearance; unchanged if the run learns none, or is unfinished.

    Raises RunError if the file is missing, damaged or of other photographs.
    """
    installed = (name for name in recipe.quantities if name in QUANTITIES)
    names = {name for name in installed if QUANTITIES.get(name).changes_color}
    if not run.file(LEARNED).exists() and not (names and run.file(SPLATS).exists()):
        return scene
    remedy = f"continue with `gs2d train ... --out {run.path} --resume`, which writes it again"
    try:
        views = read_json(run.file(LEARNED))["views"]
        appearances = {view: {name: _numbers(name, values) for name, values in views[view].items()} for view in views}
    except (DataError, LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise RunError(f"{run.file(LEARNED)} does not hold the appearance of this run ({error}); {remedy}") from error
    for view in scene.train:
        missing = names - appearances.get(view.name, {}).keys()
        if missing:
            raise RunError(f"{run.file(LEARNED)} lacks the {min(missing)} of {view.name}; {remedy}")
    return scene.with_appearance(appearances)


def _numbers(name: str, values: list[float]) -> np.ndarray:
    """Return the numbers of a quantity; raise ValueError for impossible ones."""
    numbers = np.array(values, dtype=np.float64)
    if not np.isfinite(numbers).all() or np.abs(numbers).max(initial=0) > 1e6:
        raise ValueError(f"{name} that is not finite")
    if name in QUANTITIES.builtin and numbers.shape != QUANTITIES.get(name).shape:
        raise ValueError(f"{name} of shape {list(numbers.shape)}")
    return numbers


def photographed(view: View, color: Tensor, background: tuple[float, float, float]) -> Tensor:
    """Return a rendering [H, W, 3] of a view with the appearance of its photograph, if learned."""
    if not view.appearance:
        return color
    return shown(color, numbers_of(view, color), ImagePoints(view.camera, *over(view, color, background)))


def as_scene(view: View) -> np.ndarray:
    """Return the photograph of a view, uint8 [H, W, 3 or 4], with its learned appearance removed."""
    image = view.image()
    if not view.appearance:
        return image
    color = torch.from_numpy(image[..., :3] / 255.0)
    back, result = unshown(color, numbers_of(view, color), ImagePoints(view.camera)), image.copy()
    result[..., :3] = np.rint(255 * np.clip(back.numpy(), 0, 1))
    return result


def over(view: View, color: Tensor, background: tuple[float, float, float]) -> tuple[Tensor, ...]:
    """Return alpha and background for ``expose``, or () if the photograph of the view has no alpha channel."""
    alpha = view.alpha()
    if alpha is None:
        return ()
    return torch.from_numpy(alpha).to(color), torch.tensor(background, dtype=color.dtype, device=color.device)


# -- maps of photographs -----------------------------------------------------------------------------------------------
def write_maps(run: RunFolder, scene: Scene, on_event: OnEvent) -> None:
    """Write transient masks and shine maps of the photographs, with the file names of COLMAP's masks; report masks."""
    for name in (TRANSIENTS, SHINE):
        shutil.rmtree(run.file(name), ignore_errors=True)
    for view in scene.train:
        for name, image in ((TRANSIENTS, view.transient), (SHINE, view.shine)):
            if image is not None:
                path = run.file(name) / f"{view.name}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                write_image(path, ~image if name == TRANSIENTS else image)
    shares = [view.transient for view in scene.train if view.transient is not None]
    if not shares:
        return
    share = sum(float(cells.mean()) for cells in shares) / len(scene.train)
    on_event(
        Notice(
            f"{100 * share:.1f} % of the pixels show what only one photograph shows, such as passers-by, in "
            f"{len(shares)} of {len(scene.train)} photographs; they do not count: {TRANSIENTS}/ "
            "(--robust off trains on all pixels)"
        )
    )


def with_maps(run: RunFolder, scene: Scene) -> Scene:
    """Return a scene with the maps of a run: its masks leave out what training left out.

    Raises DataError if a map is damaged.
    """

    def mapped(view: View) -> View:
        transient, shine = (run.file(name) / f"{view.name}.png" for name in (TRANSIENTS, SHINE))
        view = view.with_cells(transient=~read_mask(transient)) if transient.exists() else view
        return view.with_cells(shine=read_image(shine)[..., 0]) if shine.exists() else view

    if not any(run.file(name).is_dir() for name in (TRANSIENTS, SHINE)):
        return scene
    return replace(scene, train=tuple(map(mapped, scene.train)))


# -- cameras -----------------------------------------------------------------------------------------------------------
def write_poses(run: RunFolder, recipe: Recipe, scene: Scene, refined: Scene, on_event: OnEvent) -> None:
    """Write ``poses.json`` if the recipe or a quantity of a package moves training cameras, and report how far."""
    if not (recipe.moves_cameras or _differ(scene, refined)):
        return
    focus = focus_point([view.camera for view in scene.train])
    frames, far = [], []
    for original, view in zip(scene.train, refined.train, strict=True):
        far.append(camera_motion(original.camera, view.camera, focus, scene.extent))
        frames.append({**_frame(view, scene.root), "split": "train", "moved": far[-1]})
    frames += [{**_frame(view, scene.root), "split": "test"} for view in refined.test]
    write_json(run.file(POSES), {"format": 1, "about": CAMERAS, "frames": frames})
    mean = {name: float(np.mean([entry[name] for entry in far])) for name in far[0]}
    if not any(mean.values()):
        return
    on_event(
        Notice(
            f"cameras moved by {mean['pixels']:.2f} px on average ({mean['degrees']:.3f} degrees, "
            f"{100 * mean['shift']:.3f} % of the extent): {POSES}"
        )
    )
    zooms = [view.zoom for view in refined.train if view.zoom is not None]
    if zooms:
        scales = sorted({zoom.scale for zoom in zooms})
        several = f" to {scales[-1]:.4f} ({len(scales)} cameras)" if len(scales) > 1 else ""
        moved = max(max(abs(zoom.right), abs(zoom.down)) for zoom in zooms)
        also = f", principal points moved by up to {moved:.4f} focal lengths" if moved else ""
        on_event(Notice(f"refined focal lengths are {scales[0]:.4f}{several} times those of the capture{also}"))


def _differ(scene: Scene, refined: Scene) -> bool:
    """Return whether a training view has another pose or zoom."""
    return any(
        old.zoom != new.zoom or not np.array_equal(old.camera.T_cam_world, new.camera.T_cam_world)
        for old, new in zip(scene.train, refined.train, strict=True)
    )


def _frame(view: View, root: Path | None) -> dict[str, Any]:
    camera, file = view.camera, view.name
    if view.path is not None:
        inside = root is not None and view.path.is_relative_to(root)
        file = view.path.relative_to(root).as_posix() if inside and root is not None else str(view.path)
    return {
        "file_path": file,
        "name": view.name,
        "transform_matrix": (np.linalg.inv(camera.T_cam_world) @ _OPENGL).tolist(),
        "T_cam_world": camera.T_cam_world.tolist(),
        **{"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy},
        **{"cx": camera.cx, "cy": camera.cy},
        **({} if view.zoom is None else {"zoom": list(view.zoom)}),
    }


def camera_motion(original: Camera, now: Camera, focus: np.ndarray, extent: float) -> dict[str, float]:
    """Measure a camera's motion: degrees, shift of the centre in extents, and pixels (rms over a grid of the image).

    Pixels are measured at the distance of ``focus`` [3], the point that all cameras look at, or a tenth of the extent.
    """
    turn = now.rotation @ original.rotation.T
    sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    depth = max(float((focus - original.center) @ original.forward), 0.1 * extent)
    columns, rows = np.meshgrid(*((np.arange(GRID) + 0.5) / GRID * size for size in (original.width, original.height)))
    x, y = (columns - original.cx) / original.fx, (rows - original.cy) / original.fy
    rays = np.stack([x, y, np.ones_like(rows)], axis=-1)
    points = depth * rays.reshape(-1, 3) @ original.rotation + original.center
    shift = now.project(points)[0] - original.project(points)[0]
    return {
        "degrees": float(np.degrees(np.arctan2(sine, (np.trace(turn) - 1) / 2))),
        "shift": float(np.linalg.norm(now.center - original.center) / extent),
        "pixels": float(np.sqrt((shift**2).sum(axis=1).mean())),
    }


def with_refined_poses(run: RunFolder, recipe: Recipe, scene: Scene) -> Scene:
    """Return a scene with the cameras of ``poses.json``; unchanged if the run moves none, or is unfinished.

    Raises RunError if the file is missing, damaged or of other photographs.
    """
    if not run.file(POSES).exists() and not (recipe.moves_cameras and run.file(SPLATS).exists()):
        return scene
    remedy = f"continue with `gs2d train ... --out {run.path} --resume`, which writes it again"
    try:
        every = read_json(run.file(POSES))["frames"]
        frames = [entry for entry in every if entry["split"] == "train"]
        poses = {entry["name"]: np.array(entry["T_cam_world"], dtype=np.float64) for entry in frames}
        zooms = {entry["name"]: Zoom(*map(float, entry["zoom"])) for entry in every if "zoom" in entry}
        if not all(np.isfinite(zoom).all() for zoom in zooms.values()):
            raise ValueError("a zoom that is not finite")
        refined = scene.with_poses(poses, zooms)
    except (DataError, ShapeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise RunError(f"{run.file(POSES)} does not hold the cameras of this run ({error}); {remedy}") from error
    for view in scene.train:
        if view.name not in poses or (recipe.learns("intrinsics") and view.name not in zooms):
            raise RunError(f"{run.file(POSES)} lacks pose or zoom of {view.name}; {remedy}")
    return refined
