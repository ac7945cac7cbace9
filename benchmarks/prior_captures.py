"""Make captures with depth or normal maps and a known true surface, to measure the gain of priors.

::

    python -m benchmarks.prior_captures CAPTURE --out OUT --every 5 --maps sensor    # or relative, sparse, none
    python -m benchmarks.prior_captures room --out OUT --views 12 --maps relative

CAPTURE is in the NeRF-Synthetic layout with ``mesh_gt.ply``; every N-th training view is kept. ``room`` is a rendered,
furnished room with plain walls. The output is in COLMAP's layout with the true poses, for ``--test-every 4``, with
points that pycolmap triangulates from the training views alone. Depth maps are computed from the mesh and degraded like
those of typical sources:

sensor    half the resolution, 1 % noise, invalid within a pixel of an edge and in a tenth of the image
relative  disparity with a random scale and shift per view, smooth noise of 3 %, 16 bits
normal    no depths, but normals in OpenGL's axes, smooth noise of 5 degrees, 8 bits
none      no maps, only the points
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import grey_dilation, grey_erosion, zoom

from gs2d.contrib.capture.json_captures import read_blender
from gs2d.core.camera import Camera, look_at
from gs2d.core.mesh import Mesh
from gs2d.io.meshes import read_mesh, write_mesh
from gs2d.meshing.raycast import Hits, cast_camera

SIZE, ANGLE = 256, 1.2  # of the room's images: px, radians
UP = np.array([0.0, 0.0, 1.0])
TEST_EVERY = 4
Shot = tuple[str, Camera, bool]  # an image's name and camera, and whether it is a test view


# -- degraded depth maps -------------------------------------------------------------------------------------------
def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], cells: int) -> np.ndarray:
    """Return normal noise [H, W], interpolated from a grid with this many cells along each side."""
    coarse = rng.normal(size=(cells + 3, cells + 3))
    fine = zoom(coarse, (max(shape) / cells + 1), order=3)
    return np.asarray(fine[: shape[0], : shape[1]])


def sensor_map(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a sensor depth map, uint16 [h, w] in thousandths of a unit; 0 = invalid."""
    small = depth[::2, ::2]
    edge = grey_dilation(small, (3, 3)) - grey_erosion(small, (3, 3)) > 0.05 * np.maximum(small, 1e-6)
    noise = smooth_noise(rng, small.shape, 12)
    holes = noise > np.quantile(noise, 0.9)
    noisy = small * (1 + 0.01 * rng.normal(size=small.shape))
    return np.where(edge | holes | (small == 0), 0, np.rint(1000 * noisy)).astype(np.uint16)


def relative_map(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a relative depth map, uint16 [H, W], linear in disparity; 0 = invalid."""
    bent = 1 / np.where(depth > 0, depth, 1) * (1 + 0.03 * smooth_noise(rng, depth.shape, 5))
    low, high = bent[depth > 0].min(), bent[depth > 0].max()
    scale, shift = rng.uniform(0.4, 0.8), rng.uniform(0.05, 0.2)
    values = shift + scale * (bent - low) / (high - low)
    return np.where(depth > 0, np.rint(65535 * values), 0).astype(np.uint16)


def normal_map(mesh: Mesh, hits: Hits, camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """Return a normal map, uint8 [H, W, 3] of (n + 1) / 2, OpenGL axes; black = invalid."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    seen = normals[hits.face] @ camera.rotation.T
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones(hits.face.shape)], axis=2)
    seen *= -np.sign((seen * rays).sum(axis=2, keepdims=True))
    seen += np.radians(5) * np.stack([smooth_noise(rng, hits.face.shape, 5) for _ in range(3)], axis=2)
    seen /= np.linalg.norm(seen, axis=2, keepdims=True)
    encoded = np.rint(127.5 * (seen * (1, -1, -1) + 1))
    return np.where(hits.face[..., None] >= 0, encoded, 0).astype(np.uint8)


# -- captures ------------------------------------------------------------------------------------------------------
def write_maps(out: Path, mesh: Mesh, order: list[Shot], maps: str, seed: int) -> None:
    """Write the maps of the training views."""
    for k, (name, camera, is_test) in enumerate(order):
        if is_test or maps == "none":
            continue
        rng = np.random.default_rng([seed, k])
        hits = cast_camera(mesh.vertices, mesh.faces, camera)
        if maps == "normal":
            made = normal_map(mesh, hits, camera, rng)
        else:
            made = (sensor_map if maps == "sensor" else relative_map)(hits.depth, rng)
        path = out / ("normals" if maps == "normal" else "depths") / name
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(made).save(path)


