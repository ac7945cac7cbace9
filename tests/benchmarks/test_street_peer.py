"""The peer of the table of real photographs: what it is given, how long it may train, how its pictures are scored."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from benchmarks import street_peer
from benchmarks.street_peer import Window, canvas

from fake_peer import calls, fake_peer
from gs2d.core.camera import Camera, look_at
from gs2d.data import View, load_scene
from gs2d.data.scene import PointCloud, Scene
from gs2d.render.backends import get_backend

UP = np.array([0.0, 0.0, 1.0])


def view(number: int, *, mask: np.ndarray | None = None) -> View:
    eye = np.array([3 * np.cos(number), 3 * np.sin(number), 1.0])
    image = np.random.default_rng(number).integers(0, 256, (18, 24, 3), dtype=np.uint8)
    camera = look_at(eye, np.zeros(3), UP, width=24, height=18, fx=20.0)
    return View.from_arrays(f"cam/{number}.jpg", camera, image, mask)


@pytest.fixture
def scene() -> Scene:
    rng = np.random.default_rng(0)
    points = PointCloud(rng.normal(size=(5, 3)), rng.integers(0, 256, (5, 3), dtype=np.uint8))
    views = [view(number) for number in range(4)]
    return Scene("room", "colmap", tuple(views[:3]), tuple(views[3:]), points, 1.0, np.array([[-1.0] * 3, [1.0] * 3]))


# -- windows -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("cx", "cy"), [(12.0, 9.0), (11.5, 9.5), (12.2, 8.9), (15.3, 7.0), (2.0, 17.1)])
def test_the_canvas_holds_the_view_and_has_its_principal_point_in_the_middle(cx: float, cy: float) -> None:
    camera = Camera(24, 18, 20.0, 21.0, cx, cy, np.eye(4))
    window = canvas(camera)
    around = window.camera(camera)
    assert abs(around.cx - around.width / 2) <= 0.25
    assert abs(around.cy - around.height / 2) <= 0.25
    assert window.x <= 0 <= window.x + window.width - camera.width
    assert window.y <= 0 <= window.y + window.height - camera.height
    image = np.random.default_rng(0).integers(1, 256, (18, 24, 3), dtype=np.uint8)
    assert (window.place(window.cut(image), 18, 24) == image).all()
    assert window.cut(image).shape == (window.height, window.width, 3)


# -- what it gets --------------------------------------------------------------------------------------------------
def test_the_capture_of_the_peer_is_the_one_of_the_run(tmp_path: Path, scene: Scene) -> None:
    windows = [Window(2, 1, 20, 15)] * 4
    street_peer.write_capture(tmp_path, scene, scene.views, windows)
    again = load_scene(tmp_path, format="colmap", test_every=0)
    assert [v.name for v in again.train] == ["0001-0.png", "0002-1.png", "0003-2.png", "0004-3.png"]
    for written, meant in zip(again.train, scene.views, strict=True):
        assert (written.image() == meant.image()[1:16, 2:22]).all()
        pixels, depth = meant.camera.project(np.zeros((1, 3)))
        moved, same = written.camera.project(np.zeros((1, 3)))
        assert moved == pytest.approx(pixels - (2, 1))
        assert same == pytest.approx(depth)
    assert again.points is not None
    assert scene.points is not None
    assert (again.points.points == scene.points.points).all()
    assert again.points.colors is not None
    assert (again.points.colors == scene.points.colors).all()


# -- its pictures --------------------------------------------------------------------------------------------------
def test_the_peers_own_pictures_of_test_views_are_scored_once_it_is_trained(
    tmp_path: Path, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = SimpleNamespace(
        scene=scene, settings=SimpleNamespace(background=(0.0, 0.0, 0.0)), backend=get_backend("reference")
    )
    monkeypatch.setattr(street_peer, "open_job", lambda *_: (None, job, None))
    drawn = street_peer.draw_test_views

    def spoilt(*args: object) -> list[Path]:  # the stand-in draws the photograph itself: an infinite PSNR
        files = drawn(*args)  # type: ignore[arg-type]
        for file in files:
            pixels = street_peer.read_image(file)
            assert (pixels == scene.test[0].image()).all()
            street_peer.write_image(file, np.where(pixels < 250, pixels + 5, pixels - 5).astype(np.uint8))
        return files

    monkeypatch.setattr(street_peer, "draw_test_views", spoilt)
    binary = fake_peer(tmp_path / "bin", seconds=0.001)
    row = street_peer.measure_peer(binary, tmp_path / "run", tmp_path / "peer", 0.6)
    assert row["cpu_seconds"] <= 0.6 == row["cpu_seconds_allowed"]
    assert row["gaussians"] == 7
    assert row["scores"]["test"]["views"] == 1
    assert row["scores"]["test"]["psnr"] == pytest.approx(-20 * np.log10(5 / 255), abs=0.01)
    assert row["scores"]["test_matched"]["psnr"] > row["scores"]["test"]["psnr"]
    trainings = [words for words in calls(binary) if "--resume" not in words]
    assert all(words[0].endswith("train") for words in trainings)
    assert len(list((tmp_path / "peer/train/images").iterdir())) == 3  # no test view among them
    draws = [words for words in calls(binary) if "--resume" in words]
    assert [words[words.index("--val-image") + 1] for words in draws] == ["0004-3.png"] * 2  # one a variant
    assert set(row["variants"]) == {"own", "moving"}
    moving = [words for words in trainings if "--densify-until" in words]
    assert 0 < len(moving) < len(trainings)
    assert all(words[words.index("--densify-until") + 1] == words[words.index("-n") + 1] for words in moving)
    before = len(calls(binary))
    monkeypatch.setattr(street_peer, "draw_test_views", drawn)  # the pictures are there
    assert street_peer.measure_peer(binary, tmp_path / "run", tmp_path / "peer", 0.6)["scores"] == row["scores"]
    assert len(calls(binary)) == before  # what is finished is not repeated
