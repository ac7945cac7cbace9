"""Render the scenes of ``benchmarks/surfaces.py`` as photographed captures with exact ground truth.

``write_scene`` writes a COLMAP text model with JPEG photographs. Photographs have sensor noise and varying exposure;
the cameras and points of the model have errors of about a pixel, as after structure from motion. Every eighth
photograph is a test view: it has the mean exposure and the exact camera. The true surface and cameras are written
beside them (``benchmarks/surface_judge.py`` reads these files).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks import surface_objects as things
from benchmarks.surface_judge import PHOTOS, SCENE, TRUE_POINTS, TRUTH, SceneFacts, true_points, unproject
from benchmarks.surface_objects import Material, Noise, Part
from gs2d.core.camera import Camera, look_at
from gs2d.core.json_files import write_json
from gs2d.core.mesh import Mesh
from gs2d.evaluation.visibility import shown_points
from gs2d.io.meshes import write_mesh
from gs2d.meshing.raycast import Hits, cast_camera
from gs2d.synthetic import shapes, textures
from gs2d.synthetic.perturb_exposure import random_gains
from gs2d.synthetic.perturb_poses import disturbed
from gs2d.synthetic.shading import LAMP, BakedLight, bake, sky_radiance
from gs2d.synthetic.textures import linear_to_srgb, srgb_to_linear

TEST_EVERY = 8  # as `gs2d train` splits captures by default
SAMPLES = 2  # rays per pixel along each axis
ASPECT = 0.75  # height of a photograph, of its width
QUALITY = 92  # JPEG
NOISE, SHOT = 1.5, 0.12  # of 255: standard deviation of the noise, and its growth with the root of the value
GAIN, BALANCE = 1.18, 1.04  # largest exposure change of a photograph, and between its channels
DEGREES, FRACTION = 0.09, 0.0012  # pose errors: half a pixel by rotation and by translation at 400 px
WHITE = 0.75  # linear value of the brightest five per cent at mean exposure
CANDIDATES, TEXTURED = 14000, 0.02  # points tried per photograph; luminance step to the next pixel that makes a corner
POINT_NOISE = 0.5  # px, of observations and points
FOUND = 0.4  # share of the photographs showing a point in which it is matched
LEAST_TRACK = 3
NORMALS_APART = 0.3  # world units that a radian between normals counts when light is interpolated


@dataclass(frozen=True, eq=False)
class Environment:
    """Distant light that surfaces reflect.

    Attributes
    ----------
    lobes : sequence of (direction, sharpness, radiance)
        Windows and lamps: radiance exp(sharpness (d . direction - 1)).
    hills : Noise or None
        Outdoors: the silhouette and texture of the horizon.
    ambient : float
        Share of the radiance of the sky that remains between the lobes.
    """

    lobes: Sequence[tuple[Sequence[float], float, float]]
    hills: Noise | None = None
    ambient: float = 1.0

    def reflected(self, d: np.ndarray, roughness: float) -> np.ndarray:
        """Return the radiance [n, 3] around directions [n, 3], blurred by a Gaussian lobe of this width in radians."""
        total = self.ambient * sky_radiance(d)
        blur = 1 / max(4 * roughness**2, 1e-4)  # slopes of facets double in the reflection
        for direction, sharpness, radiance in self.lobes:
            axis = np.asarray(direction, float) / np.linalg.norm(direction)
            wide = sharpness * blur / (sharpness + blur)  # product of spherical Gaussians
            total = total + (radiance * wide / sharpness * np.exp(wide * (d @ axis - 1)))[:, None]
        return np.asarray(total)

    def background(self, d: np.ndarray) -> np.ndarray:
        """Return the radiance [n, 3] of rays [n, 3] that hit nothing: sky with clouds, and hills outdoors."""
        color = sky_radiance(d)
        if self.hills is None:
            return color
        cloud = np.clip(0.3 + 0.5 * self.hills(d * (1.0, 1.0, 2.5), 0.11), 0, 1)[:, None]
        color = color + cloud * (np.array((0.95, 0.95, 0.96)) - color)
        ridge = 0.09 + 0.035 * self.hills(d * (1.0, 1.0, 0.0), 0.25)
        wood = srgb_to_linear(things.mixed((0.20, 0.27, 0.18), (0.45, 0.50, 0.38), 0.5 + 0.4 * self.hills(d, 3.0)))
        return np.where((d[:, 2] < ridge)[:, None], wood, color)


INDOORS = Environment(
    (((-0.9, 0.3, 0.7), 14.0, 4.5), ((0.8, 0.9, 0.5), 22.0, 4.0), ((0.3, -1.0, 0.8), 18.0, 3.0), (LAMP, 120.0, 30.0)),
    ambient=0.4,
)


@dataclass(frozen=True, eq=False)
class Design:
    """A scene before it is photographed.

    Attributes
    ----------
    parts : tuple of Part
        Subject first, then support, then backdrop.
    cameras : list of Camera
    environment : Environment
    lamp : float
        Brightness of the lamp; 0 leaves the light of the sky.
    lit : dict of int to float
        Parts (by index) that neither cast nor receive shadows, and their light.
    crowd : callable, optional
        Returns the parts of the people in a photograph, by its number.
    light_samples : (int, int)
        Number of vertices whose light is computed, and of directions of the sky.
    """

    parts: tuple[Part, ...]
    cameras: list[Camera]
    environment: Environment = INDOORS
    lamp: float = 1.0
    lit: dict[int, float] | None = None
    crowd: Callable[[int], list[Part]] | None = None
    light_samples: tuple[int, int] = (12_000, 60)


# -- cameras -------------------------------------------------------------------------------------------------------
def _camera(eye: np.ndarray, target: np.ndarray, size: int, focal: float, roll: float = 0.0) -> Camera:
    forward = (target - eye) / np.linalg.norm(target - eye)
    side = np.cross(forward, [0, 0, 1.0])
    up = np.array([0, 0, np.cos(roll)]) + np.sin(roll) * side / np.linalg.norm(side)
    return look_at(eye, target, up, width=size, height=round(ASPECT * size), fx=focal * size)


def orbit(
    rng: np.random.Generator, size: int, target: Sequence[float], distance: float, rings: Sequence[tuple[float, int]]
) -> list[Camera]:
    """Return hand-held cameras on rings of (elevation in degrees, number of photographs), ring by ring."""
    cameras = []
    for elevation, count in rings:
        start = rng.uniform(0, 2 * np.pi)
        for k in range(count):
            a = start + 2 * np.pi * (k + rng.uniform(-0.25, 0.25)) / count
            e = np.radians(elevation + rng.uniform(-4, 4))
            towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
            aim = np.asarray(target) + rng.uniform(-0.04, 0.04, 3) * distance
            eye = np.asarray(target) + distance * rng.uniform(0.88, 1.12) * towards
            cameras.append(_camera(eye, aim, size, 1.05, rng.uniform(-0.06, 0.06)))
    return cameras


# -- scenes --------------------------------------------------------------------------------------------------------
def _on_table(rng: np.random.Generator, subject: list[Part], cameras: list[Camera]) -> Design:
    """Put a subject on a round wooden table in a room."""
    fine = Noise(rng, (2, 24))
    wood = Material(things.planks(fine, (0.48, 0.33, 0.20), (0.68, 0.50, 0.33), 0.13), reflectance=0.03, roughness=0.2)
    top, rim = shapes.plinth(0.98, 0.06)
    support = [Part(patch, wood, "support") for patch in (top, rim)]
    floor = Material(things.slabs(fine, (0.40, 0.38, 0.36), (0.58, 0.55, 0.50), (0.6, 0.3)))
    paper = Material(things.mottled(fine, (0.62, 0.66, 0.60), (0.78, 0.78, 0.70), 0.8))
    backdrop = [Part(things.sheet((-3.2, -3.2, -0.75), (6.4, 0, 0), (0, 6.4, 0), 0.4), floor, "backdrop")]
    for k in range(4):
        wall = things.sheet((-3.2, 3.2, -0.75), (6.4, 0, 0), (0, 0, 3.0), 0.5)
        backdrop.append(Part(wall.moved(turn=k * np.pi / 2), paper, "backdrop"))
        for x in (-1.9, 0.2, 1.6):
            height, print_ = rng.uniform(0.8, 2.0), things.printed(things.print_sheet(rng))
            cupboard = shapes.box((rng.uniform(0.5, 1.2), 0.5, height)).moved(offset=(x, 2.9, -0.75), turn=0.0)
            backdrop.append(Part(cupboard.moved(turn=k * np.pi / 2), Material(print_), "backdrop"))
    return Design((*subject, *support, *backdrop), cameras)


def _outdoors(rng: np.random.Generator, subject: list[Part], cameras: list[Camera], ground: Material) -> Design:
    """Put a subject on uneven ground below a sky with hills."""
    uneven = Noise(rng, (2, 12))

    def land(low: float, high: float, rings: int) -> shapes.Patch:
        angle = np.linspace(0, 2 * np.pi, 121)
        angle[-1] = 0
        a, r = np.meshgrid(angle, np.linspace(high, low, rings), indexing="ij")
        points = np.stack([r * np.cos(a), r * np.sin(a), np.zeros_like(a)], axis=-1)
        points[..., 2] = 0.012 * uneven(points, 0.5) + 0.004 * uneven(points, 2.0) - 0.01
        return shapes.grid(points, points[..., :2])

    support, backdrop = Part(land(0.0, 1.3, 60), ground, "support"), Part(land(1.3, 14.0, 50), ground, "backdrop")
    environment = Environment(((LAMP, 900.0, 90.0),), Noise(rng, (2, 20)))
    return Design((*subject, support, backdrop), cameras, environment)


def metal(rng: np.random.Generator, size: int) -> Design:
    """Return a bronze bust."""
    stain = Noise(rng, (1, 5))
    bronze = Material(
        things.mottled(stain, (0.52, 0.38, 0.24), (0.72, 0.54, 0.34), 0.6, contrast=0.25), metal=True, roughness=0.14
    )
    cameras = orbit(rng, size, (0, 0, 0.52), 1.75, ((2, 18), (22, 18), (50, 12)))
    return _on_table(rng, [Part(things.head(rng), bronze)], cameras)


def copper(rng: np.random.Generator, size: int) -> Design:
    """Return a hammered copper urn."""
    stain = Noise(rng, (1, 5))
    red = Material(
        things.mottled(stain, (0.80, 0.50, 0.38), (0.88, 0.60, 0.46), 0.6, contrast=0.25), metal=True, roughness=0.08
    )
    cameras = orbit(rng, size, (0, 0, 0.45), 1.65, ((5, 18), (28, 16), (55, 10)))
    return _on_table(rng, [Part(things.urn(rng), red)], cameras)


def porcelain(rng: np.random.Generator, size: int) -> Design:
    """Return a white glazed figure, a vase and a bowl."""
    white, blue = things.porcelain()
    glaze = {"reflectance": 0.05, "roughness": 0.04}
    subject = [
        Part(white, Material(things.plain((0.93, 0.92, 0.90)), **glaze)),
        Part(blue, Material(things.plain((0.16, 0.24, 0.55)), **glaze)),
    ]
    design = _on_table(rng, subject, orbit(rng, size, (-0.05, 0.15, 0.36), 1.9, ((8, 18), (30, 16), (58, 10))))
    return replace(design, light_samples=(30_000, 120))  # bands of light would be texture


def thin(rng: np.random.Generator, size: int) -> Design:
    """Return a wire chair, a spoked wheel and a lattice on paving."""
    noise = Noise(rng, (2, 24))
    paint = Material(
        things.mottled(noise, (0.10, 0.12, 0.13), (0.22, 0.24, 0.25), 1.0), reflectance=0.04, roughness=0.2
    )
    white = Material(things.mottled(noise, (0.80, 0.78, 0.72), (0.95, 0.93, 0.88), 1.0))
    red = Material(things.mottled(noise, (0.60, 0.12, 0.10), (0.75, 0.25, 0.18), 1.0), reflectance=0.04, roughness=0.2)
    subject = [
        Part(things.chair().moved(offset=(0.05, 0.0, 0.0), turn=0.4), paint),
        Part(things.wheel().moved(offset=(-0.62, -0.18, 0.0), turn=1.1), red),
        Part(things.trellis(0.9, 0.9, 0.15).moved(offset=(0.15, 0.62, 0.0), turn=0.15), white),
    ]
    ground = Material(things.slabs(noise, (0.50, 0.47, 0.43), (0.70, 0.66, 0.60), (0.4, 0.2)))
    return _outdoors(rng, subject, orbit(rng, size, (-0.05, 0.1, 0.45), 2.2, ((6, 20), (25, 18), (48, 10))), ground)


def stone(rng: np.random.Generator, size: int) -> Design:
    """Return rough boulders on gravel."""
    noise = Noise(rng, (2, 24))
    grain = Material(things.speckled(noise, (0.42, 0.39, 0.35), (0.72, 0.68, 0.60), 1.3))
    subject = [
        Part(things.rock(rng, 0.42, rows=180, around=240).moved(offset=(0.0, 0.0, 0.26)), grain),
        Part(things.rock(rng, 0.24, rows=110, around=150).moved(offset=(0.42, -0.40, 0.13)), grain),
        Part(things.rock(rng, 0.17, rows=90, around=120).moved(offset=(-0.45, -0.32, 0.09)), grain),
    ]
    gravel = Material(things.speckled(noise, (0.40, 0.37, 0.33), (0.66, 0.62, 0.56), 4.0, level=0.5))
    return _outdoors(rng, subject, orbit(rng, size, (0, -0.1, 0.2), 2.15, ((10, 18), (30, 16), (55, 8))), gravel)


def foliage(rng: np.random.Generator, size: int) -> Design:
    """Return a bushy pot plant."""
    noise = Noise(rng, (2, 24))
    stems, leaves, pot = things.plant(rng)
    leaf = things.printed(textures.linear_to_srgb(textures.foliage(rng)))
    subject = [
        Part(leaves, Material(leaf, reflectance=0.03, roughness=0.25)),
        Part(stems, Material(things.mottled(noise, (0.36, 0.30, 0.18), (0.45, 0.45, 0.25), 1.0))),
        Part(pot, Material(things.mottled(noise, (0.55, 0.30, 0.20), (0.72, 0.44, 0.30), 0.8))),
    ]
    ground = Material(things.slabs(noise, (0.50, 0.47, 0.43), (0.70, 0.66, 0.60), (0.4, 0.2)))
    return _outdoors(rng, subject, orbit(rng, size, (0, 0, 0.5), 1.6, ((5, 18), (28, 18), (52, 10))), ground)


def boxes(rng: np.random.Generator, size: int) -> Design:
    """Return stacked printed cartons, some sides without print."""
    stack = (  # size, place, turn
        ((0.60, 0.42, 0.30), (0.0, 0.0, 0.0), 0.2),
        ((0.40, 0.34, 0.26), (-0.04, 0.02, 0.30), 0.55),
        ((0.22, 0.22, 0.22), (0.0, 0.0, 0.56), 0.1),
        ((0.26, 0.20, 0.42), (0.50, 0.28, 0.0), -0.3),
        ((0.50, 0.12, 0.36), (-0.15, 0.52, 0.0), 0.05),
        ((0.34, 0.26, 0.12), (-0.52, -0.16, 0.0), 0.8),
        ((0.20, 0.14, 0.08), (-0.50, -0.18, 0.12), 1.3),
        ((0.30, 0.22, 0.07), (0.28, -0.46, 0.0), 0.35),
    )
    subject = []
    for k, (extent, place, turn) in enumerate(stack):
        print_ = things.printed(things.print_sheet(rng, plain_sides=(0, 2, 0, 1)[k % 4]))
        gloss = 0.04 if k % 3 == 0 else 0.0
        subject.append(
            Part(shapes.box(extent).moved(offset=place, turn=turn), Material(print_, reflectance=gloss, roughness=0.15))
        )
    return _on_table(rng, subject, orbit(rng, size, (0, 0, 0.3), 1.95, ((8, 16), (30, 16), (55, 8))))


def room(rng: np.random.Generator, size: int) -> Design:
    """Return a furnished room of 5 x 4 x 2.5 m with bare white walls, photographed from inside."""
    noise = Noise(rng, (2, 24))
    white = Material(things.mottled(noise, (0.88, 0.87, 0.84), (0.90, 0.89, 0.86), 0.3))
    wood = Material(
        things.planks(noise, (0.50, 0.36, 0.24), (0.70, 0.54, 0.38), 0.14), reflectance=0.03, roughness=0.25
    )
    oak = Material(things.mottled(noise, (0.45, 0.31, 0.19), (0.62, 0.45, 0.29), 0.8))
    cloth = Material(things.speckled(noise, (0.25, 0.33, 0.42), (0.42, 0.50, 0.58), 2.0))
    rug = Material(things.printed(things.print_sheet(rng, columns=1)))
    x, y, top = 2.5, 2.0, 2.5
    parts = [Part(things.sheet((-x, -y, top), (0, 2 * y, 0), (2 * x, 0, 0), 0.12), white)]  # the ceiling is part 0
    parts.append(Part(things.sheet((-x, -y, 0), (2 * x, 0, 0), (0, 2 * y, 0), 0.12), wood))
    for corner, along in (((-x, y), (2 * x, 0)), ((x, y), (0, -2 * y)), ((x, -y), (-2 * x, 0)), ((-x, -y), (0, 2 * y))):
        parts.append(Part(things.sheet((*corner, 0), (*along, 0), (0, 0, top), 0.12), white))
    boxes_ = (
        *[((-2.4, -0.9, 0.0), (-1.55, 1.0, 0.42), cloth), ((-2.4, -0.9, 0.42), (-2.15, 1.0, 0.85), cloth)],
        *[((-2.4, s - 0.12, 0.42), (-1.6, s + 0.12, 0.62), cloth) for s in (-0.8, 0.9)],
        ((-0.6, -0.45, 0.68), (0.7, 0.45, 0.72), oak),
        *[
            ((cx - 0.03, cy - 0.03, 0.0), (cx + 0.03, cy + 0.03, 0.68), oak)
            for cx in (-0.54, 0.64)
            for cy in (-0.39, 0.39)
        ],
        *[((0.9, -1.98, z), (2.2, -1.68, z + 0.03), oak) for z in (0.05, 0.45, 0.85, 1.25, 1.65)],
        *[((cx - 0.02, -1.98, 0.0), (cx + 0.02, -1.68, 1.68), oak) for cx in (0.9, 2.2)],
        (
            (2.40, -0.5, 0.0),
            (2.49, 0.4, 2.0),
            Material(things.plain((0.80, 0.78, 0.73)), reflectance=0.03, roughness=0.2),
        ),
        (
            (-2.48, 1.25, 0.0),
            (-1.9, 1.98, 1.0),
            Material(things.plain((0.86, 0.84, 0.80)), reflectance=0.03, roughness=0.2),
        ),
    )
    parts += [Part(things.block(low, high), material) for low, high, material in boxes_]
    parts.append(Part(shapes.box((1.9, 1.3, 0.012)).moved(offset=(-0.5, 0.0, 0.0), turn=0.1), rug))
    for px, pz, w, h in ((-1.0, 1.5, 0.7, 0.5), (0.9, 1.45, 0.45, 0.6)):
        print_ = Material(things.printed(things.print_sheet(rng)))
        parts.append(Part(shapes.box((w, 0.04, h)).moved(offset=(px, 1.97, pz - h / 2)), print_))
    for shelf in (0.08, 0.48, 0.88, 1.28):
        at = 0.95
        while at < 2.0:
            width, height = rng.uniform(0.03, 0.07), rng.uniform(0.2, 0.33)
            spine = Material(things.printed(things.print_sheet(rng)))
            parts.append(
                Part(shapes.box((width, 0.2, height), cells=3).moved(offset=(at + width / 2, -1.83, shelf)), spine)
            )
            at += width + (0.25 if rng.random() < 0.15 else 0.004)
    vase = np.array([[0.06, 0.0], [0.09, 0.10], [0.05, 0.2], [0.07, 0.26]])
    parts.append(
        Part(
            shapes.vase(vase, wall=0.01).moved(offset=(0.2, 0.1, 0.72)),
            Material(things.mottled(noise, (0.7, 0.4, 0.2), (0.9, 0.7, 0.4), 2.0)),
        )
    )
    cameras = []
    for k in range(56):
        a = 2 * np.pi * k / 28
        out = np.array([np.cos(a), np.sin(a)])
        place = np.array([1.55, 1.1]) * out * rng.uniform(0.7, 1.0) + rng.normal(0, 0.08, 2)
        height = (1.5 if k < 28 else 1.15) + rng.uniform(-0.12, 0.12)
        look = a + np.pi + rng.uniform(-0.75, 0.75)  # across the room
        aim = np.array([np.cos(look), np.sin(look), rng.uniform(-0.38, 0.05) if k < 28 else rng.uniform(-0.2, 0.25)])
        eye = np.array([*place, height])
        cameras.append(_camera(eye, eye + aim, size, 0.72, rng.uniform(-0.04, 0.04)))
    return Design(tuple(parts), cameras, INDOORS, lamp=0.0, lit={0: 0.75})


def facade(rng: np.random.Generator, size: int) -> Design:
    """Return a house front of 9 x 6.5 m with glass panes, a pavement with people, and the sky above."""
    noise = Noise(rng, (2, 24))
    columns, rows = 300, 220
    u, v = np.meshgrid(np.linspace(-4.5, 4.5, columns), np.linspace(0, 6.5, rows), indexing="ij")
    relief = np.zeros_like(u)  # metres towards the street
    panes = []
    for z0, z1, half in ((0.9, 2.4, 0.55), (3.3, 5.1, 0.5)):
        for cx in (-3.3, -1.7, 0.1, 1.7, 3.3):
            door = cx == 0.1 and z0 < 1
            low = 0.0 if door else z0
            frame = (np.abs(u - cx) < half + 0.14) & (v > low - 0.14) & (v < z1 + 0.14)
            hole = (np.abs(u - cx) < half) & (v > low) & (v < z1)
            relief[frame], relief[hole] = 0.07, -0.22
            if not door:
                relief[(np.abs(u - cx) < half + 0.25) & (np.abs(v - low + 0.12) < 0.06)] = 0.16
                bars = hole & ((np.abs(u - cx) < 0.045) | (np.abs(v - (low + z1) / 2) < 0.045))
                relief[bars] = -0.14
                panes.append(things.block((cx - half, 0.19, low), (cx + half, 0.24, z1), 0.3))
            else:
                panels = hole & (np.abs(np.abs(u - cx) - 0.27) < 0.2) & (np.abs(v % 0.8 - 0.4) < 0.28)
                relief[hole & ~panels] = -0.15
    for low, high, out in ((2.78, 2.95, 0.14), (5.9, 6.1, 0.22), (6.1, 6.5, 0.30), (0.0, 0.45, 0.08)):
        band = (v >= low) & (v < high) & (relief <= 0.08) & (relief >= 0)
        relief[band] = out
    points = np.stack([u, -relief, v], axis=-1)
    front = shapes.grid(points, np.stack([u, v], axis=-1))
    bricks, plaster = (
        things.slabs(noise, (0.50, 0.26, 0.20), (0.66, 0.40, 0.31), (0.36, 0.12)),
        things.mottled(noise, (0.70, 0.66, 0.57), (0.80, 0.76, 0.68), 0.5),
    )

    def wall(at: np.ndarray, uvs: np.ndarray) -> np.ndarray:
        flat = at * np.array([1.0, 0.0, 1.0])
        dark = things.mottled(noise, (0.25, 0.18, 0.12), (0.33, 0.25, 0.17), 1.0)(flat, uvs)
        color = np.where((np.abs(at[:, 1]) < 0.02)[:, None] & (at[:, 2:] < 2.8), bricks(flat, uvs), plaster(flat, uvs))
        return np.where((at[:, 1] > 0.1)[:, None], dark, color)

    glass = Material(things.plain((0.06, 0.07, 0.08)), reflectance=0.06, roughness=0.01)
    paving = Material(things.slabs(noise, (0.45, 0.43, 0.41), (0.62, 0.60, 0.57), (0.5, 0.25)))
    house = Material(things.slabs(noise, (0.55, 0.50, 0.42), (0.72, 0.66, 0.56), (0.8, 0.4)))
    parts = [
        Part(front, Material(wall)),
        Part(shapes.join(panes), glass),
        Part(things.sheet((-4.5, -1.5, 0), (9, 0, 0), (0, 1.5, 0), 0.15), paving),
        Part(things.sheet((-4.5, -12, 0), (9, 0, 0), (0, 10.5, 0), 0.3), paving, "support"),
        *[Part(things.sheet((s, -12, 0), (12, 0, 0), (0, 16, 0), 0.6), paving, "backdrop") for s in (-16.5, 4.5)],
        *[
            Part(things.block((s, 0.6, 0), (s + 6, 5, h), 0.6), house, "backdrop")
            for s, h in ((-10.8, 5.0), (4.9, 4.2))
        ],
    ]
    people = [things.person(rng) for _ in range(7)]

    def crowd(number: int) -> list[Part]:
        steps, found = np.random.default_rng([number, 11]), []
        for person in people:
            if steps.random() < 0.7:
                place, turn = (steps.uniform(-4, 4), steps.uniform(-3.2, -0.5), 0.0), steps.uniform(0, 6.3)
                found += [replace(part, patch=part.patch.moved(turn=turn).moved(offset=place)) for part in person]
        return found

    cameras = []
    for k in range(40):
        line, t = divmod(k, 20)
        t = (t + rng.uniform(-0.3, 0.3)) / 19 * 2 - 1
        eye = np.array(
            [5.6 * t, (-8.2 if line else -6.4) + 1.4 * t * t + rng.uniform(-0.4, 0.4), 1.6 + rng.uniform(-0.15, 0.25)]
        )
        aim = np.array([2.2 * t + rng.uniform(-0.7, 0.7), 0.0, 3.1 + rng.uniform(-0.5, 0.5)])
        cameras.append(_camera(eye, aim, size, 0.80, rng.uniform(-0.04, 0.04)))
    environment = Environment(((LAMP, 900.0, 60.0),), Noise(rng, (2, 20)))
    return Design(tuple(parts), cameras, environment, crowd=crowd)


TUNING: dict[str, Callable[[np.random.Generator, int], Design]] = {
    "metal": metal,
    "room": room,
    "boxes": boxes,
    "stone": stone,
}
REPORTED: dict[str, Callable[[np.random.Generator, int], Design]] = {
    **{"copper": copper, "porcelain": porcelain, "thin": thin, "foliage": foliage, "facade": facade}
}
SCENES = {**TUNING, **REPORTED}


# -- photographs ---------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _Lit:
    """The joined parts of a design with their light, and the part of each face."""

    parts: Sequence[Part]
    patch: shapes.Patch
    light: BakedLight
    part_of_face: np.ndarray


def _lit(design: Design) -> _Lit:
    """Bake the light of all parts."""
    apart = design.lit or {}
    solid = shapes.join([part.patch for k, part in enumerate(design.parts) if k not in apart])
    baked = _baked(solid, *design.light_samples)
    sky, lamp, at = [], [], 0
    for k, part in enumerate(design.parts):
        count = len(part.patch.vertices)
        if k in apart:
            sky.append(np.full((count, 3), apart[k]))
            lamp.append(np.zeros(count))
        else:
            sky.append(baked.sky[at : at + count])
            lamp.append(baked.lamp[at : at + count])
            at += count
    sizes = [len(part.patch.faces) for part in design.parts]
    light = BakedLight(np.concatenate(sky), design.lamp * np.concatenate(lamp))
    return _Lit(
        design.parts, shapes.join([p.patch for p in design.parts]), light, np.repeat(np.arange(len(sizes)), sizes)
    )


def _baked(patch: shapes.Patch, count: int, directions: int) -> BakedLight:
    """Return the light of all vertices, interpolated from ``count`` of them by similar places and normals."""
    rows = np.arange(0, len(patch.vertices), max(len(patch.vertices) // count, 1))
    few = replace(patch, vertices=patch.vertices[rows], normals=patch.normals[rows])
    found = bake(few, occluders=patch, sky_directions=directions, lamp_directions=8, threads=1)
    keys = np.concatenate([patch.vertices, NORMALS_APART * patch.normals], axis=1)
    distances, near = cKDTree(keys[rows]).query(keys, k=4)
    weights = 1 / (distances + 1e-3)
    weights /= weights.sum(axis=1, keepdims=True)
    return BakedLight(np.einsum("nk,nkc->nc", weights, found.sky[near]), (weights * found.lamp[near]).sum(axis=1))


def _open_light(parts: Sequence[Part]) -> _Lit:
    """Return people with the light of an open place."""
    patch = shapes.join([part.patch for part in parts])
    sky = sky_radiance(patch.normals) * (0.65 + 0.35 * patch.normals[:, 2:])
    sizes = [len(part.patch.faces) for part in parts]
    lamp = np.maximum(patch.normals @ LAMP, 0.0)
    return _Lit(parts, patch, BakedLight(sky, lamp), np.repeat(np.arange(len(sizes)), sizes))


def _shade(lit: _Lit, environment: Environment, hits: Hits, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return linear diffuse and reflected light [H, W, 3] of every ray; 0 without hit."""
    diffuse, mirror = (np.zeros((*hits.face.shape, 3), np.float32) for _ in range(2))
    at_rows = np.flatnonzero(hits.face.reshape(-1) >= 0)
    face, weights = hits.face.reshape(-1)[at_rows], hits.weights.reshape(-1, 3)[at_rows]
    corner, part_of_ray = lit.patch.faces[face], lit.part_of_face[face]
    for k in np.unique(part_of_ray):
        rays = np.flatnonzero(part_of_ray == k)
        c, w = corner[rays], weights[rays]

        def at_hit(values: np.ndarray, c: np.ndarray = c, w: np.ndarray = w) -> np.ndarray:
            values = values.astype(np.float32)
            shares = [w[:, k, None] if values.ndim > 1 else w[:, k] for k in range(3)]
            return np.asarray(sum(values[c[:, k]] * shares[k] for k in range(3)))

        material = lit.parts[k].material
        points, normal, sky, lamp = map(at_hit, (lit.patch.vertices, lit.patch.normals, lit.light.sky, lit.light.lamp))
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        color = srgb_to_linear(np.clip(material.texture(points, at_hit(lit.patch.uvs)), 0, 1))
        if not material.metal:
            lamps = lamp[:, None] * np.array([1.80, 1.62, 1.36])
            diffuse.reshape(-1, 3)[at_rows[rays]] = color * (0.56 * sky + 0.62 * lamps)
        if not material.metal and not material.reflectance:
            continue
        view = points - camera.center
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        cosine = -(view * normal).sum(axis=1, keepdims=True)
        reflected = view + 2 * cosine * normal
        base = color if material.metal else material.reflectance
        fresnel = base + (1 - base) * (1 - np.clip(cosine, 0, 1)) ** 5 * (1 - material.roughness)
        free = np.clip(sky.mean(axis=1, keepdims=True) / (0.62 + 0.2 * normal[:, 2:]), 0.2, 1)  # unshadowed share
        mirror.reshape(-1, 3)[at_rows[rays]] = fresnel * free * environment.reflected(reflected, material.roughness)
    return diffuse, mirror


