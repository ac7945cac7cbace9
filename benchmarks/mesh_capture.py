"""Ray-cast a capture of scanned meshes that was not used for tuning: a bust, a bunny and a cow on the demo's plinth.

::

    python -m benchmarks.mesh_capture MESHES FOLDER [--size 400] [--train 60] [--test 20]

``MESHES`` holds ``nefertiti/nefertiti.obj``, ``stanford_bunny/stanford-bunny.obj`` and ``spot/spot.obj`` with its
texture. The first two have no texture: they are painted with patterns of the demo, wrapped around them and mirrored at
the back to avoid a seam. Light, cameras and layout are those of the demo; the true surface is saved next to the images.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from gs2d.errors import Gs2dError
from gs2d.synthetic import shapes, textures
from gs2d.synthetic.demo_capture import demo_cameras, write_capture
from gs2d.synthetic.demo_scene import FLOOR, RADIUS, DemoPart, ToyScene

_Y_UP = Rotation.from_euler("x", 90, degrees=True)  # y up to z up


def read_patch(file: Path, height: float, place: tuple[float, float], turn: float, up: str) -> shapes.Patch:
    """Return a mesh that stands on the plinth: ``height`` world units, turned about z by ``turn`` radians.

    Texture coordinates are read from the file; without them, they are (angle around the centre, height).
    """
    mesh = trimesh.load_mesh(file, process=False)
    vertices = _Y_UP.apply(mesh.vertices) if up == "y" else np.asarray(mesh.vertices, dtype=float)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle = np.append((low + high)[:2] / 2, low[2])
    vertices = (vertices - middle) * (height / (high - low)[2])
    uvs = getattr(mesh.visual, "uv", None)
    if uvs is None:
        angle = np.abs(np.arctan2(vertices[:, 1], vertices[:, 0])) / np.pi  # mirrored: 0 to 1 and back
        uvs = np.stack([angle, vertices[:, 2] / height], axis=1)
    faces = np.asarray(mesh.faces, dtype=np.int64)
    merged, same = _merged_normals(vertices, faces)
    patch = shapes.Patch(vertices, merged[same], np.clip(uvs, 0, 1 - 1e-6), faces)
    return patch.moved(offset=(*place, FLOOR), turn=turn)


def _merged_normals(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals of merged vertices, and the merged index of each vertex, so that texture seams are shaded
    smoothly.
    """
    places, same = np.unique(vertices, axis=0, return_inverse=True)
    same = same.reshape(-1)
    mesh = trimesh.Trimesh(places, same[faces], process=False)
    return np.asarray(mesh.vertex_normals), same


def build(meshes: Path, seed: int = 0) -> ToyScene:
    """Return the scene of the meshes in a folder."""
    rng = np.random.default_rng(seed)
    upper, rest = shapes.plinth(RADIUS, 0.10)
    cow = np.asarray(Image.open(meshes / "spot" / "spot_texture.png").convert("RGB"))[::-1] / 255.0
    parts = (
        DemoPart("plinth", upper.moved(offset=(0, 0, FLOOR)), textures.tiles(rng), gloss=0.10),
        DemoPart("rim", rest.moved(offset=(0, 0, FLOOR)), textures.plinth_side(rng, aspect=2 * np.pi * RADIUS / 0.26)),
        DemoPart(
            "bust",
            read_patch(meshes / "nefertiti" / "nefertiti.obj", 1.35, (-0.15, 0.3), 0.0, "z"),
            textures.vase(rng, painted=1.0),
            gloss=0.12,
        ),
        DemoPart(
            "bunny",
            read_patch(meshes / "stanford_bunny" / "stanford-bunny.obj", 0.55, (0.48, -0.3), 0.7, "y"),
            textures.speckled(rng, (0.75, 0.62, 0.5), (0.35, 0.22, 0.16), level=0.8, mottle=0.12),
            gloss=0.05,
        ),
        DemoPart(
            "cow",
            read_patch(meshes / "spot" / "spot.obj", 0.5, (-0.4, -0.55), 2.4, "y"),
            textures.srgb_to_linear(cow).astype(np.float32),
            gloss=0.25,
        ),
    )
    sizes = [len(part.patch.faces) for part in parts]
    return ToyScene(parts, shapes.join([part.patch for part in parts]), np.repeat(np.arange(len(parts)), sizes))


def main(arguments: list[str] | None = None) -> int:
    """Write the capture; return 2 for user errors."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mesh_capture", description=__doc__)
    parser.add_argument("meshes", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--train", type=int, default=60)
    parser.add_argument("--test", type=int, default=20)
    args = parser.parse_args(arguments)
    try:
        cameras = demo_cameras(0, args.train, args.test, args.size)
        write_capture(args.folder, build(args.meshes), cameras)
    except (Gs2dError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
