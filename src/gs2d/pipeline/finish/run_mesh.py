"""The mesh of a run: fused depth maps of the training views, refined with the photographs."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gs2d.config.protocols import get_protocol
from gs2d.core.atomic_files import check_writable, disk_error
from gs2d.core.memory_limit import memory_budget
from gs2d.core.mesh import Mesh
from gs2d.core.splats import Splats
from gs2d.core.transforms import camera_extent, up_direction
from gs2d.data import Scene, View, detect_format, load_scene
from gs2d.data.bounds import Reach
from gs2d.data.subject_box import LARGEST, Subject, checked_box
from gs2d.errors import DataError, ProtocolError, RunError
from gs2d.io.formats.splat_formats import read_surfels
from gs2d.io.meshes import write_mesh, write_pieces
from gs2d.io.run_dir import MESH, SURFACE, TEXTURED, RunFolder
from gs2d.kernels.library import ready_library
from gs2d.meshing.convex_pieces import convex_pieces, required
from gs2d.meshing.depth_maps import RenderedView
from gs2d.meshing.extract import Extraction, ExtractOptions
from gs2d.meshing.mesh_methods import MESH_METHODS
from gs2d.meshing.refine import Refinement, RefineSettings
from gs2d.meshing.simplify import simplify
from gs2d.meshing.slabs import SLAB_BYTES
from gs2d.meshing.texture import ColorSource
from gs2d.meshing.tsdf_volume import VolumeTooLargeError
from gs2d.meshing.visual_hull import to_visual_hull
from gs2d.meshing.warped_ncc import GreyImage
from gs2d.pipeline.finish.run_report import show_again
from gs2d.pipeline.finish.run_subject import OPAQUE, centers_inside, meshed_subject
from gs2d.pipeline.finish.trusted_depth import sky_direction, sky_of, surface_reach, usable_pixels, within_reach
from gs2d.pipeline.finish.viewpoints import choose_viewpoints
from gs2d.pipeline.look.page import settings_without_run
from gs2d.pipeline.prepare.limits import release, release_buffers, use_threads
from gs2d.pipeline.prepare.loaded import Trained, checked_output, open_finished, trained_elsewhere
from gs2d.pipeline.prepare.open_capture import choose_backend
from gs2d.pipeline.prepare.options import MeshOptions
from gs2d.pipeline.prepare.predicted_views import LUMA
from gs2d.render.types import RenderOutput
from gs2d.training.events import Notice, OnEvent, Phase, Step, counted, ignore

ONE_SURFACE = 0.02  # of the depth; if mean and median differ by more, a pixel shows several surfaces
SEVERAL = 0.25  # weight of such a pixel
ERROR = 0.25  # px: half of a voxel on the surface; twice as much costs 3 % of the Chamfer distance
MESH_METRICS = (  # fields of a mesh in metrics.json
    *("vertices", "faces", "method", "voxel", "truncation", "depth_limit", "depth"),
    *("pixels", "faces_per_pixel"),
)
VOLUME_BYTES = 4 << 30  # limit of the fused volume, if the memory of the machine is unknown
LEAST_SLAB_BYTES = 32 << 20  # smaller slabs spend most of the time on preparing views again
MOSTLY_CUT = 0.5  # fraction of the depth outside the mesh from which a notice is sent
COARSER_ERROR = 4.0  # times that of the level of detail before: about a quarter of its faces
COARSER = 3  # attempts with larger voxels: the first size is an estimate
LEAST_VIEWS = 2  # one does not measure depth


# -- extraction --------------------------------------------------------------------------------------------------------
def extract_mesh(
    trained: Trained,
    options: MeshOptions,
    out: Path,
    on_event: OnEvent,
    *,
    subject: Subject | None = None,
) -> dict[str, Any]:
    """Fuse rendered depth of the training views, write the mesh, and return its file, counts and limits.

    With ``subject``, only the subject is meshed.
    """
    if not out.parent.is_dir():
        raise disk_error(out, FileNotFoundError(2, "No such file or directory"))
    result = fused(trained, options, on_event, subject=subject)
    release_buffers()
    cameras, error = [view.camera for view in trained.scene.train], _error(trained, options) or ERROR
    coarser = [result.mesh]
    for _ in range(1, options.lods):
        error *= COARSER_ERROR
        coarser.append(simplify(coarser[-1], error=error, cameras=cameras))
    write_mesh(out, result.mesh, up=up_direction(cameras), coarser=coarser[1:])
    pixels: dict[str, Any] = {"lods": [len(mesh.faces) for mesh in coarser]} if options.lods > 1 else {}
    if options.collision:
        on_event(Phase("splitting the mesh into convex pieces", 0))
        file = out.with_name(f"{out.stem}-collision.obj")
        pieces = convex_pieces(result.mesh)
        write_pieces(file, pieces)
        on_event(Notice(f"{file}: {len(pieces)} convex pieces"))
        pixels |= {"collision": str(file), "pieces": len(pieces)}
    if result.pixels is not None:
        pixels |= {"pixels": round(result.pixels), "faces_per_pixel": len(result.mesh.faces) / max(result.pixels, 1.0)}
    return {
        "file": str(out),
        "vertices": len(result.mesh.vertices),
        "faces": len(result.mesh.faces),
        "depth": options.depth or trained.protocol.fused_depth,
        "method": _method_name(options),
        "levels": result.levels,
        "fused_by": result.backend,
        **asdict(result.limits),
        "volume_bytes": result.volume_bytes,
        **pixels,
    }


def fused(trained: Trained, options: MeshOptions, on_event: OnEvent, *, subject: Subject | None = None) -> Extraction:
    """Fuse rendered depth of the training views; arguments as of :func:`extract_mesh`.

    Without a voxel size, voxels are as large as memory requires. Then photographs refine the mesh. Meshes of data sets
    stay as their protocols fuse them, unbounded ones too, whose distant faces are larger than any error of their depth,
    and watertight ones, so that they stay closed.
    """
    if not len(trained.splats):
        raise ProtocolError("there are no splats to mesh; train longer or check the cameras")
    check_mesh_options(options)
    free = options.voxel is None and trained.protocol.fusion.voxel is None
    chosen = options
    for attempt in range(COARSER * free + 1):
        try:
            result = _extract(trained, chosen, on_event, subject)
            break
        except VolumeTooLargeError as error:
            if attempt == COARSER * free:
                raise
            on_event(Notice(f"{error}; using voxels of this size (more --memory allows smaller ones)"))
            chosen = replace(chosen, voxel=error.voxel)
    bounded = MESH_METHODS.get(_method_name(options)).bounded
    if subject is None and result.limits.cut_fraction > MOSTLY_CUT:
        part = f"{result.limits.cut_fraction:.0%} of the depth is"
        if not bounded:
            limit = result.limits.depth_limit
            line = (
                f"{part} beyond {limit:.4g} world units, where depth is too uncertain; "
                "--set depth_limit extends the mesh"
            )
        else:
            line = f"{part} outside the fused box; --scene meshes everything, --bbox or --set depth_limit extend it"
        on_event(Notice(line))
    if not options.refine or options.watertight or not bounded or not trained.protocol.fusion.subject:
        return result
    mesh = refined(trained, result.mesh, on_event)
    cameras = [view.camera for view in trained.scene.train]
    return replace(result, mesh=simplify(mesh, error=_error(trained, options), cameras=cameras))


def check_mesh_options(options: MeshOptions) -> None:
    """Raise for invalid options, before anything is rendered."""
    for name in ("voxel", "truncation", "depth_limit"):
        value, option = getattr(options, name), f"--set {name}"
        if value is not None and not (value > 0 and math.isfinite(value)):
            raise ProtocolError(f"{option} must be a positive number of world units, got {value}")
        if value is not None and not 1 / LARGEST <= value <= LARGEST:
            raise ProtocolError(f"{option} must be between {1 / LARGEST:g} and {LARGEST:g} world units, got {value:g}")
    if options.error is not None and not (options.error >= 0 and math.isfinite(options.error)):
        raise ProtocolError(f"--error must be a number of pixels >= 0, got {options.error}; 0 keeps all faces")
    if options.lods < 1:
        raise ProtocolError(f"lods must be a whole number >= 1, got {options.lods}")
    if options.collision:
        required()  # before minutes are spent
    method = _method_name(options)
    if method not in MESH_METHODS:
        raise ProtocolError(f"--method: {MESH_METHODS.unknown(method)}")
    closes = MESH_METHODS.get(method).closes  # its package can be imported
    if options.watertight and not closes:
        closing = ", ".join(name for name, other in MESH_METHODS.working() if other.closes) or "none is installed"
        raise ProtocolError(f"--watertight needs a method that closes ({closing}), got {method}; leave one of them out")
    if options.bbox is not None:
        checked_box(options.bbox, "--bbox")
    if options.keep_components is not None and options.keep_components < 0:
        raise ProtocolError(f"keep_components must be a whole number >= 0 (0 = all), got {options.keep_components}")


def _extract(trained: Trained, options: MeshOptions, on_event: OnEvent, subject: Subject | None) -> Extraction:
    fusion, budget = trained.protocol.fusion, memory_budget()
    keep = fusion.clusters if options.keep_components is None else options.keep_components
    # A box or a voxel size of the user replaces all limits of the protocol.
    bbox = None if options.bbox is None else np.asarray(options.bbox, np.float64).reshape(2, 3)
    bbox = bbox if subject is None else subject.box
    method = MESH_METHODS.get(_method_name(options))
    own = bbox is not None or not method.bounded
    chosen = ExtractOptions(
        bbox=bbox,
        voxel=options.voxel if own else options.voxel or fusion.voxel,
        truncation=options.truncation or (None if own or options.voxel else fusion.truncation),
        depth_limit=options.depth_limit if own else options.depth_limit or fusion.depth_limit,
        min_weight=SEVERAL if fusion.subject else 1.0,  # of one pixel
        keep=keep or None,
        by_evidence=fusion.subject,
        error=_error(trained, options),
        watertight=options.watertight,
        # Slabs are fused one at a time, but joining and cleaning the surface needs about half of the whole volume.
        max_bytes=VOLUME_BYTES if budget is None else budget,
        slab_bytes=SLAB_BYTES if budget is None else min(SLAB_BYTES, max(LEAST_SLAB_BYTES, budget // 32)),
    )
    frames, shine = _frames(trained, options, on_event), [view.shine for view in trained.scene.train]
    frames = to_visual_hull(frames, shine) if any(cells is not None for cells in shine) else frames
    result: Extraction = method.extract(frames, chosen, threads=torch.get_num_threads(), backend=trained.backend)
    if not len(result.mesh.faces):
        on_event(Notice("the mesh is empty: no surface is covered well enough"))
    return result


def _method_name(options: MeshOptions) -> str:
    """Return the name of the method: the default is replaced by one that closes, or one for the whole scene.

    With equal voxels thin parts near the cameras would vanish from a whole scene.
    """
    if options.method != MeshOptions.method or not (options.watertight or options.whole_scene):
        return options.method
    suitable = (name for name, one in MESH_METHODS.working() if (one.closes if options.watertight else not one.bounded))
    return next(suitable, options.method)


def _error(trained: Trained, options: MeshOptions) -> float:
    """Return the error of simplification, px; 0: none."""
    if options.error is not None:
        return options.error
    return ERROR if trained.protocol.fusion.subject else 0.0


# -- depth maps --------------------------------------------------------------------------------------------------------
def _frames(trained: Trained, options: MeshOptions, on_event: OnEvent) -> Iterator[RenderedView]:
    """Yield the input of fusion for each training view; meshes of the whole scene keep the sky."""
    depth = options.depth or trained.protocol.fused_depth
    views, settings = trained.scene.train, replace(trained.settings, with_distortion=False).for_depths(depth)
    drawing = replace(trained, settings=settings)
    reach, up = surface_reach(trained), None if options.whole_scene else sky_direction(trained)
    for view in counted(views, "rendering depth", len(views), on_event):
        yield fusion_frame(trained, view, drawing.render(view.camera), depth, reach, up)
    release(trained.scene)  # decoded photographs
    on_event(Phase("fusing", 0))


def fusion_frame(
    trained: Trained,
    view: View,
    output: RenderOutput,
    depth: str,
    reach: Reach | None = None,
    up: np.ndarray | None = None,
) -> RenderedView:
    """Return the input of fusion for a view: depth and colour where it is covered well enough.

    Depth beyond ``reach``, and of the sky if its direction ``up`` is known, is infinite: no surface is there.
    """
    sky = np.zeros(output.alpha.shape, bool) if up is None else sky_of(trained, view, up)
    valid = (output.alpha >= OPAQUE).cpu().numpy() | sky
    mask = view.object_mask() if trained.protocol.use_mask_in_fusion else None
    # Outside the photograph and in ignored pixels nothing constrains the surface.
    for pixels in (mask, view.usable(masks=trained.protocol.use_mask_in_fusion)):
        if pixels is not None:
            valid = valid & pixels
    depths = output.depth(depth).cpu().numpy()
    if trained.protocol.fusion.subject:
        valid = valid * np.maximum(confidence(output), sky)
    past = sky if reach is None else sky | ~within_reach(reach, view.camera, depths)
    depths = np.where(past, np.float32(np.inf), depths)
    alpha, background = output.alpha[..., None], output.color.new_tensor(trained.settings.background)
    color = ((output.color - (1 - alpha) * background) / alpha.clamp(min=1e-3)).clamp(0, 1)  # without the background
    return RenderedView(view.camera, depths, color.cpu().numpy(), valid)


def confidence(output: RenderOutput) -> np.ndarray:
    """Return the weights [H, W] of depths: lower if the light of a pixel ends at several depths.

    Such pixels are at outlines, in floaters, or on surfaces without texture.
    """
    mean, median = output.depth_mean, output.depth_median
    return np.where(((mean - median).abs() <= ONE_SURFACE * median).cpu().numpy(), 1.0, SEVERAL)


def checked_mesh_file(path: Path, out: Path, options: MeshOptions) -> Path:
    """Return the file of a mesh, .ply or .glb; ``path`` is the run or the folder of the splats.

    Raises RunError or ProtocolError if the name has another suffix, is that of the splats, or cannot hold levels of
    detail.
    """
    glb = Path(out).suffix.lower() == ".glb"
    if options.lods > 1 and not glb:
        raise ProtocolError(f"lods={options.lods} needs --out FILE.glb, got {out}; PLY files have one level of detail")
    return checked_output(path, out, ".glb" if glb else ".ply", "a mesh (or .glb)")


# -- refinement --------------------------------------------------------------------------------------------------------
def refined(
    trained: Trained,
    mesh: Mesh,
    on_event: OnEvent,
    settings: RefineSettings = RefineSettings(),  # noqa: B008 (frozen)
) -> Mesh:
    """Move the vertices of a mesh until the training views agree; ``mesh`` is not changed.

    Without two views or a surface it is returned as it is.
    """
    views = trained.scene.train
    if len(views) < LEAST_VIEWS or not len(mesh.faces):
        return mesh

    def read(index: int, factor: int) -> GreyImage:
        view = views[index]
        small = ColorSource(view.camera, view.image(), usable_pixels(trained, view)).shrunk(factor)
        grey = small.image[..., :3] @ np.asarray(LUMA, np.float32) / np.float32(255)
        return GreyImage(small.camera, np.ascontiguousarray(grey, np.float32), small.valid)

    refinement = Refinement(mesh, [view.camera for view in views], read, settings, ready_library())
    on_event(Phase("refining the mesh", refinement.work))
    return refinement.run(lambda done: on_event(Step(done)))


# -- gs2d mesh ---------------------------------------------------------------------------------------------------------
def mesh_run(
    path: Path,
    options: MeshOptions = MeshOptions(),  # noqa: B008 (frozen)
    on_event: OnEvent = ignore,
    *,
    out: Path | None = None,
    threads: int | None = None,
) -> dict[str, Any]:
    """Extract the mesh of a finished run; return its file, counts and limits."""
    path, out = Path(path), None if out is None else Path(out)
    check_mesh_options(options)
    checked_mesh_file(path, path / MESH if out is None else out, options)
    run, trained = open_finished(path, threads, on_event)
    own = run.file(MESH)
    target = own if out is None or out.resolve() == own.resolve() else out
    with run.locked() if target == own else nullcontext():
        subject = meshed_subject(run, trained, options, on_event)
        result = extract_mesh(trained, options, target, on_event, subject=subject)
        if target != own:
            return result
        if run.metrics().get("surface"):  # scores of the previous mesh
            run.write_metrics({**run.metrics(), "surface": None})
            shutil.rmtree(run.file(SURFACE), ignore_errors=True)
        write_mesh_metrics(run, result)
        if run.file(TEXTURED).exists():
            run.file(TEXTURED).unlink()
            on_event(Notice(f"removed {TEXTURED}, which belonged to the previous mesh"))
    show_again(run, on_event, trained)
    return result


def write_mesh_metrics(run: RunFolder, result: Mapping[str, Any]) -> None:
    """Write the figures of a run's mesh into ``metrics.json``."""
    run.write_metrics({**run.metrics(), "mesh": {name: result[name] for name in MESH_METRICS if name in result}})


# -- the mesh of a file of splats --------------------------------------------------------------------------------------
LONGEST = 1600  # px: photographs of a capture are shrunk to it, as in training at full quality


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
    scene = load_scene(capture, format=kind, test_every=0)
    longest = max((max(view.camera.width, view.camera.height) for view in scene.train), default=1)
    if longest > LONGEST:
        scene = load_scene(capture, format=kind, test_every=0, downscale=-(-longest // LONGEST))
    if len(scene.train) < LEAST_VIEWS:
        raise DataError(
            f"--cameras must be a capture with {LEAST_VIEWS} or more views, got {len(scene.train)} in {capture}"
        )
    return trained_elsewhere(splats, scene, "auto", "auto", on_event)


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
