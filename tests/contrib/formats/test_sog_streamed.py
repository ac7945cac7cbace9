"""Streams of SOG that we write: every level in the leaves of space it belongs to, and nothing of the user's touched."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gs2d.contrib.formats import sog_streamed
from gs2d.contrib.formats.sog import read_sog
from gs2d.errors import BackendError, DiskError
from gs2d.io.formats.splat_formats import read_splat_file, write_layout, written_bytes
from gs2d.io.gaussians import Gaussians
from splat_scenes import a_scene


@pytest.fixture(autouse=True)
def _small_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sog_streamed, "_LEAF", 100)
    monkeypatch.setattr(sog_streamed, "_FILE", 300)


def leaves(node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    if "lods" in node:
        yield node
    for child in node.get("children", []):
        for axis in range(3):  # a box holds its children's
            assert node["bound"]["min"][axis] <= child["bound"]["min"][axis]
            assert node["bound"]["max"][axis] >= child["bound"]["max"][axis]
        yield from leaves(child)


def test_each_leaf_contains_its_splats_of_every_level(tmp_path: Path) -> None:
    splats = a_scene(1000, 1)
    path = tmp_path / "scene" / "lod-meta.json"
    write_layout(path, splats, "streamed")
    index = json.loads(path.read_text())
    assert index["lodLevels"] == 4
    assert index["counts"][0] == 1000
    assert all(half <= whole / 2 + 16 for whole, half in zip(index["counts"], index["counts"][1:], strict=False))
    assert index["count"] == sum(index["counts"])
    sets = [read_sog(path.parent / name)[0] for name in index["filenames"]]
    assert len(sets) > 6
    assert max(len(g) for g in sets) <= 400
    found = list(leaves(index["tree"]))
    assert len(found) == 16
    seen = [np.zeros(len(g), int) for g in sets]
    for leaf in found:
        assert list(leaf["lods"]) == ["0", "1", "2", "3"]
        for place in leaf["lods"].values():
            rows = np.arange(place["offset"], place["offset"] + place["count"])
            seen[place["file"]][rows] += 1
            g = sets[place["file"]].rows(rows)
            reach = 3 * np.exp(g.log_scales.max(axis=1, keepdims=True))  # of the largest of three standard deviations
            assert (g.means - reach <= np.array(leaf["bound"]["max"])).all()
            assert (g.means >= np.array(leaf["bound"]["min"]) - 1e-3).all()
            assert (g.means <= np.array(leaf["bound"]["max"]) + 1e-3).all()
    assert all((times == 1).all() for times in seen)  # every splat of every set is in one leaf
    assert written_bytes(path, "streamed") == sum(f.stat().st_size for f in path.parent.rglob("*") if f.is_file())


@pytest.mark.usefixtures("native")
def test_errors_are_larger_where_merging_changes_more(tmp_path: Path) -> None:
    """On the left each splat is there twice, so that merging loses nothing but the outline; the right is random."""
    left, right = a_scene(50, 0, seed=2), a_scene(100, 0)
    left = left.followed_by(left)
    left.means[:, 0] -= 20
    write_layout(tmp_path / "lod-meta.json", left.followed_by(right), "streamed")
    index = json.loads((tmp_path / "lod-meta.json").read_text())
    assert index["lodErrors"] is True
    two = sorted(leaves(index["tree"]), key=lambda leaf: float(leaf["bound"]["min"][0]))
    assert len(two) == 2
    for leaf in two:
        errors = leaf["errors"]
        assert len(errors) == 4
        assert errors == sorted(errors)
        assert errors[0] == 0 < errors[-1] < 2
    assert two[0]["errors"][1] < 0.2 * two[1]["errors"][1]


def test_without_the_native_library_there_are_no_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise BackendError("no native library")

    monkeypatch.setattr(sog_streamed, "get_backend", missing)
    write_layout(tmp_path / "lod-meta.json", a_scene(150, 0), "streamed")
    index = json.loads((tmp_path / "lod-meta.json").read_text())
    assert index["lodErrors"] is False
    assert not any("errors" in leaf for leaf in leaves(index["tree"]))


def test_writing_again_removes_files_of_the_older_index_only(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "1_0").mkdir()
    (folder / "1_0" / "mine.txt").write_text("mine")
    path = folder / "lod-meta.json"
    write_layout(path, a_scene(300, 1), "streamed")
    first = {f.relative_to(folder) for f in folder.rglob("*")}
    assert not any(name.parts[0] == "0_0" for name in first)  # names that are all free: none like that of the user's
    (folder / "0_0-2" / "note.txt").write_text("a note")
    write_layout(path, a_scene(200, 1, seed=5), "streamed")
    assert len(read_splat_file(path).gaussians) == 200
    assert (folder / "1_0" / "mine.txt").read_text() == "mine"
    assert [f.name for f in (folder / "0_0-2").iterdir()] == ["note.txt"]
    names = {f.name for f in folder.iterdir() if f.is_dir()}
    listed = {name.split("/")[0] for name in json.loads(path.read_text())["filenames"]}
    assert names == listed | {"1_0", "0_0-2"}


def test_a_failure_keeps_the_older_stream(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "scene" / "lod-meta.json"
    calls = []

    def breaks(g: Gaussians) -> dict[str, bytes]:
        calls.append(len(g))
        if len(calls) > 2:
            raise OSError(28, "No space left on device")
        return {"meta.json": b"{}", "quats.webp": b"x"}

    with monkeypatch.context() as patch:
        patch.setattr(sog_streamed, "packed_sog", breaks)
        with pytest.raises(OSError, match="No space"):
            write_layout(path, a_scene(900, 0), "streamed")
        assert not path.parent.exists()
    write_layout(path, a_scene(150, 0), "streamed")
    before = {f.relative_to(tmp_path): f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()}
    with monkeypatch.context() as patch:
        calls.clear()
        patch.setattr(sog_streamed, "packed_sog", breaks)
        with pytest.raises(OSError, match="No space"):
            write_layout(path, a_scene(900, 0), "streamed")
    assert {f.relative_to(tmp_path): f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()} == before
    (tmp_path / "file").write_text("")
    with pytest.raises(DiskError, match="cannot write .*file"):
        write_layout(tmp_path / "file" / "lod-meta.json", a_scene(9, 0), "streamed")
    with pytest.raises(DiskError, match="the folder does not exist: create it first"):
        write_layout(tmp_path / "none" / "none" / "lod-meta.json", a_scene(9, 0), "streamed")
