"""`gs2d survey --orthophoto`: cells, colours and heights, as other programs read them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ball_runs import options as training
from gs2d.cli import run as gs2d
from gs2d.contrib.survey.georeference import Georeference, write_georeference
from gs2d.contrib.survey.orthophoto import Raster, from_above
from gs2d.pipeline.train.train_run import train
from tiny import RADIUS, write_ball_mesh, write_capture

tifffile = pytest.importorskip("tifffile")
SCALE, ORIGIN = 10.0, np.array([500_100.0, 5_300_200.0, 430.0])
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # the run's x is north


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the ball, 16 m wide, in UTM."""
    root = tmp_path_factory.mktemp("ortho")
    run = train(training(write_capture(root / "ball", train=16, test=2, size=64), root / "run")).path
    write_ball_mesh(run / "mesh.ply", rings=64)
    place = Georeference(
        scale=SCALE, rotation=TURN, translation=np.zeros(3), origin=ORIGIN, method="a test", epsg=32632
    )
    write_georeference(run, place)
    return run


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "run"))


def cells(tags: dict[str, Any], shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Easting and northing of the middles of cells, as a reader of GeoTIFF finds them."""
    scale, tie = tags["ModelPixelScale"], tags["ModelTiepoint"]
    column, row = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    return tie[3] + (column - tie[0]) * scale[0], tie[4] - (row - tie[1]) * scale[1]


def test_heights_and_colours_match_the_ball(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert gs2d(["survey", str(run), "--orthophoto", "--set", "resolution=0.25", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["orthophoto"]
    assert (told["epsg"], told["resolution"]) == (32632, 0.25)
    with tifffile.TiffFile(run / "orthophoto_elevation.tif") as file:
        heights, tags = file.asarray(), file.pages[0].geotiff_tags
        assert float(file.pages[0].tags[42113].value) == -9999
    assert tags["ProjectedCSTypeGeoKey"] == 32632
    assert tags["GTRasterTypeGeoKey"] == 1
    east, north = (axis - at for axis, at in zip(cells(tags, heights.shape), ORIGIN[:2], strict=True))
    radius = SCALE * RADIUS
    off = np.hypot(east, north)
    known = heights > -9999
    assert known[off < 0.98 * radius].all()
    assert not known[off > 1.01 * radius].any()
    inner = off < 0.9 * radius
    true = np.sqrt(radius**2 - off[inner] ** 2) + ORIGIN[2]
    assert np.abs(heights[inner] - true).max() < 0.05

    image = np.asarray(Image.open(run / "orthophoto.tif"))  # another reader
    assert image.shape == (*heights.shape, 4)
    assert ((image[..., 3] == 255) == known).all()
    place = np.stack([north, -east, np.sqrt(np.maximum(radius**2 - off**2, 0))], axis=-1) / SCALE  # in the run
    expected = 255 * np.clip(0.5 + 0.4 * place / RADIUS + 0.1 * np.sin(9 * place), 0, 1)
    middle = off < 0.7 * radius
    assert np.abs(image[middle, :3] - expected[middle]).mean() < 8
    assert told["cells"] == known.sum()
    assert told["cells_unseen"] < 0.05 * told["cells"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--set", "resolution=0"], "--set resolution must be a positive number of metres, got 0"),
        (["--set", "resolution=nan"], "--set resolution must be a positive number of metres, got nan"),
        (["--set", "resolution=0.0001"], "more than 36,000,000; use 0.0027 m or more"),
        (["--out", "map.png"], "--out must end in .tif or .tiff, got map.png"),
        (["--out", "nowhere/map.tif"], "nowhere"),
    ],
)
def test_bad_input_is_one_line(
    run: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run)
    assert gs2d(["survey", str(run), "--orthophoto", "--quiet", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not list(run.glob("*.tif"))


def test_without_georeference_or_mesh_the_error_has_a_remedy(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "mesh.ply").unlink()
    assert gs2d(["survey", str(run), "--orthophoto", "--quiet"]) == 2
    assert "write it with `gs2d mesh" in capsys.readouterr().err
    (run / "georeference.json").unlink()
    assert gs2d(["survey", str(run), "--orthophoto", "--quiet"]) == 2
    assert "gs2d survey" in capsys.readouterr().err


# -- rays straight down ------------------------------------------------------------------------------------------------
SQUARE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


def two_floors() -> tuple[np.ndarray, np.ndarray]:
    """Return a floor at height 1, and a second one above its east half that rises from 2 to 3 towards the north."""
    low = np.concatenate([SQUARE, np.full((4, 1), 1.0)], axis=1)
    high = np.concatenate([SQUARE * (0.5, 1) + (2, 0), (2 + SQUARE[:, 1:] / 4)], axis=1)
    return np.concatenate([low, high]), np.concatenate([HALVES, HALVES + 4])


def test_the_highest_surface_is_hit_and_interpolated() -> None:
    vertices, faces = two_floors()
    hits = from_above(vertices, faces, Raster((0.0, 4.0), 1.0, (4, 4)))
    heights = (vertices[faces[hits.face], 2] * hits.weights).sum(axis=-1)
    north = np.array([3.5, 2.5, 1.5, 0.5])  # per row; the first row is the northernmost
    np.testing.assert_allclose(heights[:, :2], 1.0, atol=1e-6)
    np.testing.assert_allclose(heights[:, 2:], np.repeat((2 + north / 4)[:, None], 2, axis=1), atol=1e-6)
    x = (vertices[faces[hits.face], 0] * hits.weights).sum(axis=-1)
    np.testing.assert_allclose(x, np.tile(np.arange(4) + 0.5, (4, 1)), atol=1e-6)


def test_rays_miss_beside_the_surface_but_not_between_triangles() -> None:
    vertices, faces = two_floors()
    hits = from_above(vertices, faces, Raster((-1.0, 5.0), 0.25, (24, 24)))
    inside = np.zeros((24, 24), dtype=bool)
    inside[4:20, 4:20] = True
    assert ((hits.face >= 0) == inside).all()
