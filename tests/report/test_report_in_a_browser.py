"""The report in a browser: it fits three widths, and its images and mesh react to mouse, finger and keys."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from browser import Page, browser, require_browser
from gs2d.core.mesh import TexturedMesh
from gs2d.io.meshes import write_mesh
from gs2d.report.report_page import write_report
from report_runs import fabricate

AT = "parseFloat(document.querySelector('.wipe .both').style.getPropertyValue('--at'))"
LARGE = "document.querySelector('dialog.large').open"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    require_browser()
    run = fabricate(tmp_path_factory.mktemp("report") / "run")
    write_report(run)
    with browser() as tab:
        tab.size(1600, 1000)
        tab.open(f"file://{run}/report.html")
        yield tab
        assert tab.errors == []


def test_the_line_between_photograph_and_rendering_follows_mouse_and_arrow_keys(page: Page) -> None:
    left, width = page.ask("(() => {const b = document.querySelector('.wipe .both').getBoundingClientRect();"
                           "return [b.x, b.width]})()")  # fmt: skip
    _, y = page.middle(".wipe .both")
    page.drag((left + 0.5 * width, y), (left + 0.2 * width, y))
    assert page.ask(AT) == pytest.approx(20, abs=1)
    page.mouse("mouseMoved", left + 0.9 * width, y, buttons=0, button="none")
    assert page.ask(AT) == pytest.approx(20, abs=1)  # only while it is held
    page.key("ArrowRight")
    page.key("ArrowRight")
    assert page.ask(AT) == pytest.approx(22, abs=1)
    both = page.ask("[...document.querySelectorAll('.wipe .both img')].slice(0, 2)"
                    ".map((i) => getComputedStyle(i).clipPath)")  # fmt: skip
    assert "78%" in both[0].replace("calc(100% - 22%)", "78%")  # the photograph ends at the line
    assert both[1] == "none"


def test_images_enlarge_to_their_full_size_and_step_by_keys(page: Page) -> None:
    page.ask("document.querySelector('details#views').open = true")
    page.click(".shots button.zoom")
    assert page.ask(LARGE)
    first = page.ask("document.querySelector('dialog p').textContent")
    assert first.startswith("Colour, after surface")
    # not the JPEG in the report: the file in the run's folder
    page.until("document.querySelector('dialog .stage img').src.endsWith('renders/surface/test__r_0.color.png')")
    page.key("ArrowRight")
    assert page.ask("document.querySelector('dialog p').textContent") != first
    page.key("Escape")
    assert not page.ask(LARGE)
    page.ask("document.querySelector('.shots button.zoom').focus()")
    page.key("Enter")
    assert page.ask(LARGE)
    page.click("dialog .close")
    assert not page.ask(LARGE)


def test_the_mesh_turns_by_mouse_and_keys_and_is_drawn(page: Page) -> None:
    page.until("document.querySelector('.mesh').dataset.drawn")
    drawn = "document.querySelector('.mesh').dataset.drawn"
    first = page.ask(drawn)
    x, y = page.middle(".mesh canvas")
    page.drag((x, y), (x + 60, y + 20))
    page.until(f"{drawn} !== '{first}'")
    turned = page.ask(drawn)
    page.ask("document.querySelector('.mesh canvas').focus()")
    page.key("ArrowLeft")
    page.until(f"{drawn} !== '{turned}'")
    page.click(".mesh .shape")
    assert page.ask("document.querySelector('.mesh .shape').getAttribute('aria-pressed')") == "true"
    page.middle(".mesh canvas")
    box = page.ask("(() => {const b = document.querySelector('.mesh canvas').getBoundingClientRect();"
                   "return [b.x, b.y, b.right, b.bottom]})()")  # fmt: skip
    left, top, right, bottom = map(int, box)
    assert page.image()[top:bottom, left:right].std() > 0.02


def test_a_textured_mesh_is_shown_with_its_texture(tmp_path: Path) -> None:
    require_browser()
    run = fabricate(tmp_path / "run", size=16)
    corners = np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
    faces, uv = np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    texture = np.zeros((16, 16, 3), np.uint8)
    texture[:8, :, 0] = texture[8:, :, 1] = 250  # red above green
    normals = np.tile(np.float32([0, -1, 0]), (4, 1))
    write_mesh(run / "mesh.glb", TexturedMesh(corners, normals, faces, uv, texture))
    write_report(run)
    with browser() as tab:
        tab.size(1000, 800)
        tab.open(f"file://{run}/report.html")
        tab.until("document.querySelector('.mesh').dataset.drawn")
        assert tab.ask("document.querySelector('.mesh figcaption').textContent").startswith(
            "Textured mesh, 2 triangles."
        )
        tab.middle(".mesh canvas")
        box = tab.ask("(() => {const b = document.querySelector('.mesh canvas').getBoundingClientRect();"
                      "return [b.x, b.y, b.right, b.bottom]})()")  # fmt: skip
        left, top, right, bottom = map(int, box)
        image = tab.image()[top:bottom, left:right]
        assert tab.errors == []
    red, green = ((image[..., k] > 0.6) & (image[..., 1 - k] < 0.3) & (image[..., 2] < 0.3) for k in (0, 1))
    assert min(red.sum(), green.sum()) > 200
    assert np.nonzero(red)[0].mean() > np.nonzero(green)[0].mean() + 10  # the upper half of the texture is at z < 0


CUT_OFF = """[...document.querySelectorAll('main *')].filter((e) => {
  const b = e.getBoundingClientRect();
  if (!b.width || !b.height || getComputedStyle(e).visibility === 'hidden') return false;
  const window = document.documentElement.clientWidth;
  return b.left < -1 || b.right > window + 1 || (e.clientWidth && e.scrollWidth > e.clientWidth + 1);
}).map((e) => e.outerHTML.slice(0, 120))"""
EMPTY = """[...document.querySelectorAll('main img, main figure, main td')].filter((e) => e.checkVisibility() &&
  (!e.getBoundingClientRect().height || (e.matches('td') && !e.textContent.trim()))
).map((e) => e.outerHTML.slice(0, 120))"""


@pytest.mark.parametrize("height", [48, 72], ids=["square", "portrait"])
def test_the_report_fits_the_window(height: int, tmp_path: Path) -> None:
    require_browser()
    write_report(fabricate(tmp_path / "run", height=height))
    with browser() as page:
        for width in (390, 820, 1400):
            page.size(width, 800, phone=width < 800)
            page.open(f"file://{tmp_path}/run/report.html")
            page.until("document.querySelector('.mesh').dataset.drawn")
            assert page.ask("document.documentElement.scrollHeight") <= 2 * 800  # at most eight for one stage unfolded
            for part in (".verdict", ".wipe .both", ".mesh canvas", ".numbers"):  # on the first screen
                bottom = page.ask(f"document.querySelector('{part}').getBoundingClientRect().bottom")
                assert bottom <= 800, (part, width)
            for opened in ("false", "true"):
                page.ask(f"document.querySelectorAll('details').forEach((d) => (d.open = {opened}))")
                assert page.ask(CUT_OFF) == [], width
                assert page.ask(EMPTY) == [], width


def test_a_phone_scrolls_the_report_vertically_and_wipes_by_touch(page: Page) -> None:
    page.size(375, 812, phone=True)
    try:
        assert page.ask("document.documentElement.scrollWidth") <= 375
        x, y = page.middle(".wipe .both")
        wide = page.ask("document.querySelector('.wipe .both').getBoundingClientRect().width")
        page.fingers(((x, y), (x + 100, y)))
        assert page.ask(AT) == pytest.approx(50 + 100 * 100 / wide, abs=2)
        small = page.ask("[...document.querySelectorAll('main button, main summary')].filter((e) => "
                         "!e.textContent.trim() && !e.getAttribute('aria-label')).length")  # fmt: skip
        assert small == 0  # everything that can be pressed has a name
    finally:
        page.size(1600, 1000)
