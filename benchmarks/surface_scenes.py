"""Designs of the scenes of ``benchmarks/surfaces.py``: subjects, materials, surroundings and cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks import surface_objects as things
from benchmarks.surface_objects import Material, Noise, Part
from gs2d.contrib.demo import shapes, textures
from gs2d.contrib.demo.shading import LAMP, sky_radiance
from gs2d.contrib.demo.textures import srgb_to_linear
from gs2d.core.camera import Camera, look_at

ASPECT = 0.75  # height of a photograph, of its width


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
        *[Part(things.sheet((s, -12, 0), (12, 0, 0), (0, 16, 0), 0.6), paving, "support") for s in (-16.5, 4.5)],
        *[Part(things.block((s, 0.6, 0), (s + 6, 5, h), 0.6), house, "support") for s, h in ((-10.8, 5.0), (4.9, 4.2))],
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
