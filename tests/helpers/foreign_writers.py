"""Write captures of other tools from known cameras and lenses, following the documentation of these tools.

All use the same images (40x30, ``a_0.jpg`` ...); the same cameras as a COLMAP model serve for comparison.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from capture_writers import ColmapModel, ring

WIDTH, HEIGHT = 40, 30


@dataclass(frozen=True)
class Lens:
    """fx, fy, cx, cy in pixels from the corner; polynomial coefficients k; OpenCV's p1 and p2."""

    fx: float = 35.0
    fy: float = 35.0
    cx: float = 20.0
    cy: float = 15.0
    k: tuple[float, ...] = ()
    p: tuple[float, float] = (0.0, 0.0)

    def colmap(self) -> tuple[str, int, int, tuple[float, ...]]:
        k1, k2, k3 = (*self.k, 0.0, 0.0, 0.0)[:3]
        return "FULL_OPENCV", WIDTH, HEIGHT, (self.fx, self.fy, self.cx, self.cy, k1, k2, *self.p, k3, 0.0, 0.0, 0.0)


OFF_CENTRE = Lens(35.0, 36.0, 18.5, 16.25)
BENT = Lens(35.0, 36.0, 18.5, 16.25, (0.12, -0.05, 0.02), (0.004, -0.003))


def poses(count: int = 9) -> dict[str, np.ndarray]:
    """Return T_cam_world by name."""
    return {f"a_{i}.jpg": camera.T_cam_world for i, camera in enumerate(ring(count))}


