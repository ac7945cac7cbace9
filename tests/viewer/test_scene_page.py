"""The data and the parts of the page that shows splats."""

from __future__ import annotations

import base64
import gzip
import json
import re
import shutil
import struct
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch

from gs2d.core.camera import Camera, look_at
from gs2d.core.splats import Splats
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings
from gs2d.viewer.packed_splats import PackedSplats, pack_splats, sh_texels
from gs2d.viewer.scene_page import (
    SHADERS,
    PageOffer,
    PageScene,
    PageView,
    pack_for,
    served_page,
    splats_response,
    write_page,
)

ORIGIN = np.array([1000.0, -2000.0, 500.0])  # far away: float32 keeps a tenth of a millimetre there
CAMERA = look_at(ORIGIN + np.array([0.3, -4.0, 0.8]), ORIGIN, np.array([0.0, 0.0, 1.0]), width=120, height=80, fx=100.0)
SETTINGS = RasterSettings(near=0.2, background=(0.2, 0.5, 0.9))
node = pytest.mark.skipif(shutil.which("node") is None, reason="there is no node on this machine")


def some_splats(count: int = 400, seed: int = 0) -> Splats:
    """A cloud around ORIGIN with every degree of colour; some splats reach behind the camera."""
    torch.manual_seed(seed)
    means = torch.randn(count, 3, dtype=torch.float64) * 0.9
    means[:5] = torch.tensor([0.3, -3.6, 0.8]) + 0.1 * torch.randn(5, 3)  # close to the camera: they cross its plane
    log_scales = torch.randn(count, 2) * 0.5 - 2.0
    log_scales[:5] = 0.0
    return Splats(
        means + torch.from_numpy(ORIGIN),
        torch.randn(count, 4).double(),
        log_scales.double(),
        (torch.randn(count) * 2).double(),
        (torch.randn(count, 1, 3) * 0.7).double(),
        (torch.randn(count, 15, 3) * 0.2).double(),
    )


def unpacked(data: bytes, count: int, degree: int, scales: list[float]) -> Splats:
    """Decode the splats of a page as documented; positions are relative to the origin."""
    words, rest = data[: 32 * count], np.frombuffer(data[32 * count :], np.int8).reshape(count, -1)
    means, log_scales, quats, light = [], [], [], []
    for i in range(count):
        *mean, a, b, w, x, y, z, red, green, blue, opacity = struct.unpack_from("<3f2e4h4e", words, 32 * i)
        means.append(mean)
        log_scales.append([a, b])
        quats.append([w / 32767, x / 32767, y / 32767, z / 32767])
        light.append([red, green, blue, opacity])
    colors = torch.tensor(light, dtype=torch.float64)
    places = (degree + 1) ** 2 - 1
    shN = torch.from_numpy(rest[:, : 3 * places] / 127.0).reshape(count, places, 3)
    return Splats(
        torch.tensor(means, dtype=torch.float64),
        torch.tensor(quats, dtype=torch.float64),
        torch.tensor(log_scales, dtype=torch.float64),
        torch.logit(colors[:, 3].clamp(max=1 - 1e-9)),
        colors[:, None, :3],
        shN * torch.tensor(scales[:places], dtype=torch.float64)[:, None],
    )


def data_of(packed: PackedSplats) -> bytes:
    """Return the bytes of packed splats."""
    return b"".join(packed.data)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(((a - b) ** 2).mean()))


def at_origin(camera: Camera) -> Camera:
    T = camera.T_cam_world.copy()
    T[:3, 3] += camera.rotation @ ORIGIN
    return replace(camera, T_cam_world=T)


@pytest.mark.parametrize(("degree", "least"), [(3, 50.0), (1, 50.0), (0, 50.0)])
def test_stored_splats_render_like_the_originals(degree: int, least: float) -> None:
    splats, settings = some_splats(), replace(SETTINGS, sh_degree=degree)
    packed = pack_splats(splats, ORIGIN, degree, settings.alpha_min)
    assert (packed.degree, packed.metadata["texels"]) == (degree, sh_texels(degree))
    stored = unpacked(data_of(packed), packed.count, degree, packed.scales)
    with torch.no_grad():
        before = rasterize(splats, CAMERA, settings, backend="reference")
        after = rasterize(stored, at_origin(CAMERA), settings, backend="reference")
    assert psnr(before.color.numpy(), after.color.numpy()) > least
    assert float((before.normal - after.normal).abs().mean()) < 1e-3


