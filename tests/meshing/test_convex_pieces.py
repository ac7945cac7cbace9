"""Convex pieces fill the volume of a mesh."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from gs2d.core.mesh import Mesh
from gs2d.errors import BackendError, ProtocolError
from gs2d.meshing.convex_pieces import convex_pieces


def block(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], np.float64)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return corners * np.subtract(high, low) + low, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def volume(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return float(np.einsum("fi,fi->f", a, np.cross(b, c)).sum()) / 6


def test_two_separate_blocks_become_two_convex_pieces() -> None:
    pytest.importorskip("coacd")
    (one, faces), (other, _) = block((100, 0, 0), (101, 1, 1)), block((103, 0, 0), (104, 2, 1))
    mesh = Mesh(np.concatenate([one, other]), np.concatenate([faces, faces + 8]).astype(np.int32))
    pieces = convex_pieces(mesh)
    assert len(pieces) == 2
    assert sorted(abs(volume(piece)) for piece in pieces) == pytest.approx([1, 2], rel=0.05)
    points = np.concatenate([piece.vertices for piece in pieces])
    np.testing.assert_allclose([points.min(axis=0), points.max(axis=0)], [[100, 0, 0], [104, 2, 1]], atol=0.05)


def test_an_empty_mesh_is_refused() -> None:
    pytest.importorskip("coacd")
    with pytest.raises(ProtocolError, match="got an empty mesh"):
        convex_pieces(Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32)))


def test_a_missing_package_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "coacd", None)
    with pytest.raises(BackendError, match=r"--collision needs coacd, which is not installed; pip install 'coacd"):
        convex_pieces(Mesh(*block((0, 0, 0), (1, 1, 1))))
