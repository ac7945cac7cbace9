"""The demo's still life: a painted vase with leafy twigs, a torus knot, a tin and fruit behind a wire trellis."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gs2d.contrib.demo import shapes, textures

FLOOR = -0.60  # world units, height of the plinth's upper face
RADIUS = 1.08  # world units, of the plinth


@dataclass(frozen=True, eq=False)
class DemoPart:
    """An object of the scene."""

    name: str
    patch: shapes.Patch
    texture: np.ndarray  # [rows, columns, 3] float32, linear light
    gloss: float = 0.0  # strength of the highlight; 0 is matt


@dataclass(frozen=True, eq=False)
class ToyScene:
    """All parts as one list of triangles."""

    parts: tuple[DemoPart, ...]
    patch: shapes.Patch  # the joined parts
    part_of_face: np.ndarray  # [F]


def build_scene(seed: int) -> ToyScene:
    """Build the still life within [-1.2, 1.2]^3; ``seed`` is for the twigs and textures."""
    parts = tuple(_parts(np.random.default_rng(seed)))
    sizes = [len(part.patch.faces) for part in parts]
    return ToyScene(parts, shapes.join([part.patch for part in parts]), np.repeat(np.arange(len(parts)), sizes))


def _parts(rng: np.random.Generator) -> Iterator[DemoPart]:
    upper, rest = shapes.plinth(RADIUS, 0.10)
    yield DemoPart("plinth", upper.moved(offset=(0, 0, FLOOR)), textures.tiles(rng), gloss=0.10)
    yield DemoPart("rim", rest.moved(offset=(0, 0, FLOOR)), textures.plinth_side(rng, aspect=2 * np.pi * RADIUS / 0.26))

    outline = np.array(
        [[0.17, 0.0], [0.20, 0.03], [0.30, 0.22], [0.36, 0.42], [0.31, 0.62], [0.17, 0.76], [0.145, 0.86], [0.20, 0.95]]
    )
    center = np.array([-0.12, 0.22, FLOOR])
    yield DemoPart("vase", shapes.vase(outline, wall=0.025).moved(offset=center), textures.vase(rng), gloss=0.12)
    twigs, blades, buds = _twigs(rng, center + np.array([0, 0, 0.80]))
    yield DemoPart("twigs", twigs, textures.speckled(rng, (0.36, 0.25, 0.16), (0.55, 0.42, 0.28), level=1.0))
    yield DemoPart("leaves", blades, textures.foliage(rng))
    yield DemoPart("buds", buds, textures.speckled(rng, (0.93, 0.50, 0.55), (0.99, 0.85, 0.80), level=1.0), gloss=0.1)

    knot = shapes.tube(shapes.torus_knot(0.20, 0.088), 0.062, around=16, closed=True)
    knot = shapes.Patch(knot.vertices, knot.normals, knot.uvs * [1, 6] % 1.0001, knot.faces)
    yield DemoPart(
        "knot",
        knot.moved(offset=(-0.55, -0.36, FLOOR + 0.150), turn=0.5),
        textures.speckled(rng, (0.86, 0.24, 0.17), (0.96, 0.70, 0.35), level=2.2, mottle=0.03),
        gloss=0.35,
    )
    yield DemoPart(
        "tin",
        shapes.box((0.34, 0.34, 0.46)).moved(offset=(0.47, -0.02, FLOOR), turn=0.95),
        textures.tin(rng),
        gloss=0.08,
    )
    orange = textures.speckled(rng, (0.93, 0.50, 0.08), (0.85, 0.41, 0.05), level=1.6, mottle=0.03)
    yield DemoPart("orange", shapes.ball(0.135).moved(offset=(0.02, -0.38, FLOOR + 0.132)), orange, gloss=0.15)
    lemon = textures.speckled(rng, (0.94, 0.80, 0.18), (0.88, 0.72, 0.12), level=1.6, mottle=0.03)
    lemon_patch = _laid_down(shapes.ball(0.095, stretch=1.3)).moved(offset=(0.19, -0.58, FLOOR + 0.093), turn=0.6)
    yield DemoPart("lemon", lemon_patch, lemon, gloss=0.15)
    wire = textures.speckled(rng, (0.16, 0.17, 0.19), (0.30, 0.31, 0.33), level=1.2)
    yield DemoPart("trellis", _trellis().moved(offset=(0.36, -0.60, FLOOR), turn=0.45), wire, gloss=0.2)


def _laid_down(patch: shapes.Patch) -> shapes.Patch:
    """Rotate by 90 degrees about y: z becomes x."""
    R = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])
    return shapes.Patch(patch.vertices @ R.T, patch.normals @ R.T, patch.uvs, patch.faces)


def _trellis(*, width: float = 0.62, height: float = 0.52, radius: float = 0.0125) -> shapes.Patch:
    """Return a round-topped wire trellis in the xz plane, an occluder."""
    half = width / 2
    arch = np.linspace(np.pi, 0, 25)
    frame = np.concatenate(
        [
            [[-half, 0, z] for z in np.linspace(0, height, 8)[:-1]],
            np.stack([half * np.cos(arch), np.zeros(25), height + half * np.sin(arch)], axis=1),
            [[half, 0, z] for z in np.linspace(height, 0, 8)[1:]],
        ]
    )
    wires = [shapes.tube(frame, radius * 1.25, around=10)]
    top = [height + np.sqrt(half**2 - x**2) for x in (-half / 3, half / 3)]
    for x, z in zip((-half / 3, half / 3), top, strict=True):
        wires.append(shapes.tube(np.linspace([x, 0, 0.0], [x, 0, z], 12), radius, around=8))
    for z in (0.12, 0.32, height):
        wires.append(shapes.tube(np.linspace([-half, 0, z], [half, 0, z], 12), radius, around=8))
    return shapes.join(wires)


def _twigs(rng: np.random.Generator, mouth: np.ndarray) -> tuple[shapes.Patch, shapes.Patch, shapes.Patch]:
    """Return twigs in the vase, their leaves, and a bud at each end."""
    twigs, blades, buds = [], [], []
    count = 6
    for k in range(count):
        angle = 2 * np.pi * (k + rng.uniform(-0.2, 0.2)) / count
        outwards = np.array([np.cos(angle), np.sin(angle), 0.0])
        reach, rise = rng.uniform(0.30, 0.46), rng.uniform(0.52, 0.82)
        side = np.array([-outwards[1], outwards[0], 0.0]) * rng.uniform(-0.10, 0.10)
        knots = [
            mouth - outwards * 0.06 - [0, 0, 0.45],
            mouth + outwards * 0.07 + [0, 0, 0.05],
            mouth + outwards * reach * 0.55 + side + [0, 0, rise * 0.62],
            mouth + outwards * reach + [0, 0, rise],
        ]
        path = shapes.smooth_path([list(p) for p in knots], 28)
        twigs.append(shapes.tube(path, np.linspace(0.014, 0.009, 28), around=7))
        for j, at in enumerate((13, 16, 19, 22, 25)):
            tangent = path[at + 1] - path[at - 1]
            tangent /= np.linalg.norm(tangent)
            spin = np.cross(tangent, outwards * np.cos(2.4 * j + k) + np.array([0, 0, 1]) * np.sin(2.4 * j + k))
            spin /= np.linalg.norm(spin)
            along = 0.55 * tangent + 0.83 * spin
            length = rng.uniform(0.19, 0.27) * (1 - 0.05 * j)
            blades.append(shapes.leaf(path[at], along, tangent, length=length, width=0.36 * length))
        buds.append(shapes.ball(0.036, stretch=1.25, rows=9, around=14).moved(offset=path[-1]))
    return shapes.join(twigs), shapes.join(blades), shapes.join(buds)
