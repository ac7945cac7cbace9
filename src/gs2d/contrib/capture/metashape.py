"""Captures of Agisoft Metashape: cameras of ``File > Export > Export Cameras`` (XML) and images.

Conventions (Metashape's manual, appendix "Camera models"; its support on ``camera.transform``): the transform of a
camera maps camera to chunk coordinates, with x right, y down, z forward; the transform of its component (or chunk) is a
similarity from there to the world. In a multi-camera system (Metashape's manual, "Multi-camera system") only
the cameras of the master sensor have a transform; T_world_camera of another is T_world_master [R t] with the rotation R
and the location t of its sensor. The origin of pixels is the image corner. With (x, y) = (X/Z, Y/Z), or (x, y) t / r
with t = atan(r) for a fisheye:

x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y     (p1 and p2 are OpenCV's p2 and p1)
y' = y (1 + ...)                               + p2 (r^2 + 2 y^2) + 2 p1 x y
u = w / 2 + cx + x' (f + b1) + y' b2,   v = h / 2 + cy + y' f

A spherical camera has an equirectangular panorama (``gs2d.data.faces``), and no parameters but its size.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from gs2d.contrib.capture.camera_files import (
    FileReader,
    files_ending,
    points_beside,
    pose_from_camera_to_world,
    real,
    reals,
    register_file_reader,
    whole,
)
from gs2d.core.json_files import read_bytes
from gs2d.data.build import Capture, PosedImage, skipping
from gs2d.data.camera_models import Lens
from gs2d.data.faces import panorama
from gs2d.data.file_names import find_photographs, head, in_any_case
from gs2d.data.undistort import Intrinsics
from gs2d.errors import DataError

_KINDS = {"frame": "perspective", "fisheye": "fisheye"}
_PANORAMA = "spherical"
_EARTH = (6.2e6, 6.5e6)  # m, distance from the origin of geocentric coordinates
_AXES = (6378137.0, 6378137.0, 6356752.314245)  # m, WGS 84


@dataclass(frozen=True)
class Similarity:
    """x_world = scale R x + t."""

    scale: float
    R: np.ndarray  # [3, 3]
    t: np.ndarray  # [3]


_SAME = Similarity(1.0, np.eye(3), np.zeros(3))


def camera_file(root: Path) -> Path | None:
    """Return the XML file with cameras of Metashape: ``cameras.xml``, else the first by name; or None."""
    files = sorted(files_ending(root, ".xml"), key=lambda path: (path.name.lower() != "cameras.xml", path.name))
    return next((path for path in files if b"<document" in (begins := head(path)) and b"<chunk" in begins), None)


def read_metashape(root: Path) -> Capture:
    """Read the cameras of Metashape; unaligned and disabled cameras and those of other components are skipped.

    Images are searched by label in ``images`` or elsewhere below the folder, sparse points in a PLY file beside the
    cameras (``camera_files.points_beside``). A DataError about an invalid file or an unsupported camera names the file
    and the entry.
    """
    path = camera_file(root)
    if path is None:
        raise DataError(f"{root} must hold cameras.xml of Metashape (File > Export > Export Cameras), got no such file")
    chunk, notes = _chunk(path)
    sensors = {sensor.get("id", ""): sensor for sensor in chunk.iterfind("sensors/sensor")}
    listed = [camera for group in chunk.iterfind("cameras") for camera in group.iter("camera")]
    placed, skipped = _placed(listed, sensors, path)
    component, more = _component(placed)
    world = _world(chunk, component, path)
    poses = [(pose.camera, pose.label, _to_world(pose.M, world)) for pose in placed if pose.component == component]
    poses, moved = _from_geocentric(poses)
    photographs = find_photographs([label for _, label, _ in poses], [in_any_case(root, "images"), root], path)
    frames: list[PosedImage] = []
    lost = [*skipped, *more]
    for camera, label, M in poses:
        where = f"{path}: camera {label}"
        photo = photographs[label]
        if photo.path is None:
            lost.append(f"{label}: {photo.reason}")
            continue
        key = camera.get("sensor_id", "")
        if key not in sensors:
            raise DataError(f"{path} must hold sensor {key!r} of camera {label}, got {sorted(sensors)[:9]}")
        with skipping(label, lost):
            k = _intrinsics(sensors[key], f"{path}: sensor {key}")
            T = pose_from_camera_to_world(M, f"{where}: transform", opengl=False)
            frames.append(PosedImage(photo.name, photo.path, k, T))
    points, point_notes = points_beside(root, frames)
    return Capture("metashape", tuple(frames), points, skipped=tuple(lost), notes=(*notes, *moved, *point_notes))


register_file_reader("metashape", FileReader("cameras.xml (Metashape)", camera_file, read_metashape), __name__)


def _chunk(path: Path) -> tuple[ElementTree.Element, list[str]]:
    """Return the chunk with most cameras, and a note if there are several."""
    try:
        text = read_bytes(path)
        if any(word in text.replace(b"\0", b"") for word in (b"<!DOCTYPE", b"<!ENTITY")):  # in UTF-16 too
            raise DataError(f"{path} must be XML of Metashape, got XML with document type definitions")
        document = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise DataError(f"{path} must be XML, got: {error}; is the file complete?") from error
    chunks = [chunk for chunk in document.iter("chunk") if chunk.find("cameras") is not None]
    if not chunks:
        raise DataError(f"{path} must hold a chunk with cameras, got none; export the cameras again (Agisoft XML)")
    counts = [sum(1 for _ in chunk.iter("camera")) for chunk in chunks]
    best = int(np.argmax(counts))
    if len(chunks) == 1:
        return chunks[0], []
    return chunks[best], [f"{path.name} holds {len(chunks)} chunks: using the one with {counts[best]} cameras"]


@dataclass(frozen=True)
class _Placed:
    """A camera with its pose: ``M`` [4, 4] maps camera to chunk coordinates."""

    camera: ElementTree.Element
    label: str
    component: str | None
    M: np.ndarray


def _placed(
    listed: Sequence[ElementTree.Element], sensors: Mapping[str, ElementTree.Element], path: Path
) -> tuple[list[_Placed], list[str]]:
    """Return the enabled cameras with a pose, and the reasons for skipping others.

    In a multi-camera system only the camera of the master sensor has a transform; the other sensors have a rotation and
    a location relative to the master.
    """
    placed: list[_Placed] = []
    skipped: list[str] = []
    cameras = {camera.get("id"): camera for camera in listed}
    for camera in listed:
        label = camera.get("label") or camera.get("id") or "without a label"
        master = camera if camera.find("transform") is not None else cameras.get(camera.get("master_id"))
        where = f"{path}: camera {label}"
        if camera.get("enabled", "true").lower() in ("false", "0"):
            skipped.append(f"{label}: disabled in Metashape")
        elif master is None or master.find("transform") is None:
            skipped.append(f"{label}: not aligned in Metashape")
        else:
            with skipping(label, skipped):
                M = reals(master.findtext("transform") or "", 16, f"{where}: transform").reshape(4, 4)
                if master is not camera:
                    mounted = _in_master(sensors.get(camera.get("sensor_id", "")), where)
                    if mounted is None:
                        skipped.append(f"{label}: its sensor has no rotation and location in its multi-camera system")
                        continue
                    M = M @ mounted
                placed.append(_Placed(camera, label, camera.get("component_id") or master.get("component_id"), M))
    return placed, skipped


def _in_master(sensor: ElementTree.Element | None, where: str) -> np.ndarray | None:
    """Return the transform [4, 4] from a camera to the master of its multi-camera system; None if not stated."""
    texts = [None if sensor is None else sensor.findtext(name) for name in ("rotation", "location")]
    if all(text is None for text in texts):
        return None
    M = np.eye(4)
    if texts[0] is not None:
        M[:3, :3] = reals(texts[0], 9, f"{where}: rotation of its sensor").reshape(3, 3)
    if texts[1] is not None:
        M[:3, 3] = reals(texts[1], 3, f"{where}: location of its sensor")
    return M


def _component(placed: Sequence[_Placed]) -> tuple[str | None, list[str]]:
    """Return the component with most cameras, and the reasons for skipping others."""
    counts = Counter(pose.component for pose in placed)
    if not counts:
        return None, []
    best = counts.most_common(1)[0][0]
    return best, [f"{pose.label}: in another component" for pose in placed if pose.component != best]


def _world(chunk: ElementTree.Element, component: str | None, path: Path) -> Similarity:
    """Return the similarity of a component, or of the chunk if the component has none."""
    own = next((c for c in chunk.iterfind("components/component") if c.get("id") == component), None)
    transform = None if own is None else own.find("transform")
    transform = chunk.find("transform") if transform is None else transform
    if transform is None:
        return _SAME
    where = f"{path}: transform of the chunk"

    def numbers(name: str, count: int) -> np.ndarray | None:
        text = transform.findtext(name)
        return None if text is None else reals(text, count, f"{where}: {name}")

    R, t, scale = numbers("rotation", 9), numbers("translation", 3), numbers("scale", 1)
    if scale is not None and scale[0] <= 0:
        raise DataError(f"{where}: scale must be positive, got {scale[0]:g}")
    return Similarity(
        1.0 if scale is None else float(scale[0]),
        np.eye(3) if R is None else R.reshape(3, 3),
        np.zeros(3) if t is None else t,
    )


def _to_world(M: np.ndarray, world: Similarity) -> np.ndarray:
    """Apply a similarity to a pose [4, 4]; its scale applies to the translation only."""
    moved = np.eye(4)
    moved[:3, :3] = world.R @ M[:3, :3]
    moved[:3, 3] = world.scale * world.R @ M[:3, 3] + world.t
    return moved


Poses = list[tuple[ElementTree.Element, str, np.ndarray]]


def _from_geocentric(poses: Poses) -> tuple[Poses, list[str]]:
    """Convert geocentric poses to metres east, north and up of the mean camera, which fit 32-bit numbers."""
    if not poses:
        return poses, []
    middle = np.mean([M[:3, 3] for _, _, M in poses], axis=0)
    if not _EARTH[0] < np.linalg.norm(middle) < _EARTH[1]:
        return poses, []
    up = middle / np.square(_AXES)  # the normal of the ellipsoid
    up /= np.linalg.norm(up)
    east = np.cross((0.0, 0.0, 1.0), up)
    east /= max(float(np.linalg.norm(east)), 1e-12)
    local = np.eye(4)
    local[:3, :3] = np.stack([east, np.cross(up, east), up])
    local[:3, 3] = -local[:3, :3] @ middle
    note = "the chunk is geocentric: the scene is in metres east, north and up of the mean camera"
    return [(camera, label, local @ M) for camera, label, M in poses], [note]


def _intrinsics(sensor: ElementTree.Element, where: str) -> Intrinsics:
    """Return the intrinsics of a sensor, from its adjusted calibration if there is one."""
    every = sensor.findall("calibration")
    calibration = next((c for c in every if c.get("class") == "adjusted"), every[0] if every else None)
    kind = (None if calibration is None else calibration.get("type")) or sensor.get("type") or "frame"
    if kind == _PANORAMA:
        return panorama(*_size(calibration, sensor, where), where)
    if calibration is None:
        raise DataError(f"{where} must have a calibration, got none; align the photographs, then export again")
    if kind not in _KINDS:
        raise DataError(
            f"{where} has the unsupported type {kind} (supported: {', '.join((*_KINDS, _PANORAMA))}); "
            "export undistorted photographs from Metashape and their cameras"
        )
    width, height = _size(calibration, sensor, where)
    names = ("f", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2")
    value: Mapping[str, float] = {
        name: real(calibration.findtext(name, "0").strip(), f"{where}: {name}") for name in names
    }
    fx, fy = value["f"] + value["b1"], value["f"]
    if not (min(fx, fy) > 0 and min(width, height) > 0):
        raise DataError(
            f"{where} must have a positive size and focal length f, got {width}x{height}, {fy:g}; "
            "export the cameras with Metashape 1.2 or newer"
        )
    if value["p3"] or value["p4"]:
        raise DataError(
            f"{where} has the coefficients p3 and p4, which are not supported; "
            "disable them in Optimize Cameras, or export undistorted photographs and their cameras"
        )
    radial = tuple(value[f"k{i}"] for i in (1, 2, 3, 4))
    lens = Lens(_KINDS[kind], radial, (), (value["p2"], value["p1"]), value["b2"] / fx)
    center = (width / 2 + value["cx"], height / 2 + value["cy"])
    return Intrinsics(width, height, fx, fy, *center, None if lens.is_identity else lens)


def _size(calibration: ElementTree.Element | None, sensor: ElementTree.Element, where: str) -> tuple[int, int]:
    """Return width and height, px, from the calibration or the sensor."""
    stated = (entry.find("resolution") for entry in (calibration, sensor) if entry is not None)
    size = next((resolution for resolution in stated if resolution is not None), None)
    if size is None:
        raise DataError(f"{where} must have a resolution, got none; export the cameras again")
    width, height = (whole(size.get(side), f"{where}: {side}") for side in ("width", "height"))
    return width, height
