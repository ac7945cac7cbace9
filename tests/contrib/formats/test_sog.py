"""SOG, against a decoder written here after the format's page, one splat after the other."""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from gs2d.contrib.formats.sog import read_sog, write_sog
from gs2d.errors import DataError
from gs2d.io.formats.splat_formats import is_splat_file, read_splat_file
from gs2d.io.gaussians import FLAT_LOG_SCALE, Gaussians, sigmoid
from gs2d.pipeline.look.info import describe_file
from splat_scenes import a_scene, turned_by


def members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def packed(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def webp(array: np.ndarray) -> bytes:
    data = io.BytesIO()
    Image.fromarray(array.astype(np.uint8)).save(data, "WEBP", lossless=True, exact=True, method=0)
    return data.getvalue()


def decoded(path: Path) -> dict[str, np.ndarray]:
    """By the page of the format."""
    files = members(path)
    meta = json.loads(files["meta.json"])
    assert meta["version"] == 2
    pictures = {}
    for name, data in files.items():
        if name.endswith(".webp"):
            with Image.open(io.BytesIO(data)) as file:
                assert file.format == "WEBP"
                pictures[name] = np.asarray(file.convert("RGBA")).astype(int)
    width = pictures["quats.webp"].shape[1]
    rows: dict[str, list[Any]] = {"mean": [], "scale": [], "quat": [], "color": [], "opacity": [], "shN": []}
    for i in range(meta["count"]):
        x, y = i % width, i // width
        mean = []
        for a in range(3):
            q = (pictures["means_u.webp"][y, x, a] << 8 | pictures["means_l.webp"][y, x, a]) / 65535
            n = meta["means"]["mins"][a] + (meta["means"]["maxs"][a] - meta["means"]["mins"][a]) * q
            mean.append(math.copysign(math.exp(abs(n)) - 1, n))
        rows["mean"].append(mean)
        rows["scale"].append([meta["scales"]["codebook"][k] for k in pictures["scales.webp"][y, x, :3]])
        a, b, c, mode = pictures["quats.webp"][y, x]
        smaller = [(v / 255 - 0.5) * 2 / math.sqrt(2) for v in (a, b, c)]
        smaller.insert(mode - 252, math.sqrt(max(0.0, 1 - sum(v * v for v in smaller))))
        rows["quat"].append(smaller)
        rows["color"].append([meta["sh0"]["codebook"][k] for k in pictures["sh0.webp"][y, x, :3]])
        rows["opacity"].append(pictures["sh0.webp"][y, x, 3] / 255)
        if "shN" in meta:
            places = (0, 3, 8, 15)[meta["shN"]["bands"]]
            label = pictures["shN_labels.webp"][y, x, 0] + 256 * pictures["shN_labels.webp"][y, x, 1]
            assert label < meta["shN"]["count"]
            u, v = (label % 64) * places, label // 64
            center = pictures["shN_centroids.webp"][v, u : u + places, :3]
            rows["shN"].append(np.array(meta["shN"]["codebook"])[center])
    return {name: np.array(values) for name, values in rows.items()}


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_sog_has_the_documented_values(tmp_path: Path, degree: int) -> None:
    splats = a_scene(300, degree)
    g = Gaussians.of(splats)
    write_sog(tmp_path / "a.sog", g)
    d = decoded(tmp_path / "a.sog")
    match = cKDTree(g.means).query(d["mean"])[1]
    same = g.rows(match)
    assert len(set(match)) == 300
    assert np.abs(d["mean"] - same.means).max() < 2e-4  # e^1.4 of 2.8 / 65535
    assert np.abs(d["scale"] - same.log_scales).max() < 0.06
    np.testing.assert_allclose(d["scale"][:, 2], FLAT_LOG_SCALE, rtol=1e-6)
    assert turned_by(d["quat"], same.quats).max() < 0.9
    assert np.abs(d["color"] - same.sh0).max() < 0.06
    assert np.abs(d["opacity"] - sigmoid(same.opacity_logits)).max() <= 0.5001 / 255
    if degree:
        assert np.abs(d["shN"] - same.shN).max() < 0.02  # fewer than 1024 splats: each has its row of the palette
    back, kind = read_sog(tmp_path / "a.sog")
    assert kind == "SOG"
    np.testing.assert_allclose(back.means, d["mean"], atol=1e-6)
    np.testing.assert_allclose(back.shN, d["shN"].reshape(back.shN.shape), atol=1e-6)
    assert back.is_flat
    first = (tmp_path / "a.sog").read_bytes()
    write_sog(tmp_path / "b.sog", g)
    assert (tmp_path / "b.sog").read_bytes() == first


def test_a_folder_and_the_finest_level_of_a_stream_are_read(tmp_path: Path) -> None:
    fine, coarse, around = (Gaussians.of(a_scene(n, 1, seed=n)) for n in (40, 10, 7))
    for name, g in (("0_0", fine), ("1_0", coarse), ("env", around)):
        write_sog(tmp_path / "a.sog", g)
        with zipfile.ZipFile(tmp_path / "a.sog") as archive:
            archive.extractall(tmp_path / "scene" / name)
    folder = tmp_path / "scene" / "0_0" / "meta.json"
    assert is_splat_file(folder)
    g, kind = read_sog(folder)
    assert (len(g), kind) == (40, "SOG, unpacked")
    assert describe_file(folder)["splats"] == 40
    part = {"0": {"file": 0, "offset": 5, "count": 30}, "1": {"file": 1, "offset": 0, "count": 10}}
    only_coarse = {"1": {"file": 1, "offset": 0, "count": 4}}
    index = {
        "version": 1, "lodLevels": 2, "count": 44, "counts": [30, 14],
        "filenames": ["0_0/meta.json", "1_0/meta.json"], "environment": "env/meta.json",
        "tree": {"bound": {}, "children": [{"lods": part}, {"children": [{"lods": only_coarse}]}]},
    }  # fmt: skip
    path = tmp_path / "scene" / "lod-meta.json"
    path.write_text(json.dumps(index))
    file = read_splat_file(path)
    assert file.kind == "streamed SOG, its finest level"
    assert len(file.gaussians) == 30 + 4 + 7
    np.testing.assert_array_equal(file.gaussians.means[:30], g.means[5:35])
    for change, words in (
        ({"filenames": ["../../etc/passwd", "x"]}, "expected files in its own folder"),
        ({"filenames": ["none/meta.json", "1_0/meta.json"]}, "cannot read .*none"),
        ({"tree": {"lods": {"0": {"file": 0, "offset": 0, "count": 41}}}}, "splats 0 to 41 in a chunk of 40"),
        ({"tree": {"children": [{"lods": part}, {"lods": {"0": {"file": 0, "offset": 5, "count": 1}}}]}}, "level once"),
        ({"tree": {}, "environment": None}, "no chunk of the finest level"),
        ({"tree": 5}, "is invalid"),
    ):
        path.write_text(json.dumps(index | change))
        with pytest.raises(DataError, match=words) as caught:
            read_splat_file(path)
        assert "\n" not in str(caught.value)


def meta_with(**changes: Any) -> Callable[[dict[str, bytes]], object]:
    def change(files: dict[str, bytes]) -> None:
        files["meta.json"] = json.dumps(json.loads(files["meta.json"]) | changes).encode()

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (meta_with(version=3), "expected SOG of version 1 or 2, got 3"),
        (meta_with(count=10**9), "expected 1000000000 pixels in means_l.webp"),
        (meta_with(count=-1), "expected a number of splats"),
        (meta_with(scales={"codebook": [0.0] * 255, "files": ["scales.webp"]}), "expected 256 numbers, got 255"),
        (meta_with(quats={"files": ["sh0.webp"]}), "rotations with a fourth byte of 252 or more"),
        (
            meta_with(sh0={"codebook": [math.nan] * 256, "files": ["sh0.webp"]}),
            r"300 splats have NaN or infinity \(sh0\)",
        ),
        (meta_with(means={"mins": [0] * 3, "maxs": [500] * 3, "files": ["means_l.webp", "means_u.webp"]}), "infinity"),
        (lambda f: f.pop("quats.webp"), "'quats.webp' is missing"),
        (lambda f: f.update({"quats.webp": b"RIFF"}), "cannot decode the image 'quats.webp'"),
        (lambda f: f.update({"meta.json": b"[" * 100_000}), "its JSON is invalid"),
        (lambda f: f.update({"shN_labels.webp": webp(np.full((20, 20, 3), 255))}), "labels below"),
        (lambda f: f.update({"shN_centroids.webp": webp(np.zeros((8, 8, 3)))}), "192 columns of centroids"),
        (lambda f: f.update({"sh0.webp": webp(np.zeros((9000, 9000, 3)))}), r"an image \(9000x9000\) would take"),
    ],
)
def test_an_invalid_sog_is_a_one_line_error(
    tmp_path: Path, change: Callable[[dict[str, bytes]], object], words: str
) -> None:
    write_sog(tmp_path / "a.sog", Gaussians.of(a_scene(300, 1)))
    files = members(tmp_path / "a.sog")
    change(files)
    with pytest.raises(DataError, match=words) as caught:
        read_splat_file(packed(tmp_path / "b.sog", files))
    assert "\n" not in str(caught.value)
