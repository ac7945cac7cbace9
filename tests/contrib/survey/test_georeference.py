"""`gs2d survey`: every source, every error, and exported files."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ball_runs import options as training
from gs2d.cli import run as gs2d
from gs2d.contrib.survey.find_georeference import georeference_run
from gs2d.contrib.survey.georeference import Georeference, read_georeference, write_georeference
from gs2d.contrib.survey.projection import Projection
from gs2d.contrib.survey.survey_commands import GeoreferenceOptions
from gs2d.core.json_files import read_json
from gs2d.data.positions import to_enu
from gs2d.io.formats.splat_formats import read_splat_file
from gs2d.io.meshes import read_mesh
from gs2d.io.splat_ply import read_splats
from gs2d.pipeline.look.page import page_content
from gs2d.pipeline.train.train_run import train
from tiny import ball_cameras, write_ball_mesh, write_capture

SCALE, TURN = 4.0, Rotation.from_euler("z", 37, degrees=True).as_matrix()
PLACE = np.array([47.123456, 8.654321, 431.0])  # latitude, longitude, height of the ball


def enu(points: np.ndarray) -> np.ndarray:
    """Where points of the run are, metres east, north, up of the ball."""
    return SCALE * points @ TURN.T


def geodetic(points: np.ndarray) -> np.ndarray:
    """The same as latitude, longitude, height: Newton's method on the other direction."""
    target, found = enu(points), np.tile(PLACE, (len(points), 1))
    step = np.array([1 / 111_000, 1 / 76_000, 1.0])
    for _ in range(6):
        off = to_enu(found, PLACE) - target
        found = found - off[:, [1, 0, 2]] * step
    assert np.abs(to_enu(found, PLACE) - target).max() < 1e-3
    return found


def centers(count: int = 12) -> np.ndarray:
    return np.array([camera.center for camera in ball_cameras(count)])


def rational(value: float) -> tuple[Any, Any, Any]:
    value, degrees = abs(value), int(abs(value))
    minutes = int(60 * (value - degrees))
    return float(degrees), float(minutes), 3600 * (value - degrees - minutes / 60)


