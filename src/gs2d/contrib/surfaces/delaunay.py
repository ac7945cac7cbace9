"""Extract a mesh from depth maps by Delaunay tetrahedra and a minimum cut.

The method is that of Labatut, Pons and Keriven (2009). Oriented points are the corners of tetrahedra, lines of sight
vote whether each tetrahedron is inside or outside, and the surface is the minimum cut between both. Most points are
vertices of the fused volume, which are more accurate than single depth maps; the cut selects those on the surface.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_erosion
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gs2d.contrib.surfaces.oriented_points import (
    PIXELS_APART,
    OrientedPoints,
    merge_pixels,
    merge_vertices,
    settle,
    sight_lines,
)
from gs2d.core.memory import trim
from gs2d.core.mesh import Mesh
from gs2d.errors import ProtocolError
from gs2d.kernels.library import Library, load
from gs2d.meshing.depth_maps import RenderedView, Spool
from gs2d.meshing.evidence import clean
from gs2d.meshing.extract import Extraction, ExtractOptions, bounds_of, fused_depths, spooled
from gs2d.meshing.fusion_bounds import FusionBounds, backproject
from gs2d.meshing.marching_cubes import inside_box, keep_components, select_faces
from gs2d.meshing.mesh_methods import register_mesh_method
from gs2d.meshing.minimum_cut import Lines, cast_votes, outside
from gs2d.meshing.simplify import simplify
from gs2d.meshing.tetrahedra import FACES, Tetrahedra, divide
from gs2d.meshing.tsdf_volume import fusion_backend
from gs2d.render.backends import Backend

BYTES_A_POINT = 2500  # peak memory of tetrahedra, votes and cut
LEAST_POINTS = 8
LINES_A_POINT = 6  # lines of sight; 12 give the same surface in twice the time
LONG = 20.0  # spacings: an open surface has no longer edges; 10 leaves holes in walls, 40 frays at outlines
SMALL = 0.002  # fraction of the area of the largest component: the cut leaves few fragments, but separates objects
STEP = 8  # px between lines of sight that go past the scene
EDGE = 3  # px: the outline of the scene is uncertain
BEYOND = 0.75  # largest distance of the ends of these lines from the box centre, as a fraction of its diagonal
TAUBIN = (0.5, -0.53)  # smoothing steps: shrink and grow (Taubin 1995)
TAUBIN_ROUNDS = 2


@register_mesh_method("delaunay", closes=True)
def extract_delaunay(
    frames: Iterable[RenderedView],
    options: ExtractOptions = ExtractOptions(),  # noqa: B008 (frozen)
    *,
    threads: int | None = None,
    backend: str | Backend = "auto",
) -> Extraction:
    """Extract a mesh from depth maps as the minimum cut of tetrahedra.

    Parameters and errors are those of ``extract``, but ``voxel`` is also half the distance of the points, ``max_bytes``
    limits their number, and a ProtocolError is raised if there are fewer than two views or no surface is visible in two
    of them. ``volume_bytes`` of the result includes the tetrahedra.
    """
    backend = fusion_backend(backend)
    spool, samples = spooled(frames, threads)
    if len(spool) < 2:
        raise ProtocolError(f"a mesh by Delaunay needs two or more views, got {len(spool)}; use --method tsdf")
    limits = bounds_of(spool, samples, options)
    del samples
    fused, volume_bytes = fused_depths(spool, limits, options, backend)
    points = _points(fused, spool, limits, options)
    del fused
    trim()
    library = load()
    space, lines = _sight(points, spool, limits, library)
    votes = cast_votes(space, lines, library)
    del lines
    out = outside(space, votes, library, closed=options.watertight, spacing=points.spacing)
    del votes
    mesh = _surface(space, points, out, closed=options.watertight)
    del space, out
    trim()
    mesh = _taubin(mesh)
    pixels = None
    if not options.watertight:
        mesh = mesh if options.bbox is None else inside_box(mesh, options.bbox)
        if options.by_evidence:
            mesh, pixels = clean(mesh, spool, limits.truncation, small=SMALL)
    mesh = keep_components(mesh, keep=options.keep)
    mesh = simplify(mesh, error=options.error, cameras=spool.cameras)
    volume_bytes = max(volume_bytes, BYTES_A_POINT * len(points.xyz))
    return Extraction(mesh, limits, len(spool), volume_bytes, 1, backend.name, pixels)


def _points(fused: Mesh, spool: Spool, limits: FusionBounds, options: ExtractOptions) -> OrientedPoints:
    """Return points of the fused surface, and merged pixels elsewhere; farther apart if memory requires it."""
    apart = PIXELS_APART if options.voxel is None else 2 * options.voxel / limits.pixel_footprint
    most = max(options.max_bytes // BYTES_A_POINT, LEAST_POINTS)
    while True:
        points = settle(merge_vertices(fused, spool.cameras, limits, apart=apart), spool, limits, rounds=0)
        others = merge_pixels(spool, limits, apart=apart).apart_from(points)
        if len(points.xyz) + len(others.xyz) <= most:
            break
        apart *= max(np.sqrt((len(points.xyz) + len(others.xyz)) / most), 1.1)
    points = points.joined(settle(others, spool, limits))
    if len(points.xyz) < LEAST_POINTS:
        raise ProtocolError(
            f"expected surface visible in two or more views, got {len(points.xyz)} points; check the box and cameras"
        )
    return points


def _sight(points: OrientedPoints, spool: Spool, limits: FusionBounds, library: Library) -> tuple[Tetrahedra, Lines]:
    """Return tetrahedra of the points and of points beyond the scene, and the lines of sight to both."""
    centers = np.array([camera.center for camera in spool.cameras])
    rows, cameras, weights = sight_lines(points, spool, limits, most=LINES_A_POINT)
    past, past_cameras = _beyond(spool, limits)
    space = divide(np.concatenate([points.xyz, past]), centers, library)
    sigma = np.maximum(points.spread, points.spacing)[rows]
    lines = Lines(
        np.concatenate([rows, len(points.xyz) + np.arange(len(past))]).astype(np.int32),
        np.concatenate([centers[cameras], centers[past_cameras]]),
        np.concatenate([sigma, np.full(len(past), limits.voxel)]),
        np.concatenate([weights, np.ones(len(past))]),
        len(rows),
    )
    return space, lines


def _beyond(spool: Spool, limits: FusionBounds) -> tuple[np.ndarray, np.ndarray]:
    """Return points [S, 3] in free space or beyond the box, on rays past the scene, and their cameras [S]."""
    lower, upper = np.asarray(limits.lower), np.asarray(limits.upper)
    middle, radius = (lower + upper) / 2, BEYOND * float(np.linalg.norm(upper - lower))
    points, cameras = [np.zeros((0, 3))], [np.zeros(0, np.int64)]
    for number, item in enumerate(spool):
        camera = item.camera
        rows, columns = np.indices(item.depth.shape).reshape(2, -1)
        finite = np.where(np.isfinite(item.depth), item.depth, 0)
        xyz = backproject(camera, finite.ravel().astype(np.float64), rows, columns)
        within = ((xyz >= lower) & (xyz <= upper)).all(axis=1).reshape(item.depth.shape)
        past = np.isinf(item.depth) | (item.depth > 0) & ~within
        past = binary_erosion(past, iterations=EDGE, border_value=1)
        rows, columns = (k * STEP + STEP // 2 for k in np.nonzero(past[STEP // 2 :: STEP, STEP // 2 :: STEP]))
        ray = backproject(camera, np.ones(len(rows)), rows, columns) - camera.center
        length = np.linalg.norm(ray, axis=1)
        ray /= length[:, None]
        away = camera.center - middle
        along, inside = ray @ away, radius**2 - away @ away
        if inside <= 0:
            continue  # the camera is farther away than the ends of the lines
        far = np.minimum(np.sqrt(along**2 + inside) - along, item.depth[rows, columns] * length)
        points.append(camera.center + far[:, None] * ray)
        cameras.append(np.full(len(rows), number))
    return np.concatenate(points), np.concatenate(cameras)


def _surface(space: Tetrahedra, points: OrientedPoints, out: np.ndarray, *, closed: bool) -> Mesh:
    """Return the facets between inside and outside, counter-clockwise from outside.

    An open surface has no facets with long edges, which close invisible regions, and none whose points are visible from
    the other side, which are the back of a wall. A closed one has no edges with more than two faces.
    """
    out = _without_touching_edges(space, out) if closed else out
    inner, facet = np.nonzero(~out[:, None] & (space.neighbours >= 0) & out[space.neighbours])
    faces = np.take_along_axis(space.corners[inner], FACES[facet], 1)[:, [0, 2, 1]]
    count = len(points.xyz)
    if not closed:
        faces = faces[(faces < count).all(axis=1)]
        corners = points.xyz[faces]
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        front = ((points.normals[faces] * normal[:, None]).sum(axis=2) > 0).sum(axis=1) >= 2
        faces = faces[front & (edges <= LONG * points.spacing[faces].max(axis=1))]
    vertices = np.concatenate([points.xyz, space.xyz[count:]])
    colors = None
    if points.colors is not None:
        colors = np.concatenate([points.colors, np.full((len(vertices) - count, 3), 128, np.uint8)])
    return _split(Mesh(vertices, faces.astype(np.int32), colors))


def _without_touching_edges(space: Tetrahedra, out: np.ndarray) -> np.ndarray:
    """Fill tetrahedra outside at edges with more than two faces of the surface, until there are none."""
    out = out.copy()
    count = len(space.xyz)
    while True:
        inner, facet = np.nonzero(~out[:, None] & (space.neighbours >= 0) & out[space.neighbours])
        faces = np.take_along_axis(space.corners[inner], FACES[facet], 1)
        keys, uses = np.unique(_edges(faces, ((0, 1), (1, 2), (2, 0)), count), return_counts=True)
        touching = keys[uses > 2]
        if not len(touching):
            return out
        ends = np.zeros(count, bool)
        ends[np.concatenate([touching // count, touching % count])] = True
        near = np.flatnonzero(out & (ends[space.corners].sum(axis=1) >= 2))
        pairs = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
        edges = _edges(space.corners[near], pairs, count).reshape(len(pairs), -1)
        out[near[np.isin(edges, touching).any(axis=0)]] = False


def _edges(corners: np.ndarray, pairs: tuple[tuple[int, int], ...], count: int) -> np.ndarray:
    """Return keys of edges, one pair of columns after the other: smaller end times ``count`` plus larger end."""
    ends = [corners[:, pair].astype(np.int64) for pair in pairs]
    return np.concatenate([end.min(axis=1) * count + end.max(axis=1) for end in ends])


def _split(mesh: Mesh) -> Mesh:
    """Give each fan of faces at a vertex a vertex of its own, and drop vertices without faces."""
    faces, corners = mesh.faces, np.arange(mesh.faces.size).reshape(-1, 3)
    if not len(faces):
        return select_faces(mesh, np.zeros(0, bool))
    keys = _edges(faces, ((0, 1), (1, 2), (2, 0)), len(mesh.vertices))
    # corners at the smaller and the larger end of each edge
    ends = np.concatenate(
        [np.take_along_axis(corners[:, p], np.argsort(faces[:, p], axis=1), 1) for p in ([0, 1], [1, 2], [2, 0])]
    )
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    first, second = ends[order[same]], ends[order[same + 1]]
    links = (first.ravel(), second.ravel())
    graph = coo_array((np.ones(len(links[0]), bool), links), shape=(faces.size, faces.size))
    count, label = connected_components(graph, directed=False)
    origin = np.empty(count, np.int64)
    origin[label] = faces.ravel()
    colors = None if mesh.colors is None else mesh.colors[origin]
    return Mesh(mesh.vertices[origin].astype(np.float32), label.reshape(-1, 3).astype(np.int32), colors)


def _taubin(mesh: Mesh) -> Mesh:
    """Smooth a mesh without shrinking it; vertices at borders move along with it."""
    faces, count = mesh.faces, len(mesh.vertices)
    tails = np.concatenate([faces[:, 0], faces[:, 1], faces[:, 2], faces[:, 1], faces[:, 2], faces[:, 0]])
    heads = np.concatenate([faces[:, 1], faces[:, 2], faces[:, 0], faces[:, 0], faces[:, 1], faces[:, 2]])
    graph = coo_array((np.ones(len(tails)), (tails, heads)), shape=(count, count)).tocsr()
    graph.data[:] = 1
    degree = np.maximum(np.asarray(graph.sum(axis=1)).reshape(-1, 1), 1)
    vertices = mesh.vertices.astype(np.float64)
    for step in TAUBIN * TAUBIN_ROUNDS:
        vertices = vertices + step * (graph @ vertices / degree - vertices)
    return replace(mesh, vertices=vertices.astype(np.float32))
