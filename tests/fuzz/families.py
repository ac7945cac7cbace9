"""What is mutated and who reads it: small valid files of every kind that gs2d takes from others, and its readers."""

from __future__ import annotations

import base64
import json
import random
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

import commands as c
import mutations as m
import numpy as np
import torch
from mutations import Mutation
from PIL import Image

from capture_writers import small_blender, small_colmap, small_dtu, small_nerfstudio
from foreign_writers import Lens, small_alicevision, small_metashape, small_opensfm
from gs2d.core.splats import Splats

Files = dict[str, bytes]


@dataclass(frozen=True)
class Family:
    """Kinds of valid input, each a folder of files; what changes which of them; and what then reads the folder."""

    name: str
    seeds: Callable[[], list[Files]]
    mutate: Mapping[str, Mutation]  # by the end of a file's name; files of no such end stay as they are
    read: Callable[[Path], object]

    def case(self, seed: int) -> tuple[Files, str]:
        """Return input ``seed``, always the same one: its files, and the one that was changed."""
        rng = random.Random(f"{self.name} {seed}")
        files = dict(rng.choice(self.seeds_made()))
        victims = sorted(name for name in files if self._mutation(name) is not None)
        victim = rng.choice(victims)
        mutation = self._mutation(victim)
        assert mutation is not None
        files[victim] = mutation(rng, files[victim])
        return files, victim

    def seeds_made(self) -> list[Files]:
        """Return the seeds, made once a process."""
        return _seeds(self.name)

    def _mutation(self, name: str) -> Mutation | None:
        return next((mutation for end, mutation in self.mutate.items() if name.endswith(end)), None)


@cache
def _seeds(name: str) -> list[Files]:
    return FAMILIES[name].seeds()


def written(*writers: Callable[[Path], object]) -> Callable[[], list[Files]]:
    """Seeds that functions write into empty folders."""

    def make() -> list[Files]:
        found = []
        for write in writers:
            with TemporaryDirectory(prefix="gs2d-seed-") as home:
                root = Path(home, "a")
                root.mkdir()
                write(root)
                found.append(
                    {p.relative_to(root).as_posix(): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}
                )
        return found

    return make


# -- captures ----------------------------------------------------------------------------------------------------------
def read_capture(root: Path) -> None:
    """As `gs2d train` does before it trains: the scene, one view with all that belongs to it, the points it shows."""
    from gs2d.contrib.lab.dataset_folders import missing_lines
    from gs2d.data import load_scene

    missing_lines(root)
    scene = load_scene(root)
    view = scene.views[0]
    view.image(), view.mask(), view.object_mask(), view.valid()
    if view.maps is not None:
        _ = view.maps.files.depth and view.maps.depth(), view.maps.files.normal and view.maps.normal()
    if scene.observe is not None:
        scene.observe()


def _nerfstudio(root: Path) -> None:
    """With everything that a file of nerfstudio may say."""
    maps = {"depth_file_path": "depth.png", "normal_file_path": "normal.npy", "mask_path": "mask.png"}
    meta = {"ply_file_path": "points.ply", "camera_model": "OPENCV", "k1": 0.01, "p1": 0.001}
    meta |= {"train_filenames": ["images/f_00.png", "images/f_01.png"], "test_filenames": ["images/f_02.png"]}
    small_nerfstudio(root, count=3, meta=meta, frame={**maps, "depth_unit_scale_factor": 0.001})
    Image.fromarray(np.full((30, 40), 3000, np.uint16)).save(root / "depth.png")
    np.save(root / "normal.npy", np.tile(np.float32([0, 0, 1]), (30, 40, 1)))
    Image.new("L", (40, 30), 255).save(root / "mask.png")
    ply_points(root / "points.ply")


