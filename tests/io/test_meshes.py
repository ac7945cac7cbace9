"""Mesh files: round trips, and files that other programs read."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gs2d.core.mesh import Mesh
from gs2d.errors import DataError
from gs2d.io.meshes import glb_bytes, read_mesh, triangulate, write_mesh, write_pieces
from gs2d.io.ply_format import write_ply
from surface_shapes import tetrahedron


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("colors", [True, False])
def test_a_mesh_survives_a_round_trip(tmp_path: Path, dtype: type, colors: bool) -> None:
    mesh = tetrahedron(colors, dtype)
    write_mesh(tmp_path / "a.ply", mesh)
    back = read_mesh(tmp_path / "a.ply")
    assert back.vertices.dtype == dtype
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    assert (back.colors is None) if mesh.colors is None else np.array_equal(back.colors, mesh.colors)


def test_trimesh_reads_a_written_mesh(tmp_path: Path) -> None:
    write_mesh(tmp_path / "a.ply", tetrahedron())
    back = trimesh.load(tmp_path / "a.ply", process=False)
    assert back.volume == pytest.approx(1 / 6)  # positive: the faces point outwards
    assert back.visual.vertex_colors[1].tolist() == [255, 4, 5, 255]


def test_a_face_with_an_invalid_index_is_a_data_error(tmp_path: Path) -> None:
    mesh = tetrahedron()
    write_mesh(tmp_path / "a.ply", Mesh(mesh.vertices[:3], mesh.faces))
    with pytest.raises(DataError, match="expected vertex indices"):
        read_mesh(tmp_path / "a.ply")


def test_points_are_not_read_as_a_mesh(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", {"vertex": np.zeros(3, [(name, "f4") for name in "xyz"])})
    with pytest.raises(DataError, match="without faces"):
        read_mesh(tmp_path / "a.ply")


def test_polygons_become_triangle_fans() -> None:
    faces = triangulate(np.array([2, 5, 3]), np.array([0, 1, 10, 11, 12, 13, 14, 20, 21, 22]))
    assert faces.tolist() == [[10, 11, 12], [10, 12, 13], [10, 13, 14], [20, 21, 22]]


def test_obj_faces_with_texture_indices_negative_indices_and_polygons_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(
        "# a comment\nmtllib none.mtl\nv 0 0 0\nv 1 0 0 0.5 0.5 0.5\nv 1 1 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\n"
        "f 1/1/1 2//1 3/1 4 # a square\nf -4 -3 -2\n"
    )
    mesh = read_mesh(tmp_path / "a.obj")
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert mesh.faces.tolist() == [[0, 1, 2], [2, 3, 0], [0, 1, 2]]
    assert mesh.vertices.dtype == np.float64


@pytest.mark.parametrize("name", ["a.stl", "a.off", "a.obj", "A.OBJ"])
def test_other_formats_are_read_as_trimesh_writes_them(tmp_path: Path, name: str) -> None:
    mesh = tetrahedron(colors=False)
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / name.lower())
    (tmp_path / name.lower()).rename(tmp_path / name)
    back = read_mesh(tmp_path / name)
    np.testing.assert_array_equal(back.vertices[back.faces], mesh.vertices[mesh.faces])


@pytest.mark.parametrize(
    "text",
    ["v 0 0\n", "v 0 0 0\nf 1 2 x\n", "v 0 0 0\nf 1 2 3\n", "v 0 0 0\n", f"v 0 0 0\nf 1 1 {'9' * 30}\n"],  # no int64
)
def test_a_broken_obj_is_a_data_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(DataError):
        read_mesh(tmp_path / "a.obj")


def test_a_glb_has_the_vertex_colours(tmp_path: Path) -> None:
    colors = np.array([[255, 0, 0], [0, 188, 0], [12, 0, 255]], np.uint8)
    data = glb_bytes(Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), colors))
    (tmp_path / "a.glb").write_bytes(data)
    loaded = trimesh.load(tmp_path / "a.glb", force="mesh", process=False)
    np.testing.assert_allclose(loaded.vertices, np.eye(3))
    # linear in the file (glTF 3.7.2.1): ((188 / 255 + 0.055) / 1.055)^2.4 = 0.5029, 12 / 255 / 12.92 about 0.0037
    length = struct.unpack("<I", data[12:16])[0]
    document = json.loads(data[20 : 20 + length])
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (5123, "VEC4", True)
    start = 28 + length + document["bufferViews"][accessor["bufferView"]]["byteOffset"]
    found = np.frombuffer(data, "<u2", 12, start).reshape(3, 4) / 65535
    np.testing.assert_allclose(found, [[1, 0, 0, 1], [0, 0.5029, 0, 1], [0.00364, 0, 1, 1]], atol=1e-4)


def test_levels_of_detail_are_nodes_beside_the_scene(tmp_path: Path) -> None:
    colors = np.full((4, 3), 99, np.uint8)
    fine, coarse = tetrahedron(True, np.float32), Mesh(np.eye(4, 3, dtype=np.float32), np.array([[0, 1, 2]]), colors)
    write_mesh(tmp_path / "a.glb", fine, up=np.array([0, 0, 1.0]), coarser=[coarse])
    shown = trimesh.load(tmp_path / "a.glb", force="mesh", process=False)
    assert len(shown.faces) == len(fine.faces)  # readers without the extension
    data = (tmp_path / "a.glb").read_bytes()
    document = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    assert document["extensionsUsed"] == ["KHR_materials_unlit", "MSFT_lod"]
    assert document["scenes"] == [{"nodes": [0]}]
    assert document["nodes"][0]["extensions"]["MSFT_lod"]["ids"] == [1]
    assert document["nodes"][0]["extras"]["MSFT_screencoverage"] == [1 / 16, 0]
    assert document["nodes"][1]["rotation"] == document["nodes"][0]["rotation"]
    (primitive,) = document["meshes"][document["nodes"][1]["mesh"]]["primitives"]
    assert document["accessors"][primitive["indices"]]["count"] == 3


def test_pieces_are_objects_of_one_obj(tmp_path: Path) -> None:
    pieces = [tetrahedron(False, np.float64), tetrahedron(False, np.float64)]
    write_pieces(tmp_path / "a.obj", pieces)
    lines = (tmp_path / "a.obj").read_text().splitlines()
    assert [line for line in lines if line.startswith("o ")] == ["o piece_000", "o piece_001"]
    found = read_mesh(tmp_path / "a.obj")
    np.testing.assert_array_equal(found.vertices, np.concatenate([piece.vertices for piece in pieces]))
    np.testing.assert_array_equal(found.faces, np.concatenate([pieces[0].faces, pieces[1].faces + 4]))