def write_exif(path: Path, place: np.ndarray) -> None:
    with Image.open(path) as opened:
        image = opened.copy()
    exif, gps = Image.Exif(), ExifTags.GPS
    exif[ExifTags.IFD.GPSInfo] = {
        **{gps.GPSLatitudeRef: "N", gps.GPSLatitude: rational(place[0])},
        **{gps.GPSLongitudeRef: "E", gps.GPSLongitude: rational(place[1])},
        **{gps.GPSAltitudeRef: b"\0", gps.GPSAltitude: float(place[2])},
    }
    image.save(path, exif=exif)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the ball, whose photographs know where they were taken."""
    root = tmp_path_factory.mktemp("geo")
    capture = write_capture(root / "ball", train=12, test=2)
    for k, place in enumerate(geodetic(centers())):
        write_exif(capture / "train" / f"r_{k}.png", place)
    run = train(training(capture, root / "run")).path
    write_ball_mesh(run / "mesh.ply")
    return run


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "run"))


def found(run: Path, **options: Any) -> Georeference:
    result = georeference_run(run, GeoreferenceOptions(**options))
    assert result is not None
    return result


def error_of(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert gs2d(words) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    return lines[0]


# sources


def test_gps_of_the_photographs_in_utm_and_in_a_local_frame(run: Path) -> None:
    pytest.importorskip("pyproj")
    before = (run / "splats.ply").read_bytes()
    g = found(run, gps=True)
    assert g.epsg == 32632
    world = Projection(32632).from_geodetic(geodetic(centers()))
    assert np.abs(g.to_world(centers()) - world).max() < 0.02  # EXIF has four decimals of a second: millimetres
    assert g.metres_per_unit == pytest.approx(SCALE, rel=1e-3)
    assert g.count("fitted") == 12
    local = found(run, gps=True, enu=True)
    assert (local.epsg, local.frame) == (None, "local east, north, up")
    assert local.scale == pytest.approx(SCALE, rel=1e-3)
    assert local.geodetic == pytest.approx(np.median(geodetic(centers()), axis=0), abs=1e-7)
    kept = read_georeference(run)
    assert kept is not None
    assert kept.scale == local.scale
    assert (run / "splats.ply").read_bytes() == before


def test_positions_in_a_file_with_outliers(run: Path, tmp_path: Path) -> None:
    places = geodetic(centers())
    places[3] += (0.001, 0.0, 30.0)
    lines = ["name,lat,lon,height", *(f"r_{k}.png,{a:.9f},{b:.9f},{c:.4f}" for k, (a, b, c) in enumerate(places))]
    file = tmp_path / "positions.csv"
    file.write_text("\n".join(lines[:9]))  # r_0 to r_7; test views have names of their own
    with pytest.raises(Exception, match="must name one image"):
        found(run, positions=file, enu=True)
    file.write_text("\n".join(lines[:13]).replace("r_", "train/r_"))
    g = found(run, positions=file, enu=True)
    assert g.scale == pytest.approx(SCALE, rel=1e-4)
    assert [residual.name for residual in g.residuals if residual.role == "left out"] == ["train/r_3.png"]


def test_positions_of_openDroneMap_and_metres_with_a_code(run: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyproj")
    offset = np.array([1_000_000.0, 6_000_000.0, 100.0])
    world = enu(centers()) + offset
    rows = [f"train/r_{k} {x:.6f} {y:.6f} {z:.6f} 0 0 0 0.02 0.03" for k, (x, y, z) in enumerate(world)]
    (tmp_path / "geo.txt").write_text("\n".join(["EPSG:2056", *rows]))
    g = found(run, positions=tmp_path / "geo.txt")
    assert g.epsg == 2056
    assert np.abs(g.to_world(centers()) - world).max() < 1e-4
    csv = "name;x;y;z\n" + "\n".join(f"train/r_{k};{x};{y};{z}" for k, (x, y, z) in enumerate(world))
    (tmp_path / "p.csv").write_text(csv)
    assert found(run, positions=tmp_path / "p.csv", epsg=2056).scale == pytest.approx(SCALE, rel=1e-6)


def control_rows(offset: np.ndarray, *, wrong: float = 0.0) -> list[str]:
    """Points on the ball as they appear in three photographs each."""
    rows, cameras = ["name,x,y,z,photo,u,v,check"], ball_cameras(12)
    points = Rotation.random(7, random_state=4).apply((0.8, 0.0, 0.0))
    for i, point in enumerate(points):
        world = enu(point[None])[0] + offset + (wrong if i == 2 else 0.0)
        seen = sorted(range(12), key=lambda k: -float(cameras[k].center @ point))[:3]
        for k in seen:
            local = cameras[k].rotation @ (point - cameras[k].center)
            u, v = (cameras[k].fx * local[j] / local[2] + (cameras[k].cx, cameras[k].cy)[j] for j in (0, 1))
            rows.append(f"P{i},{world[0]},{world[1]},{world[2]},train/r_{k}.png,{u},{v},{'yes' if i > 4 else ''}")
    return rows


def test_control_points_by_their_pixels_with_check_points(run: Path, tmp_path: Path) -> None:
    offset = np.array([1_000_000.0, 6_000_000.0, 100.0])
    file = tmp_path / "control.csv"
    file.write_text("\n".join(control_rows(offset)))
    g = found(run, control=file)
    assert np.abs(g.to_world(centers()) - enu(centers()) - offset).max() < 1e-3
    assert (g.count("fitted"), g.count("check")) == (5, 2)
    check = g.rms("check")
    assert check is not None
    assert check < 1e-3
    assert g.doubts == ()
    file.write_text("\n".join(control_rows(offset, wrong=2.0)))
    doubtful = found(run, control=file, check_points=("P0",))
    assert doubtful.count("check") == 3
    assert doubtful.doubts


def test_a_known_distance_and_up(run: Path) -> None:
    g = found(run, known_distance=(0.0, 0.0, 0.0, 0.0, 0.3, 0.4, 2.0))
    assert g.scale == pytest.approx(4.0, rel=1e-12)
    assert (g.rotation == np.eye(3)).all()  # the cameras agree on z
    lying = found(run, known_distance=(0.0, 0.0, 0.0, 0.0, 0.3, 0.4, 2.0), up=(1.0, 0.0, 0.0))
    assert lying.rotation @ (1.0, 0.0, 0.0) == pytest.approx((0, 0, 1), abs=1e-12)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--gps", "--markers", "0.1"], "one source at a time"),
        (["--epsg", "32632"], "needs --gps"),
        (["--gps", "--epsg", "4326"], "projected system in metres"),
        (["--gps", "--epsg", "32632", "--set", "enu=true"], "exclude each other"),
        (["--known-distance", *"0 0 0 0 0 0 1".split()], "two different points"),
        (["--known-distance", *"0 0 0 1 0 0 -1".split()], "positive distance"),
        (["--positions", "no-such.csv"], "no-such.csv, found nothing"),
        (["--control", "control.csv"], "has no photograph of that name|no photograph of"),
        (["--markers", "0"], "positive number"),
        (["--set", "up=0,0,0", "--gps"], "up must be a direction"),
        (["--set", "resolution=1"], "needs --orthophoto"),
    ],
)
def test_bad_input_is_one_line(
    run: Path,
    words: list[str],
    text: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    pytest.importorskip("pyproj")
    monkeypatch.chdir(tmp_path)
    Path("control.csv").write_text("name,x,y,z,photo,u,v\nA,1,2,3,nowhere.jpg,1,1\nB,2,2,3,nowhere.jpg,1,1\n")
    line = error_of(["survey", str(run), "--quiet", *words], capsys)
    assert any(part in line for part in text.split("|")), line


# files


def placed(run: Path) -> Georeference:
    """Put the run a million metres away, turned and grown."""
    g = Georeference(
        scale=4.2,
        rotation=Rotation.from_euler("xyz", (5, -3, 70), degrees=True).as_matrix(),
        translation=np.array([0.25, -0.5, 0.125]),
        origin=np.array([1_000_123.0, 6_000_456.0, 789.0]),
        method="a test",
        epsg=32632,
    )
    write_georeference(run, g)
    return g


@pytest.mark.parametrize(
    ("name", "exact"),
    [
        ("a.ply", 1e-3),
        ("a.compressed.ply", 0.05),
        ("a.spz", 0.02),
        ("a.splat", 1e-3),
        ("a.usd", 1e-3),
        ("a.glb", 1e-3),
        ("a.sog", 0.02),
    ],
)
def test_exported_splats_are_exact_a_million_metres_from_the_origin(
    run: Path, tmp_path: Path, name: str, exact: float
) -> None:
    g, out = placed(run), tmp_path / name
    assert gs2d(["survey", str(run), "--out", str(out), "--quiet"]) == 0
    beside = Georeference.from_json(read_json(tmp_path / f"{name}.georeference.json"))
    assert (beside.epsg, beside.origin.tolist()) == (32632, g.origin.tolist())
    assert [float(x) for x in (tmp_path / f"{out.stem}_offset.xyz").read_text().split()] == g.origin.tolist()
    local = read_splat_file(out).gaussians.means
    if name.endswith(".glb"):  # the reader turns y up into the y down of captures
        local = local[:, [0, 2, 1]] * (-1, -1, -1)
    expected = g.to_local(read_splats(run / "splats.ply").means.numpy())
    away, which = cKDTree(expected).query(local)  # some formats reorder
    assert away.max() < exact
    assert exact > 1e-3 or len(set(which)) == len(expected)


def test_the_exported_mesh_is_exact_a_million_metres_from_the_origin(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    g, out = placed(run), tmp_path / "mesh.ply"
    before = (run / "mesh.ply").read_bytes()
    assert gs2d(["survey", str(run), "--part", "mesh", "--out", str(out)]) == 0
    assert "relative to the offset 1000123 6000456 789" in capsys.readouterr().out
    vertices = read_mesh(out).vertices
    assert np.abs(vertices - g.to_local(read_mesh(run / "mesh.ply").vertices)).max() < 1e-3
    assert (run / "mesh.ply").read_bytes() == before


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--part", "texture", "--out", "a.glb"], "mesh.glb does not exist; write it with `gs2d mesh"),
        (["--out", "a.xyz"], "splats are written as"),
        (["--out", "RUN/world.ply"], "inside the run"),
    ],
)
def test_export_errors_are_one_line(
    run: Path, words: list[str], text: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run.parent)
    assert "no georeference" in error_of(["survey", str(run), "--out", "a.ply", "--quiet"], capsys)
    placed(run)
    words = [word.replace("RUN", str(run)) for word in words]
    assert text in error_of(["survey", str(run), "--quiet", *words], capsys)


def test_the_page_of_a_georeferenced_run_measures_in_metres(run: Path, tmp_path: Path) -> None:
    g = placed(run)
    world = page_content(run).scene.world
    assert world is not None
    assert world.metres == g.metres_per_unit
    assert (world.rotation == g.rotation).all()
    (run / "georeference.json").write_text('{"rotation": [1]}')
    assert page_content(run).scene.world is None
