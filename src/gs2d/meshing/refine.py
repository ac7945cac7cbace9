"""Refine a mesh photometrically: vertices move along their normals until neighbouring photographs agree.

The idea is that of Vu et al. 2012, "High accuracy and visibility-consistent dense multi-view stereo". The energy is

    sum over pairs of views of sum over pixels of w (1 - NCC)
    + bending / 2 sum over vertices of A kappa^2 + tether / 2 sum over vertices of A m^2 / s^4

plus a membrane term on each step. kappa is the difference of the mean curvature from a smooth version of that of the
start, A the area of a vertex, s the size of a pixel on the surface, and m the distance that the vertex has moved. Each
step solves the Gauss-Newton system of the distances along the normals, so surface without texture follows its
surroundings. Shiny surface stays near its start, with a stronger tether and w = 0: there photographs agree on
reflections, which lie elsewhere. Formulas: docs/math.md, "Mesh refinement".
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TypeVar

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.spatial import cKDTree

from gs2d.core.camera import Camera
from gs2d.core.memory_limit import cache_bytes
from gs2d.core.mesh import Mesh
from gs2d.kernels.library import Library
from gs2d.meshing.bending import Curvature, solve, split_edges
from gs2d.meshing.depth_maps import DepthMap
from gs2d.meshing.evidence import Evidence, gather, pixels
from gs2d.meshing.fusion_bounds import backproject
from gs2d.meshing.simplify import simplify
from gs2d.meshing.texture import vertex_normals
from gs2d.meshing.warped_ncc import (
    DrawnMesh,
    GreyImage,
    MatchSettings,
    Pull,
    Surface,
    brightness_share,
    draw_mesh,
    gather_vertices,
    match_views,
)

T = TypeVar("T")
CACHE_BYTES = 1 << 29  # limit for images and depth maps in memory
BYTES_A_PIXEL = 8  # of a face and a depth; photographs have fewer
SMALL_SIDE = 100  # px, shorter side of the images in which neighbours are chosen
DEPTH_TOLERANCE = 0.05  # of the depth: tolerance of these coarse images
POINTS = 600  # of a view that compare its neighbours
SPREAD = 0.6  # standard deviation of the logarithm of good angles
LEAST_GAIN = 0.02  # of the points: a neighbour must add as much
TINY = 1e-12
REPEATED = 0.6  # a point that a perfect neighbour sees loses this fraction of its value for further ones
COARSE_SIDE = 350  # px, shorter side of the first images
LEAST_ANGLE, BEST_ANGLE, MOST_ANGLE = 4.0, 14.0, 35.0  # degrees between the rays of two views to a surface point
BENDING, MEMBRANE = 16.0, 0.01
"""Weights of the curvature, and of differences between the steps of neighbouring vertices. Independent of the size of
the scene and of the images."""
TETHER, SHINY_TETHER = 0.003, 0.03  # weight of the distance from the start, and what shiny surface adds
SMOOTH_RINGS = 6  # of neighbours: the mean of the curvature over them is kept, so bends and edges stay, noise does not
LONGEST_STEP = 1.0  # px, of a vertex
SOLVER_STEPS = 60  # iterations of the solver in a step, at most
TOLERANCE = 1e-3  # relative residual at which it stops
MATT, SHINY = 0.1, 0.2
"""Share of brightness in the differences of photographs, see ``brightness_share``: up to MATT, photographs move a
vertex, from SHINY on they do not. Its median is 0.08 on stone, 0.12 on boxes and in a room, 0.5 on metal."""
RARELY, OFTEN = 0.1, 0.3
"""Part of the pixels of a vertex that can be compared, away from outlines and seen by the neighbour: up to RARELY, a
vertex keeps nothing of its move, from OFTEN on all. Rods, wires and leaves have few of them."""
TRUST_RINGS = 24  # both are averaged over as many rings: shiny things have matt-looking spots

ReadGrey = Callable[[int, int], GreyImage]
"""Reads photograph ``index``, downscaled by an integer factor."""


@dataclass(frozen=True)
class RefineSettings:
    """How a mesh is refined."""

    # The photographs are downscaled by these, one after the other. Empty: down to a shorter side of ``COARSE_SIDE``.
    factors: tuple[int, ...] = ()
    first_steps: int = 16  # Gauss-Newton steps at the first of them, where vertices move farthest
    steps: int = 6  # at each of the others
    neighbours: int = 3  # views that each view is compared with, at most
    face_pixels: float = 1.5  # mean number of pixels of a face after simplification
    split_pixels: float = 6.0  # number of pixels of the largest faces
    match: MatchSettings = field(default_factory=MatchSettings)


@dataclass(frozen=True, eq=False)
class _Moving:
    """Vertices, and what moves with them."""

    vertices: np.ndarray  # [P, 3] float64, world units
    start: np.ndarray  # where they were
    faces: np.ndarray  # [F, 3] int32
    size: np.ndarray  # [P] float64: size of a full pixel on the surface, world units
    matt: np.ndarray  # [P] float64, from 0 to 1: factor of w: 0 on shiny surface
    kept: np.ndarray  # [P] float64, from 0 to 1: share of its move that a vertex keeps in the end

    def normals(self) -> np.ndarray:
        """Return unit normals [P, 3]."""
        return vertex_normals(Mesh(self.vertices, self.faces)).astype(np.float64)

    def split(self, limit: np.ndarray) -> _Moving:
        """Halve edges longer than ``limit`` [P]."""
        values = np.column_stack([self.start, self.size, self.matt, self.kept])
        vertices, faces, values = split_edges(self.vertices, self.faces, limit, values)
        return _Moving(vertices, values[:, :3], faces, *values[:, 3:].T)

    def settled(self) -> np.ndarray:
        """Return the final vertices [P, 3]."""
        return self.start + self.kept[:, None] * (self.vertices - self.start)


ComparedView = tuple[GreyImage, DrawnMesh, Sequence[tuple[GreyImage, np.ndarray]]]
"""A photograph, the mesh in it, and its neighbours with the depth [h, w] of the mesh."""


class Refinement:
    """A mesh under refinement, which is not changed; the cameras are those of the photographs at full size."""

    def __init__(
        self,
        mesh: Mesh,
        cameras: Sequence[Camera],
        photographs: ReadGrey,
        settings: RefineSettings,
        library: Library,
    ) -> None:
        self._mesh, self._cameras, self._photographs = mesh, list(cameras), photographs
        self._settings, self._library = settings, library
        self._factors = settings.factors or coarse_to_fine(self._cameras, COARSE_SIDE)
        self._cache_bytes = cache_bytes(CACHE_BYTES) // 3  # for photographs, for their usable pixels and for depth maps
        self._done = 0
        rounds = self._cost(self._factors[0]) + sum(self._steps(f) * self._cost(f) for f in self._factors)
        self.work = rounds * len(self._cameras)

    def _cost(self, factor: int) -> int:
        """Return the cost of a view, in views of the smallest size."""
        return (max(self._factors) // factor) ** 2

    def _steps(self, factor: int) -> int:
        return self._settings.first_steps if factor == self._factors[0] else self._settings.steps

    def run(self, on_work: Callable[[int], None]) -> Mesh:
        """Refine the mesh, which gets the colours of the nearest vertices of the input.

        ``on_work`` receives the amount of work that is done; ``work`` is the last number that it receives.
        """
        mesh = Mesh(self._mesh.vertices.astype(np.float64), self._mesh.faces)
        settings, count = self._settings, pixels(mesh, self._visibility(mesh))
        mesh = simplify(mesh, faces=int(count / settings.face_pixels), cameras=self._cameras)
        density = self._visibility(mesh).density.astype(np.float64)
        if not len(mesh.faces) or not (density > 0).any():
            return self._mesh
        density[density == 0] = np.median(density[density > 0])
        neighbours = choose_neighbours(mesh, self._cameras, settings, self._library)
        one = np.ones(len(density))
        now = _Moving(mesh.vertices, mesh.vertices, mesh.faces, 1 / np.sqrt(density), one, one)
        self._done = 0
        for factor in self._factors:
            # of an equilateral face; halves of an edge are shorter by up to 2
            now = now.split(factor * now.size * np.sqrt(2 * 4 / np.sqrt(3) * settings.split_pixels))
            now = self._at_size(now, factor, neighbours, on_work)
        vertices = now.settled().astype(self._mesh.vertices.dtype)
        colors = None
        if self._mesh.colors is not None:
            colors = self._mesh.colors[cKDTree(self._mesh.vertices).query(now.start)[1]]
        return Mesh(vertices, now.faces, colors)

    def _visibility(self, mesh: Mesh) -> Evidence:
        """Return which views see the vertices, and at how many pixels per unit of surface."""
        depths: list[float] = []
        for camera in self._cameras:
            depth = camera.project(mesh.vertices[:: max(1, len(mesh.vertices) // POINTS)])[1]
            depths.extend(depth[depth > 0])
        maps = (
            DepthMap(c, draw_mesh(mesh.vertices, mesh.faces, c, self._library).depth, None, None) for c in self._cameras
        )
        return gather(mesh, maps, self._settings.match.occluded * float(np.median(depths or [0.0])))

    def _cached(self, make: Callable[[int], T], cameras: Sequence[Camera]) -> Callable[[int], T]:
        """Cache a function of the index of a view; as many results as fit in memory."""
        largest = BYTES_A_PIXEL * max(camera.width * camera.height for camera in cameras)
        return lru_cache(max(1, self._cache_bytes // largest))(make)

    def _at_size(
        self, now: _Moving, factor: int, neighbours: Sequence[Sequence[int]], on_work: Callable[[int], None]
    ) -> _Moving:
        """Take the steps at one size of the photographs; at the first, estimate which vertices can be trusted."""
        cameras = [camera.downscaled(factor) for camera in self._cameras]
        photographs = self._cached(lambda index: self._photographs(index, factor), cameras)
        curvature = Curvature.of(now.vertices, now.faces, now.normals())
        bend = curvature.smooth(SMOOTH_RINGS)

        def views(surface: Surface) -> Iterator[ComparedView]:
            for view in self._views(surface, cameras, photographs, neighbours):
                yield view
                self._done += self._cost(factor)
                on_work(self._done)

        surface = Surface(now.vertices, now.faces, now.normals())
        if factor == self._factors[0]:
            matt, kept = self._trusted(surface, views(surface), curvature)
            now = replace(now, matt=matt, kept=kept)
        for _ in range(self._steps(factor)):
            surface = Surface(now.vertices, now.faces, now.normals())
            now = self._moved(now, factor, surface.normals, self._derivatives(surface, views(surface)), bend)
        return now

    def _views(
        self,
        surface: Surface,
        cameras: Sequence[Camera],
        photographs: Callable[[int], GreyImage],
        neighbours: Sequence[Sequence[int]],
    ) -> Iterator[ComparedView]:
        """Yield the views and their neighbours."""

        def draw(index: int) -> DrawnMesh:
            return draw_mesh(surface.vertices, surface.faces, cameras[index], self._library)

        def usable(index: int) -> GreyImage:
            photograph, inner = photographs(index), drawn(index).inner(cameras[index].fx)
            return replace(photograph, usable=inner if photograph.usable is None else inner & photograph.usable)

        drawn, images = self._cached(draw, cameras), self._cached(usable, cameras)
        for index in range(len(cameras)):
            beside = [(images(other), drawn(other).depth) for other in neighbours[index]]
            yield images(index), drawn(index), beside

    def _derivatives(self, surface: Surface, views: Iterable[ComparedView]) -> Pull:
        """Return the derivatives of all pairs."""
        match, pull = self._settings.match, Pull.zeros(len(surface.vertices))
        for image, drawn, neighbours in views:
            by_pixel = Pull.zeros(drawn.depth.shape, drawn.depth.dtype)
            for other, depth in neighbours:
                match_views(image, other, drawn.depth, depth, match, by_pixel, self._library)
            gather_vertices(surface, image.camera, drawn.face, by_pixel, pull, match, self._library)
        return pull

    def _trusted(
        self, surface: Surface, views: Iterable[ComparedView], curvature: Curvature
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return how matt the surface is at each vertex [P], and the share of its move that it keeps [P]."""
        settings, faces = self._settings, surface.faces
        sums = np.zeros((4, len(faces)))  # brightness and its weights, pixels that were compared and all pixels
        for image, drawn, neighbours in views:
            at = drawn.face >= 0
            share, weight, compared = brightness_share(image, drawn.depth, neighbours, settings.match, self._library)
            for total, values in zip(sums, (share * weight, weight, compared, at), strict=True):
                total += np.bincount(drawn.face[at], values[at], len(faces))
        bright, textured, compared, drawn_pixels = (
            curvature.spread(np.bincount(faces.ravel(), np.repeat(total, 3), len(surface.vertices)), TRUST_RINGS)
            for total in sums
        )
        shine = bright / np.maximum(textured, TINY)
        often = compared / np.maximum(drawn_pixels, TINY)
        matt = np.clip((SHINY - shine) / (SHINY - MATT), 0.0, 1.0)
        return matt, np.clip((often - RARELY) / (OFTEN - RARELY), 0.0, 1.0)

    def _moved(self, now: _Moving, factor: int, normals: np.ndarray, pull: Pull, bend: np.ndarray) -> _Moving:
        """Take one Gauss-Newton step; ``bend`` [P] is the curvature to keep."""
        size = factor * now.size
        curvature = Curvature.of(now.vertices, now.faces, normals)
        stiff = csr_array(curvature.change.T @ diags_array(BENDING * curvature.areas))
        tether = (TETHER + SHINY_TETHER * (1 - now.matt)) * curvature.areas / size**4
        offset = ((now.vertices - now.start) * normals).sum(axis=1)
        joint = diags_array(np.sqrt(MEMBRANE) / size)
        matrix = (
            stiff @ curvature.change + joint @ curvature.graph @ joint + diags_array(now.matt * pull.curvature + tether)
        )
        right = -(now.matt * pull.gradient + stiff @ (curvature.values - bend) + tether * offset)
        step = solve(csr_array(matrix), right, steps=SOLVER_STEPS, tolerance=TOLERANCE)
        longest = LONGEST_STEP * size
        return replace(now, vertices=now.vertices + normals * np.clip(step, -longest, longest)[:, None])