def _colmap(root: Path, kind: str, model: str = "PINHOLE") -> None:
    params = {"PINHOLE": (35.0, 36.0, 18.5, 16.25), "OPENCV": (35.0, 36.0, 18.5, 16.25, 0.01, 0.0, 0.001, 0.0)}[model]
    small_colmap(root, count=4, kind=kind, cameras={7: (model, 40, 30, params)})
    Image.new("L", (40, 30), 255).save((root / "masks").mkdir() or root / "masks/0.png.png")


# -- splats, meshes, points --------------------------------------------------------------------------------------------
def some_splats(count: int = 20, degree: int = 1) -> Splats:
    rng = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "quats": (4,), "log_scales": (2,), "opacity_logits": (), "sh0": (1, 3)}
    shapes["shN"] = ((degree + 1) ** 2 - 1, 3)
    return Splats(**{name: torch.randn((count, *shape), generator=rng) for name, shape in shapes.items()})


def _splats(layout: str, name: str) -> Callable[[Path], object]:
    def write(root: Path) -> None:
        from gs2d.io.formats.splat_formats import write_layout

        write_layout(root / name, some_splats(), layout)

    return write


def as_ascii(name: str) -> Callable[[Path], object]:
    """The same splats as text."""

    def write(root: Path) -> None:
        _splats("2dgs", name)(root)
        from gs2d.io.ply_format import read_ply

        vertex = read_ply(root / name).elements["vertex"]
        head = "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 20\n"
        head += "".join(f"property float {prop}\n" for prop in vertex.properties)
        rows = np.stack([vertex.scalar(prop) for prop in vertex.properties], axis=1)
        (root / name).write_text(head + "end_header\n" + "".join(" ".join(map(repr, r)) + "\n" for r in rows.tolist()))

    return write


def read_splats_everywhere(root: Path) -> None:
    """As `gs2d info`, `gs2d export` and `--init` do."""
    from gs2d.io.formats.splat_formats import LAYOUTS, read_splat_file, read_splats, read_surfels, write_layout
    from gs2d.pipeline.look.info import describe_file

    (path,) = (p for p in root.iterdir() if p.is_file())
    describe_file(path)
    read_splat_file(path)
    notes: list[str] = []
    read_surfels(path, notes.append)
    disks = read_splats(path, notes.append)
    assert not [note for note in notes if "\n" in note]
    for layout in ("2dgs", "3dgs", "compressed", "spz", "splat"):
        write_layout(root / f"out{LAYOUTS.get(layout).ending}", disks, layout)


