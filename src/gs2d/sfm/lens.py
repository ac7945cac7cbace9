"""The lens model of a camera: ``START`` while images are placed, then ``RICH`` if the camera has enough images.

Runs in the worker, on pycolmap objects. Both models have one focal length: if all cameras are level, a vertical stretch
of the images and one of the scene are indistinguishable. The choice was measured on eleven captures
(docs/notebook/sfm.md).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

# Panoramas (``data.exif.Taken.panorama``) are placed with COLMAP's spherical camera, one pose each; training cuts them
# into faces (``data.faces``).
PANORAMA = "EQUIRECTANGULAR"
FINER = 2  # times feature_size: a panorama covers four times the field of view of a photograph
START, RICH = "SIMPLE_RADIAL", "RADIAL"
ENOUGH = 8  # images of one camera, for a second coefficient of distortion
BEND = 0.5  # largest plausible displacement of a corner, relative to its radius; action cameras reach 0.4
FARTHEST = 4.0  # px; COLMAP's limit: a larger error is a wrong match
NARROWEST = 1.5  # degrees between the rays to a point; COLMAP's limit
ITERATIONS = 30  # of the bundle adjustment: it starts close to the solution


def with_rich_lenses(pycolmap: Any, piece: Any, *, threads: int) -> Any:
    """Return a model whose cameras with ``ENOUGH`` images have the lens ``RICH``, adjusted to it.

    The model itself is returned if there are none, or if a lens becomes implausible. ``piece``: placed with ``START``;
    cameras with other lenses keep them.
    """
    images = Counter(image.camera_id for image in piece.images.values() if image.has_pose)
    rich = [n for n, camera in piece.cameras.items() if camera.model.name == START and images[n] >= ENOUGH]
    if not rich:
        return piece
    copy = pycolmap.Reconstruction(piece)
    for number in rich:
        camera = copy.camera(number)
        params = [*camera.params, 0.0]
        camera.model = getattr(pycolmap.CameraModelId, RICH)
        camera.params = params
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.num_threads = threads
    options.ceres.solver_options.max_num_iterations = ITERATIONS
    options.ceres.solver_options.function_tolerance = 1e-6
    pycolmap.bundle_adjustment(copy, options)
    if not all(is_plausible(copy.camera(n).params, copy.camera(n).width, copy.camera(n).height) for n in rich):
        return piece
    pycolmap.ObservationManager(copy).filter_all_points3D(FARTHEST, NARROWEST)
    copy.update_point_3d_errors()
    return copy


def is_plausible(params: Sequence[float], width: int, height: int) -> bool:
    """Whether a lens ``RICH`` (f, cx, cy, k1, k2) distorts moderately, and monotonically up to the farthest corner."""
    f, cx, cy, k1, k2 = map(float, params)
    if not (np.isfinite([f, cx, cy, k1, k2]).all() and f > 0):
        return False
    r = np.linspace(0, np.hypot(max(cx, width - cx), max(cy, height - cy)) / f, 50)
    moved = r * (1 + k1 * r**2 + k2 * r**4)
    return bool((np.diff(moved) > 0).all() and abs(moved[-1] / r[-1] - 1) <= BEND)