def coarse_to_fine(cameras: Sequence[Camera], side: int) -> tuple[int, ...]:
    """Return powers of two down to 1: the largest leaves the median photograph a shorter side of ``side`` px."""
    shorter = float(np.median([min(camera.width, camera.height) for camera in cameras] or [side]))
    return tuple(2**k for k in range(max(int(np.log2(max(shorter / side, 1.0))), 0), -1, -1))


# -- neighbours --------------------------------------------------------------------------------------------------------
def choose_neighbours(
    mesh: Mesh, cameras: Sequence[Camera], settings: RefineSettings, library: Library
) -> list[tuple[int, ...]]:
    """Return for each camera those that see its part of the mesh at good angles.

    Each further neighbour is the one with the largest sum over points of angle x foreshortening x resolution, where
    points that earlier neighbours see count less.
    """
    small = [camera.downscaled(max(1, min(camera.width, camera.height) // SMALL_SIDE)) for camera in cameras]
    drawn = [draw_mesh(mesh.vertices, mesh.faces, camera, library) for camera in small]
    neighbours = []
    for index, camera in enumerate(small):
        points, normals = _sampled(mesh, camera, drawn[index])
        rays = points - camera.center
        distance = np.linalg.norm(rays, axis=1)
        scores = np.zeros((len(small), len(points)))
        for other, there in enumerate(small):
            if other == index or not len(points):
                continue
            back = points - there.center
            length = np.linalg.norm(back, axis=1)
            cosine = (rays * back).sum(axis=1) / np.maximum(distance * length, 1e-300)
            angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
            good = _visible(points, there, drawn[other].depth)
            good &= (angle >= LEAST_ANGLE) & (angle <= MOST_ANGLE)
            facing = np.clip(-(normals * back).sum(axis=1) / np.maximum(length, 1e-300), 0, 1)
            finer = distance * there.fx / np.maximum(length * camera.fx, 1e-300)
            likely = np.exp(-0.5 * (np.log(np.maximum(angle, 1e-3) / BEST_ANGLE) / SPREAD) ** 2)
            scores[other] = np.where(good, likely * facing * np.minimum(finer, 1 / np.maximum(finer, 1e-9)), 0)
        neighbours.append(_best(scores, settings.neighbours))
    return neighbours


def _best(scores: np.ndarray, most: int) -> tuple[int, ...]:
    """Choose rows of ``scores`` [V, n] one by one."""
    chosen: list[int] = []
    value = np.ones(scores.shape[1])
    while len(chosen) < most:
        gains = scores @ value
        gains[chosen] = 0
        best = int(np.argmax(gains))
        if not gains[best] > LEAST_GAIN * scores.shape[1]:
            break
        chosen.append(best)
        value = value * (1 - REPEATED * scores[best])
    return tuple(chosen)


def _sampled(mesh: Mesh, camera: Camera, drawn: DrawnMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return surface points that a camera sees, and their unit normals, [n, 3] each."""
    rows, columns = np.nonzero(drawn.face >= 0)
    some = np.linspace(0, len(rows) - 1, min(POINTS, len(rows))).astype(np.int64)
    rows, columns = rows[some], columns[some]
    points = backproject(camera, drawn.depth[rows, columns].astype(np.float64), rows, columns)
    a, b, c = (mesh.vertices[mesh.faces[drawn.face[rows, columns], k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    return points, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def _visible(points: np.ndarray, camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Return which points a camera sees, [n] bool."""
    at, z = camera.project(points)
    inside = (z > 0) & (at >= 0).all(axis=1) & (at < (camera.width, camera.height)).all(axis=1)
    column, row = np.where(inside[:, None], at, 0).astype(np.int64).T
    surface = depth[row, column]
    return np.asarray(inside & (surface > 0) & (np.abs(surface - z) < DEPTH_TOLERANCE * z))
