"""Fuse unbounded scenes into nested levels of increasing voxel size, and extract one mesh without gaps.

Each level is a separate volume. Between two levels, the cells of marching cubes are those of the dual grid: each corner
of a fine voxel on the border is surrounded by eight voxels, fine ones inside and coarse ones outside, of which some
occur several times. Such a cell is a cube with some edges of length zero, so the table of cases is valid, faces of
neighbouring cells have the same four voxels, and a vertex is identified by the two voxels it lies between. The mesh is
therefore as closed as within a level. (Dual marching cubes on an octree: Schaefer and Warren 2004.)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.memory import trim
from gs2d.core.mesh import Mesh
from gs2d.errors import ProtocolError
from gs2d.meshing.consistency import depth_noise
from gs2d.meshing.depth_maps import DepthMap, RenderedView
from gs2d.meshing.extract import Extraction, ExtractOptions, spooled
from gs2d.meshing.fusion_bounds import (
    BOX_PERCENTILES,
    DEPTH_PERCENTILE,
    FAR_FACTOR,
    MIN_VOXELS_PER_TRUNCATION,
    DepthSample,
    FusionBounds,
    backproject,
    check_positive,
    checked_box,
    widen_truncation,
)
from gs2d.meshing.marching_cubes import (
    CORNERS,
    EDGES,
    case_table,
    cell_surface,
    keep_components,
    mixed_colors,
    zero_crossing,
)
from gs2d.meshing.mesh_methods import register_mesh_method
from gs2d.meshing.sampling import DepthSampler, make_sampler
from gs2d.meshing.simplify import simplify
from gs2d.meshing.slabs import SLAB_BYTES, slabs
from gs2d.meshing.tsdf_volume import (
    BLOCK,
    VOXELS,
    Budget,
    Volume,
    VolumeBlocks,
    add_all,
    block_grid,
    check_truncation,
    fusion_backend,
    gather_keys,
    invalid_volume,
    touched_blocks,
)
from gs2d.render.backends import Backend

# -- the volumes -------------------------------------------------------------------------------------------------------
# All cubes have the same centre and the same number of voxels along a side. A level owns its cube except for the inner
# cube, so every point belongs to exactly one level, and voxels grow with the distance from the centre like the width of
# a pixel. The truncation is proportional to the voxel.
STEP = 4 * BLOCK  # the voxels along a side are a multiple, so that the middle half of a level consists of whole blocks
MAX_LEVELS = 24
PIXEL_ERROR = 0.5  # px; matching error between views, which limits how far away depth is valid


@dataclass(frozen=True)
class TsdfCascade:
    """Levels of an unbounded fusion, finest first."""

    levels: tuple[FusionBounds, ...]  # ``lower`` of a level is the centre of its first voxel
    voxels: int  # along a side of every level, a multiple of ``STEP``
    center: tuple[float, float, float]  # world units
    half: float  # half the side of the innermost cube, world units

    @property
    def dims(self) -> tuple[int, int, int]:
        """Number of blocks along x, y, z of every level."""
        return (self.voxels // BLOCK,) * 3

    @property
    def hole(self) -> tuple[int, int]:
        """Range of blocks (first, end) of the middle half of a level, along each axis."""
        return self.voxels // STEP, 3 * self.voxels // STEP

    def level_of(self, points: np.ndarray) -> np.ndarray:
        """Return the level [P] that owns each point [P, 3]; ``len(levels)`` outside all levels."""
        distance = np.abs(points - np.asarray(self.center)).max(axis=1) / self.half
        return np.clip(np.ceil(np.log2(np.maximum(distance, 1.0))), 0, len(self.levels)).astype(np.int64)

    def with_truncation(self, truncation: float, noise: float | None) -> TsdfCascade:
        """Return a copy with another truncation of the innermost level, and proportional ones of the others."""
        levels = tuple(
            replace(level, truncation=truncation * 2**k, depth_noise=noise) for k, level in enumerate(self.levels)
        )
        return replace(self, levels=levels)


def derive_cascade(
    samples: Sequence[DepthSample],
    cameras: Sequence[Camera],
    *,
    resolution: int = 512,
    bbox: np.ndarray | None = None,
    voxel: float | None = None,
    truncation: float | None = None,
    depth_limit: float | None = None,
) -> TsdfCascade:
    """Derive the levels of a scene from samples of all views; requested limits override derived ones.

    The innermost cube contains ``bbox`` [2, 3], or the 1st to 99th percentile of the nearer half of the points. Its
    side has ``resolution`` voxels, not finer than half the median pixel of the nearer half; ``voxel`` and
    ``truncation`` (world units) are those of this level. The outermost contains all points up to the depth limit: 1.25
    times the 99.5th percentile of depth, but not beyond the depth whose uncertainty equals the truncation
    (``valid_depth``), where sky and textureless walls create false surfaces. Raises ProtocolError if no pixel has a
    depth, or a requested limit is invalid.
    """
    xyz = np.concatenate([s.points for s in samples]) if samples else np.zeros((0, 3))
    depths = np.concatenate([s.depths for s in samples]) if samples else np.zeros(0)
    if not len(depths):
        raise ProtocolError("expected depth maps with valid pixels, got none; is the scene empty?")
    check_positive(voxel=voxel, truncation=truncation, depth_limit=depth_limit, resolution=resolution)
    footprints = np.concatenate([s.footprints for s in samples])
    median, high = float(np.median(depths)), float(np.percentile(depths, DEPTH_PERCENTILE))
    near = depths <= median
    footprint = float(np.median(footprints[near]))
    lower, upper = np.percentile(xyz[near], BOX_PERCENTILES, axis=0) if bbox is None else checked_box(bbox)
    side = float((upper - lower).max())
    if not side > 0:
        raise ProtocolError("expected depth maps of several points, got a single point; set a bbox")
    size = voxel if voxel is not None else max(side / resolution, 0.5 * footprint)
    voxels = max(1, int(np.ceil(side / size / STEP - 1e-9))) * STEP
    half, center = 0.5 * voxels * size, (lower + upper) / 2
    band = truncation if truncation is not None else MIN_VOXELS_PER_TRUNCATION * size
    limit = depth_limit
    if limit is None:
        limit = min(high * 1.25, max(valid_depth(cameras, band / half), FAR_FACTOR * median))
    within = depths <= limit
    if not within.any():
        raise ProtocolError(f"depth_limit must exceed the nearest depth, {depths.min():.4g} world units, got {limit:g}")
    reach = float(np.abs(xyz[within] - center).max()) / half
    count = min(MAX_LEVELS, 1 + int(np.ceil(np.log2(max(reach, 1.0)))))
    levels = []
    for k in range(count):
        first = center - half * 2**k + 0.5 * size * 2**k
        last = center + half * 2**k
        levels.append(
            FusionBounds(
                lower=(float(first[0]), float(first[1]), float(first[2])),
                upper=(float(last[0]), float(last[1]), float(last[2])),
                side=2 * half * 2**k,
                voxel=float(size * 2**k),
                truncation=float(band * 2**k),
                depth_limit=float(limit),
                depth_median=median,
                depth_high=high,
                pixel_footprint=footprint,
                cut_fraction=float(1 - within.mean()),
            )
        )
    middle = (float(center[0]), float(center[1]), float(center[2]))
    return TsdfCascade(tuple(levels), voxels, middle, float(half))


def valid_depth(cameras: Sequence[Camera], band: float) -> float:
    """Return the depth, in world units, at which the depth uncertainty equals the truncation.

    A point at depth z with baseline b and focal length f has a depth uncertainty of e z^2 / (b f), where e is the
    matching error in px; the truncation there is ``band`` z. So z = band b f / e. The baseline is twice the median
    distance of the cameras from their mean. Infinite if all cameras have the same centre.
    """
    centers = np.array([camera.center for camera in cameras])
    baseline = 2 * float(np.median(np.linalg.norm(centers - centers.mean(axis=0), axis=1)))
    focal = float(np.median([np.sqrt(camera.fx * camera.fy) for camera in cameras]))
    return band * baseline * focal / PIXEL_ERROR if baseline > 0 else float("inf")


# -- the surface -------------------------------------------------------------------------------------------------------
FAR_VIEWS = 5.0  # smallest weight of valid voxels outside the innermost level: few views agree on a false sky depth


def find_cascade_blocks(
    frames: Iterable[DepthMap],
    cascade: TsdfCascade,
    *,
    max_bytes: int = 4 << 30,
) -> tuple[VolumeBlocks, ...]:
    """Find the blocks of each level; parameters and errors as for ``find_blocks``, with a common memory limit."""
    check_truncation(cascade.levels[0])
    block_grid(cascade.levels[0])  # refuses voxels that are too small
    budget = Budget(cascade.levels[0], max_bytes, side=2 * cascade.half, step=STEP)
    keys, colored = gather_keys(frames, lambda item: _touched(item, cascade), budget)
    return tuple(VolumeBlocks(cascade.dims, level, colored) for level in keys)


def _empty(blocks: VolumeBlocks, limits: FusionBounds) -> Volume:
    return invalid_volume(limits, blocks.dims, blocks.keys, colored=blocks.colored)


def _fuse_into(
    volumes: Sequence[Volume],
    frames: Iterable[DepthMap],
    cascade: TsdfCascade,
    backend: str | Backend,
) -> None:
    """Add all views to volumes of some levels."""

    def prepare(item: DepthMap) -> DepthSampler:
        return make_sampler(item, cascade.levels[0], truncation=_truncations(item, cascade))

    add_all(volumes, frames, prepare, backend=backend)


def _distances(item: DepthMap, cascade: TsdfCascade) -> np.ndarray:
    """Return the largest coordinate [H, W] of pixels' points from the centre, in units of ``half``; 0 if invalid."""
    rows, columns = np.nonzero((item.depth > 0) & np.isfinite(item.depth))
    points = backproject(item.camera, item.depth[rows, columns].astype(np.float64), rows, columns)
    distance = np.zeros(item.depth.shape)
    distance[rows, columns] = np.abs(points - np.asarray(cascade.center)).max(axis=1) / cascade.half
    return distance


