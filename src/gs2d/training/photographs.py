"""Whole photographs in iterations instead of their pinhole faces, on backends that render the rays of a lens (rule 25).

An iteration then compares the pixels of a wide photograph as they are; those of faces are interpolated, and there are
more of them. The start, the removal of floaters, scores and mesh use the faces.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from gs2d.config.protocols import Protocol
from gs2d.config.recipe import Recipe
from gs2d.core.image_arrays import at_cells
from gs2d.data.scene import View
from gs2d.data.undistort import Intrinsics
from gs2d.render.backends import Backend
from gs2d.render.rays import ray_map


def needs_faces(recipe: Recipe, protocol: Protocol, backend: Backend) -> str:
    """Return why iterations cannot use whole photographs; "" if they can."""
    if not backend.takes_rays:
        return f"backend {backend.name} renders pinhole images only"
    if protocol.near_plane_policy != "draw":
        return f"protocol {protocol.name} does not draw splats that cross the camera plane"
    if learned := [name for name in recipe.quantities if name != "exposure"]:
        return f"{' and '.join(learned)} is learned for each face"
    return "priors belong to faces" if recipe.depth_prior or recipe.normal_prior else ""


class TrainedViews:
    """The ``views`` that iterations compare: those given, with whole photographs instead of faces if ``whole``.

    ``masks``: whether training uses masks; pixels that are masked in all photographs of a lens get no ray. ``like``: a
    tensor of the type of the splats.
    """

    def __init__(self, views: Sequence[View], *, whole: bool, masks: bool, like: Tensor) -> None:
        self._faces = views
        groups: dict[View, list[int]] = {}  # rows of the faces of each view
        for row, view in enumerate(views):
            groups.setdefault(view.whole if whole and view.whole else view, []).append(row)
        self._rows = list(groups.values())
        photographs = groups.keys() - set(views)
        shown: dict[Intrinsics, np.ndarray | np.bool_] = {}
        for view in photographs:
            usable = view.usable(masks=masks)
            shown[_lens(view)] = np.logical_or(usable is None or usable, shown.get(_lens(view), False))
        rays = {k: torch.from_numpy(k.rays() * np.atleast_3d(pixels)).to(like) for k, pixels in shown.items()}
        maps = {k: ray_map(directions) for k, directions in rays.items()}
        self.views = tuple(_placed(view, [views[row] for row in rows], maps) for view, rows in groups.items())

    def cells(self, maps: Tensor, index: int) -> Tensor:
        """Return the cells [S, S] of view ``index`` from maps [V, S, S] of the given ones."""
        camera = self.views[index].camera
        if camera.rays is None:
            return maps[self._rows[index][0]]
        side = maps.shape[1]
        rays = at_cells(camera.rays[..., :3].numpy(), side).reshape(-1, 3)
        points = camera.center + rays @ camera.rotation
        cells = maps.new_zeros(len(points))
        for row in self._rows[index]:
            face = self._faces[row].camera
            pixels, z = face.project(points)
            at = np.floor(pixels / (face.width, face.height) * side)
            inside = (z > 0) & (at >= 0).all(axis=1) & (at < side).all(axis=1)
            column, line = torch.from_numpy(at[inside].astype(np.int64)).unbind(dim=1)
            cells[torch.from_numpy(inside)] = maps[row][line, column]
        return cells.reshape(side, side)


def _lens(view: View) -> Intrinsics:
    """Return the intrinsics of a whole photograph at its training size."""
    c = view.camera
    return replace(view.file_intrinsics(), width=c.width, height=c.height, fx=c.fx, fy=c.fy, cx=c.cx, cy=c.cy)


def _placed(view: View, faces: Sequence[View], maps: Mapping[Intrinsics, Tensor]) -> View:
    """Return a photograph with its rays, at the mean pose of its faces, whose cameras may have been adjusted."""
    if view is faces[0]:
        return view
    turns = [np.rint(face.camera.rotation @ view.camera.rotation.T) for face in faces]  # faces are those of a cube
    rotations = [turn.T @ face.camera.rotation for turn, face in zip(turns, faces, strict=True)]
    T = np.eye(4)
    T[:3, :3] = Rotation.from_matrix(np.stack(rotations)).mean().as_matrix()
    T[:3, 3] = -T[:3, :3] @ np.mean([face.camera.center for face in faces], axis=0)
    camera = replace(view.camera, T_cam_world=T, rays=maps[_lens(view)])
    return replace(view, camera=camera, appearance=faces[0].appearance)
