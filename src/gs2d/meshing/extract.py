"""From frames to a mesh: limits, fusion, marching cubes, components."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gs2d.core.memory import trim
from gs2d.core.mesh import Mesh
from gs2d.meshing.bounds import DepthSample, FusionBounds, derive_limits, sample_depths, widen_truncation
from gs2d.meshing.consistency import depth_noise
from gs2d.meshing.depth_maps import RenderedView, Spool
from gs2d.meshing.evidence import Cleaned, clean, simplified
from gs2d.meshing.marching_cubes import components, inside_box, keep_components
from gs2d.meshing.slabs import SLAB_BYTES, fused_surface
from gs2d.meshing.tsdf import Blocks, find_blocks, fusion_backend
from gs2d.meshing.unbounded import FAR_VIEWS, derive_cascade, find_cascade_blocks, fused_cascade_surface
from gs2d.render.backends import Backend

SAMPLES_A_MAP, FEWEST_SAMPLES = 4096, 16  # pixels of a depth map by which limits are derived
SAMPLES = 1 << 19  # of all: 40 MB


@dataclass(frozen=True)
class Extraction:
    """A mesh and how it came about."""

    mesh: Mesh
    limits: FusionBounds
    frames: int
    blocks: int
    volume_bytes: int
    components: int  # before small ones went
    faces_removed: int
    levels: int = 1  # of the nest of an unbounded scene
    backend: str = "reference"  # what fused: never "auto"
    cleaned: Cleaned | None = None  # where it was made to hold what the views saw, and no more


def extract(
    frames: Iterable[RenderedView] | Spool,
    *,
    limits: FusionBounds | None = None,
    resolution: int = 512,
    bbox: np.ndarray | None = None,
    voxel: float | None = None,
    truncation: float | None = None,
    depth_limit: float | None = None,
    points: np.ndarray | None = None,
    min_weight: float = 1.0,
    min_faces: int = 50,
    keep: int | None = None,
    max_bytes: int = 4 << 30,
    threads: int | None = None,
    backend: str | Backend = "auto",
    folder: str | os.PathLike[str] | None = None,
    by_evidence: bool = False,
    slab_bytes: int = SLAB_BYTES,
) -> Extraction:
    """Fuse frames into a mesh.

    Parameters
    ----------
    frames : iterable of RenderedView, or Spool
        Read once (a generator is fine) and kept in a temporary file; a spool is one, and stays open.
    limits : FusionBounds, optional
        Default: ``derive_limits`` from the frames, with ``resolution``, ``bbox``, ``voxel``, ``truncation``,
        ``depth_limit`` and ``points`` as it takes them (they may not be given together with ``limits``); a truncation
        that is not given grows with the disagreement of the depth maps (``consistency.depth_noise``). With ``bbox`` no
        face reaches beyond it.
    min_weight : float
        See ``marching_cubes``.
    min_faces, keep : int
        See ``keep_components``.
    max_bytes : int
        Bound on the volume.
    threads : int, optional
    backend : str or Backend
        What fuses, see ``fuse``.
    folder : path, optional
        Where the temporary file goes.
    by_evidence : bool
        Leave only what more views see than see through, in no more faces than their pixels carry
        (``evidence.clean``).
    slab_bytes : int
        Of the volume that are in memory at a time; the mesh does not depend on it.

    Raises
    ------
    ProtocolError
        If there is nothing to fuse, the limits make no sense, or the volume would be larger than ``max_bytes``.
    ShapeError
        If a frame's maps are not of its camera's size.
    DiskError
        If the temporary file cannot be written.
    BackendError
        If the backend is unknown or cannot run here.
    """
    if limits is not None and any(v is not None for v in (bbox, voxel, truncation, depth_limit, points)):
        raise TypeError("give limits, or the numbers to derive them from, not both")
    backend = fusion_backend(backend)
    with Spool.of(frames, folder) as spool:
        if limits is None:
            samples = sampled(spool)
            limits = derive_limits(
                samples,
                spool.cameras,
                resolution=resolution,
                bbox=bbox,
                voxel=voxel,
                truncation=truncation,
                depth_limit=depth_limit,
                points=points,
            )
            if truncation is None:
                limits = widen_truncation(limits, depth_noise(spool, samples, limits))
            del samples
            trim()  # 20 to 60 MB, before the volume
        blocks = find_blocks(spool, limits, max_bytes=max_bytes, threads=threads, backend=backend)
        fused = _Fused(blocks.frames, len(blocks.keys), blocks.nbytes, 1)
        whole = fused_surface(
            spool,
            limits,
            blocks,
            min_weight=min_weight,
            slab_bytes=slab_bytes,
            threads=threads,
            backend=backend,
        )
        whole = whole if bbox is None else inside_box(whole, bbox)
        trim()  # the volume of the last slab
        found = _extraction(whole, limits, fused, min_faces=min_faces, keep=keep, backend=backend)
        if not by_evidence:
            return found
        del whole
        cleaned = clean(found.mesh, spool, limits.truncation)
        found = replace(found, mesh=cleaned.mesh)  # the other is let go before the collapse, which takes most
        cleaned = simplified(cleaned)
        return replace(found, mesh=cleaned.mesh, cleaned=cleaned)


def extract_unbounded(
    frames: Iterable[RenderedView] | Spool,
    *,
    resolution: int = 512,
    bbox: np.ndarray | None = None,
    voxel: float | None = None,
    truncation: float | None = None,
    depth_limit: float | None = None,
    min_weight: float = 1.0,
    far_views: float = FAR_VIEWS,
    min_faces: int = 50,
    keep: int | None = None,
    max_bytes: int = 4 << 30,
    threads: int | None = None,
    backend: str | Backend = "auto",
    folder: str | os.PathLike[str] | None = None,
    slab_bytes: int = SLAB_BYTES,
) -> Extraction:
    """Fuse frames of a scene without bounds into a mesh, in voxels that grow with the distance from its centre.

    Parameters
    ----------
    frames : iterable of RenderedView, or Spool
        As for ``extract``.
    resolution, bbox, voxel, truncation, depth_limit
        See ``unbounded.derive_cascade``; ``bbox``, ``voxel`` and ``truncation`` are those of the innermost level. A
        truncation that is not given grows with the disagreement of the depth maps, as in ``extract``.
    min_weight : float
        See ``marching_cubes``.
    far_views : float
        The same outside the innermost level, at most half as many as there are views.
    min_faces, keep, max_bytes, threads, backend, folder, slab_bytes
        As for ``extract``.

    Returns
    -------
    Extraction
        ``limits`` are those of the innermost level, but ``lower`` and ``upper`` those of the outermost.

    Raises
    ------
    ProtocolError, ShapeError, DiskError, BackendError
        As ``extract``.
    """
    backend = fusion_backend(backend)
    with Spool.of(frames, folder) as spool:
        samples = sampled(spool)
        cascade = derive_cascade(
            samples,
            spool.cameras,
            resolution=resolution,
            bbox=bbox,
            voxel=voxel,
            truncation=truncation,
            depth_limit=depth_limit,
        )
        if truncation is None:
            inner = cascade.levels[0]
            # far depths contradict each other more, but their levels have wider bands
            noise = depth_noise(spool, samples, replace(inner, depth_limit=min(inner.depth_median, inner.depth_limit)))
            cascade = cascade.with_truncation(widen_truncation(inner, noise).truncation, noise)
        del samples
        trim()
        blocks = find_cascade_blocks(spool, cascade, max_bytes=max_bytes, threads=threads, backend=backend)
        whole = fused_cascade_surface(
            spool,
            cascade,
            blocks,
            min_weight=min_weight,
            far_weight=min(far_views, blocks[0].frames / 2),
            slab_bytes=slab_bytes,
            threads=threads,
            backend=backend,
        )
    fused = _Fused.of(blocks)
    limits = replace(cascade.levels[0], lower=cascade.levels[-1].lower, upper=cascade.levels[-1].upper)
    return _extraction(whole, limits, fused, min_faces=min_faces, keep=keep, backend=backend)


def sampled(spool: Spool) -> list[DepthSample]:
    """Return pixels of all depth maps: of each the fewer, the more there are, so that any number takes the same."""
    count = min(SAMPLES_A_MAP, max(FEWEST_SAMPLES, SAMPLES // max(len(spool), 1)))
    return [sample_depths(item, count) for item in spool]


@dataclass(frozen=True)
class _Fused:
    """What is said of volumes when they are gone."""

    frames: int
    blocks: int
    nbytes: int
    levels: int

    @classmethod
    def of(cls, levels: Sequence[Blocks]) -> _Fused:
        blocks, nbytes = sum(len(level.keys) for level in levels), sum(level.nbytes for level in levels)
        return cls(levels[0].frames, blocks, nbytes, len(levels))


def _extraction(
    whole: Mesh, limits: FusionBounds, fused: _Fused, *, min_faces: int, keep: int | None, backend: Backend
) -> Extraction:
    """Without small pieces, with the figures."""
    mesh = keep_components(whole, min_faces=min_faces, keep=keep)
    return Extraction(
        mesh=mesh,
        limits=limits,
        frames=fused.frames,
        blocks=fused.blocks,
        volume_bytes=fused.nbytes,
        components=int(components(whole).max(initial=-1)) + 1,
        faces_removed=len(whole.faces) - len(mesh.faces),
        levels=fused.levels,
        backend=backend.name,
    )
