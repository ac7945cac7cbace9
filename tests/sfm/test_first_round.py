"""How cameras are placed first: by COLMAP's own demands, by easier ones, or all at once."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gs2d.cli import run
from gs2d.data.readers.colmap import read_images
from gs2d.sfm import colmap_worker
from gs2d.sfm.steps import Steps
from room_photos import write_walk


class _Piece(SimpleNamespace):
    def num_reg_images(self) -> int:
        return int(self.photographs)

    def num_points3D(self) -> int:
        return 100


class _Placing:
    """Mapping that only says how many photographs each of its models has."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path, **sizes: tuple[int, ...]) -> None:
        self.tried: list[str] = []
        self.said: list[str] = []
        self.steps = Steps(folder)
        self._sizes = {name.replace("_", " "): found for name, found in sizes.items()}
        monkeypatch.setattr(colmap_worker, "_options", lambda *_: SimpleNamespace(mapper=SimpleNamespace()))
        monkeypatch.setattr(colmap_worker, "grow_all", self._place)
        monkeypatch.setattr(colmap_worker, "place_all", lambda _p, _r, steps, name, threads: self._make(steps, name))
        monkeypatch.setattr(Steps, "read", lambda _s, _p, name: self._piece(name))

    def _piece(self, name: str) -> _Piece:
        attempt, number = name.rsplit("-", 1)
        return _Piece(photographs=self._sizes[attempt][int(number)])

    def _place(self, _p: Any, _d: Any, _o: Any, steps: Steps, name: str, _c: Any, *, often: bool) -> None:
        self._make(steps, name)

    def _make(self, steps: Steps, name: str) -> None:
        self.tried.append(name)
        for i in range(len(self._sizes[name])):
            (steps.folder / f"{name}-{i}").mkdir(exist_ok=True)

    def run(self, photographs: int, mapper: str = "incremental") -> list[str]:
        request = {
            "in_order": ["a"] * photographs,
            "mapper": mapper,
            "database": "",
            "threads": 1,
            "asked_lens": "OPENCV",
        }
        colmap_worker._first_round(None, request, self.steps, self._say)
        names = self.steps.facts("first")
        assert isinstance(names, list)
        return names

    def _say(self, **message: Any) -> None:
        self.said.extend([message["note"]] if "note" in message else [])


def test_where_most_photographs_have_a_place_no_other_way_is_tried(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    placing = _Placing(monkeypatch, tmp_path, strictly=(2, 4, 5))
    assert placing.run(10) == ["strictly-2", "strictly-1"]  # two photographs are no model
    assert (placing.tried, placing.said) == (["strictly"], [])


def test_easier_demands_are_believed_where_they_place_clearly_more(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    placing = _Placing(monkeypatch, tmp_path, strictly=(4,), as_on_a_walk=(8,))
    assert placing.run(20) == ["as on a walk-0"]
    assert placing.tried == ["strictly", "as on a walk"]
    assert placing.said == ["cameras were placed as on a walk: 8 photographs, 4 by stricter rules"]


def test_a_walk_straight_ahead_has_cameras(colmap: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """COLMAP's own demands refuse every pair of it. Focal length and depth are one scale then, which nothing tells."""
    write_walk(tmp_path / "photos")
    out = tmp_path / "capture"
    assert run(["poses", str(tmp_path / "photos"), "--out", str(out), "--threads", "1"]) == 0
    assert json.loads((out / "poses.json").read_text())["placed"] == 8
    images = sorted(read_images(out / "sparse" / "0", "bin"), key=lambda image: image.name)
    centers = np.stack([-image.T_cam_world[:3, :3].T @ image.T_cam_world[:3, 3] for image in images])
    steps = np.diff(centers, axis=0)
    ahead = np.stack([image.T_cam_world[2, :3] for image in images])  # where each camera looks
    assert np.linalg.norm(steps, axis=1) == pytest.approx(np.linalg.norm(steps, axis=1).mean(), rel=0.15)
    assert (ahead[:-1] * steps / np.linalg.norm(steps, axis=1, keepdims=True)).sum(axis=1) == pytest.approx(1, abs=0.02)
    assert "cameras" in capsys.readouterr().err
