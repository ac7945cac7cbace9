"""Our files in other people's programs, from npm: a validator, and a converter both ways."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from gs2d.contrib.formats.gltf import EXTENSION
from gs2d.contrib.formats.turned import mirrored
from gs2d.core.splats import Splats
from gs2d.io.formats.splat_formats import read_splat_file, write_layout
from gs2d.io.gaussians import Gaussians, unit_quats
from npm import forget, node, package, splat_transform
from splat_scenes import a_scene, turned_by

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def _nothing_is_left() -> Iterator[None]:
    yield
    forget()


_VALIDATE = """
const validator = require("gltf-validator"), fs = require("fs");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1]))).then(r => console.log(JSON.stringify(r)));
"""


def validated(path: Path) -> list[dict[str, object]]:
    """What Khronos' validator says of a file; the extension is new to it."""
    package("gltf-validator")
    report = json.loads(node(_VALIDATE, str(path)))
    found: list[dict[str, object]] = report["issues"]["messages"]
    return [message for message in found if message["code"] != "UNSUPPORTED_EXTENSION"]


def test_khronos_validator_reports_unknown_names_only(tmp_path: Path) -> None:
    for count, degree in ((0, 0), (30, 0), (30, 3)):
        path = tmp_path / f"{count}_{degree}.glb"
        write_layout(path, a_scene(count, degree), "gltf")
        pointer = f"/meshes/0/primitives/0/attributes/{EXTENSION}:"
        beyond = [
            message
            for message in validated(path)
            if message["code"] != "MESH_PRIMITIVE_INVALID_ATTRIBUTE" or not str(message["pointer"]).startswith(pointer)
        ]
        assert beyond == []
        # With names of an application's own, which it does look at, nothing is left.
        path.write_bytes(path.read_bytes().replace(f'"{EXTENSION}:'.encode(), b'"_' + b"S" * len(EXTENSION)))
        assert validated(path) == []
    data = path.read_bytes()
    path.write_bytes(data[: len(data) - 4])
    assert validated(path) != []  # it does look


def near(found: Gaussians, splats: Splats, **within: float) -> None:
    """Compare Gaussians, whatever their order, with the splats that were written."""
    from scipy.spatial import cKDTree

    ours = Gaussians.of(splats)
    distance, match = cKDTree(ours.means).query(found.means)
    assert sorted(match.tolist()) == list(range(len(ours)))
    same = ours.rows(match)
    assert distance.max() <= within.get("means", 1e-6)
    assert turned_by(found.quats, same.quats).max() <= within.get("quats", 0.1)
    assert np.abs(found.log_scales[:, :2] - same.log_scales[:, :2]).max() <= within.get("scales", 1e-5)
    assert np.abs(found.sh0 - same.sh0).max() <= within.get("sh0", 1e-6)
    assert np.abs(found.shN - same.shN).max() <= within.get("shN", 1e-6)


def test_splat_transform_writes_the_same_glb(tmp_path: Path) -> None:
    splats = a_scene(200)
    splats.opacity_logits.clamp_(-8, 8)
    write_layout(tmp_path / "a.ply", splats, "3dgs")
    splat_transform(tmp_path / "a.ply", tmp_path / "theirs.glb")
    write_layout(tmp_path / "ours.glb", splats, "gltf")
    theirs, ours = (read_splat_file(tmp_path / f"{name}.glb").gaussians for name in ("theirs", "ours"))
    np.testing.assert_array_equal(theirs.means, ours.means)
    np.testing.assert_array_equal(theirs.shN, ours.shN)
    assert np.abs(np.abs((unit_quats(theirs.quats) * unit_quats(ours.quats)).sum(axis=1)) - 1).max() < 1e-6
    near(theirs, splats)


def info(path: Path) -> dict[str, object]:
    found: dict[str, object] = json.loads(splat_transform(path, "--info", "json", "null"))
    return found


@pytest.mark.parametrize(
    ("name", "layout"), [("a.ply", "3dgs"), ("a.ply", "2dgs"), ("a.compressed.ply", "compressed"), ("a.sog", "sog")]
)
def test_the_tag_of_disks_reaches_splat_transform_and_what_it_writes(tmp_path: Path, name: str, layout: str) -> None:
    path = tmp_path / name
    write_layout(path, a_scene(60, 1), layout)
    assert info(path)["model"] == "2dgs"
    for other in ("c.ply", "c.sog"):
        splat_transform(path, tmp_path / other)
        assert info(tmp_path / other)["model"] == "2dgs"
        found = read_splat_file(tmp_path / other)
        assert found.surfels is not None
        assert len(found.surfels) == 60
    assert "scale_2" not in splat_header(tmp_path / "c.ply")


def splat_header(path: Path) -> str:
    return path.read_bytes().partition(b"end_header")[0].decode()


