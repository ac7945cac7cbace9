"""What is learned of each training view, exposures and poses, as the training loop meets it."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from gs2d.config.recipe import Recipe
from gs2d.core.camera import Zoom
from gs2d.core.photometry import CameraPhotometry
from gs2d.data.scene import Scene
from gs2d.errors import RecipeError
from gs2d.kernels.reference import finite
from gs2d.render.backends import Backend
from gs2d.training.exposure import Exposures, check_views, exposure_step, uncount
from gs2d.training.photometry import Photometries, check_photometries, photometry_rate, photometry_step
from gs2d.training.point_gains import point_gains
from gs2d.training.poses import Poses, check_poses, pose_rate, pose_step
from gs2d.training.state import TrainState
from gs2d.training.zooms import Zooms, check_zooms, zoom_rate, zoom_step


def start(state: TrainState, recipe: Recipe, scene: Scene, exposures: Tensor | None = None) -> TrainState:
    """Return the state with what the recipe learns of views, at its beginning.

    Raises
    ------
    RecipeError
        The recipe takes exposures [V, 3, 4] that are given, and none are, or of another number of views.
    """
    if recipe.exposure is not None and recipe.exposure.initial == "given":
        count = None if exposures is None else len(exposures)
        if exposures is None or count != len(scene.train):
            raise RecipeError(
                f"exposure.initial=given needs a transform of each of {len(scene.train)} training views, got "
                f"{count or 'none'}; `gs2d blocks` gives them, elsewhere take points or identity"
            )
        state.exposures = Exposures.given(exposures, state.splats.means)
    elif recipe.exposure is not None:
        state.exposures = Exposures.start(len(scene.train), state.splats.means)
        known = point_gains(scene) if recipe.exposure.initial == "points" else None
        if known is not None:
            state.exposures.begin_with(known.gains)
    if recipe.poses is not None:
        state.poses = Poses.start([view.camera for view in scene.train], scene.extent)
    if recipe.intrinsics is not None:
        state.zooms = Zooms.start(scene.train)
    if recipe.photometry is not None:
        state.photometries = Photometries.start(scene.train)
    return state


def check(state: TrainState, recipe: Recipe, views: int) -> None:
    """Raise RunError unless a state has what the recipe learns of so many views, and nothing else."""
    check_views(state.exposures, views if recipe.exposure else 0)
    check_poses(state.poses, views if recipe.poses else 0)
    check_zooms(state.zooms, views if recipe.intrinsics else 0)
    check_photometries(state.photometries, views if recipe.photometry else 0)


def update(
    state: TrainState,
    recipe: Recipe,
    iteration: int,
    index: int,
    gradients: Mapping[str, Tensor],
    backend: Backend,
) -> None:
    """Update what is learned of a view."""
    if state.exposures is not None:
        exposure_step(state.exposures, index, gradients["exposure"], recipe, state.stage, iteration, backend)
    if state.poses is not None and "pose" in gradients and backend.is_whole():
        # The host has waited for the gradient, so it may ask.
        pose_step(state.poses, index, gradients["pose"], recipe, pose_rate(recipe, state.stage, iteration))
    if state.zooms is not None and "zoom" in gradients and backend.is_whole():
        zoom_step(state.zooms, index, gradients["zoom"], recipe, zoom_rate(recipe, state.stage, iteration))
    if state.photometries is not None and "photometry" in gradients and backend.is_whole():
        rate = photometry_rate(recipe, state.stage, iteration)
        photometry_step(state.photometries, index, gradients["photometry"], recipe, rate)


def rollback(state: TrainState, recipe: Recipe, iteration: int, index: int) -> None:
    """Take back what the host has counted of an update that was cancelled on the device."""
    if state.exposures is not None:
        uncount(state.exposures, index, recipe, state.stage, iteration)


def find_nonfinite(state: TrainState) -> str:
    """Return what is not finite, in words; "" if all is."""
    if state.exposures is not None and not finite(state.exposures.offsets):
        return "an exposure"
    if state.zooms is not None and not finite(state.zooms.offsets):
        return "a focal length"
    if state.photometries is not None and not finite(state.photometries.offsets):
        return "the vignetting or the response of a camera"
    return "a pose" if state.poses is not None and not finite(state.poses.offsets) else ""


def scene_now(state: TrainState, scene: Scene) -> Scene:
    """Return the scene with its training cameras where they are now, and what is known of their light.

    Focal lengths are those of a camera: test photographs that share one with training photographs have its new one.
    """
    poses, cameras = state.poses, photometries_now(state, scene)
    scene = scene.with_photometries(cameras) if cameras else scene
    if poses is None:
        return scene
    return scene.with_poses(
        {view.name: poses.pose(index).numpy() for index, view in enumerate(scene.train)}, zooms_now(state, scene)
    )


def photometries_now(state: TrainState, scene: Scene) -> dict[str, CameraPhotometry]:
    """Return what is known of the cameras of views, by their names; empty where nothing is learned of them."""
    found = state.photometries
    if found is None:
        return {}
    of_camera = {view.file_intrinsics(): found.photometry(index) for index, view in enumerate(scene.train)}
    return {view.name: of_camera[view.file_intrinsics()] for view in scene.views if view.file_intrinsics() in of_camera}


def zooms_now(state: TrainState, scene: Scene) -> dict[str, Zoom]:
    """Return what the intrinsics of views have become, by their names; empty where none are learned."""
    zooms = state.zooms
    if zooms is None:
        return {}
    of_camera = {view.file_intrinsics(): zooms.zoom(index) for index, view in enumerate(scene.train)}
    return {view.name: of_camera[view.file_intrinsics()] for view in scene.views if view.file_intrinsics() in of_camera}