def _truncations(item: DepthMap, cascade: TsdfCascade) -> np.ndarray:
    """Return the truncation [H, W] world units of the level that owns each pixel's point."""
    level = np.ceil(np.log2(np.maximum(_distances(item, cascade), 1.0)))
    return cascade.levels[0].truncation * np.exp2(np.minimum(level, len(cascade.levels) - 1))


def _touched(item: DepthMap, cascade: TsdfCascade) -> list[np.ndarray]:
    """Return the keys of each level's own blocks near the surface of a depth map."""
    distance = _distances(item, cascade)
    first, last = cascade.hole
    touched = []
    for k, limits in enumerate(cascade.levels):
        # points outside the level whose truncation band may reach into it
        margin = (3 * limits.truncation + 2 * BLOCK * limits.voxel) / cascade.half
        inner = 2.0 ** (k - 1) if k else 0.0
        near = (distance > inner - margin) & (distance < 2.0**k + margin)
        part = replace(item, depth=np.where(near, item.depth, np.float32(0)))
        # one more block on every side, because points just outside the level touch its border blocks
        step = BLOCK * limits.voxel
        lower = (limits.lower[0] - step, limits.lower[1] - step, limits.lower[2] - step)
        dims = (cascade.dims[0] + 2,) * 3
        keys = touched_blocks(part, replace(limits, lower=lower), dims)
        blocks = np.stack(np.unravel_index(keys, dims), axis=1) - 1
        blocks = blocks[((blocks >= 0) & (blocks < cascade.dims[0])).all(axis=1)]
        if k:
            blocks = blocks[~((blocks >= first) & (blocks < last)).all(axis=1)]
        touched.append((blocks[:, 0] * cascade.dims[1] + blocks[:, 1]) * cascade.dims[2] + blocks[:, 2])
    return touched


