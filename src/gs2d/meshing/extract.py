"""Extract a mesh from depth maps: limits, fusion, marching cubes, components."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gs2d.core.memory import trim
from gs2d.core.mesh import Mesh
from gs2d.kernels.library import load
from gs2d.meshing.consistency import depth_noise
from gs2d.meshing.depth_maps import RenderedView, Spool
from gs2d.meshing.evidence import clean
from gs2d.meshing.fusion_bounds import DepthSample, FusionBounds, derive_limits, sample_depths, widen_truncation
from gs2d.meshing.marching_cubes import inside_box, keep_components
from gs2d.meshing.mesh_methods import register_mesh_method
from gs2d.meshing.simplify import simplify
from gs2d.meshing.slabs import SLAB_BYTES, fused_surface
from gs2d.meshing.tsdf_volume import find_blocks, fusion_backend
from gs2d.render.backends import Backend

SAMPLES_A_MAP, FEWEST_SAMPLES = 4096, 16  # pixels of a depth map that limits are derived from
SAMPLES = 1 << 19  # of all depth maps: 40 MB


@dataclass(frozen=True)
class Extraction:
    """A mesh and statistics of its extraction."""

    mesh: Mesh
    limits: FusionBounds
    frames: int
    volume_bytes: int
    levels: int  # of an unbounded scene; 1 otherwise
    backend: str  # that fused the depth maps; never "auto"
    pixels: float | None = None  # of the surface, if it was cleaned by evidence (``evidence.clean``)


@dataclass(frozen=True, eq=False)
class ExtractOptions:
    """Settings of the extraction. Limits that are None are derived from the depth maps."""

    resolution: int = 512  # voxels along the longest side, see ``derive_limits``
    # [2, 3] world units: box to fuse; faces outside are removed. For an unbounded scene, the innermost level.
    bbox: np.ndarray | None = None
    voxel: float | None = None  # world units, as the two below
    # derived, it grows with the disagreement of the depth maps (``consistency.depth_noise``)
    truncation: float | None = None
    depth_limit: float | None = None
    min_weight: float = 1.0  # see ``cell_surface``
    keep: int | None = None  # number of components to keep, see ``keep_components``
    # Keep only surface that more views see than see through (``evidence.clean``). Not for unbounded scenes.
    by_evidence: bool = False
    error: float = 0.0  # px: simplify with this error, see ``simplify``; 0 keeps all faces
    watertight: bool = False  # close the surface everywhere, also where no view shows it (Delaunay alone)
    max_bytes: int = 4 << 30  # limit of the volume
    slab_bytes: int = SLAB_BYTES  # part of the volume that is in memory at a time; the mesh does not depend on it

    @property
    def limits(self) -> dict[str, Any]:
        """Limits, as arguments of ``derive_limits``."""
        return {name: getattr(self, name) for name in ("resolution", "bbox", "voxel", "truncation", "depth_limit")}


@register_mesh_method("tsdf")
def extract(
    frames: Iterable[RenderedView],
    options: ExtractOptions = ExtractOptions(),
    *,
    threads: int | None = None,
    backend: str | Backend = "auto",
) -> Extraction:
    """Fuse depth maps into a mesh.

    ``frames`` are read once (it may be a generator) and stored in a temporary file. The backend is that of the fusion,
    see ``fuse_blocks``. Raises ProtocolError if there is nothing to fuse, a limit is invalid, or the volume would
    exceed ``max_bytes``; ShapeError if the maps of a frame do not have the size of its camera; DiskError if the
    temporary file cannot be written; BackendError if the backend is unknown or cannot run here.
    """
    backend = fusion_backend(backend)
    spool, samples = spooled(frames, threads)
    limits = bounds_of(spool, samples, options)
    del samples
    mesh, volume_bytes = fused_depths(spool, limits, options, backend)
    mesh = mesh if options.bbox is None else inside_box(mesh, options.bbox)
    trim()  # returns the volume of the last slab
    mesh = keep_components(mesh, keep=options.keep)
    pixels = None
    if options.by_evidence:
        mesh, pixels = clean(mesh, spool, limits.truncation)
    mesh = simplify(mesh, error=options.error, cameras=spool.cameras)
    return Extraction(mesh, limits, len(spool), volume_bytes, 1, backend.name, pixels)


def spooled(frames: Iterable[RenderedView], threads: int | None) -> tuple[Spool, list[DepthSample]]:
    """Store depth maps and sample their pixels: fewer of each if there are many, so that their total is bounded.

    Then sets the number of threads of the native library (default: all cores), which rendering may change.
    """
    spool = Spool(frames)
    load().use_threads(threads or os.cpu_count() or 1)
    count = min(SAMPLES_A_MAP, max(FEWEST_SAMPLES, SAMPLES // max(len(spool), 1)))
    return spool, [sample_depths(item, count) for item in spool]


def bounds_of(spool: Spool, samples: Sequence[DepthSample], options: ExtractOptions) -> FusionBounds:
    """Derive the limits of the fusion; the truncation grows with the disagreement of the depth maps."""
    limits = derive_limits(samples, spool.cameras, **options.limits)
    return widen_truncation(limits, None if options.truncation else depth_noise(spool, samples, limits))


def fused_depths(spool: Spool, limits: FusionBounds, options: ExtractOptions, backend: Backend) -> tuple[Mesh, int]:
    """Return the surface of all components in the fused volume, and the bytes of the volume."""
    trim()  # returns 20 to 60 MB before the volume is allocated
    blocks = find_blocks(spool, limits, max_bytes=options.max_bytes)
    mesh = fused_surface(
        spool,
        limits,
        blocks,
        min_weight=options.min_weight,
        slab_bytes=options.slab_bytes,
        backend=backend,
    )
    return mesh, blocks.nbytes