def _rays(camera: Camera) -> np.ndarray:
    """Return unit directions [H S, W S, 3] of the rays in the world."""
    x = ((np.arange(camera.width * SAMPLES) + 0.5) / SAMPLES - camera.cx) / camera.fx
    y = ((np.arange(camera.height * SAMPLES) + 0.5) / SAMPLES - camera.cy) / camera.fy
    d = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], axis=-1) @ camera.rotation
    return np.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True))


def _pixels(rays: np.ndarray) -> np.ndarray:
    """Average blocks of rays [H S, W S, ...] to pixels."""
    height, width = rays.shape[0] // SAMPLES, rays.shape[1] // SAMPLES
    return np.asarray(rays.reshape(height, SAMPLES, width, SAMPLES, -1).mean(axis=(1, 3)))


@dataclass(frozen=True, eq=False)
class _Shot:
    """A photograph before exposure: linear light [H, W, 3], the luminance of its diffuse part [H, W], and the hits of
    the static scene at the first ray of each pixel."""

    light: np.ndarray
    diffuse: np.ndarray
    face: np.ndarray
    depth: np.ndarray
    hidden: np.ndarray  # behind people


def _photograph(lit: _Lit, design: Design, camera: Camera, number: int) -> _Shot:
    hits = cast_camera(lit.patch.vertices, lit.patch.faces, camera, samples=SAMPLES)
    diffuse, mirror = _shade(lit, design.environment, hits, camera)
    missed = hits.face < 0
    if missed.any():
        diffuse[missed] = design.environment.background(_rays(camera)[missed])
    hidden = np.zeros(missed.shape, bool)
    crowd = design.crowd(number) if design.crowd is not None else []
    if crowd:
        people = _open_light(crowd)
        front = cast_camera(people.patch.vertices, people.patch.faces, camera, samples=SAMPLES)
        hidden = (front.face >= 0) & (missed | (front.depth < hits.depth))
        diffuse[hidden], mirror[hidden] = _shade(people, design.environment, front, camera)[0][hidden], 0.0
    light = np.minimum(diffuse + mirror, 4.0)  # sensors saturate
    first = (slice(None, None, SAMPLES),) * 2
    return _Shot(_pixels(light), _pixels(diffuse).mean(axis=2), hits.face[first], hits.depth[first], hidden[first])


