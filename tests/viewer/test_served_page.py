"""The served page in a browser: stages, mesh, photographs, live training; other sites get nothing."""

from __future__ import annotations

import http.server
import io
import json
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from browser import Page, browser, require_browser
from gs2d.core.camera import look_at
from gs2d.core.mesh import Mesh
from gs2d.core.sh import rgb_to_sh0
from gs2d.core.splats import Splats
from gs2d.errors import DataError
from gs2d.meshing.web_mesh import web_mesh
from gs2d.render.types import RasterSettings
from gs2d.viewer.packed_splats import pack_splats
from gs2d.viewer.page_server import PageServer, Response
from gs2d.viewer.scene_page import PageOffer, PageScene, PageView, served_page, splats_response

ORIGIN, UP = np.array([10.0, -20.0, 5.0]), np.array([0.0, 0.0, 1.0])
SETTINGS = RasterSettings(near=0.05, background=(1.0, 1.0, 1.0), sh_degree=0)
COLORS = {"red": (0.9, 0.1, 0.1), "green": (0.1, 0.9, 0.1), "blue": (0.1, 0.1, 0.9)}


def seen_from(degrees: float) -> PageView:
    angle = np.radians(degrees)
    eye = ORIGIN + np.array([4 * np.cos(angle), 4 * np.sin(angle), 0.5])
    return PageView(f"{degrees:g}.jpg", look_at(eye, ORIGIN, UP, width=240, height=160, fx=200.0))


SCENE = PageScene("a disc", [seen_from(0), seen_from(10)], SETTINGS, ORIGIN, 4.0, UP)


def disc(color: str) -> Splats:
    """A large opaque disc across x in the middle of the scene."""
    sh0 = rgb_to_sh0(torch.tensor([COLORS[color]]))
    turn = torch.tensor([[np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]])
    return Splats(torch.tensor(ORIGIN)[None], turn, torch.full((1, 2), -1.0), torch.full((1,), 6.0), sh0,
                  torch.zeros(1, 0, 3))  # fmt: skip


def square() -> bytes:
    """Return a green square across x."""
    corners = ORIGIN + np.array([[0.0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]])
    green = np.tile(np.array([26, 230, 26], np.uint8), (4, 1))
    return web_mesh(Mesh(corners.astype(np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32), green))


class Training:
    """A server whose answers change as a training goes on."""

    def __init__(self, *, is_live: bool = False) -> None:
        self.version, self.status = 0, "training begins"
        stages = () if is_live else ("red", "broken", "blue")
        page = served_page(SCENE, PageOffer(() if is_live else ("mesh",), True, stages=stages, live=is_live))
        self.server = PageServer(
            None,
            {
                "": lambda _: Response("text/html; charset=utf-8", [page]),
                "state": lambda _: Response("application/json", [json.dumps(self.state).encode()]),
                "splats": self.splats,
                "mesh": lambda _: Response("application/octet-stream", [square()]),
                "photograph": self.photograph,
            },
        )

    @property
    def state(self) -> dict[str, object]:
        return {"version": self.version, "status": self.status}

    def splats(self, arguments: Mapping[str, str]) -> Response:
        stage = arguments.get("stage") or ["", "red", "blue"][self.version]
        if stage not in COLORS:
            raise DataError(f"{stage} cannot be read")
        return splats_response(pack_splats(disc(stage), ORIGIN, 0, SETTINGS.alpha_min))

    def photograph(self, arguments: Mapping[str, str]) -> Response:
        file = io.BytesIO()
        Image.new("RGB", (8 * (1 + int(arguments["view"])), 8)).save(file, "JPEG")
        return Response("image/jpeg", [file.getvalue()])


@contextmanager
def opened(training: Training) -> Iterator[Page]:
    try:
        with browser() as tab:
            tab.size(900, 700)
            tab.open(training.server.url)
            yield tab
    finally:
        training.server.close()


def middle(tab: Page) -> str:
    """The colour near the middle of the window (beside handles of the box), once it is drawn in full."""
    tab.until("document.body.dataset.drawn === 'still'")
    image = tab.image()
    color = image[image.shape[0] // 2 + 25, image.shape[1] // 2 + 40]
    return min([*COLORS, "white"], key=lambda name: float(np.abs(color - COLORS.get(name, (1.0, 1, 1))).sum()))


@pytest.fixture(autouse=True)
def _browser() -> None:
    require_browser()


def test_stages_the_mesh_and_photographs_are_requested_when_they_are_chosen() -> None:
    with opened(Training()) as tab:
        tab.until("facts.splats === 1")
        assert middle(tab) == "blue"  # the last stage
        choose = "(name) => { $('stage').value = name; $('stage').onchange(); }"
        tab.ask(f"({choose})('broken')")
        tab.until("$('status').textContent === 'broken cannot be read'")
        assert middle(tab) == "blue"
        tab.errors.clear()  # the browser's line about status 400
        tab.ask(f"({choose})('red')")
        tab.until("$('status').hidden")
        assert middle(tab) == "red"
        tab.click("[data-show=mesh]")
        tab.until("meshes.mesh")
        assert middle(tab) == "green"
        tab.ask("goTo(1)")
        tab.until("$('photograph').querySelector('img').naturalWidth === 16")
        assert tab.errors == []


def test_a_live_page_shows_new_splats_can_be_paused_and_reports_a_lost_server() -> None:
    training = Training(is_live=True)
    with opened(training) as tab:
        tab.until("$('status').textContent === 'training begins'")
        assert middle(tab) == "white"
        training.version, training.status = 1, "training 10/30"
        tab.until("version === 1 && facts.splats === 1")
        assert tab.ask("$('status').textContent") == "training 10/30"
        assert middle(tab) == "red"
        tab.click("#live")
        training.version, training.status = 2, "training 20/30"
        tab.until("$('status').textContent === 'training 20/30'")
        assert middle(tab) == "red"
        tab.click("#live")
        tab.until("version === 2")
        assert middle(tab) == "blue"
        assert tab.errors == []
        training.server.close()
        tab.until("$('status').textContent.startsWith('gs2d does not answer')")


def test_without_the_token_there_is_nothing() -> None:
    training = Training()
    with opened(training) as tab:
        tab.open(training.server.url.partition("?")[0])
        assert "open the address that gs2d printed" in tab.ask("document.body.innerText")
        assert not tab.ask("document.querySelector('canvas')")


def test_another_site_gets_nothing_even_with_the_token(tmp_path: Path) -> None:
    training = Training()
    address = training.server.url.replace("/?", "/state?")
    attack = f"""<script>fetch("{address}").then(() => (document.title = "read"), () => (document.title = "refused"));
        </script><iframe src="{training.server.url}"></iframe>"""
    (tmp_path / "index.html").write_text(attack, encoding="utf-8")

    class Silent(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *args: object) -> None:
            super().__init__(*args, directory=str(tmp_path))  # type: ignore[arg-type]

        def log_message(self, *_: object) -> None: ...

    site = http.server.ThreadingHTTPServer(("localhost", 0), Silent)
    threading.Thread(target=site.serve_forever, daemon=True).start()
    try:
        with opened(training) as tab:
            tab.open(f"http://localhost:{site.server_port}/")
            tab.until("document.title")
            assert tab.ask("document.title") == "refused"
            assert tab.ask("frames.length") == 1
            assert any("frame-ancestors" in error for error in tab.errors)
    finally:
        site.shutdown()
        site.server_close()
