"""The judge of surfaces: what a scene holds, how meshes are scored, and that finished runs are reused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import surface_photographs, surface_scenes, surfaces
from benchmarks.street_runs import Process
from benchmarks.surface_judge import PADDING, TrueScene, face_normals, read_scene, score_mesh
from benchmarks.surface_objects import Material, Noise, Part, block, plain, speckled

from gs2d.core.mesh import Mesh
from gs2d.data import load_scene

SIZE = 96


def cube(rng: np.random.Generator, size: int) -> surface_scenes.Design:
    """A speckled cube of side 0.5 on a speckled plate that reaches 0.25 beyond it."""
    spots = Material(speckled(Noise(rng, (2, 12)), (0.2, 0.3, 0.4), (0.9, 0.8, 0.7), 2.0))
    subject = Part(block((-0.25, -0.25, 0.0), (0.25, 0.25, 0.5), 0.05), spots)
    plate = Part(block((-0.5, -0.5, -0.1), (0.5, 0.5, 0.0), 0.1), Material(plain((0.5, 0.5, 0.5))), "support")
    cameras = surface_scenes.orbit(rng, size, (0, 0, 0.2), 1.6, ((20, 10), (50, 6)))
    return surface_scenes.Design((subject, plate), cameras)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("scenes")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(surface_scenes.SCENES, "boxes", cube)
        surface_photographs.write_scene("boxes", made / "boxes", size=SIZE)
    return made


@pytest.fixture(scope="module")
def scene(folder: Path) -> TrueScene:
    return read_scene(folder / "boxes")


def test_a_scene_is_a_colmap_capture_with_test_views_and_points_near_the_truth(folder: Path, scene: TrueScene) -> None:
    capture = load_scene(folder / "boxes")
    assert (len(capture.train), len(capture.test)) == (14, 2)
    exact = [scene.facts.cameras[k] for k in (0, 8)]
    for view, camera in zip(capture.test, exact, strict=True):
        np.testing.assert_allclose(view.camera.T_cam_world, camera.T_cam_world, atol=1e-6)
    shift = [
        np.abs(v.camera.project(scene.points)[0] - c.project(scene.points)[0]).mean()
        for v, c in zip(capture.train, scene.training_cameras, strict=True)
    ]
    assert 0.02 < np.mean(shift) < 0.5  # px at a width of 96: about one at 400
    assert capture.points is not None
    assert len(capture.points) > 50
    assert capture.points.points[:, 2].max() < 0.55


def test_scenes_are_deterministic(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(surface_scenes.SCENES, "boxes", cube)
    surface_photographs.write_scene("boxes", tmp_path, size=SIZE)
    for file in sorted(
        path for path in (folder / "boxes").rglob("*") if path.suffix in (".jpg", ".txt", ".json", ".ply")
    ):
        assert file.read_bytes() == (tmp_path / file.relative_to(folder / "boxes")).read_bytes(), file.name


def test_only_what_two_cameras_see_is_true_surface(scene: TrueScene) -> None:
    sides = face_normals(scene.subject)
    np.testing.assert_allclose(np.abs(scene.normals).max(axis=1), 1, atol=1e-6)
    assert sides[:, 2].min() == -1  # the cube has a bottom
    assert scene.normals[:, 2].min() > -0.5  # which no camera sees
    assert 0.5 * np.sqrt(3) == pytest.approx(np.linalg.norm(scene.box[1] - scene.box[0]))


def test_the_true_mesh_scores_perfectly(scene: TrueScene) -> None:
    score = score_mesh(scene.truth, scene)
    assert score.chamfer < 1e-3
    assert min(*score.f_area.values(), *score.f_scan.values()) > 0.999
    assert score.normal_error is not None
    assert score.normal_error < 0.1
    assert (score.holes, score.excess) == (0, 0)
    assert (score.pieces, score.faces) == (1, len(scene.truth.faces))  # cube and plate share vertices


def without_top(scene: TrueScene) -> Mesh:
    top = (face_normals(scene.truth)[:, 2] > 0.5) & (
        scene.truth.vertices[scene.truth.faces][:, :, 2].mean(axis=1) > 0.4
    )
    return Mesh(scene.truth.vertices, scene.truth.faces[~top])


def test_missing_surface_is_a_hole(scene: TrueScene) -> None:
    score = score_mesh(without_top(scene), scene)
    share = 100 * float((scene.normals[:, 2] > 0.5).mean())
    margin = 1 - (1 - 2 * 0.01 * np.sqrt(3)) ** 2  # of the top is within 1 % of the diagonal of the sides
    assert score.holes == pytest.approx(share * (1 - margin), abs=0.5)
    assert score.completeness > 0.5
    assert score.f_area["0.1"] < 0.95


def test_a_sheet_is_excess_and_the_surroundings_are_not(scene: TrueScene) -> None:
    sheet = block((-0.25, -0.25, 0.55), (0.25, 0.25, 0.551), 0.05)
    added = Mesh(
        np.concatenate([scene.truth.vertices, sheet.vertices]),
        np.concatenate([scene.truth.faces, sheet.faces + len(scene.truth.vertices)]).astype(np.int32),
    )
    score = score_mesh(added, scene)
    assert 5 < score.excess < 40
    assert score.accuracy > 100 * 0.05 * 0.1  # a tenth of the points are 5 hundredths away, more in fractions of 0.87
    assert score.holes == 0
    assert score_mesh(scene.subject, scene).excess == 0


def test_mesh_outside_the_box_does_not_count(scene: TrueScene) -> None:
    wall = block((3.0, -5.0, -2.0), (3.1, 5.0, 3.0), 1.0)
    faces = np.concatenate([scene.truth.faces, wall.faces + len(scene.truth.vertices)]).astype(np.int32)
    score = score_mesh(Mesh(np.concatenate([scene.truth.vertices, wall.vertices]), faces), scene)
    assert (score.excess, score.holes, score.pieces) == (0, 0, 7)  # the truth and the six sides
    assert score.chamfer < 1e-3


def test_turned_faces_have_a_normal_error(scene: TrueScene) -> None:
    corners = scene.subject.vertices[scene.subject.faces].astype(np.float64)
    middles, normals = corners.mean(axis=1, keepdims=True), face_normals(scene.subject)
    axis = np.cross(normals, np.roll(normals, 1, axis=1))[:, None]  # in the plane of the face
    turn, arms = np.radians(20), corners - middles
    turned = (
        middles
        + arms * np.cos(turn)
        + np.cross(axis, arms) * np.sin(turn)
        + axis * (arms * axis).sum(axis=2, keepdims=True) * (1 - np.cos(turn))
    )
    shingles = Mesh(turned.reshape(-1, 3), np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3))
    error = score_mesh(shingles, scene).normal_error
    assert error == pytest.approx(20, abs=0.5)


def test_an_empty_mesh_is_one_hole(scene: TrueScene) -> None:
    score = score_mesh(Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32)), scene)
    assert (score.holes, score.excess, score.normal_error, score.pieces) == (100, 0, None, 0)
    assert score.chamfer == 100 * PADDING
    assert set(score.f_area.values()) == {0.0}


# -- the command ---------------------------------------------------------------------------------------------------
@pytest.fixture
def trainings(monkeypatch: pytest.MonkeyPatch, scene: TrueScene) -> list[list[str]]:
    """Trainings that return the true mesh; the list gets the commands."""
    commands: list[list[str]] = []

    def watch(command: list[str], console: Path, **_: Any) -> Process:
        commands.append(command)
        run = Path(command[command.index("--out") + 1])
        run.mkdir()
        scene.truth.save(run / "mesh.ply")
        (run / "metrics.json").write_text(json.dumps({"stages": [{"test": {"psnr": 30.0}, "splats": 7}]}))
        console.write_text("")
        return Process(command, 0, 3.0, 2.0, None, 0)

    monkeypatch.setattr(surfaces, "watch_process", watch)
    return commands


def test_the_command_trains_once_scores_and_draws(
    folder: Path, tmp_path: Path, scene: TrueScene, trainings: list[list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    given = tmp_path / "given"
    given.mkdir()
    without_top(scene).save(given / "boxes.ply")
    (given / "boxes.json").write_text('{"cpu_seconds": 12}')
    words = ["--scenes", "boxes", "--captures", str(folder), "--out", str(tmp_path / "out"), "--mesh", f"other={given}"]
    words += ["--pictures", "--set", "surface.iterations=5"]
    assert surfaces.main(words) == 0
    assert surfaces.main(words) == 0
    assert len(trainings) == 1
    assert trainings[0][-2:] == ["--set", "surface.iterations=5"]
    table = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if line.startswith("| boxes")]
    ours, theirs = table[0], table[1]
    assert ours[1:4] == ["best", "0.000", "1.000"]
    assert ours[-2:] == ["30.00", "2 |"]
    assert theirs[1] == "other"
    assert float(theirs[8]) > 10
    assert theirs[-2:] == ["-", "12 |"]
    rows = json.loads((tmp_path / "out" / "results.json").read_text())["rows"]
    assert [row["recipe"] for row in rows] == ["best", "other"]
    assert rows[0]["splats"] == 7
    assert (tmp_path / "out" / "pictures" / "boxes.png").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scenes", "moon"], "got moon"),
        (["--scale", "0"], "--scale must be"),
        (["--size", "20"], "--size must be"),
        (["--mesh", "openmvs"], "NAME=FOLDER"),
        (["--recipes", "nonsense"], "nonsense"),
    ],
)
def test_wrong_options_are_one_line(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        surfaces.main(words)
    assert message in capsys.readouterr().err.splitlines()[-1]


def test_rows_of_several_scenes_have_a_mean() -> None:
    rows = [
        {"scene": name, "recipe": "best", "seed": 0, "chamfer": c, "f_area": {"0.1": f}, "normal_error": None}
        for name, c, f in (("a", 1.0, 0.2), ("b", 2.0, 0.4))
    ]
    (mean,) = surfaces.means(rows)
    assert (mean["scene"], mean["chamfer"], mean["normal_error"]) == ("mean of 2", 1.5, None)
    assert mean["f_area"]["0.1"] == pytest.approx(0.3)
