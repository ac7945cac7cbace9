"""Edge collapse in a separate process gives the same bytes as in-process, and also works where no process can start."""

from __future__ import annotations

import numpy as np
import pytest

from gs2d.meshing import simplify

pytest.importorskip("fast_simplification")


def sheet(n: int = 30) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    points = np.stack([x.ravel(), y.ravel(), 0.1 * np.sin(7 * x.ravel())], axis=1).astype(np.float32)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = [np.stack([corner, corner + 1, corner + n], 1), np.stack([corner + 1, corner + n + 1, corner + n], 1)]
    return points, np.concatenate(faces).astype(np.int32)


def test_a_separate_process_gives_the_same_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    points, faces = sheet()
    here = simplify.collapse(points, faces, 300)
    monkeypatch.setattr(simplify, "OWN_PROCESS_FACES", 1)
    there = simplify._elsewhere(points, faces, 300)
    assert there is not None
    assert len(here[1]) <= 310
    for one, other, asked in zip(here, there, simplify.collapse(points, faces, 300), strict=True):
        assert one.dtype == other.dtype
        assert one.tobytes() == other.tobytes() == asked.tobytes()


@pytest.mark.parametrize("program", ["raise SystemExit(1)", "print('no arrays')"])
def test_a_failing_process_falls_back_to_this_one(monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    points, faces = sheet()
    expected = simplify.collapse(points, faces, 300)
    monkeypatch.setattr(simplify, "OWN_PROCESS_FACES", 1)
    monkeypatch.setattr(simplify, "_PROGRAM", program)
    assert simplify._elsewhere(points, faces, 300) is None
    found = simplify.collapse(points, faces, 300)
    assert found[1].tobytes() == expected[1].tobytes()
