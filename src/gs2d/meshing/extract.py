"""From frames to a mesh: limits, fusion, marching cubes, components."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gs2d.core.memory import trim
from gs2d.core.mesh import Mesh
from gs2d.meshing.consistency import depth_noise
from gs2d.meshing.depth_maps import RenderedView, Spool
from gs2d.meshing.evidence import Cleaned, clean, simplified
from gs2d.meshing.fusion_bounds import DepthSample, FusionBounds, derive_limits, sample_depths, widen_truncation
from gs2d.meshing.marching_cubes import components, inside_box, keep_components
from gs2d.meshing.slabs import SLAB_BYTES, fused_surface
from gs2d.meshing.tsdf_volume import VolumeBlocks, find_blocks, fusion_backend
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


@dataclass(frozen=True, eq=False)
class ExtractOptions:
    """How depth maps become a mesh; limits that are None are derived from the maps.

    Attributes
    ----------
    resolution : int
        Voxels along the longest side, see ``bounds.derive_limits`` and ``unbounded.derive_cascade``.
    bbox : array [2, 3] world units or None
        Box that is fused; no face reaches beyond it. Of an unbounded scene the innermost level.
    voxel, truncation, depth_limit : float world units or None
        A truncation that is None grows with the disagreement of the depth maps (``consistency.depth_noise``).
    min_weight : float
        See ``marching_cubes``.
    far_views : float
        The same outside the innermost level of an unbounded scene, at most half as many as there are views.
    min_faces, keep : int
        See ``keep_components``.
    by_evidence : bool
        Leave only what more views see than see through, in no more faces than their pixels carry
        (``evidence.clean``). Not for unbounded scenes.
    max_bytes : int
        Bound on the volume.
    slab_bytes : int
        Bytes of the volume that are in memory at a time; the mesh does not depend on it.
    """

    resolution: int = 512
    bbox: np.ndarray | None = None
    voxel: float | None = None
    truncation: float | None = None
    depth_limit: float | None = None
    min_weight: float = 1.0
    far_views: float = FAR_VIEWS
    min_faces: int = 50
    keep: int | None = None
    by_evidence: bool = False
    max_bytes: int = 4 << 30
    slab_bytes: int = SLAB_BYTES

    @property
    def given(self) -> dict[str, Any]:
        """Limits as ``derive_limits`` and ``derive_cascade`` take them."""
        return {name: getattr(self, name) for name in ("resolution", "bbox", "voxel", "truncation", "depth_limit")}


def extract(
    frames: Iterable[RenderedView] | Spool,
    options: ExtractOptions = ExtractOptions(),
    *,
    threads: int | None = None,
    backend: str | Backend = "auto",
) -> Extraction:
    """Fuse frames into a mesh.

    Parameters
    ----------
    frames : iterable of RenderedView, or Spool
        Read once (a generator is fine) and kept in a temporary file; a spool is one, and stays open.
    options : ExtractOptions
    threads : int, optional
    backend : str or Backend
        What fuses, see ``fuse``.

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
    backend = fusion_backend(backend)
    with Spool.of(frames) as spool:
        samples = sampled(spool)
        limits = derive_limits(samples, spool.cameras, **options.given)
        if options.truncation is None:
            limits = widen_truncation(limits, depth_noise(spool, samples, limits))
        del samples
        trim()  # 20 to 60 MB, before the volume
        blocks = find_blocks(spool, limits, max_bytes=options.max_bytes, threads=threads, backend=backend)
        fused = _Fused.of([blocks])
        whole = fused_surface(
            spool,
            limits,
            blocks,
            min_weight=options.min_weight,
            slab_bytes=options.slab_bytes,
            threads=threads,
            backend=backend,
        )
        whole = whole if options.bbox is None else inside_box(whole, options.bbox)
        trim()  # the volume of the last slab
        found = _extraction(whole, limits, fused, options, backend)
        if not options.by_evidence:
            return found
        del whole
        cleaned = clean(found.mesh, spool, limits.truncation)
        found = replace(found, mesh=cleaned.mesh)  # the other is let go before the collapse, which takes most
        cleaned = simplified(cleaned)
        return replace(found, mesh=cleaned.mesh, cleaned=cleaned)


def extract_unbounded(
    frames: Iterable[RenderedView] | Spool,
    options: ExtractOptions = ExtractOptions(),
    *,
    threads: int | None = None,
    backend: str | Backend = "auto",
) -> Extraction:
    """Fuse frames of a scene without bounds into a mesh, in voxels that grow with the distance from its centre.

    Parameters
    ----------
    frames, options, threads, backend
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
    with Spool.of(frames) as spool:
        samples = sampled(spool)
        cascade = derive_cascade(samples, spool.cameras, **options.given)
        if options.truncation is None:
            inner = cascade.levels[0]
            # far depths contradict each other more, but their levels have wider bands
            noise = depth_noise(spool, samples, replace(inner, depth_limit=min(inner.depth_median, inner.depth_limit)))
            cascade = cascade.with_truncation(widen_truncation(inner, noise).truncation, noise)
        del samples
        trim()
        blocks = find_cascade_blocks(spool, cascade, max_bytes=options.max_bytes, threads=threads, backend=backend)
        whole = fused_cascade_surface(
            spool,
            cascade,
            blocks,
            min_weight=options.min_weight,
            far_weight=min(options.far_views, blocks[0].frames / 2),
            slab_bytes=options.slab_bytes,
            threads=threads,
            backend=backend,
        )
    limits = replace(cascade.levels[0], lower=cascade.levels[-1].lower, upper=cascade.levels[-1].upper)
    return _extraction(whole, limits, _Fused.of(blocks), options, backend)


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
    def of(cls, levels: Sequence[VolumeBlocks]) -> _Fused:
        blocks, nbytes = sum(len(level.keys) for level in levels), sum(level.nbytes for level in levels)
        return cls(levels[0].frames, blocks, nbytes, len(levels))


def _extraction(
    whole: Mesh, limits: FusionBounds, fused: _Fused, options: ExtractOptions, backend: Backend
) -> Extraction:
    """Return the mesh without small components, with the figures."""
    mesh = keep_components(whole, min_faces=options.min_faces, keep=options.keep)
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
