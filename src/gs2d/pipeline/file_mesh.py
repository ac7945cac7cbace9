"""Mesh the splats of a file, of gs2d or another program, without a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gs2d.config.protocols import get_protocol
from gs2d.core.atomic_files import check_writable
from gs2d.core.splats import Splats
from gs2d.core.transforms import camera_extent
from gs2d.data import Scene, detect_format, load_scene
from gs2d.data.scene import View
from gs2d.errors import DataError, RunError
from gs2d.io.formats.splat_formats import read_surfels
from gs2d.pipeline.finish.run_mesh import check_mesh_options, checked_mesh_file, extract_mesh
from gs2d.pipeline.finish.run_subject import centers_inside, meshed_subject
from gs2d.pipeline.finish.viewpoints import choose_viewpoints
from gs2d.pipeline.look.page import settings_without_run
from gs2d.pipeline.prepare.limits import use_threads
from gs2d.pipeline.prepare.loaded import Trained
from gs2d.pipeline.prepare.open_capture import choose_backend, choose_protocol
from gs2d.pipeline.prepare.options import MeshOptions
from gs2d.training.events import Notice, OnEvent, Phase, ignore
from gs2d.training.objective import raster_settings

LONGEST = 1600  # px: photographs of a capture are shrunk to it, as in training at full quality
FEWEST = 2  # views: one does not measure depth


def mesh_file(
    splats_file: Path,
    options: MeshOptions = MeshOptions(),  # noqa: B008 (frozen)
    on_event: OnEvent = ignore,
    *,
    out: Path | None,
    cameras: Path | None = None,
    threads: int | None = None,
) -> dict[str, Any]:
    """Mesh the splats of a file of any format; return the mesh file ``out``, counts and limits.

    3D Gaussians become disks across their shortest axes. ``cameras`` is a capture in the frame of the splats, whose
    training views are rendered; None: ``choose_viewpoints``. Raises RunError, DataError or ProtocolError if a file, the
    capture or an option is invalid.
    """
    if out is None:
        raise RunError("--splats needs --out FILE, the mesh to write")
    check_mesh_options(options)
    out = checked_mesh_file(Path(splats_file).parent, Path(out), options)
    check_writable(out)
    use_threads(threads)
    splats, kind = read_surfels(splats_file, lambda text: on_event(Notice(text)))
    on_event(Notice(f"{len(splats):,} splats: {kind}", detail=True))
    if options.bbox is not None:
        centers_inside(splats, options.bbox, "--bbox")
    if cameras is None:
        trained, box = _around(splats, on_event)
        options = replace(options, refine=False)  # there are no photographs
    else:
        trained, box = _photographed(splats, Path(cameras), on_event), None
    near = None if box is None else box.ravel().tolist()
    subject = meshed_subject(None, trained, options, on_event, box=near)
    return extract_mesh(trained, options, out, on_event, subject=subject)


def _photographed(splats: Splats, capture: Path, on_event: OnEvent) -> Trained:
    """Return the splats with the views of a capture."""
    kind = detect_format(capture)
    protocol, backend = choose_protocol("auto", capture, kind, on_event), choose_backend("auto", on_event)
    scene = load_scene(capture, format=kind, test_every=0)
    longest = max((max(view.camera.width, view.camera.height) for view in scene.train), default=1)
    if longest > LONGEST:
        scene = load_scene(capture, format=kind, test_every=0, downscale=-(-longest // LONGEST))
    if len(scene.train) < FEWEST:
        raise DataError(f"--cameras must be a capture with {FEWEST} or more views, got {len(scene.train)} in {capture}")
    settings = raster_settings(protocol, scene.extent, splats.sh_degree)
    return Trained(splats.to(backend.device), scene, protocol, settings, backend)


def _around(splats: Splats, on_event: OnEvent) -> tuple[Trained, np.ndarray | None]:
    """Return the splats with views of chosen cameras, and the box of the subject [2, 3], if there is one."""
    on_event(Phase("choosing viewpoints", 0))
    protocol, backend = get_protocol("generic"), choose_backend("auto", on_event)
    splats = splats.to(backend.device)
    settings = settings_without_run(splats).for_depths(protocol.fused_depth)
    chosen = choose_viewpoints(splats, settings, backend)
    on_event(Notice(f"{len(chosen.cameras)} viewpoints {chosen.why}; --cameras CAPTURE sets them"))
    centers = np.stack([camera.center for camera in chosen.cameras])
    image = np.zeros((chosen.cameras[0].height, chosen.cameras[0].width, 3), np.uint8)  # of all views
    scene = Scene(
        name="splats",
        format="",
        train=tuple(View.from_arrays(f"view{n:03d}", camera, image) for n, camera in enumerate(chosen.cameras)),
        test=(),
        points=None,
        extent=camera_extent(chosen.cameras),
        bounds=np.stack([centers.min(axis=0), centers.max(axis=0)]),
    )
    return Trained(splats, scene, protocol, settings, backend), chosen.box
