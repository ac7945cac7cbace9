"""Render the scenes of ``benchmarks/surfaces.py`` as photographed captures with exact ground truth.

``write_scene`` writes a COLMAP text model with JPEG photographs. Photographs have sensor noise and varying exposure;
the cameras and points of the model have errors of about a pixel, as after structure from motion. Every eighth
photograph is a test view: it has the mean exposure and the exact camera. The true surface and cameras are written
beside them (``benchmarks/surface_judge.py`` reads these files).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks.perturbations import disturbed, random_gains
from benchmarks.surface_judge import PHOTOS, SCENE, TRUE_POINTS, TRUTH, SceneFacts, true_points, unproject
from benchmarks.surface_objects import Part
from benchmarks.surface_scenes import SCENES, Design, Environment
from gs2d.contrib.demo import shapes
from gs2d.contrib.demo.shading import LAMP, BakedLight, bake, sky_radiance
from gs2d.contrib.demo.textures import linear_to_srgb, srgb_to_linear
from gs2d.contrib.lab.visibility import shown_points
from gs2d.core.camera import Camera
from gs2d.core.json_files import write_json
from gs2d.core.mesh import Mesh
from gs2d.io.meshes import write_mesh
from gs2d.meshing.raycast import Hits, cast_camera

TEST_EVERY = 8  # as `gs2d train` splits captures by default
SAMPLES = 2  # rays per pixel along each axis
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
