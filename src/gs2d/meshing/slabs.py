"""Fuse and extract a volume slab by slab, with only one slab in memory.

Blocks are fused independently, and their keys are ordered in layers along x, so a slab is a range of keys. The cells of
its last layer need the first voxels of the next layer, which is fused twice. Vertices on the plane between two slabs
have the same index and value in both, so the mesh is byte-identical to that of the whole volume.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from gs2d.core.mesh import Mesh
from gs2d.meshing.depth_maps import DepthMap
from gs2d.meshing.fusion_bounds import FusionBounds
from gs2d.meshing.marching_cubes import EDGES_OF_BLOCK, cell_surface, edge_vertices
from gs2d.meshing.tsdf_volume import VolumeBlocks, block_bytes, fuse_blocks
from gs2d.render.backends import Backend

SLAB_BYTES = 192 << 20  # smaller slabs prepare views more often, larger ones raise the peak memory


def fused_surface(
    frames: Iterable[DepthMap],
    limits: FusionBounds,
    blocks: VolumeBlocks,
    *,
    min_weight: float = 1.0,
    slab_bytes: int = SLAB_BYTES,
    backend: str | Backend = "auto",
) -> Mesh:
    """Fuse depth maps and extract their surface, without the whole volume in memory.

    ``frames`` are read once for each slab: a sequence or a ``Spool``. ``blocks`` are from ``find_blocks``;
    ``min_weight`` as of ``cell_surface``, the backend as of ``fuse_blocks``. ``slab_bytes`` is exceeded only if a
    single layer of blocks and the next one do not fit.
    """
    edges: list[np.ndarray] = []
    vertices: list[np.ndarray] = []
    colors: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    before = 0  # number of vertices of the earlier slabs
    for start, own, stop in slabs(blocks, slab_bytes):
        volume = fuse_blocks(frames, limits, blocks.part(start, stop), backend=backend)
        slab_edges, corners, ends = cell_surface(volume, min_weight, own - start)
        points, tints = edge_vertices(volume, slab_edges, ends)
        del volume
        edges.append(slab_edges + start * EDGES_OF_BLOCK)
        vertices.append(points)
        colors += [] if tints is None else [tints]
        faces.append(corners + before)
        before += len(points)
    if len(edges) == 1:
        return Mesh(vertices[0], faces[0].astype(np.int32), colors[0] if colors else None)
    _, first, number = np.unique(np.concatenate(edges), return_index=True, return_inverse=True)
    tinted = np.concatenate(colors)[first] if colors else None
    return Mesh(np.concatenate(vertices)[first], number.astype(np.int32)[np.concatenate(faces)], tinted)


def slabs(blocks: VolumeBlocks, slab_bytes: int) -> Iterator[tuple[int, int, int]]:
    """Yield (start, own, stop) of slabs: blocks from ``start`` to ``own`` create surface, the rest is only read."""
    layer = blocks.keys // (blocks.dims[1] * blocks.dims[2])
    starts = np.searchsorted(layer, np.arange(blocks.dims[0] + 2))  # first block of each layer
    most = slab_bytes // block_bytes(blocks.colored)
    first = 0
    while first < blocks.dims[0]:
        last = first + 1  # the layer after the slab
        while last < blocks.dims[0] and starts[last + 2] - starts[first] <= most:
            last += 1
        if starts[last] > starts[first]:
            yield int(starts[first]), int(starts[last]), int(starts[last + 1])
        first = last