def write_images(folder: Path, names: dict[str, np.ndarray]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for seed, name in enumerate(names):
        small = np.random.default_rng(seed).integers(0, 256, (6, 8, 3)).astype(np.uint8)
        Image.fromarray(small).resize((WIDTH, HEIGHT), Image.Resampling.BILINEAR).save(folder / name, quality=95)


def points(count: int = 30) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(7)
    return rng.uniform(-0.5, 0.5, (count, 3)), rng.integers(0, 256, (count, 3))


def as_colmap(root: Path, lens: Lens, count: int = 9) -> Path:
    """Write the same capture as a COLMAP model."""
    model = ColmapModel(cameras={1: lens.colmap()})
    for index, (name, T) in enumerate(poses(count).items()):
        model.images.append((index + 1, T, 1, name, []))
    xyz, rgb = points()
    model.points = [(i + 1, x, tuple(c.tolist()), 0.5, []) for i, (x, c) in enumerate(zip(xyz, rgb, strict=True))]
    model.write(root / "sparse/0")
    write_images(root / "images", poses(count))
    return root


def opensfm_camera(lens: Lens) -> dict[str, Any]:
    """Return the camera normalised by the larger side, with its origin at the image centre."""
    k1, k2, k3 = (*lens.k, 0.0, 0.0, 0.0)[:3]
    return {
        "projection_type": "brown",
        "width": WIDTH,
        "height": HEIGHT,
        "focal_x": lens.fx / WIDTH,
        "focal_y": lens.fy / WIDTH,
        "c_x": (lens.cx - WIDTH / 2) / WIDTH,
        "c_y": (lens.cy - HEIGHT / 2) / WIDTH,
        "k1": k1,
        "k2": k2,
        "k3": k3,
        "p1": lens.p[0],
        "p2": lens.p[1],
    }


def opensfm_reconstruction(camera: dict[str, Any], shots: dict[str, np.ndarray]) -> dict[str, Any]:
    xyz, rgb = points()
    return {
        "cameras": {"v2 a b": camera},
        "shots": {
            name: {
                "rotation": Rotation.from_matrix(T[:3, :3]).as_rotvec().tolist(),
                "translation": T[:3, 3].tolist(),
                "camera": "v2 a b",
                "orientation": 1,
            }
            for name, T in shots.items()
        },
        "points": {
            str(i): {"coordinates": x.tolist(), "color": [float(v) for v in c]}
            for i, (x, c) in enumerate(zip(xyz, rgb, strict=True))
        },
    }


def small_opensfm(
    root: Path, lens: Lens = OFF_CENTRE, *, where: str = ".", camera: dict[str, Any] | None = None
) -> None:
    write_images(root / "images", poses())
    (root / where).mkdir(parents=True, exist_ok=True)
    value = [opensfm_reconstruction(camera or opensfm_camera(lens), poses())]
    (root / where / "reconstruction.json").write_text(json.dumps(value))


#: Pose of the chunk in Metashape captures: x_world = scale R x_chunk + t
CHUNK = (2.5, Rotation.from_euler("zyx", [30, -20, 50], degrees=True).as_matrix(), np.array([1.0, -2.0, 3.0]))


def metashape_transform(T_cam_world: np.ndarray, chunk: tuple[float, np.ndarray, np.ndarray] = CHUNK) -> str:
    """Return the camera-to-chunk matrix as text; the chunk's similarity maps it to ``T_cam_world``."""
    scale, R, t = chunk
    M = np.linalg.inv(T_cam_world)
    inside = np.eye(4)
    inside[:3, :3] = R.T @ M[:3, :3]
    inside[:3, 3] = R.T @ (M[:3, 3] - t) / scale
    return " ".join(repr(float(v)) for v in inside.ravel())


def metashape_similarity(chunk: tuple[float, np.ndarray, np.ndarray] = CHUNK) -> str:
    scale, R, t = chunk
    numbers = [" ".join(repr(float(v)) for v in np.ravel(a)) for a in (R, t, scale)]
    return (
        f"<transform><rotation locked='true'>{numbers[0]}</rotation>"
        f"<translation locked='true'>{numbers[1]}</translation><scale locked='true'>{numbers[2]}</scale></transform>"
    )


def metashape_calibration(lens: Lens, extra: str = "", kind: str = "frame") -> str:
    """Return a calibration with focal length fy, b1 = fx - fy, and OpenCV's tangential coefficients swapped."""
    k = "".join(f"<k{i + 1}>{value!r}</k{i + 1}>" for i, value in enumerate(lens.k))
    return (
        f"<calibration type='{kind}' class='adjusted'><resolution width='{WIDTH}' height='{HEIGHT}'/>"
        f"<f>{lens.fy!r}</f><cx>{lens.cx - WIDTH / 2!r}</cx><cy>{lens.cy - HEIGHT / 2!r}</cy>"
        f"<b1>{lens.fx - lens.fy!r}</b1>{k}<p1>{lens.p[1]!r}</p1><p2>{lens.p[0]!r}</p2>{extra}</calibration>"
    )


def metashape_document(
    calibration: str, cameras: str, *, transform: str | None = None, components: str = "", kind: str = "frame"
) -> str:
    transform = metashape_similarity() if transform is None else transform
    return (
        "<?xml version='1.0' encoding='UTF-8'?>\n<document version='2.0.0'>\n <chunk label='Chunk 1' enabled='true'>\n"
        f"  <sensors next_id='1'><sensor id='0' label='unknown' type='{kind}'>"
        f"<resolution width='{WIDTH}' height='{HEIGHT}'/>{calibration}</sensor></sensors>\n"
        f"  {components}<cameras next_id='99' next_group_id='0'>{cameras}</cameras>\n  {transform}\n"
        " </chunk>\n</document>"
    )


def small_metashape(
    root: Path, lens: Lens = OFF_CENTRE, *, more: str = "", labels: str = "{}", extra: str = "", kind: str = "frame"
) -> None:
    """Write a Metashape capture. ``labels`` maps a file stem to a label; ``more`` adds cameras."""
    write_images(root / "images", poses())
    cameras = "".join(
        f"<camera id='{i}' sensor_id='0' label='{labels.format(name[:-4])}'><transform>{metashape_transform(T)}"
        "</transform><orientation>1</orientation></camera>"
        for i, (name, T) in enumerate(poses().items())
    )
    text = metashape_document(metashape_calibration(lens, extra, kind), cameras + more, kind=kind)
    (root / "cameras.xml").write_text(text)


def write_points(path: Path, offset: float = 0.0) -> None:
    """Write the points as an ASCII PLY, as tools export them."""
    xyz, rgb = points()
    rows = "".join(
        f"{float(x[0] + offset)!r} {float(x[1])!r} {float(x[2])!r} {c[0]} {c[1]} {c[2]}\n"
        for x, c in zip(xyz, rgb, strict=True)
    )
    header = "".join(f"property double {a}\n" for a in "xyz") + "".join(
        f"property uchar {a}\n" for a in ("red", "green", "blue")
    )
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex {len(xyz)}\n{header}end_header\n{rows}")


def alicevision_intrinsic(lens: Lens, version: tuple[int, int, int]) -> dict[str, Any]:
    """Return the intrinsics in the layout of a file format version."""
    entry: dict[str, Any] = {
        "intrinsicId": "12",
        "width": str(WIDTH),
        "height": str(HEIGHT),
        "sensorWidth": "23.5",
        "sensorHeight": "15.6",
        "serialNumber": "x",
        "initializationMode": "estimated",
        "locked": "false",
    }
    kinds = {0: ("none", "pinhole"), 1: ("radialk1", "radial1"), 3: ("radialk3", "radial3")}
    new, old = ("brown", "brown") if any(lens.p) else kinds[len(lens.k)]
    entry |= {"type": "pinhole", "distortionType": new} if version >= (1, 2, 6) else {"type": old}
    middle = (WIDTH / 2, HEIGHT / 2) if version >= (1, 2, 1) else (0.0, 0.0)
    entry["principalPoint"] = [repr(lens.cx - middle[0]), repr(lens.cy - middle[1])]
    params = [*lens.k, *lens.p] if any(lens.p) else list(lens.k)
    entry["distortionParams"] = [repr(v) for v in params] if params else ""
    if version < (1, 2, 0):
        entry["pxFocalLength"] = repr(lens.fx)
    elif version < (1, 2, 2):
        entry["pxFocalLength"] = [repr(lens.fx), repr(lens.fy)]
    else:
        entry["focalLength"] = repr(lens.fx * 23.5 / WIDTH)
        entry["pixelRatio"] = repr(lens.fx / lens.fy if version < (1, 2, 5) else lens.fy / lens.fx)
    return entry


def alicevision_scene(lens: Lens, version: tuple[int, int, int], *, structure: bool = True) -> dict[str, Any]:
    views, placed = [], []
    for i, (name, T) in enumerate(poses().items()):
        ids = {"viewId": str(100 + i), "poseId": str(200 + i), "intrinsicId": "12"}
        views.append({**ids, "path": f"D:\\shots\\{name}", "width": str(WIDTH), "height": str(HEIGHT)})
        center = -T[:3, :3].T @ T[:3, 3]
        column_by_column = [repr(float(T[row, column])) for column in range(3) for row in range(3)]
        transform = {"rotation": column_by_column, "center": [repr(float(v)) for v in center]}
        placed.append({"poseId": str(200 + i), "pose": {"transform": transform, "locked": "0"}})
    xyz, rgb = points()
    landmarks = [
        {"landmarkId": str(i), "descType": "sift", "color": [str(v) for v in c], "X": [repr(float(v)) for v in x]}
        for i, (x, c) in enumerate(zip(xyz, rgb, strict=True))
    ]
    return {
        "version": [str(v) for v in version],
        "featuresFolders": [""],
        "views": views,
        "intrinsics": [alicevision_intrinsic(lens, version)],
        "poses": placed,
    } | ({"structure": landmarks} if structure else {})


def small_alicevision(
    root: Path, lens: Lens = OFF_CENTRE, *, version: tuple[int, int, int] = (1, 2, 8), name: str = "cameras.sfm"
) -> None:
    write_images(root / "images", poses())
    (root / name).write_text(json.dumps(alicevision_scene(lens, version), indent=4))