def write_colmap(out: Path, images: dict[str, list[tuple[Camera, np.ndarray]]]) -> list[Shot]:
    """Write a COLMAP capture in which every 4th image is a test view, with points from the other images."""
    import pycolmap

    (out / "images").mkdir()
    train, test = list(images["train"]), list(images["test"])
    order: list[Shot] = []
    while train:
        is_test = len(order) % TEST_EVERY == 0
        camera, image = test.pop(0) if is_test else train.pop(0)
        order.append((f"{len(order):03d}.png", camera, is_test))
        Image.fromarray(image).save(out / "images" / order[-1][0])
    work = out / "work"
    (work / "images").mkdir(parents=True)
    for name, _, is_test in order:
        if not is_test:
            with Image.open(out / "images" / name) as file:
                white = Image.new("RGB", file.size, "white")
                white.paste(file, mask=file.getchannel("A") if file.mode == "RGBA" else None)
                white.save(work / "images" / name)
    camera = order[0][1]
    reader = pycolmap.ImageReaderOptions(
        camera_model="PINHOLE", camera_params=f"{camera.fx},{camera.fy},{camera.cx},{camera.cy}"
    )
    database = work / "database.db"
    pycolmap.extract_features(database, work / "images", camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader)
    pycolmap.match_exhaustive(database)
    write_model(work / "known", order, with_test=False)
    with pycolmap.Database.open(database) as db:
        ids = {image.name: image.image_id for image in db.read_all_images()}
    write_model(work / "known", order, ids=ids, with_test=False)
    found = pycolmap.triangulate_points(
        pycolmap.Reconstruction(work / "known"), database, work / "images", work / "known", refine_intrinsics=False
    )
    (work / "txt").mkdir()
    found.write_text(work / "txt")
    sparse = out / "sparse" / "0"
    write_model(sparse, order, ids=ids, with_test=True)
    # Keep the true poses; take the observations from the triangulation.
    lines = [line for line in (work / "txt" / "images.txt").read_text().splitlines() if not line.startswith("#")]
    observed = {lines[i].split()[-1]: lines[i + 1] for i in range(0, len(lines) - 1, 2)}
    given = (sparse / "images.txt").read_text().splitlines()
    text = [line for i in range(0, len(given), 2) for line in (given[i], observed.get(given[i].split()[-1], ""))]
    (sparse / "images.txt").write_text("\n".join(text) + "\n")
    shutil.copy(work / "txt" / "points3D.txt", sparse)
    shutil.rmtree(work)
    return order