def _first_rays(camera: Camera) -> Camera:
    """Return the camera whose pixel centres are the first ray of each pixel."""
    shift = 0.5 - 0.5 / SAMPLES
    return replace(camera, cx=camera.cx + shift, cy=camera.cy + shift)


def _developed(light: np.ndarray, gains: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the photograph uint8 [H, W, 3] of linear light: exposure, sRGB, noise."""
    values = 255 * np.minimum(linear_to_srgb(np.clip(light, 0, 1)) * gains, 1)
    values = values + (NOISE + SHOT * np.sqrt(values)) * rng.normal(size=values.shape)
    return np.rint(np.clip(values, 0, 255)).astype(np.uint8)


def write_scene(name: str, folder: Path, *, seed: int = 0, size: int = 400) -> None:
    """Photograph a scene and write its capture with the ground truth; ``scene.json`` is written last.

    Parameters
    ----------
    name : str
        Of ``SCENES``.
    folder : Path
    seed : int
    size : int
        Width of the photographs, px.
    """
    rng = np.random.default_rng([seed, sorted(SCENES).index(name)])
    design = SCENES[name](rng, size)
    lit = _lit(design)
    shots = [_photograph(lit, design, camera, k) for k, camera in enumerate(design.cameras)]
    bright = np.percentile(np.concatenate([shot.light[::4, ::4].reshape(-1) for shot in shots]), 95)
    train = [k for k in range(len(shots)) if k % TEST_EVERY]
    gains = np.ones((len(shots), 3))
    gains[train] = random_gains(len(train), seed, gain=GAIN, balance=BALANCE)
    (folder / PHOTOS).mkdir(parents=True, exist_ok=True)
    names = [f"{k:03d}.jpg" for k in range(len(shots))]
    photos = []
    for k, shot in enumerate(shots):
        photos.append(_developed(shot.light * (WHITE / bright), gains[k], rng))
        Image.fromarray(photos[-1]).save(folder / PHOTOS / names[k], quality=QUALITY, subsampling=0)

    known = list(design.cameras)
    for k, camera in zip(
        train, disturbed([known[k] for k in train], seed, degrees=DEGREES, fraction=FRACTION), strict=True
    ):
        known[k] = camera
    points = _sparse_points(design.cameras, shots, train, rng)
    _write_model(folder / "sparse" / "0", names, known, points, photos, rng)

    kept = [part.patch for role in ("subject", "support") for part in design.parts if part.role == role]
    subject_faces = sum(len(part.patch.faces) for part in design.parts if part.role == "subject")
    vertices, faces = shapes.merge_vertices(*(lambda p: (p.vertices, p.faces))(shapes.join(kept)))
    truth = Mesh(vertices, faces.astype(np.int32))
    (folder / TRUTH).parent.mkdir(
        exist_ok=True
    )  # not beside the capture: `gs2d train` would score it, which takes time
    write_mesh(folder / TRUTH, truth)
    views = [(_first_rays(design.cameras[k]), shots[k].depth) for k in train]
    np.savez_compressed(
        folder / TRUE_POINTS, **true_points(truth, subject_faces, views, [shots[k].face for k in train])
    )
    facts = SceneFacts(name, seed, size, subject_faces, tuple(train), tuple(names), tuple(design.cameras))
    write_json(folder / SCENE, facts.as_json())


# -- what structure from motion would find ---------------------------------------------------------------------------
def _sparse_points(
    cameras: Sequence[Camera], shots: Sequence[_Shot], train: Sequence[int], rng: np.random.Generator
) -> list[tuple[np.ndarray, list[int]]]:
    """Return points of textured surface with noise, each with the training photographs in which it was matched."""
    found: list[tuple[np.ndarray, list[int]]] = []
    bright = np.percentile([shot.diffuse.mean() for shot in shots], 50)
    for k in train:
        camera, shot = cameras[k], shots[k]
        y, x = (rng.integers(2, side - 2, CANDIDATES // len(train)) for side in shot.diffuse.shape)
        step = np.maximum(
            np.abs(shot.diffuse[y, x] - shot.diffuse[y, x + 1]), np.abs(shot.diffuse[y, x] - shot.diffuse[y + 1, x])
        )
        good = (step > TEXTURED * bright / 0.5) & (shot.face[y, x] >= 0) & ~shot.hidden[y, x]
        x, y = x[good], y[good]
        depth = shot.depth[y, x].astype(np.float64)
        places = unproject(_first_rays(camera), x, y, shot.depth)
        seen = np.stack(
            [shown_points(places, _first_rays(cameras[j]), shots[j].depth, 0.01 * depth) for j in train], axis=1
        )
        matched = seen & (rng.random(seen.shape) < FOUND)
        matched[:, train.index(k)] = True
        noisy = places + rng.normal(size=places.shape) * (POINT_NOISE * depth / camera.fx)[:, None]
        found += [
            (point, [train[j] for j in np.flatnonzero(row)])
            for point, row in zip(noisy, matched, strict=True)
            if row.sum() >= LEAST_TRACK
        ]
    return found


def _write_model(
    folder: Path,
    names: Sequence[str],
    cameras: Sequence[Camera],
    points: Sequence[tuple[np.ndarray, list[int]]],
    photos: Sequence[np.ndarray],
    rng: np.random.Generator,
) -> None:
    """Write a COLMAP text model with observations and tracks."""
    folder.mkdir(parents=True, exist_ok=True)
    observed: list[list[str]] = [[] for _ in names]
    tracks: list[list[str]] = [[] for _ in points]
    colors = np.zeros((len(points), 3))
    places = np.array([place for place, _ in points]).reshape(-1, 3)
    shown = np.zeros((len(points), len(names)), bool)
    for number, (_, views) in enumerate(points):
        shown[number, views] = True
    for k, camera in enumerate(cameras):
        mine = np.flatnonzero(shown[:, k])
        pixels = camera.project(places[mine])[0] + rng.normal(0, POINT_NOISE, (len(mine), 2))
        pixels = pixels.clip(0, (camera.width - 0.01, camera.height - 0.01))
        colors[mine] += photos[k][pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
        for number, (u, v) in zip(mine, pixels, strict=True):
            tracks[number].append(f"{k + 1} {len(observed[k])}")
            observed[k].append(f"{u:.2f} {v:.2f} {number + 1}")
    lines = []
    for number, (x, y, z) in enumerate(places):
        r, g, b = np.rint(colors[number] / shown[number].sum()).astype(int)
        lines.append(f"{number + 1} {x:.6f} {y:.6f} {z:.6f} {r} {g} {b} {POINT_NOISE} {' '.join(tracks[number])}\n")
    rows = []
    for k, (name, camera) in enumerate(zip(names, cameras, strict=True)):
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
        pose = " ".join(f"{value:.12g}" for value in (w, x, y, z, *camera.T_cam_world[:3, 3]))
        rows.append(f"{k + 1} {pose} 1 {name}\n{' '.join(observed[k])}\n")
    c = cameras[0]
    (folder / "cameras.txt").write_text(f"1 PINHOLE {c.width} {c.height} {c.fx} {c.fy} {c.cx} {c.cy}\n")
    (folder / "images.txt").write_text("".join(rows))
    (folder / "points3D.txt").write_text("".join(lines))