def test_sog_is_exchanged_with_splat_transform(tmp_path: Path) -> None:
    splats = a_scene(900, 3)
    write_layout(tmp_path / "a.ply", splats, "3dgs")
    splat_transform(tmp_path / "a.ply", tmp_path / "theirs.sog")
    splat_transform(tmp_path / "theirs.sog", tmp_path / "theirs.ply")
    bits = {"means": 2e-4, "scales": 0.1, "quats": 2.0}
    ours, theirs = (read_splat_file(tmp_path / f"theirs.{end}").gaussians for end in ("sog", "ply"))
    # Its writer gives one base colour in fifty of random splats its lowest code; its reader reads that as ours does.
    near(ours, splats, **bits, sh0=10.0, shN=1.0)
    for name in ("means", "log_scales", "sh0", "shN"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-6, err_msg=name)
    assert turned_by(ours.quats, theirs.quats).max() < 0.05
    write_layout(tmp_path / "ours.sog", splats, "sog")
    splat_transform(tmp_path / "ours.sog", tmp_path / "back.ply")
    back = read_splat_file(tmp_path / "back.ply").gaussians
    near(back, splats, **bits, sh0=0.1, shN=0.03)
    ours = read_splat_file(tmp_path / "ours.sog").gaussians
    np.testing.assert_allclose(back.means, ours.means, atol=1e-6)
    np.testing.assert_allclose(back.shN, ours.shN, atol=1e-6)
    np.testing.assert_allclose(back.sh0, ours.sh0, atol=1e-6)
    assert turned_by(back.quats, ours.quats).max() < 0.05


def test_spz_4_is_exchanged_with_splat_transform(tmp_path: Path) -> None:
    pytest.importorskip("zstandard")
    splats = a_scene(300, 2)
    splats.opacity_logits.clamp_(-5, 5)  # of an opaque byte the converter makes an infinite logit
    write_layout(tmp_path / "a.ply", splats, "3dgs")
    splat_transform(tmp_path / "a.ply", tmp_path / "theirs.spz")
    theirs = read_splat_file(tmp_path / "theirs.spz")
    assert theirs.kind == "SPZ version 4"
    # It stores coordinates as they are, where the format has y up: half a turn about x.
    bits = {"means": 3e-4, "scales": 0.04, "quats": 0.3, "sh0": 0.015}
    near(mirrored(theirs.gaussians, (1, -1, -1)), splats, **bits, shN=0.1)
    write_layout(tmp_path / "ours.spz", splats, "spz4")
    splat_transform(tmp_path / "ours.spz", tmp_path / "back.ply")
    near(mirrored(read_splat_file(tmp_path / "back.ply").gaussians, (1, -1, -1)), splats, **bits, shN=0.05)


@pytest.fixture
def their_stream(tmp_path: Path) -> Path:
    """700 splats in a stream of SplatTransform, with a level of every other splat."""
    splats = a_scene(700, 1)
    write_layout(tmp_path / "a.ply", splats, "3dgs")
    write_layout(tmp_path / "half.ply", splats.rows(torch.arange(0, 700, 2)), "3dgs")
    path = tmp_path / "theirs" / "lod-meta.json"
    splat_transform(tmp_path / "a.ply", "-l", "0", tmp_path / "half.ply", "-l", "1", path)
    return path


def test_the_finest_level_of_a_splat_transform_stream_has_all_splats(their_stream: Path) -> None:
    found = read_splat_file(their_stream)
    assert (found.kind, len(found.gaussians)) == ("streamed SOG, its finest level", 700)


def test_splat_transform_reads_streams_and_writes_the_same_index(tmp_path: Path, their_stream: Path) -> None:
    path = tmp_path / "ours" / "lod-meta.json"
    write_layout(path, a_scene(900, 1), "streamed")
    ours, theirs = (json.loads(file.read_text()) for file in (path, their_stream))
    facts = info(path)
    assert (facts["model"], facts["numLods"], facts["lodCounts"]) == ("2dgs", 4, ours["counts"])
    assert len(ours["filenames"]) == 4
    for number, name in enumerate(ours["filenames"]):
        splat_transform(path.parent / name, tmp_path / "back.ply")
        back = read_splat_file(tmp_path / "back.ply").gaussians
        same = read_splat_file(path.parent / name).gaussians
        assert len(back) == ours["counts"][number]
        for what in ("means", "sh0", "shN"):
            np.testing.assert_allclose(getattr(back, what), getattr(same, what), atol=1e-6, err_msg=what)
        np.testing.assert_allclose(back.log_scales[:, :2], same.log_scales[:, :2], atol=1e-6)
    assert set(ours) == set(theirs)
    assert (ours["lodErrors"], theirs["lodErrors"]) == (True, False)  # measuring them needs a GPU there
    leaf, other = ours["tree"], theirs["tree"]
    assert set(leaf) == {"bound", "lods", "errors"} == set(other) | {"errors"}
    assert set(leaf["bound"]) == set(other["bound"])
    assert set(leaf["lods"]["0"]) == set(other["lods"]["0"])