_FIELD = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "World"
{
    float3 xformOp:rotateXYZ = (90, 0, 30)
    double3 xformOp:translate = (1, -2, 3.5)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]

    def ParticleField3DGaussianSplat "Balls"
    {
        float[] opacities = [0.5, 1]
        quath[] orientationsh = [(1, 0, 0, 0), (0.5, 0.5, 0.5, 0.5)]
        point3f[] positions = [(0, 1, 2), (-1.5, 2, 1e-3)]
        half3[] radiance:sphericalHarmonicsCoefficientsh = [(0, 0.5, 1), (-1, 2, 0.25)]
        uniform int radiance:sphericalHarmonicsDegree = 0
        float3[] scales = [(0.1, 0.2, 1e-6), (0.2, 0.1, 1e-6)]
    }
}
"""


def read_usd(root: Path) -> None:
    """As `--init` does: each reading is a process."""
    from gs2d.io.formats.splat_formats import read_surfels

    (path,) = (p for p in root.iterdir() if p.is_file())
    read_surfels(path, lambda _: None)


def _gltf_text(root: Path) -> None:
    """The same as text, with the bytes in base64."""
    _splats("gltf", "a.glb")(root)
    data = (root / "a.glb").read_bytes()
    (root / "a.glb").unlink()
    (length,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + length])
    document["buffers"][0]["uri"] = "data:;base64," + base64.b64encode(data[28 + length :]).decode()
    document["nodes"] = [{"mesh": 0, "rotation": [0, 0.6, 0, 0.8], "scale": [2, 2, 2]}, {"children": [0]}]
    document["scenes"] = [{"nodes": [1]}]
    (root / "a.gltf").write_text(json.dumps(document))


def _stream(root: Path) -> None:
    """A tree of a few leaves in some levels."""
    from gs2d.contrib.formats import sog_streamed
    from gs2d.io.formats.splat_formats import write_layout

    with mock.patch.object(sog_streamed, "_LEAF", 20), mock.patch.object(sog_streamed, "_FILE", 30):
        write_layout(root / "lod-meta.json", some_splats(60), "streamed")


def read_stream(root: Path) -> None:
    """As `gs2d info` and `--init` do."""
    from gs2d.io.formats.splat_formats import read_splat_file
    from gs2d.pipeline.look.info import describe_file

    describe_file(root / "lod-meta.json")
    read_splat_file(root / "lod-meta.json")


def ply_points(path: Path) -> None:
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 12\nproperty double x\nproperty double y\n"
    head += "property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    rows = b"".join(struct.pack("<ddf3B", 0.1 * i, 0.2 * (i % 3), -0.1 * i, i, 20, 255) for i in range(12))
    path.write_bytes(head.encode() + rows)


_VERTICES = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 0.5, 1)]
_FACES = [(0, 1, 2, 3), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)]


def ply_mesh(path: Path, order: str, *, ragged: bool = True) -> None:
    """A pyramid: a square and four triangles, or triangles alone; with colours and a property that nobody reads."""
    faces = _FACES if ragged else [face[:3] for face in _FACES]
    head = f"ply\nformat {order} 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
    head += "property float red\nproperty float green\nproperty float blue\n"
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nproperty short flags\nend_header\n"
    if order == "ascii":
        rows = "".join(f"{x} {y} {z} 0.5 0.25 1\n" for x, y, z in _VERTICES)
        rows += "".join(f"{len(face)} {' '.join(map(str, face))} 7\n" for face in faces)
        path.write_bytes((head + rows).encode())
        return
    mark = "<" if "little" in order else ">"
    body = b"".join(struct.pack(mark + "6f", *v, 0.5, 0.25, 1) for v in _VERTICES)
    body += b"".join(struct.pack(f"{mark}B{len(face)}ih", len(face), *face, 7) for face in faces)
    path.write_bytes(head.encode() + body)


_ORDERS = ("ascii", "binary_little_endian", "binary_big_endian")


def _pyramid(root: Path, order: str, ragged: bool) -> None:
    ply_mesh(root / "a.ply", order, ragged=ragged)


def read_surface(root: Path) -> None:
    """As `gs2d info` and `gs2d evaluate --mesh-gt` do."""
    from gs2d.contrib.lab.visible_surface import read_truth
    from gs2d.io.meshes import FOREIGN, read_mesh, read_points
    from gs2d.pipeline.look.info import describe_file

    (path,) = (p for p in root.iterdir() if p.suffix != ".npy")
    describe_file(path)
    if path.suffix not in FOREIGN:
        read_points(path)
    read_truth(path)
    read_mesh(path)


def _obj(path: Path) -> None:
    lines = ["# by hand", "mtllib a.mtl", "o pyramid"]
    lines += [f"v {x} {y} {z} 0.5 0.25 1" for x, y, z in _VERTICES] + ["vt 0 0", "vt 1 0", "vn 0 0 1", "usemtl red"]
    lines += ["f " + " ".join(f"{i + 1}/1/1" for i in face) for face in _FACES[:2]]
    lines += ["g sides", *("f " + " ".join(str(i - 5) for i in face) for face in _FACES[2:])]
    path.write_text("\n".join(lines) + "\n")


def _off(path: Path) -> None:
    lines = ["OFF", "5 5 0", *(f"{x} {y} {z}" for x, y, z in _VERTICES)]
    path.write_text("\n".join([*lines, *(f"{len(face)} {' '.join(map(str, face))}" for face in _FACES)]) + "\n")


def _stl(path: Path, *, text: bool) -> None:
    faces = [[_VERTICES[i] for i in face[:3]] for face in _FACES]
    if text:
        corners = ["".join(f"vertex {x} {y} {z}\n" for x, y, z in face) for face in faces]
        body = "".join(f"facet normal 0 0 1\nouter loop\n{c}endloop\nendfacet\n" for c in corners)
        path.write_text(f"solid a\n{body}endsolid a\n")
        return
    rows = b"".join(struct.pack("<3f9fH", 0, 0, 1, *(x for corner in face for x in corner), 0) for face in faces)
    path.write_bytes(bytes(80) + struct.pack("<I", len(faces)) + rows)


# -- images and arrays -------------------------------------------------------------------------------------------------
def _image(name: str, mode: str = "RGB", **options: object) -> Callable[[Path], object]:
    def write(root: Path) -> None:
        channels = {"L": 0, "I;16": 0, "F": 0, "1": 0, "P": 0, "RGBA": 4, "LA": 2}.get(mode, 3)
        pixels = np.random.default_rng(0).integers(0, 256, (20, 24, channels) if channels else (20, 24))
        dtype = {"I;16": np.uint16, "F": np.float32}.get(mode, np.uint8)
        image = Image.fromarray(pixels.astype(dtype))
        image = image if mode in ("I;16", "F", "RGBA", "RGB", "L", "LA") else image.convert(mode)
        exif = Image.Exif()
        exif[0x0112], exif[0x0110] = 6, "camera"
        image.save(root / name, **({"exif": exif} if name.endswith(("jpg", "tif", "webp")) else {}), **options)

    return write


def read_picture(root: Path) -> None:
    """As a photograph, as one without a camera yet, as a mask, as depths and as normals."""
    from gs2d.data.image_files import image_size, read_image, read_mask
    from gs2d.data.prior_maps import read_depth, read_normals
    from gs2d.errors import DataError
    from gs2d.sfm.photos import _read as looked_at

    (path,) = (p for p in root.iterdir() if p.is_file())
    refused: Exception | None = None
    for read in (image_size, read_image, lambda p: looked_at(p, root, p.name), read_mask, read_depth, read_normals):
        try:
            read(path)
        except DataError as error:
            refused = error
    if refused is not None:
        raise refused


def _array(name: str, array: object) -> Callable[[Path], object]:
    return lambda root: np.save(root / name, np.asarray(array))


def read_map(root: Path) -> None:
    from gs2d.data.prior_maps import read_depth, read_normals

    (path,) = (p for p in root.iterdir() if p.is_file())
    (read_normals if "normal" in path.name else read_depth)(path)


def _counted(root: Path) -> None:
    ply_mesh(root / "mesh.ply", "binary_little_endian", ragged=False)
    np.save(root / "mesh_seen.npy", np.arange(len(_FACES)))


# -- places in the world -----------------------------------------------------------------------------------------------
_TABLES = {
    "control.csv": "# EPSG:32632\nname,x,y,z,photo,u,v,check\nA,600000.5,5200000,400,f_0.png,12.5,7,\n"
    "A,600000.5,5200000,400,f_1.png,3,9,\nB,600010,5200000,401.5,f_0.png,20,11,yes\n",
    "control_in_the_run.csv": 'name;lat;lon;height;run_x;run_y;run_z\n"A";47.5;9.25;400;0;1;2\n'
    '"B, new";47.6;9.5;;1;1;1\n',
    "control_odm.txt": "EPSG:32632\n600000 5200000 400 12 8 f_0.png A\n600010 5200000 401 20 11 f_1.png B\n",
    "positions.csv": "name,lat,lon,height\nf_0.png,47.5,9.25,401\nf_1.png,47.51,9.26,\n",
    "positions_odm.txt": "+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs\nf_0.png 600000 5200000 400 0 0 0\n",
}


def read_places(root: Path) -> None:
    """As `gs2d survey` reads its tables."""
    from gs2d.contrib.survey.control import read_control
    from gs2d.data.positions import matched, read_positions
    from gs2d.errors import DataError

    refused: Exception | None = None
    for path in sorted(root.iterdir()):
        try:
            if path.stem.startswith("control"):
                read_control(path)
            elif path.stem.startswith("positions"):
                matched(read_positions(path), ["f_0.png", "f_1.png"])
        except DataError as error:
            refused = error
    if refused is not None:
        raise refused


# -- official ground truth ---------------------------------------------------------------------------------------------
def _official(root: Path) -> None:
    (root / "crop.json").write_text(json.dumps({
        "axis_max": 1.0, "axis_min": -1.0, "bounding_polygon": [[0, 0, 0], [1, 0, 0], [1, 1, 0]], "class_name":
        "SelectionPolygonVolume", "orthogonal_axis": "Z", "version_major": 1, "version_minor": 0,
    }))  # fmt: skip
    np.savetxt(root / "trans.txt", np.eye(4))
    (root / "a.log").write_text("".join(f"{i} {i} 0\n1 0 0 0\n0 1 0 0\n0 0 1 {i}\n0 0 0 1\n" for i in range(3)))


def read_official(root: Path) -> None:
    from gs2d.contrib.lab.evaluate_tnt import read_crop, read_trajectory, read_transform
    from gs2d.errors import DataError

    refused: Exception | None = None
    reads = {"crop.json": read_crop, "trans.txt": read_transform, "a.log": read_trajectory}
    for name, read in reads.items():
        try:
            read(root / name)
        except DataError as error:
            refused = error
    if refused is not None:
        raise refused


# -- checkpoints, recipes ----------------------------------------------------------------------------------------------
def _checkpoint(root: Path) -> None:
    from gs2d.io.run_dir import save_tensors

    splats = some_splats(5)
    state = {"splats": dict(splats.items()), "queue": [1, 2], "generator": torch.Generator().get_state()}
    save_tensors(root / "0-surface-0000004.pt", {"state": state, "key": "a" * 64, "events_bytes": 10, "seconds": 1.0})


def read_checkpoint(root: Path) -> None:
    from gs2d.io.run_dir import load_tensors

    payload = load_tensors(root / "0-surface-0000004.pt")
    sum(t.double().sum() for t in payload.get("state", {}).get("splats", {}).values() if hasattr(t, "double"))


def _recipe(root: Path) -> None:
    from gs2d.config.presets import get_recipe
    from gs2d.config.serialize import to_json

    (root / "mine.json").write_text(json.dumps(to_json(get_recipe("2dgs-r"))))


def read_recipe(root: Path) -> None:
    from gs2d.config.recipe_files import read_recipe_file

    read_recipe_file(str(root / "mine.json"))


_JSON = m.either(m.of_json, m.of_json, m.of_text, m.of_bytes)
_TEXT = m.either(m.of_text, m.of_text, m.of_bytes)
_NPZ = m.of_zip(m.of_npy)
_LENS = Lens()
_TREE = {".json": _JSON, ".ply": m.of_ply, ".npy": m.of_npy, ".png": m.of_png}

_SOG = m.either(m.of_json, m.of_bytes)  # of_json takes what is none as text

_ALL = (
    Family("colmap-bin", written(partial(_colmap, kind="bin"), partial(_colmap, kind="bin", model="OPENCV")),
           {".bin": m.of_bytes}, read_capture),
    Family("colmap-txt", written(partial(_colmap, kind="txt"), partial(_colmap, kind="txt", model="OPENCV")),
           {".txt": _TEXT}, read_capture),
    Family("transforms", written(_nerfstudio, partial(small_blender, train=2, test=1)), _TREE, read_capture),
    Family("dtu", written(partial(small_dtu, count=3)), {".npz": _NPZ, ".png": m.of_png}, read_capture),
    Family("opensfm", written(lambda root: small_opensfm(root, _LENS)), {".json": _JSON}, read_capture),
    Family("metashape", written(lambda root: small_metashape(root, _LENS)), {".xml": _TEXT}, read_capture),
    Family("meshroom", written(lambda root: small_alicevision(root, _LENS)), {".sfm": _JSON}, read_capture),
    Family("ply-splats", written(_splats("2dgs", "a.ply"), _splats("3dgs", "a.ply"), as_ascii("a.ply"),
           _splats("compressed", "a.compressed.ply")), {".ply": m.of_ply}, read_splats_everywhere),
    Family("ply-mesh", written(
        *(partial(_pyramid, order=order, ragged=ragged) for order in _ORDERS for ragged in (True, False)),
        lambda root: ply_points(root / "a.ply")), {".ply": m.of_ply}, read_surface),
    Family("obj-stl-off", written(lambda root: _obj(root / "a.obj"), lambda root: _off(root / "a.off"),
           lambda root: _stl(root / "a.stl", text=True), lambda root: _stl(root / "a.stl", text=False)),
           {".obj": _TEXT, ".off": _TEXT, ".stl": m.either(m.of_text, m.of_bytes)}, read_surface),
    Family("spz-splat", written(_splats("spz", "a.spz"), _splats("spz4", "4.spz"), _splats("splat", "a.splat")),
           {"4.spz": m.of_bytes, ".spz": m.either(m.of_gzip, m.of_gzip, m.of_bytes), ".splat": m.of_bytes},
           read_splats_everywhere),
    Family("gltf", written(_splats("gltf", "a.glb"), _gltf_text), {".glb": m.of_glb, ".gltf": _JSON},
           read_splats_everywhere),
    Family("sog", written(_splats("sog", "a.sog")), {".sog": m.either(m.of_zip(_SOG), m.of_zip(_SOG), m.of_bytes)},
           read_splats_everywhere),
    Family("sog-streamed", written(_stream), {".json": _JSON, ".webp": m.of_bytes}, read_stream),
    Family("usd", written(_splats("usd", "a.usd"), lambda root: (root / "a.usda").write_text(_FIELD)),
           {".usd": m.of_bytes, ".usda": m.either(_TEXT, _TEXT, m.of_bytes)}, read_usd),
    Family("npy", written(_array("depth.npy", np.ones((8, 9))), _array("normal.npy", np.ones((8, 9, 3)) / 3**0.5)),
           {".npy": m.of_npy}, read_map),
    Family("seen-counts", written(_counted), {".npy": m.of_npy}, read_surface),
    Family("images", written(
        _image("a.png"), _image("a.png", "P"), _image("a.png", "LA"), _image("a.png", "I;16"), _image("a.jpg"),
        _image("a.jpg", "L", progressive=True), _image("a.tif"), _image("a.tif", "F"), _image("a.webp", "RGBA"),
        _image("a.tif", compression="tiff_lzw"), _image("a.bmp"), _image("a.ppm"),
        _image("a.jp2")),
        {".png": m.of_png, "": m.of_bytes}, read_picture),
    Family("places", written(lambda root: [(root / name).write_text(text) for name, text in _TABLES.items()]),
           {".csv": _TEXT, ".txt": _TEXT}, read_places),
    Family("official", written(_official), {".json": _JSON, ".txt": _TEXT, ".log": _TEXT}, read_official),
    Family("checkpoint", written(_checkpoint), {".pt": m.either(m.of_zip(m.of_bytes), m.of_bytes)}, read_checkpoint),
    Family("recipe", written(_recipe), {".json": _JSON}, read_recipe),
    Family("run-files", c.run_seeds, c.RUN_FILES, c.read_run),
    Family("command-line", c.line_seeds, {".json": c.JSON_LINE}, c.read_line),
)  # fmt: skip
FAMILIES = {family.name: family for family in _ALL}
