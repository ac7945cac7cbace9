"""The viewer in a real browser: whoever has its address sees and measures the scene, and nobody else gets any of it."""

from __future__ import annotations

import http.server
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

from browser import Page, browser, require_browser
from gs2d.core.sh import rgb_to_sh0
from gs2d.core.splats import Splats
from gs2d.io.splat_ply import write_splats
from gs2d.pipeline.options import ViewOptions
from gs2d.pipeline.view import open_viewer
from gs2d.viewer.server import Viewer

SIDE = 5  # discs a side of the floor


@pytest.fixture(scope="module")
def viewer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    """A red floor on z = 0, from -1 to 1, looked at from aside."""
    require_browser()
    pytest.importorskip("viser", reason="viser is not installed (extra `view`)")
    at = torch.linspace(-1, 1, SIDE)
    means = torch.cartesian_prod(at, at, torch.zeros(1))
    n = len(means)
    splats = Splats(means, torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.full((n, 2), -1.0), torch.full((n,), 5.0),
                    rgb_to_sh0(torch.tensor([[0.8, 0.1, 0.1]])).repeat(n, 1, 1), torch.zeros(n, 0, 3))  # fmt: skip
    path = tmp_path_factory.mktemp("viewer") / "floor.ply"
    write_splats(path, splats)
    served = open_viewer(path, ViewOptions(host="127.0.0.1", port=None))
    yield served
    served.close()


@pytest.fixture(scope="module")
def tab(viewer: Viewer) -> Iterator[Page]:
    with browser() as page:
        page.size(900, 700)
        yield page


def press(tab: Page, x: float, y: float) -> None:
    """Move the mouse to a place and click."""
    tab.mouse("mouseMoved", x, y, buttons=0)
    tab.mouse("mousePressed", x, y)
    tab.mouse("mouseReleased", x, y)


def test_the_printed_address_shows_the_scene_and_two_clicks_measure_it(viewer: Viewer, tab: Page) -> None:
    tab.open(viewer.url)
    tab.until("document.querySelector('canvas')")
    label = "[...document.querySelectorAll('label')].find((e) => e.textContent === 'measure')"
    tab.until(label)
    tab.ask(f"document.getElementById({label}.htmlFor).click()")  # its folder is closed: nobody has to open it
    assert viewer.ruler is not None
    listens = "(e) => getComputedStyle(e).cursor === 'pointer'"
    tab.until(f"[...document.querySelectorAll('canvas')].some({listens})")
    places = ((380.0, 350.0), (480.0, 370.0))
    for count, (x, y) in enumerate(places, 1):
        press(tab, x, y)
        tab.until(f"document.body.textContent.includes('{('other end', 'units')[count - 1]}')")
    start, end = viewer.ruler.ends
    np.testing.assert_allclose([start[2], end[2]], 0, atol=1e-3)  # on the floor
    assert np.abs([start[:2], end[:2]]).max() < 1.5
    assert f"{np.linalg.norm(end - start):.4g} units" in tab.ask("document.body.textContent")


def test_without_the_token_there_is_nothing(viewer: Viewer) -> None:
    with browser() as stranger:
        stranger.open(viewer.url.partition("?")[0])
        assert "open the address that gs2d printed" in stranger.ask("document.body.innerText")
        assert not stranger.ask("document.querySelector('canvas')")


@contextmanager
def another_site(folder: Path, page: str) -> Iterator[str]:
    """A page of another origin on this machine."""
    (folder / "index.html").write_text(page, encoding="utf-8")

    class Silent(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *args: object) -> None:
            super().__init__(*args, directory=str(folder))  # type: ignore[arg-type]

        def log_message(self, *_: object) -> None: ...

    server = http.server.ThreadingHTTPServer(("localhost", 0), Silent)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://localhost:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()


def test_a_page_of_another_site_gets_no_scene_even_in_the_browser_that_has_it(
    viewer: Viewer, tab: Page, tmp_path: Path
) -> None:
    import viser

    tab.open(viewer.url)  # the cookie is there
    tab.until("document.querySelector('canvas')")
    before, address = viewer.watchers, viewer.url.partition("/?")[0].replace("http", "ws", 1)
    attack = f"""<script>
        const socket = new WebSocket("{address}/", "viser-v{viser.__version__}");
        socket.onopen = () => document.title = "open";
        socket.onmessage = () => document.title = "told";
        socket.onerror = socket.onclose = () => {{ if (!document.title) document.title = "refused"; }};
        </script><iframe src="{viewer.url.partition("?")[0]}"></iframe>"""
    with another_site(tmp_path, attack) as site:
        tab.open(site)
        tab.until("document.title")
        assert tab.ask("document.title") == "refused"
        assert viewer.watchers < before or before == 0  # our own page was left, and nobody came
