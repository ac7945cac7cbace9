"""Compare textured meshes with the photographs of views that were not used for baking.

::

    python -m benchmarks.texture RUN [--downscale N] [--faces 50000] [--every 1] [--hold-out 4] [--pictures FOLDER]

Bakes a texture from the photographs of a run with a ``mesh.ply``. Renders the mesh with the texture and with its vertex
colours from the test views, with the demo's ray caster (2 x 2 rays per pixel). For a run without test views, every N-th
training view is left out of baking (``--hold-out``). Prints means over these views:

- PSNR of the whole image, and of the pixels that mesh and alpha channel, if any, cover entirely;
- PSNR of those pixels after one gain per channel and image, which removes the photograph's exposure;
- the median absolute error of those pixels, which is robust to obstacles in the photographs;
- sharpness: the mean gradient of those pixels relative to the photograph's.

Photographs are compared in the mean exposure of the run. ``--downscale`` applies to the photographs that are baked and
compared (default: the run's).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gs2d.core.camera import Camera
from gs2d.core.image_arrays import composite
from gs2d.core.mesh import Mesh, TexturedMesh
from gs2d.data import View
from gs2d.data.image_files import write_image
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import MESH, open_run
from gs2d.meshing.raycast import Hits, cast_camera
from gs2d.meshing.texture import bilinear
from gs2d.pipeline.finish.run_texture import textured_mesh
from gs2d.pipeline.prepare.learned_views import as_scene
from gs2d.pipeline.prepare.loaded import finished_splats, reload_run
from gs2d.pipeline.prepare.open_capture import read_scene
from gs2d.pipeline.prepare.options import TextureOptions

SAMPLES = 2  # rays per pixel along each axis


def image(
    mesh: Mesh | TexturedMesh, camera: Camera, background: Sequence[float] = (1.0, 1.0, 1.0), samples: int = SAMPLES
) -> tuple[np.ndarray, np.ndarray]:
    """Return the unshaded mesh image [H, W, 3] in [0, 1], and the coverage of each pixel [H, W]."""
    hits = cast_camera(mesh.vertices.astype(np.float64), mesh.faces, camera, samples=samples)
    rays = np.ones((*hits.face.shape, 3)) * np.asarray(background)
    rays[hits.face >= 0] = _colors(mesh, hits)
    blocks = (camera.height, samples, camera.width, samples)
    covered = (hits.face >= 0).reshape(blocks).mean(axis=(1, 3))
    return rays.reshape(*blocks, 3).mean(axis=(1, 3)), covered


def _colors(mesh: Mesh | TexturedMesh, hits: Hits) -> np.ndarray:
    """Return colours [hits, 3] in [0, 1], interpolated between vertices or sampled from the texture."""
    hit = hits.face >= 0
    corners, weights = mesh.faces[hits.face[hit]], hits.weights[hit].astype(np.float64)
    if isinstance(mesh, Mesh):
        assert mesh.colors is not None
        return np.asarray(np.einsum("hk,hkc->hc", weights, mesh.colors[corners] / 255))
    uv = np.einsum("hk,hkc->hc", weights, mesh.uv[corners].astype(np.float64)) * len(mesh.texture)
    return bilinear(mesh.texture, uv[:, 0], uv[:, 1]) / 255


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Return the PSNR in dB of values in [0, 1]."""
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def sharpness(image: np.ndarray, inside: np.ndarray) -> float:
    """Return the mean gradient of the grey image [H, W, 3] between pixels that are both ``inside`` [H, W]."""
    grey = image.mean(axis=2)
    steps = [
        np.abs(np.diff(grey, axis=k))[
            inside.take(range(1, inside.shape[k]), k) & inside.take(range(inside.shape[k] - 1), k)
        ]
        for k in (0, 1)
    ]
    return float(np.concatenate(steps).mean())


def compare(
    meshes: dict[str, Mesh | TexturedMesh],
    views: Sequence[View],
    background: Sequence[float],
    pictures: Path | None,
) -> None:
    """Print the figures of each mesh and write the images."""
    for name, mesh in meshes.items():
        figures = []
        for i, view in enumerate(views):
            target = composite(as_scene(view), background)
            drawn, covered = image(mesh, view.camera, background)
            alpha = view.alpha()
            both = (covered == 1) & (alpha == 1 if alpha is not None else True)
            level = drawn[both] * np.median(target[both], axis=0) / np.maximum(np.median(drawn[both], axis=0), 1e-6)
            error = float(np.median(np.abs(drawn[both] - target[both]))) * 255
            sharp = sharpness(drawn, both) / sharpness(target, both)
            figures.append(
                (psnr(drawn, target), psnr(drawn[both], target[both]), psnr(level, target[both]), error, sharp)
            )
            if pictures is not None:
                write_image(pictures / f"{i:03d}-{name}.png", drawn)
                write_image(pictures / f"{i:03d}-photograph.png", target)
        whole, inside, levelled, error, sharp = np.mean(figures, axis=0)
        print(
            f"{name:>16}: {whole:.2f} dB, {inside:.2f} dB where both cover a pixel, {levelled:.2f} dB after a gain, "
            f"median error {error:.1f} of 255, "
            f"sharpness {sharp:.2f}"
        )


def main() -> None:
    """Parse the arguments and run the comparison."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--downscale", type=int)
    parser.add_argument("--faces", type=int, default=TextureOptions().faces)
    parser.add_argument("--size", type=int)
    parser.add_argument("--every", type=int, default=1, help="use only every N-th test view")
    parser.add_argument("--hold-out", type=int, default=4, help="without test views: leave out every N-th view")
    parser.add_argument("--pictures", type=Path, help="existing folder for images")
    arguments = parser.parse_args()
    run = open_run(arguments.run)
    job, mesh = reload_run(run, lambda _event: None), read_mesh(run.file(MESH))
    shrink = arguments.downscale or job.resolved.downscale
    if shrink != job.resolved.downscale and job.scene.root is not None:
        scene = read_scene(job.scene.root, job.scene.format, shrink, job.protocol, lambda _event: None)
        job = replace(job, scene=scene, resolved=replace(job.resolved, downscale=shrink))
    views = job.scene.test
    if not views:
        views = job.scene.train[:: arguments.hold_out]
        rest = tuple(view for view in job.scene.train if view not in views)
        job = replace(job, scene=replace(job.scene, train=rest, test=views))
    meshes: dict[str, Mesh | TexturedMesh] = {"vertex colours": mesh}
    start, cpu = time.perf_counter(), time.process_time()
    baked = textured_mesh(
        job.trained(finished_splats(run)), mesh, TextureOptions(faces=arguments.faces, texture_size=arguments.size)
    )
    took = f"{time.perf_counter() - start:.1f} s ({time.process_time() - cpu:.1f} s of CPU)"
    size, unseen = len(baked.mesh.texture), baked.unseen / baked.texels
    print(f"texture: {size}x{size}, {len(baked.mesh.faces):,} faces, {unseen:.2%} unseen, {took}", flush=True)
    meshes["texture"] = baked.mesh
    compare(meshes, views[:: arguments.every], job.settings.background, arguments.pictures)


if __name__ == "__main__":
    main()