def write_model(folder: Path, order: list[Shot], *, ids: dict[str, int] | None = None, with_test: bool) -> None:
    """Write COLMAP text files of known cameras, without points."""
    from scipy.spatial.transform import Rotation

    folder.mkdir(parents=True, exist_ok=True)
    c = order[0][1]
    (folder / "cameras.txt").write_text(f"1 PINHOLE {c.width} {c.height} {c.fx} {c.fy} {c.cx} {c.cy}\n")
    lines = []
    for index, (name, camera, is_test) in enumerate(order):
        if is_test and not with_test:
            continue
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
        t = camera.T_cam_world[:3, 3]
        number = (ids or {}).get(name, 10_000 + index)
        lines += [f"{number} {w} {x} {y} {z} {t[0]} {t[1]} {t[2]} 1 {name}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text("")


def of_capture(root: Path, every: int, tests: int) -> tuple[Mesh, dict[str, list[tuple[Camera, np.ndarray]]]]:
    """Return mesh and images of a NeRF-Synthetic capture, reduced to fewer views."""
    found: dict[str, list[tuple[Camera, np.ndarray]]] = {"train": [], "test": []}
    for frame in read_blender(root).frames:
        k = frame.intrinsics
        camera = Camera(k.width, k.height, k.fx, k.fy, k.cx, k.cy, frame.T_cam_world)
        found[frame.split or "train"].append((camera, np.asarray(Image.open(frame.path))))
    step = max(1, len(found["test"]) // tests)
    return read_mesh(root / "mesh_gt.ply"), {"train": found["train"][::every], "test": found["test"][::step][:tests]}


# -- a room --------------------------------------------------------------------------------------------------------
def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices [8, 3] and faces [12, 3].

    Face i belongs to side i // 2: x low, x high, y low, y high, z low, z high.
    """
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
    vertices = np.array(low) + corners * (np.array(high) - np.array(low))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [tri for a, b, c, d in quads for tri in ((a, b, c), (a, c, d))]
    return vertices, np.array(faces)


ROOM = ((-2.0, -1.6, 0.0), (2.0, 1.6, 2.4))
THINGS = (  # low, high, colour, whether it has a texture
    ((-1.9, -0.5, 0.0), (-1.1, 0.9, 0.5), (0.55, 0.3, 0.25), True),  # a couch
    ((0.2, -0.4, 0.0), (0.9, 0.3, 0.45), (0.5, 0.4, 0.25), True),  # a table
    ((0.4, -0.1, 0.45), (0.6, 0.1, 0.75), (0.2, 0.35, 0.6), True),  # an object on the table
    ((1.5, -1.5, 0.0), (1.95, -0.6, 1.8), (0.75, 0.72, 0.65), False),  # a plain wardrobe
    ((-0.6, 1.56, 1.0), (0.6, 1.6, 1.8), (0.4, 0.5, 0.35), True),  # an image on the wall
)


def room_mesh() -> tuple[Mesh, np.ndarray]:
    """Return the room's mesh, and the object index of each face: 0 for the room, 1.. for THINGS."""
    vertices, faces, owner, count = [], [], [], 0
    for index, (low, high) in enumerate([ROOM, *((t[0], t[1]) for t in THINGS)]):
        v, f = box(low, high)
        vertices.append(v)
        faces.append(f + count)
        owner += [index] * len(f)
        count += len(v)
    return Mesh(np.concatenate(vertices), np.concatenate(faces).astype(np.int32)), np.array(owner)


def room_image(mesh: Mesh, owner: np.ndarray, camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """Render uint8 [H, W, 3]: plain walls and ceiling, board floor, textured objects, one lamp, a little noise."""
    samples = 3
    hits = cast_camera(mesh.vertices, mesh.faces, camera, samples=samples)
    points = (mesh.vertices[mesh.faces[hits.face]] * hits.weights[..., None]).sum(axis=2)
    side = (hits.face % 12) // 2
    axis = side // 2
    normal = np.eye(3)[axis] * np.sign((camera.center - points)[..., None, :] @ np.eye(3)[axis][..., None])[..., 0]
    thing = owner[hits.face]
    colors = np.array([(0.85, 0.83, 0.78), *(t[2] for t in THINGS)])
    albedo = colors[thing]
    u = np.take_along_axis(points, ((axis + 1) % 3)[..., None], axis=2)[..., 0]
    v = np.take_along_axis(points, ((axis + 2) % 3)[..., None], axis=2)[..., 0]
    speckles = np.random.default_rng(5).random((256, 256))
    mottle = np.zeros_like(u)
    for cells in (5, 11, 23):  # a metre
        mottle += speckles[np.floor(cells * u).astype(np.int64) % 256, np.floor(cells * v).astype(np.int64) % 256] / 3
    pattern = 0.3 + 1.4 * mottle
    textured = np.array([False, *(t[3] for t in THINGS)])[thing]
    floor = (thing == 0) & (side == 4)
    boards = (0.45 + 0.1 * np.sin(7 * np.floor(points[..., 1] / 0.2))) * (0.5 + mottle)
    albedo = np.where(floor[..., None], np.array((1.0, 0.8, 0.55)) * boards[..., None], albedo)
    albedo = np.where(textured[..., None], albedo * pattern[..., None], albedo)
    lamp = np.array((0.3, 0.2, 2.2)) - points
    distance = np.linalg.norm(lamp, axis=2)
    light = 0.45 + 0.9 * np.abs((lamp * normal).sum(axis=2)) / distance / (0.6 + distance**2)
    color = np.clip(albedo * light[..., None], 0, 1)
    color = color.reshape(camera.height, samples, camera.width, samples, 3).mean(axis=(1, 3)) ** (1 / 2.2)
    return np.rint(np.clip(255 * color + rng.normal(size=color.shape), 0, 255)).astype(np.uint8)


def of_room(views: int, tests: int, seed: int) -> tuple[Mesh, dict[str, list[tuple[Camera, np.ndarray]]]]:
    """Return mesh and images of a camera turning in the room's centre, with a step to the side per image."""
    mesh, owner = room_mesh()
    rng = np.random.default_rng([seed, 7])
    f = SIZE / 2 / np.tan(ANGLE / 2)
    found: dict[str, list[tuple[Camera, np.ndarray]]] = {}
    for split, count, start in (("train", views, 0.0), ("test", tests, 0.35)):
        found[split] = []
        for k in range(count):
            angle = start + 2 * np.pi * k / count
            eye = np.array(
                [-0.35 + 0.45 * np.cos(2.4 * k), -0.7 + 0.35 * np.sin(2.4 * k), 1.35 + 0.2 * np.sin(1.7 * k)]
            )
            target = eye + np.array([np.cos(angle), np.sin(angle), -0.25 + 0.15 * np.sin(3.1 * k)])
            camera = look_at(eye, target, UP, width=SIZE, height=SIZE, fx=f)
            found[split].append((camera, room_image(mesh, owner, camera, rng)))
    return mesh, found


def main() -> None:
    """Write one capture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", help="NeRF-Synthetic capture with mesh_gt.ply, or: room")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--maps", choices=("sensor", "relative", "normal", "none"), default="none")
    parser.add_argument("--every", type=int, default=5, help="keep every N-th training view of a capture")
    parser.add_argument("--views", type=int, default=16, help="number of training views of the room")
    parser.add_argument("--tests", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    room = args.capture == "room"
    mesh, images = (
        of_room(args.views, args.tests, args.seed) if room else of_capture(Path(args.capture), args.every, args.tests)
    )
    args.out.mkdir(parents=True)
    write_mesh(args.out / "mesh_gt.ply", mesh)
    write_maps(args.out, mesh, write_colmap(args.out, images), args.maps, args.seed)


if __name__ == "__main__":
    main()