@dataclass(frozen=True, eq=False)
class _Nodes:
    """The voxels of several levels with a common numbering: offset of the level + 512 * row + voxel."""

    volumes: Sequence[Volume]
    min_weights: Sequence[float]

    @property
    def offsets(self) -> np.ndarray:
        return np.concatenate([[0], np.cumsum([len(v.keys) * VOXELS for v in self.volumes])])

    def _by_level(self, ids: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Yield each level, where ``ids`` are its nodes, and the numbers of these nodes in it."""
        offsets = self.offsets
        for k in range(len(self.volumes)):
            here = (ids >= offsets[k]) & (ids < offsets[k + 1])
            yield k, here, ids[here] - offsets[k]

    def gather(self, arrays: Sequence[np.ndarray], ids: np.ndarray) -> np.ndarray:
        """Return ``arrays`` [M, 512, ...] of the levels at the nodes ``ids`` [...]."""
        tail = arrays[0].shape[2:]
        out = np.zeros((*ids.shape, *tail), arrays[0].dtype)
        for k, here, local in self._by_level(ids):
            out[here] = arrays[k].reshape(-1, *tail)[local]
        return out

    def distances(self, ids: np.ndarray) -> np.ndarray:
        """Return signed distances in world units, because truncations differ between levels."""
        out = self.gather([volume.tsdf for volume in self.volumes], ids)
        for k, here, _ in self._by_level(ids):
            out[here] *= np.float32(self.volumes[k].limits.truncation)
        return out

    def valid(self, ids: np.ndarray) -> np.ndarray:
        """Return whether voxels have enough weight to be valid."""
        out = np.zeros(ids.shape, bool)
        for k, here, local in self._by_level(ids):
            out[here] = self.volumes[k].weight.reshape(-1)[local] >= max(self.min_weights[k], 1e-12)
        return out

    def positions(self, ids: np.ndarray) -> np.ndarray:
        """Return the world points [P, 3] of nodes [P]."""
        out = np.zeros((*ids.shape, 3))
        for k, here, local in self._by_level(ids):
            volume = self.volumes[k]
            within = np.stack(np.unravel_index(local % VOXELS, (BLOCK,) * 3), axis=-1)
            grid = volume.blocks[local // VOXELS] * BLOCK + within
            out[here] = np.asarray(volume.limits.lower) + grid * volume.limits.voxel
        return out


def fused_cascade_surface(
    frames: Iterable[DepthMap],
    cascade: TsdfCascade,
    blocks: Sequence[VolumeBlocks],
    *,
    min_weight: float = 1.0,
    far_weight: float,
    slab_bytes: int = SLAB_BYTES,
    backend: str | Backend = "auto",
) -> Mesh:
    """Fuse depth maps into all levels, and extract the zero level set as one mesh.

    Levels are fused slab by slab (``slabs``), several small slabs at a time; the mesh does not depend on their size.
    Blocks at the border between two levels stay in memory until both are finished. ``frames`` are read once for each
    batch of slabs: a sequence or a ``Spool``. ``blocks`` of each level are from ``find_cascade_blocks``. ``min_weight``
    and ``far_weight`` are the smallest weights of valid voxels in the innermost level, and in all others.
    """
    surface = CascadeSurface(cascade, [len(part.keys) for part in blocks], min_weight, far_weight)
    for level, part in enumerate(blocks):
        if not len(part.keys):
            surface.add(_empty(part, cascade.levels[level]), level, 0, 0)
    for slabs_at_once in _batches(blocks, slab_bytes):
        volumes = [_empty(blocks[k].part(start, stop), cascade.levels[k]) for k, start, _, stop in slabs_at_once]
        _fuse_into(volumes, frames, cascade, backend)
        for (level, start, own, _), volume in zip(slabs_at_once, volumes, strict=True):
            surface.add(volume, level, start, own - start)
        volumes.clear()
        del volume
    return surface.mesh()


def _batches(blocks: Sequence[VolumeBlocks], slab_bytes: int) -> Iterator[list[tuple[int, int, int, int]]]:
    """Yield batches of slabs (level, and start, own, stop of ``slabs``) in order, as many as fit."""
    batch: list[tuple[int, int, int, int]] = []
    held = 0
    for level, part in enumerate(blocks):
        for start, own, stop in slabs(part, slab_bytes):
            size = part.part(start, stop).nbytes
            if batch and held + size > slab_bytes:
                yield batch
                batch, held = [], 0
            batch.append((level, start, own, stop))
            held += size
    if batch:
        yield batch


class CascadeSurface:
    """Collect the surface of levels that are processed in parts. Nodes are numbered over all levels (``_Nodes``)."""

    def __init__(self, cascade: TsdfCascade, counts: Sequence[int], min_weight: float, far_weight: float) -> None:
        self._cascade = cascade
        self._min_weights = [min_weight if k == 0 else max(min_weight, far_weight) for k in range(len(counts))]
        self._offsets = np.concatenate([[0], np.cumsum([count * VOXELS for count in counts])])
        self._border: list[list[tuple[Volume, np.ndarray]]] = [[] for _ in counts]  # border blocks, and their rows
        self._pairs = [np.zeros((0, 2), np.int64)]
        self._triangles = [np.zeros((0, 3), np.int64)]
        self._vertices = [np.zeros((0, 3), np.float32)]
        self._colors: list[np.ndarray] = []
        self._count = 0

    def add(self, volume: Volume, level: int, start: int, own: int) -> None:
        """Add the cells of the first ``own`` blocks of a part that starts at block ``start`` of its level."""
        edges, faces, ends = cell_surface(volume, self._min_weights[level], own)
        pairs = np.stack([edges // 3, ends], axis=1)
        nodes = _Nodes([volume], [self._min_weights[level]])
        self._append(nodes, pairs, pairs + (self._offsets[level] + start * VOXELS), faces)
        rows = np.flatnonzero(self._at_joins(volume.blocks[:own]))
        self._border[level].append((_rows_of(volume, rows), rows + start))

    def _append(self, nodes: _Nodes, local: np.ndarray, pairs: np.ndarray, faces: np.ndarray) -> None:
        vertices, colors = _vertices(nodes, local[:, 0], local[:, 1])
        self._pairs.append(pairs)
        self._triangles.append(faces + self._count)
        self._vertices.append(vertices)
        self._colors += [] if colors is None else [colors]
        self._count += len(pairs)

    def _at_joins(self, blocks: np.ndarray) -> np.ndarray:
        """Return which blocks [M, 3] are at the outer border of a level, or around the hole in it."""
        first, last = self._cascade.hole
        outermost = ((blocks == 0) | (blocks == np.asarray(self._cascade.dims) - 1)).any(axis=1)
        return np.asarray(outermost | ((blocks >= first - 1) & (blocks <= last)).all(axis=1))

    def mesh(self) -> Mesh:
        """Connect the levels, and return the mesh."""
        levels = [_joined_level(parts) for parts in self._border]
        for k in range(len(levels) - 1):
            volumes, rows = zip(*levels[k : k + 2], strict=True)
            nodes = _Nodes(volumes, self._min_weights[k : k + 2])
            inner, outer = nodes.offsets[:2]
            cells = _join_cells(volumes[0], volumes[1], self._cascade, inner, outer)
            local = _join_triangles(nodes, cells).reshape(-1, 2)
            numbers = [
                (self._offsets[k + i] + level_rows[:, None] * VOXELS + np.arange(VOXELS)).reshape(-1)
                for i, level_rows in enumerate(rows)
            ]
            corners = np.arange(len(local)).reshape(-1, 3)
            self._append(nodes, local, np.concatenate(numbers)[local], corners)
        both = np.concatenate(self._pairs)
        # a vertex is identified by its pair of nodes, which is the same in all adjacent cells
        flat = both[:, 0] * int(self._offsets[-1] + 1) + both[:, 1]
        _, first, number = np.unique(flat, return_index=True, return_inverse=True)
        faces = number.reshape(-1)[np.concatenate(self._triangles)]
        a, b, c = faces.T
        faces = faces[(a != b) & (b != c) & (c != a)]  # cells between levels have edges of length zero
        colors = np.concatenate(self._colors)[first] if self._colors else None
        return Mesh(np.concatenate(self._vertices)[first], faces.astype(np.int32), colors)


ARRAYS = ("keys", "tsdf", "weight", "color", "color_weight")  # fields of a volume, a row per block; colours may be None


def _rows_of(volume: Volume, rows: np.ndarray) -> Volume:
    """Return some blocks of a volume."""
    arrays = {name: getattr(volume, name) for name in ARRAYS}
    some: dict[str, Any] = {name: None if array is None else array[rows] for name, array in arrays.items()}
    return replace(volume, **some)


def _joined_level(parts: Sequence[tuple[Volume, np.ndarray]]) -> tuple[Volume, np.ndarray]:
    """Merge the border blocks of a level into one volume; also return their rows in the level."""
    whole = parts[0][0]
    there = [name for name in ARRAYS if getattr(whole, name) is not None]
    every: dict[str, Any] = {name: np.concatenate([getattr(volume, name) for volume, _ in parts]) for name in there}
    return replace(whole, **every), np.concatenate([rows for _, rows in parts])


def _vertices(nodes: _Nodes, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the positions [P, 3] of the zero crossings between nodes, and their colours."""
    t = zero_crossing(nodes.distances(low), nodes.distances(high))
    start = nodes.positions(low)
    vertices = (start + t[:, None].astype(np.float64) * (nodes.positions(high) - start)).astype(np.float32)
    colors = [volume.color for volume in nodes.volumes if volume.color is not None]
    weights = [volume.color_weight for volume in nodes.volumes if volume.color_weight is not None]
    if not colors:
        return vertices, None
    has = [nodes.gather(weights, ids) > 0 for ids in (low, high)]
    return vertices, mixed_colors(t, nodes.gather(colors, low), nodes.gather(colors, high), *has)


def _join_cells(inner: Volume, outer: Volume, cascade: TsdfCascade, inner_offset: int, outer_offset: int) -> np.ndarray:
    """Return the nodes [C, 8] of the cells across the border of a level, if all eight voxels exist."""
    n = cascade.voxels
    local = np.stack(np.unravel_index(np.arange(VOXELS), (BLOCK,) * 3), axis=1)
    corners = [np.zeros(0, np.int64)]
    for axis in range(3):
        for side, layer in ((0, 0), (1, BLOCK - 1)):
            blocks = inner.blocks[inner.blocks[:, axis] == side * (n // BLOCK - 1)]
            voxels = (blocks[:, None] * BLOCK + local[local[:, axis] == layer]).reshape(-1, 3)
            for shift in CORNERS[CORNERS[:, axis] == side]:  # the four corners of the voxel on the border
                corner = voxels + shift
                corners.append((corner[:, 0] * (n + 1) + corner[:, 1]) * (n + 1) + corner[:, 2])
    corner = np.stack(np.unravel_index(np.unique(np.concatenate(corners)), (n + 1,) * 3), axis=1)
    nodes = np.empty((len(corner), 8), np.int64)
    for o, octant in enumerate(CORNERS):
        voxel = corner - 1 + octant
        inside = ((voxel >= 0) & (voxel < n)).all(axis=1)
        fine = _find(inner, np.where(inside[:, None], voxel, 0))
        coarse = _find(outer, (voxel + n // 2) >> 1)
        nodes[:, o] = np.where(
            inside, np.where(fine < 0, -1, fine + inner_offset), np.where(coarse < 0, -1, coarse + outer_offset)
        )
    return nodes[(nodes >= 0).all(axis=1)]


def _find(volume: Volume, voxels: np.ndarray) -> np.ndarray:
    """Return 512 * row + voxel of grid voxels [P, 3], -1 if their block does not exist."""
    block, at = voxels // BLOCK, voxels % BLOCK
    key = (block[:, 0] * volume.dims[1] + block[:, 1]) * volume.dims[2] + block[:, 2]
    if not len(volume.keys):
        return np.full(len(voxels), -1, np.int64)
    row = np.minimum(np.searchsorted(volume.keys, key), len(volume.keys) - 1)
    flat = row * VOXELS + (at[:, 0] * BLOCK + at[:, 1]) * BLOCK + at[:, 2]
    return np.where(volume.keys[row] == key, flat, -1)


def _join_triangles(nodes: _Nodes, cells: np.ndarray) -> np.ndarray:
    """Return triangles [T, 3, 2] of cells [C, 8]; a vertex is its pair of nodes, the smaller first."""
    cells = cells[nodes.valid(cells).all(axis=1)]
    case = ((nodes.distances(cells) < 0) << np.arange(8)).sum(axis=1)
    table = case_table()
    counts = table.starts[case + 1] - table.starts[case]
    owner = np.repeat(np.arange(len(cells)), counts)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    edges = table.edges[table.starts[case[owner]] + within]  # [T, 3] edge of the cell
    low = np.array([corner for _, corner in EDGES])[edges]
    high = low | 1 << np.array([axis for axis, _ in EDGES])[edges]
    rows = owner[:, None]
    return np.sort(np.stack([cells[rows, low], cells[rows, high]], axis=2), axis=2)


@register_mesh_method("unbounded", bounded=False)
def extract_unbounded(
    frames: Iterable[RenderedView],
    options: ExtractOptions = ExtractOptions(),  # noqa: B008 (frozen)
    *,
    threads: int | None = None,
    backend: str | Backend = "auto",
) -> Extraction:
    """Fuse depth maps of an unbounded scene into a mesh, with voxels that grow with the distance from its centre.

    Parameters and errors are those of ``extract``; ``limits`` of the result are those of the innermost level, with
    ``lower`` and ``upper`` of the outermost.
    """
    backend = fusion_backend(backend)
    spool, samples = spooled(frames, threads)
    cascade = derive_cascade(samples, spool.cameras, **options.limits)
    if options.truncation is None:
        inner = cascade.levels[0]
        # distant depths differ more, but their levels have wider truncations
        noise = depth_noise(spool, samples, replace(inner, depth_limit=min(inner.depth_median, inner.depth_limit)))
        cascade = cascade.with_truncation(widen_truncation(inner, noise).truncation, noise)
    del samples
    trim()
    blocks = find_cascade_blocks(spool, cascade, max_bytes=options.max_bytes)
    count, volume_bytes = len(spool), sum(level.nbytes for level in blocks)
    mesh = fused_cascade_surface(
        spool,
        cascade,
        blocks,
        min_weight=options.min_weight,
        far_weight=min(FAR_VIEWS, count / 2),
        slab_bytes=options.slab_bytes,
        backend=backend,
    )
    trim()
    mesh = simplify(keep_components(mesh, keep=options.keep), error=options.error, cameras=spool.cameras)
    limits = replace(cascade.levels[0], lower=cascade.levels[-1].lower, upper=cascade.levels[-1].upper)
    return Extraction(mesh, limits, count, volume_bytes, len(cascade.levels), backend.name)
