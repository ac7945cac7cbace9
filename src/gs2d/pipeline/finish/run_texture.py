"""Texture the mesh of a run from its photographs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from gs2d.core.atomic_files import check_writable
from gs2d.core.memory import trim
from gs2d.core.mesh import Mesh
from gs2d.core.transforms import up_direction
from gs2d.data import View
from gs2d.errors import ProtocolError, RunError
from gs2d.io.meshes import read_mesh, write_mesh, written_files
from gs2d.io.run_dir import MESH, TEXTURED, RunFolder
from gs2d.meshing.texture import (
    MAX_SIZE,
    MIN_SIZE,
    Baked,
    ColorSource,
    bake,
    required,
    simplified,
    texture_size,
    unwrap,
)
from gs2d.pipeline.finish.run_mesh import check_mesh_options, fused, mesh_run
from gs2d.pipeline.finish.run_report import show_again
from gs2d.pipeline.finish.run_subject import meshed_subject
from gs2d.pipeline.finish.trusted_depth import usable_pixels
from gs2d.pipeline.prepare.learned_views import as_scene
from gs2d.pipeline.prepare.loaded import Trained, open_finished, read_resolved, spare_photographs
from gs2d.pipeline.prepare.open_capture import read_scene
from gs2d.pipeline.prepare.options import MeshOptions, TextureOptions
from gs2d.training.events import Notice, OnEvent, Phase, counted, ignore

PACKAGE = "xatlas"  # of the extra `texture`
PASSES = ("colouring the texture", "comparing the colours")


def texture_run(
    path: Path,
    options: TextureOptions = TextureOptions(),  # noqa: B008 (frozen)
    mesh_options: MeshOptions = MeshOptions(),  # noqa: B008 (frozen)
    on_event: OnEvent = ignore,
    *,
    out: Path | None = None,
    threads: int | None = None,
) -> dict[str, Any]:
    """Write the textured mesh of a finished run; return its files and counts.

    The mesh is the run's ``mesh.ply``. If that is missing, or ``mesh_options`` are set, it is extracted again, and
    replaces ``mesh.ply`` if ``out`` is None.
    """
    check_texture_options(options)
    check_mesh_options(mesh_options)
    required(PACKAGE)  # before minutes are spent
    path = Path(path)
    target = path / TEXTURED if out is None else Path(out)
    files = written_files(target)
    if out is not None:
        if not target.parent.is_dir():
            raise RunError(f"--out {out} must be in an existing folder; create {target.parent} first")
        for file in files:
            check_writable(file)
    elif mesh_options != MeshOptions() or not (path / MESH).exists():
        mesh_run(path, mesh_options, on_event, threads=threads)
        mesh_options = MeshOptions()
    run, trained = open_finished(path, threads, on_event)
    spare_photographs(files, "--out", trained.scene)
    mesh = _mesh(run, trained, mesh_options, on_event)
    baked = textured_mesh(trained, mesh, options, on_event, downscale=read_resolved(run).downscale)
    write_mesh(target, baked.mesh, up=up_direction([view.camera for view in trained.scene.train]))
    if target.resolve() == run.file(TEXTURED).resolve():
        show_again(run, on_event, trained)
    return {
        "files": [str(file) for file in files],
        "faces": len(baked.mesh.faces),
        "faces_before": len(mesh.faces),
        "vertices": len(baked.mesh.vertices),
        "texture_size": len(baked.mesh.texture),
        "charts": baked.charts,
        "texels": baked.texels,
        "texels_unseen": baked.unseen,
        "bytes": sum(file.stat().st_size for file in files),
    }


def textured_mesh(
    trained: Trained, mesh: Mesh, options: TextureOptions, on_event: OnEvent = ignore, *, downscale: int | None = None
) -> Baked:
    """Simplify a mesh of a run, cut it into charts and colour them, with the appearance of photographs removed.

    ``downscale`` is that of the views.
    """
    on_event(Phase("cutting the surface into charts", 0))
    views, small = _views(trained, options, on_event, downscale), simplified(mesh, options.faces)
    if len(small.faces) > options.faces:
        on_event(Notice(f"simplified to {len(small.faces):,} triangles, the closest possible to faces={options.faces}"))
    size = options.texture_size or texture_size(small, [view.camera for view in views])
    images = partial(photographs, trained, views, on_event)
    return bake(unwrap(small, size), images, size, threads=torch.get_num_threads())


def check_texture_options(options: TextureOptions) -> None:
    """Raise for invalid options."""
    if options.faces < 4:
        raise ProtocolError(f"faces must be a whole number >= 4, got {options.faces}")
    if options.texture_downscale is not None and options.texture_downscale < 1:
        raise ProtocolError(f"texture_downscale must be a whole number >= 1, got {options.texture_downscale}")
    if options.texture_size is not None and not MIN_SIZE <= options.texture_size <= MAX_SIZE:
        raise ProtocolError(f"texture_size must be {MIN_SIZE} to {MAX_SIZE} texels, got {options.texture_size}")


def _mesh(run: RunFolder, trained: Trained, options: MeshOptions, on_event: OnEvent) -> Mesh:
    """Return the mesh of the run, or one extracted with other options."""
    if options == MeshOptions() and run.file(MESH).exists():
        return read_mesh(run.file(MESH))
    subject = meshed_subject(run, trained, options, on_event)
    mesh = fused(trained, options, on_event, subject=subject).mesh
    trim()
    return mesh


def _views(
    trained: Trained, options: TextureOptions, on_event: OnEvent, trained_downscale: int | None
) -> Sequence[View]:
    """Return the training views at the requested size, with refined cameras and learned appearance."""
    scene = trained.scene
    if options.texture_downscale in (None, trained_downscale) or scene.root is None:
        return scene.train
    downscale = options.texture_downscale or 1
    resized = read_scene(scene.root, scene.format, downscale, trained.protocol, on_event, scene.masks)
    zooms = {view.name: view.zoom for view in scene.train if view.zoom is not None}
    resized = resized.with_poses({view.name: view.camera.T_cam_world for view in scene.train}, zooms)
    return resized.with_appearance({view.name: view.appearance for view in scene.train}).train


def photographs(trained: Trained, views: Sequence[View], on_event: OnEvent, factor: int) -> Iterator[ColorSource]:
    """Yield photographs in the colours of the scene, smaller by ``factor``."""
    for view in counted(views, PASSES[factor > 1], len(views), on_event):
        yield ColorSource(view.camera, as_scene(view), usable_pixels(trained, view)).shrunk(factor)