class Scripts(HTMLParser):
    """The scripts of a page by their ids, and everything that it would load."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: dict[str, str] = {}
        self.loads: list[str] = []
        self.title = self._id = ""
        self._in_title = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = dict(attrs)
        self.loads += [value for name, value in attrs if name in ("src", "href", "data", "action") and value]
        self._id = str(attributes.get("id", "main")) if tag == "script" else ""
        self._in_title = tag == "title"

    def handle_data(self, data: str) -> None:
        if self._id:
            self.texts[self._id] = self.texts.get(self._id, "") + data
        if self._in_title:
            self.title += data

    def handle_endtag(self, tag: str) -> None:
        self._id, self._in_title = "", False


SCENE = PageScene(
    title="a <b> & {{facts}} {{splats}}",
    views=[PageView("</script>.png", CAMERA), PageView("2.png", CAMERA)],
    settings=SETTINGS,
    focus=ORIGIN,
    unit=4.0,
    up=np.array([0, 0, 1.0]),
)


MESH, PHOTOGRAPHS = b"a mesh", [b"a photograph", b"another one"]


def page_of(path: Path) -> Scripts:
    write_page(path, some_splats(), SCENE, meshes={"mesh": MESH}, photographs=PHOTOGRAPHS)
    page = Scripts()
    page.feed(path.read_text())
    return page


def test_the_page_is_one_file_with_all_data_and_loads_nothing(tmp_path: Path) -> None:
    path = tmp_path / "scene.html"
    page = page_of(path)
    text = path.read_text()
    assert page.loads == []
    assert page.title == SCENE.title
    assert not re.search(r"https?://", text)
    assert "default-src 'none'" in text
    assert "connect-src" not in text
    assert set(page.texts) == {"facts", *SHADERS, "sorter", "mesh", "photographs", "splats", "main"}
    facts = json.loads(page.texts["facts"])
    assert facts["origin"] == ORIGIN.tolist()
    assert [camera["name"] for camera in facts["cameras"]] == ["</script>.png", "2.png"]
    assert np.allclose(facts["cameras"][0]["t"], at_origin(CAMERA).T_cam_world[:3, 3])
    packed = pack_for(SCENE, some_splats())
    assert gzip.decompress(base64.b64decode(page.texts["splats"])) == data_of(packed)
    assert (facts["splats"], facts["texels"], facts["background"]) == (packed.count, 3, [0.2, 0.5, 0.9])
    assert facts["offer"] == {"meshes": ["mesh"], "photographs": True, "served": False, "stages": [], "live": False}
    assert gzip.decompress(base64.b64decode(page.texts["mesh"])) == MESH
    assert [base64.b64decode(line) for line in page.texts["photographs"].split()] == PHOTOGRAPHS
    for shader in SHADERS:
        for line in re.findall(r"uniform \w+ ([\w, ]+)", page.texts[shader]):
            for name in line.replace(" ", "").split(","):
                assert name in page.texts["main"], f"{shader}: the uniform {name} is not set"
    again = tmp_path / "again.html"
    page_of(again)
    assert again.read_bytes() == path.read_bytes()


def test_the_most_important_splats_come_first() -> None:
    splats = some_splats()
    packed = pack_splats(splats, ORIGIN, 0, SETTINGS.alpha_min)
    stored = unpacked(data_of(packed), packed.count, 0, packed.scales)
    importance = stored.opacity_logits.sigmoid().log() + stored.log_scales.sum(dim=1)
    assert (importance.diff() < 0.02).all()


def served() -> Scripts:
    """A page as a server offers it."""
    page = Scripts()
    page.feed(served_page(SCENE, PageOffer(("mesh", "textured"), True, stages=("surface", "final"))).decode())
    return page


def test_a_served_page_has_no_data_and_connects_to_its_own_server_only(tmp_path: Path) -> None:
    page, alone = served(), page_of(tmp_path / "scene.html")
    assert page.loads == ["data:,"]
    assert set(page.texts) == set(alone.texts) - {"mesh", "photographs", "splats"}
    packed = pack_for(SCENE, some_splats())
    answer = splats_response(packed)
    assert b"".join(answer.parts) == data_of(packed)
    facts = {**json.loads(page.texts["facts"]), **json.loads(answer.headers["X-Splats"]), "offer": None}
    assert facts == {**json.loads(alone.texts["facts"]), "offer": None}
    text = served_page(SCENE, PageOffer()).decode()
    assert "default-src 'none'" in text
    assert "connect-src 'self'; img-src 'self' data:" in text
    assert not re.search(r"https?://", text)


@node
def test_the_scripts_are_javascript_and_the_sorter_sorts_exactly(tmp_path: Path) -> None:
    page = page_of(tmp_path / "scene.html")
    (tmp_path / "page.js").write_text(page.texts["main"])
    subprocess.run(["node", "--check", str(tmp_path / "page.js")], check=True)
    rng = np.random.default_rng(0)
    means = rng.normal(size=(500, 3)).astype(np.float32)
    means[100:200] = means[:100]  # equal depths: later rows are drawn first, because rule 2 has them behind
    plane = np.array([0.6, 0.0, 0.8, 1.5], np.float32)
    values = json.dumps({"means": means.flatten().tolist(), "plane": plane.astype(float).tolist()})
    (tmp_path / "sorter.js").write_text(
        page.texts["sorter"].replace('"use strict";', "")
        + f";const values = {values}; globalThis.postMessage = (m) => console.log(JSON.stringify([...m.order]));"
        "onmessage({data: {means: Float32Array.from(values.means)}});"
        "for (const limit of [500, 150]) onmessage({data: {plane: values.plane, near: 0.2, limit}});"
    )
    done = subprocess.run(["node", str(tmp_path / "sorter.js")], capture_output=True, text=True, check=True)
    depth = (means.astype(float) @ plane[:3].astype(float) + float(plane[3])).astype(np.float32)
    for limit, line in zip((500, 150), done.stdout.splitlines(), strict=True):
        front = np.flatnonzero(depth[:limit] > 0.2)
        assert json.loads(line) == front[np.argsort(depth[front], kind="stable")][::-1].tolist()
