"""``Splats.save`` and ``Mesh.save`` choose the format by the suffix."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import gs2d
from gs2d.errors import DataError, DiskError
from gs2d.io.formats.splat_formats import write_layout
from gs2d.io.meshes import read_mesh


@pytest.fixture
def splats() -> gs2d.Splats:
    g = torch.Generator().manual_seed(0)
    return gs2d.Splats(
        means=torch.rand(20, 3, generator=g),
        quats=torch.nn.functional.normalize(torch.randn(20, 4, generator=g), dim=1),
        log_scales=torch.randn(20, 2, generator=g) - 3,
        opacity_logits=torch.randn(20, generator=g),
        sh0=gs2d.rgb_to_sh0(torch.rand(20, 3, generator=g)),
        shN=0.1 * torch.randn(20, 15, 3, generator=g),
    )


@pytest.fixture
def mesh() -> gs2d.Mesh:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    return gs2d.Mesh(vertices, np.array([[0, 1, 2]], np.int32), np.full((3, 3), 200, np.uint8))


@pytest.mark.parametrize(
    ("name", "layout"), [("a.ply", "3dgs"), ("a.compressed.ply", "compressed"), ("A.SPZ", "spz"), ("a.splat", "splat")]
)
def test_the_suffix_selects_the_format(splats: gs2d.Splats, tmp_path: Path, name: str, layout: str) -> None:
    splats.save(tmp_path / name)
    write_layout(tmp_path / "exported", splats, layout)
    assert (tmp_path / name).read_bytes() == (tmp_path / "exported").read_bytes()
    assert len(gs2d.read_splats(tmp_path / name)) == len(splats)


@pytest.mark.parametrize(
    ("name", "layout", "message"),
    [
        ("a.txt", None, "compressed"),
        ("a.spz", "2dgs", "layout"),
        ("a.ply", "3dg", "layout"),
    ],
)
def test_an_unknown_suffix_or_layout_is_an_error(
    splats: gs2d.Splats, tmp_path: Path, name: str, layout: str | None, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        splats.save(tmp_path / name, layout=layout)
    assert list(tmp_path.iterdir()) == []


def test_a_mesh_is_saved_by_its_suffix(mesh: gs2d.Mesh, tmp_path: Path) -> None:
    mesh.save(tmp_path / "a.ply")
    again = read_mesh(tmp_path / "a.ply")
    assert np.array_equal(again.vertices, mesh.vertices)
    assert np.array_equal(again.colors, mesh.colors)
    mesh.save(str(tmp_path / "a.GLB"))
    assert (tmp_path / "a.GLB").read_bytes()[:4] == b"glTF"
    with pytest.raises(DataError, match="written"):
        mesh.save(tmp_path / "a.stl")
    with pytest.raises(DiskError, match="create it first"):
        mesh.save(tmp_path / "none" / "a.ply")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.GLB", "a.ply"]
