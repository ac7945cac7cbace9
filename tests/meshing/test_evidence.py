"""Mesh cleaning keeps observed surface: removes sheets seen by few views, merges faces, keeps borders and colours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gs2d.core.camera import look_at
from gs2d.core.mesh import Mesh
from gs2d.meshing.depth_maps import RenderedView, depth_map
from gs2d.meshing.evidence import Evidence, areas, gather, large_components
from gs2d.meshing.extract import ExtractOptions, extract
from gs2d.meshing.fusion_bounds import backproject
from surface_shapes import orbit, sphere_depth

BOX = np.array([[-2.0, -2, -2], [2, 2, 2]])


def frames(count: int, *, sheets: int = 0) -> list[RenderedView]:
    """Render a coloured ball from all around; the first views have a sheet in front of it in an image corner."""
    made = []
    for number, camera in enumerate(orbit(count, 4.0, size=32, focal=40.0)):
        depth = sphere_depth(camera, 1.0)
        if number < sheets:
            depth[:10, :10] = 2.6
        color = np.full((camera.height, camera.width, 3), (200, 40, 90), np.uint8)
        made.append(RenderedView(camera, depth, color))
    return made


def off_the_ball(mesh: Mesh) -> float:
    """Return the fraction of the area that lies away from the ball."""
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    area = areas(mesh)
    return float(area[np.abs(np.linalg.norm(middle, axis=1) - 1) > 0.15].sum() / area.sum())


def test_a_sheet_seen_by_one_view_is_removed_and_the_ball_is_kept() -> None:
    seen = frames(14, sheets=1)
    before, after = (
        extract(seen, ExtractOptions(bbox=BOX, voxel=0.1, by_evidence=cleans), threads=1) for cleans in (False, True)
    )
    assert off_the_ball(before.mesh) > 0.01  # the sheet exists
    assert off_the_ball(after.mesh) == 0.0
    assert areas(after.mesh).sum() == pytest.approx(4 * np.pi, rel=0.1)
    assert before.pixels is None


def test_no_face_extends_beyond_the_box() -> None:
    box = np.array([[-0.73, -2, -2], [0.77, 2, 2]])
    mesh = extract(frames(14), ExtractOptions(bbox=box, voxel=0.1), threads=1).mesh
    assert mesh.vertices[:, 0].min() == pytest.approx(-0.73, abs=0.1)
    assert mesh.vertices[:, 0].max() == pytest.approx(0.77, abs=0.1)
    assert (np.abs(mesh.vertices[:, 0] - 0.02) <= 0.75).all()


def test_the_number_of_faces_follows_the_error_in_pixels() -> None:
    options = ExtractOptions(bbox=BOX, voxel=0.06, by_evidence=True)
    dense = extract(frames(14), options, threads=1)
    found = extract(frames(14), replace(options, error=0.5), threads=1)
    assert found.pixels is not None
    # a pixel at distance 3 is 3 / 40 wide, and the best view of each part is nearly perpendicular to it
    assert found.pixels == pytest.approx(4 * np.pi * (40 / 3) ** 2, rel=0.3)
    assert found.pixels == dense.pixels
    assert len(found.mesh.faces) < 0.25 * len(dense.mesh.faces)
    assert np.abs(np.linalg.norm(found.mesh.vertices, axis=1) - 1).max() < 0.1
    assert found.mesh.colors is not None
    assert (np.abs(found.mesh.colors.astype(int) - (200, 40, 90)).max(axis=0) <= 1).all()


def test_evidence_does_not_depend_on_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    made = [depth_map(frame) for frame in frames(5, sheets=2)]
    mesh = extract(frames(5), ExtractOptions(bbox=BOX, voxel=0.1), threads=1).mesh
    whole = gather(mesh, made, 0.1)
    monkeypatch.setattr("gs2d.meshing.evidence.VERTICES_AT_ONCE", 37)
    parts = gather(mesh, made, 0.1)
    for name in ("views", "support", "against", "density"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
    for at in range(0, len(mesh.vertices), 29):  # one vertex at a time, in double precision
        support, against, least = 0, 0, np.inf
        for item in made:
            x, y, z = item.camera.rotation @ mesh.vertices[at] + item.camera.T_cam_world[:3, 3]
            column, row = item.camera.fx * x / z + item.camera.cx, item.camera.fy * y / z + item.camera.cy
            seen = item.depth[int(row), int(column)]
            normal = mesh.vertices[at] / np.linalg.norm(mesh.vertices[at])  # approximate: exact for a ball
            arm = item.camera.center - mesh.vertices[at]
            facing = normal @ arm / np.linalg.norm(arm)
            least = min(least, abs(abs(seen - z) - 0.1), abs(facing - 0.1) / 3)
            support += bool(seen > 0 and abs(seen - z) <= 0.1 and facing > 0.1)
            against += bool(seen > z + 0.1)
        if least > 0.02:  # skip vertices close to the tolerance or to grazing angles
            assert (whole.support[at], whole.against[at]) == (support, against)


def views_of_a_floor(count: int = 12) -> list[RenderedView]:
    """Render the plane z = 0 from above; its depth is noisy with low weight, as on textureless floors."""
    made = []
    for number in range(count):
        angle = 2 * np.pi * number / count
        eye = np.array([2 * np.cos(angle), 2 * np.sin(angle), 2.0])
        camera = look_at(eye, np.zeros(3), np.array([0, 0, 1.0]), width=40, height=30, fx=40)
        rows, columns = np.indices((30, 40)).reshape(2, -1)
        ray = backproject(camera, np.ones(len(rows)), rows, columns) - eye
        depth = (-eye[2] / ray[:, 2]).reshape(30, 40) + 0.04 * np.sin(np.arange(40) / 5 + number)
        made.append(RenderedView(camera, depth, None, np.full((30, 40), 0.25)))
    return made


def part_of_floor(frames: list[RenderedView]) -> float:
    """Return the part of the square |x|, |y| < 0.7 covered by the fused mesh, and the part of the mesh above it."""
    mesh = extract(
        frames, ExtractOptions(bbox=BOX, voxel=0.06, truncation=0.3, min_weight=0.25, by_evidence=True), threads=1
    ).mesh
    inside = (np.abs(mesh.vertices[mesh.faces].mean(axis=1)[:, :2]) < 0.7).all(axis=1)
    return float(areas(mesh)[inside].sum()) / 1.4**2


def test_a_floor_with_noisy_depths_is_kept() -> None:
    assert part_of_floor(views_of_a_floor()) == pytest.approx(1, abs=0.1)


def test_a_small_part_stays_if_about_as_many_views_see_it_as_the_rest() -> None:
    def sheet(x: float, side: float) -> tuple[np.ndarray, np.ndarray]:
        corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]) * side + [x, 0, 0]
        return corners, np.array([[0, 1, 2], [1, 3, 2]])

    parts = [sheet(0, 10.0), sheet(20, 0.5), sheet(30, 0.5), sheet(40, 0.5)]
    vertices = np.concatenate([corners for corners, _ in parts])
    faces = np.concatenate([corner + 4 * k for k, (_, corner) in enumerate(parts)])
    views = np.repeat([20, 12, 4, 12], 4)  # the last one covers few pixels
    density = np.repeat([100.0, 1000.0, 1000.0, 10.0], 4)
    evidence = Evidence(views.astype(np.int32), np.ones(16), np.zeros(16), density)
    mesh, kept = large_components(Mesh(vertices, faces), evidence)
    assert sorted(set(mesh.vertices[:, 0] // 10)) == [0, 1, 2]
    assert sorted(set(kept.views)) == [12, 20]
