"""``gs2d mesh --splats FILE`` without a run: cameras of a capture or chosen ones, and bad input in one line."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from cli_runs import one_line
from gs2d.cli import run
from gs2d.core.splats import Splats
from gs2d.data import Scene, load_scene
from gs2d.errors import DataError
from gs2d.io.formats.splat_formats import write_splats
from gs2d.io.meshes import read_mesh
from gs2d.meshing.depth_maps import RenderedView
from gs2d.pipeline.finish import run_mesh
from gs2d.pipeline.finish.run_mesh import fused, mesh_file
from gs2d.pipeline.finish.viewpoints import choose_viewpoints
from gs2d.pipeline.look.page import settings_without_run
from gs2d.pipeline.prepare.loaded import trained_elsewhere
from gs2d.pipeline.prepare.options import MeshOptions
from gs2d.render.backends import get_backend
from gs2d.training.events import ignore
from tiny import RADIUS, write_capture


def tiles(points: np.ndarray, normals: np.ndarray, size: float) -> Splats:
    """Round opaque splats at points [N, 3] across normals [N, 3]."""
    z = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    quats = np.stack([1 + z[:, 2], -z[:, 1], z[:, 0], np.zeros(len(z))], axis=1)  # rotates the third axis to z
    quats[z[:, 2] < -0.999999] = (0, 1, 0, 0)
    count = len(points)
    arrays = (
        points,
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        np.full((count, 2), np.log(size)),
        np.full(count, 4.0),
        np.full((count, 1, 3), 0.5),
        np.zeros((count, 0, 3)),
    )
    return Splats(*(torch.from_numpy(np.ascontiguousarray(array, np.float32)) for array in arrays))


def ball(radius: float = RADIUS, count: int = 1200, center: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Splats:
    k = np.arange(count)
    z, turn = 1 - (2 * k + 1) / count, k * np.pi * (3 - np.sqrt(5))
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    return tiles(radius * normals + center, normals, 1.2 * radius * np.sqrt(4 * np.pi / count))


def square(side: float, height: float, axis: int = 2, n: int = 30) -> Splats:
    u, v = (grid.ravel() for grid in np.meshgrid(*[np.linspace(-side / 2, side / 2, n)] * 2))
    points = np.insert(np.stack([u, v], axis=1), axis, height, axis=1)
    return tiles(points, np.tile(np.eye(3)[axis], (len(points), 1)), side / n)


def joined(*parts: Splats) -> Splats:
    return Splats(*(torch.cat([dict(part.items())[name] for part in parts]) for name, _ in parts[0].items()))


def chosen(splats: Splats) -> tuple[np.ndarray, np.ndarray, str]:
    """Return camera centres, viewing directions and the reason."""
    found = choose_viewpoints(splats, settings_without_run(splats), get_backend("auto"))
    centers = np.array([camera.center for camera in found.cameras])
    return centers, np.array([camera.forward for camera in found.cameras]), found.why


def test_a_closed_object_is_seen_from_all_sides_though_far_splats_surround_it() -> None:
    centers, _, why = chosen(joined(ball(1.0, center=(5, 0, 0)), ball(200.0, 300)))
    assert "all sides" in why
    np.testing.assert_allclose(centers.mean(axis=0), (5, 0, 0), atol=0.2)
    assert (np.abs(np.linalg.norm(centers - (5, 0, 0), axis=1) - 2.6) < 0.3).all()


def test_an_object_on_a_floor_is_seen_from_above() -> None:
    centers, _, why = chosen(joined(ball(0.5, center=(0, 0, 0.5)), square(4.0, 0.0)))
    assert "the side" in why
    assert len(centers) > 12
    assert centers[:, 2].min() > 0.1


def test_a_room_full_of_things_is_seen_from_inside() -> None:
    walls = [square(2.4, end, axis, 24) for axis in range(3) for end in (-1.2, 1.2)]
    corners = ((0.6, 0.6, -0.6), (-0.6, 0.6, -0.6), (0.6, -0.6, 0.6), (-0.6, -0.6, 0.6))
    things = [ball(0.5, 500, corner) for corner in corners]
    centers, ahead, why = chosen(joined(*walls, *things))
    assert "middle" in why
    assert np.abs(centers).max() < 0.8
    np.testing.assert_allclose(ahead.mean(axis=0), 0, atol=0.05)


def test_splats_without_a_surface_are_refused() -> None:
    faint = ball()
    faint.opacity_logits.fill_(-9.0)
    with pytest.raises(DataError, match="got 1,200 with opacities below"):
        chosen(faint)
    with pytest.raises(DataError, match="in one point"):
        chosen(tiles(np.zeros((5, 3)), np.tile([0, 0, 1.0], (5, 1)), 0.1))


@pytest.mark.parametrize("layout", ["3dgs", "compressed", "spz"])
def test_a_file_of_each_kind_is_meshed_without_cameras(tmp_path: Path, layout: str) -> None:
    file = tmp_path / ("ball.spz" if layout == "spz" else "ball.compressed.ply" if layout == "compressed" else "b.ply")
    write_splats(file, ball(), layout=layout)
    out = tmp_path / "mesh.ply"
    assert run(["mesh", "--splats", str(file), "--out", str(out), "--set", "voxel=0.06", "--threads", "1"]) == 0
    mesh = read_mesh(out)
    distance = np.linalg.norm(mesh.vertices, axis=1)
    assert len(mesh.faces) > 100
    assert np.median(distance) == pytest.approx(RADIUS, rel=0.05)
    assert (np.ptp(mesh.vertices, axis=0) > 1.8 * RADIUS).all()


def test_the_cameras_of_a_capture_are_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = write_capture(tmp_path / "capture", size=48)
    file, out = tmp_path / "ball.ply", tmp_path / "mesh.ply"
    write_splats(file, ball(), layout="2dgs")
    words = [
        "mesh",
        "--splats",
        str(file),
        "--cameras",
        str(capture),
        "--out",
        str(out),
        "--set",
        "voxel=0.06",
        "--threads",
        "1",
    ]
    assert run(words) == 0
    assert "viewpoints" not in capsys.readouterr().err
    assert np.median(np.linalg.norm(read_mesh(out).vertices, axis=1)) == pytest.approx(RADIUS, rel=0.1)


def test_only_shiny_views_move_to_the_visual_hull(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene(write_capture(tmp_path / "capture", size=48), test_every=0)
    shiny = tuple(view.with_cells(shine=np.full((4, 4), 255, np.uint8)) for view in scene.train[:3])
    maps: list[Sequence[np.ndarray | None]] = []

    def nearer(frames: Iterable[RenderedView], shine: Sequence[np.ndarray | None]) -> Iterator[RenderedView]:
        maps.append(shine)
        return (replace(frame, depth=0.9 * frame.depth) for frame in frames)

    def height(scene: Scene) -> float:
        trained = trained_elsewhere(ball(), scene, "auto", "auto", ignore)
        mesh = fused(trained, MeshOptions(voxel=0.06, refine=False), ignore).mesh
        return float(np.median(np.linalg.norm(mesh.vertices, axis=1)))

    monkeypatch.setattr(run_mesh, "to_visual_hull", nearer)
    matt = height(scene)
    assert not maps
    assert height(replace(scene, train=(*shiny, *scene.train[3:]))) > 1.05 * matt
    assert [cells is None for cells in maps[0]] == [False] * 3 + [True] * (len(scene.train) - 3)


def test_a_glb_has_levels_of_detail_and_convex_pieces_beside_it(tmp_path: Path) -> None:
    pytest.importorskip("coacd")
    file, out = tmp_path / "ball.ply", tmp_path / "ball.glb"
    write_splats(file, ball(), layout="2dgs")
    options = MeshOptions(voxel=0.06, lods=3, collision=True)
    result = mesh_file(file, options, out=out, threads=1)
    assert result["lods"][0] > result["lods"][1] > result["lods"][2] > 0
    assert result["faces"] == len(trimesh.load(out, force="mesh").faces) == result["lods"][0]
    assert (tmp_path / "ball-collision.obj").read_text().count("o piece_") == result["pieces"]


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out, empty = tmp_path / "ball.ply", tmp_path / "mesh.ply", tmp_path / "empty.ply"
    write_splats(file, ball(count=50), layout="2dgs")
    write_splats(empty, ball().rows(torch.zeros(1200, dtype=torch.bool)), layout="2dgs")
    one_view = write_capture(tmp_path / "capture", size=16, train=1, test=0)
    cases = {
        (): "expected the folder of a run, got none",
        ("--splats", file): "--splats needs --out FILE",
        ("--splats", file, "--texture", "--out", out): "expected the folder of a run",
        ("--splats", empty, "--out", out): "must contain splats, got an empty file",
        ("--splats", tmp_path / "none.ply", "--out", out): "none.ply",
        ("--splats", file, "--out", tmp_path / "mesh.xyz"): "--out must name a .ply file",
        ("--splats", file, "--out", out, "--set", "lods=2"): "lods=2 needs --out FILE.glb",
        ("--splats", file, "--out", out, "--set", "lods=0"): "lods must be a whole number >= 1, got 0",
        ("--splats", file, "--out", out, "--error", "-1"): "--error must be a number of pixels >= 0, got -1",
        ("--splats", file, "--out", out, "--bbox", *"5 5 5 6 6 6".split()): "--bbox contains none of the 50 splats",
        ("--splats", file, "--out", out, "--cameras", tmp_path): "must hold",
        ("--splats", file, "--out", out, "--cameras", one_view): "training cameras with different centres, got 1",
    }
    for words, message in cases.items():
        assert run(["mesh", *map(str, words)]) == 2
        assert message in one_line(capsys.readouterr().err), words
    assert not out.exists()
