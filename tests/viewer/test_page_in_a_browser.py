"""The page in a browser: opening view, limits of the camera, crop, meshes, photographs, touch and keys."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from browser import Page, browser, require_browser
from gs2d.core.camera import look_at
from gs2d.core.mesh import Mesh, TexturedMesh
from gs2d.core.splats import Splats
from gs2d.data.subject_box import Subject
from gs2d.io.splat_ply import write_splats
from gs2d.meshing.web_mesh import web_mesh
from gs2d.pipeline.look.page import page_run
from gs2d.render.api import rasterize
from gs2d.render.types import RasterSettings
from gs2d.viewer.scene_page import PageScene, PageView, write_page

ORIGIN = np.array([100.0, -200.0, 50.0])
UP = np.array([0.0, 0.0, 1.0])
SETTINGS = RasterSettings(near=0.05, background=(0.2, 0.5, 0.9), sh_degree=0)
WIDTH, HEIGHT = 240, 160


def seen_from(degrees: float, *, height: float = 1.0, away: float = 4.0) -> PageView:
    angle = np.radians(degrees)
    eye = ORIGIN + np.array([away * np.cos(angle), away * np.sin(angle), height])
    camera = look_at(eye, ORIGIN, UP, width=WIDTH, height=HEIGHT, fx=200.0)
    return PageView(f"{degrees:g}.jpg", camera)


ONE_SIDE = [seen_from(degrees) for degrees in (-40, -20, 0, 20, 40)]
SUBJECT = Subject("object", ORIGIN - 0.6, ORIGIN + 0.6, ORIGIN, UP, "a test")


def two_balls() -> Splats:
    """A red splat at y = +0.3 and a green one at y = -0.3."""
    means = torch.from_numpy(ORIGIN + np.array([[0.0, 0.3, 0.0], [0.0, -0.3, 0.0]]))
    quats = torch.tensor([[np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]] * 2)  # faces x
    colors = (torch.tensor([[[0.9, 0.1, 0.1]], [[0.1, 0.9, 0.1]]]).double() - 0.5) / 0.28209479177387814
    return Splats(means, quats, torch.full((2, 2), -2.0).double(), torch.full((2,), 3.0).double(), colors,
                  torch.zeros(2, 0, 3).double())  # fmt: skip


def square(*, textured: bool) -> Mesh | TexturedMesh:
    """Return a square across x, red with vertex colours or green with a texture."""
    corners = (ORIGIN + 0.5 * np.array([[0.0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]])).astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    if not textured:
        return Mesh(corners, faces, np.tile(np.array([230, 26, 26], np.uint8), (4, 1)))
    uv = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    texture = np.tile(np.array([26, 230, 26], np.uint8), (8, 8, 1))
    return TexturedMesh(corners, np.tile(np.float32([1, 0, 0]), (4, 1)), faces, uv, texture)


def write(path: Path, views: list[PageView] = ONE_SIDE) -> Path:
    scene = PageScene("two balls", views, SETTINGS, ORIGIN, 4.0, UP, SUBJECT)
    meshes = {"mesh": web_mesh(square(textured=False)), "textured": web_mesh(square(textured=True))}
    photographs = []
    for k in range(len(views)):
        file = io.BytesIO()
        Image.new("RGB", (8 * (1 + k), 8)).save(file, "JPEG")
        photographs.append(file.getvalue())
    write_page(path, two_balls(), scene, meshes=meshes, photographs=photographs)
    return path


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    require_browser()
    path = write(tmp_path_factory.mktemp("page") / "scene.html")
    with browser() as tab:
        tab.size(640, 420)
        tab.open(f"file://{path}")
        still(tab)
        yield tab
        assert tab.errors == []


@pytest.fixture(autouse=True)
def as_at_first(request: pytest.FixtureRequest) -> None:
    """Each test begins at the opening view, whatever the one before left behind."""
    if "page" in request.fixturenames:
        tab = request.getfixturevalue("page")
        tab.size(640, 420)
        tab.ask("$('help').close(); limited = true; $('free').checked = false; document.body.classList.remove('bare');"
                "toggleTools(true); resetCrop(); editCrop(false); setCrop(true); setMeasuring(false); setKind(0);"
                "show('splats');"
                "press('showcameras', false); goHome(); document.activeElement.blur()")  # fmt: skip
        still(tab)


def still(page: Page) -> None:
    """Wait until the full image is drawn."""
    page.until("document.body.dataset.drawn === 'still'")


def values(page: Page, *names: str) -> list[Any]:
    return list(json.loads(page.ask(f"JSON.stringify([{', '.join(names)}])")))


# -- in a browser ------------------------------------------------------------------------------------------------------
def test_it_opens_at_a_photograph_with_the_subject_in_the_middle_and_crop_on(page: Page) -> None:
    page.key("h")
    eye, target, ahead = (np.array(value) for value in values(page, "camera.eye", "target", "camera.ahead"))
    np.testing.assert_allclose(eye, ONE_SIDE[2].camera.center - ORIGIN, atol=1e-6)
    np.testing.assert_allclose(target, 0, atol=1e-9)
    np.testing.assert_allclose(ahead, -eye / np.linalg.norm(eye), atol=1e-6)
    still(page)
    image = page.image()
    assert np.abs(image[210, 320 - 4 : 320 + 4] - [0.2, 0.5, 0.9]).max() > 0.02  # the balls, not the background alone
    # all of the subject's ball fits into the window: 2 asin(radius / away) of the view, 10 % to spare
    needed = 2.2 * 200 * np.tan(np.arcsin(SUBJECT.radius / np.linalg.norm(eye)))
    assert values(page, "crop.on", "isCropped()", "shows", "isPressed('showcameras')") == [True, True, "splats", False]
    assert values(page, "camera.h")[0] == pytest.approx(min(needed, HEIGHT))


def test_dragging_turns_about_the_subject_and_stops_at_the_end_of_the_arc(page: Page) -> None:
    page.key("h")
    page.drag((320, 160), (360, 160))
    eye, target = (np.array(value) for value in values(page, "camera.eye", "target"))
    np.testing.assert_allclose(target, 0, atol=1e-9)
    assert np.linalg.norm(eye) == pytest.approx(np.hypot(4, 1))
    assert np.degrees(np.arctan2(eye[1], eye[0])) == pytest.approx(-np.degrees(40 * 0.006), abs=1)
    for _ in range(6):
        page.drag((100, 160), (400, 160), steps=3)
    eye = np.array(values(page, "camera.eye")[0])
    assert -53 < np.degrees(np.arctan2(eye[1], eye[0])) < -10  # 40 degrees and 12 of margin
    for start, end in ((40, 300), (300, 40)):  # towards the zenith, and towards the floor
        for _ in range(4):
            page.drag((320, start), (320, end), steps=8)
        rise = np.degrees(np.arcsin(values(page, "camera.eye")[0][2] / np.hypot(4, 1)))
        assert 14 - 12 - 0.1 < rise < 14 + 20 + 0.1
        assert abs(rise - 14) > 5  # it turned
    assert values(page, "$('note').hidden") == [True]
    page.ask("$('free').click()")
    page.drag((100, 160), (400, 160), steps=4)  # 103 degrees on
    still(page)
    assert values(page, "$('note').hidden") == [False]
    page.ask("$('free').click()")
    page.key("h")
    still(page)
    assert values(page, "$('note').hidden") == [True]


def coloured(image: np.ndarray, channel: int) -> int:
    """Return the number of red (0) or green (1) pixels."""
    return int(((image[..., channel] > 0.6) & (image[..., 1 - channel] < 0.4) & (image[..., 2] < 0.4)).sum())


def drawn(page: Page) -> np.ndarray:
    still(page)
    page.ask("document.body.classList.add('bare')")
    image = page.image()
    page.ask("document.body.classList.remove('bare')")
    return image


def test_the_crop_box_hides_splats_and_its_numbers_are_an_option(page: Page) -> None:
    page.click("#editcrop")
    assert page.ask("$('bbox').value") == "--bbox 99.400 -200.600 49.400 100.600 -199.400 50.600"
    page.ask("$('croppanel').querySelector('[data-side=high][data-axis=\"1\"]').focus()")
    page.ask("document.activeElement.select()")
    page.send("Input.insertText", text="-200")
    assert page.ask("$('bbox').value") == "--bbox 99.400 -200.600 49.400 100.600 -200.000 50.600"
    page.ask("document.activeElement.blur()")
    page.key("b")  # the box remains, its panel and lines are closed
    image = drawn(page)
    assert coloured(image, 0) == 0
    assert coloured(image, 1) > 50
    page.key("x")
    assert coloured(drawn(page), 0) > 50
    page.key("b")
    still(page)  # the handles are placed with the next image
    handle = page.middle("circle[data-side=high][data-axis='2']")
    page.drag(handle, (handle[0], handle[1] + 30))
    high = float(page.ask("$('bbox').value").split()[-1])
    assert 50.0 < high < 50.55  # the top is lower
    page.click("#resetcrop")
    assert page.ask("cropText()") == "99.400 -200.600 49.400 100.600 -199.400 50.600"


def test_the_view_of_a_photograph_shows_everything_and_other_views_no_spikes(page: Page) -> None:
    page.ask("setFace('high', 1, 0)")  # without the red ball
    page.ask("goTo(2)")
    assert coloured(drawn(page), 0) > 50
    page.ask("orbit(0.01, 0)")
    assert coloured(drawn(page), 0) == 0
    page.ask("resetCrop()")
    assert coloured(drawn(page), 0) > 50
    page.ask("limited = false; zoom(0.1)")  # the balls are larger than the window
    assert coloured(drawn(page), 0) + coloured(drawn(page), 1) == 0
    page.key("x")
    assert coloured(drawn(page), 0) + coloured(drawn(page), 1) > 50


def test_mesh_and_textured_mesh_are_shown_in_place_of_the_splats(page: Page) -> None:
    assert page.ask("[...$('shows').children].map((b) => b.textContent).join()") == "Splats,Mesh,Textured mesh"
    for name, channel in (("mesh", 0), ("textured", 1)):
        page.click(f"[data-show={name}]")
        page.until(f"meshes.{name}")
        image = drawn(page)
        assert coloured(image, channel) > 5000
        assert coloured(image, 1 - channel) == 0
    page.ask("setFace('high', 0, -0.1)")  # the square is in front of the box
    assert coloured(drawn(page), 1) == 0
    page.click("[data-show=splats]")


def test_a_click_on_a_camera_goes_there_and_shows_its_photograph_until_the_view_moves(page: Page) -> None:
    page.ask("goTo(0); zoom(1.5)")
    page.click("#showcameras")
    still(page)
    assert page.ask("[...$('cameras').children].every((path) => path.getAttribute('d').length > 50)")
    page.click("#cameras path:nth-child(2)")
    assert page.ask("shown") == 1
    page.until("$('photograph').querySelector('img').naturalWidth === 8 * 2 && !$('photograph').hidden")
    page.key("d")
    page.until("$('photograph').hidden")


def test_the_controls_fit_in_one_row_of_a_tablet_or_laptop(page: Page) -> None:
    page.ask("toggleTools(false)")
    for width in (820, 960, 1160, 1400):
        page.size(width, 420)
        assert page.ask("$('bar').offsetHeight") < 2 * 32, width


def test_a_phone_has_every_button_in_sight_turns_and_pinches(page: Page) -> None:
    page.size(375, 667, phone=True)
    try:
        page.ask("toggleTools(false)")
        page.click("#tools")
        shown = page.ask(
            "[...document.querySelectorAll('#bar button')].filter((b) => b.checkVisibility())"
            ".map((b) => b.getBoundingClientRect())"
            ".every((r) => r.left >= 0 && r.right <= innerWidth && r.bottom <= innerHeight && r.height >= 40)"
        )
        assert shown
        assert page.ask("[...document.querySelectorAll('button')].every((b) => b.textContent.trim() || b.ariaLabel)")
        page.fingers(((180, 300), (220, 300)))
        assert abs(values(page, "camera.eye")[0][1]) > 0.3
        away = np.linalg.norm(values(page, "camera.eye")[0])
        page.fingers(((170, 300), (120, 300)), ((200, 300), (250, 300)))
        assert np.linalg.norm(np.subtract(*values(page, "camera.eye", "target"))) < 0.7 * away
    finally:
        page.size(640, 420)
        page.key("h")


def test_keys_open_help_show_normals_and_depth_and_step_through_photographs(page: Page) -> None:
    page.key("?")
    assert page.ask("$('help').open")
    page.key("n")  # not behind the help
    page.key("Escape")
    assert values(page, "$('help').open", "kind") == [False, 0]
    page.key("z")
    assert values(page, "kind", "$('kind').value") == [2, "2"]
    page.key("c")
    page.key("ArrowRight")
    assert page.ask("$('view').textContent") == "20.jpg"
    page.key("h")
    page.key("t")
    page.until("Math.abs(camera.eye[1]) > 0.05")  # it turns by itself
    page.key("t")
    still(page)


def test_motion_draws_only_the_most_important_splats_and_rest_draws_all(page: Page) -> None:
    assert values(page, "MOVING_SPLATS", "count") == [500_000, 2]
    page.ask("window.adaptation = adapt; adapt = () => (movingLimit = 1); movingLimit = 1")
    page.key("t")
    page.until("count === 1 && drawn === wanted")
    page.key("t")
    still(page)
    assert values(page, "count") == [2]
    page.ask("adapt = adaptation; scale = 1")
    slow = "window.now = performance.now(); performance.now = () => (window.now += 70); adapt(performance.now());"
    page.ask(slow * 8 + "delete performance.now")  # frames of 70 ms
    assert values(page, "scale", "movingLimit") == [0.4, 50_000]
    page.ask("[scale, movingLimit] = [1, MOVING_SPLATS]")


def set_mip_filter(page: Page, sigma: float) -> None:
    facts = replace(SETTINGS, mip_px=sigma)
    page.ask(f"Object.assign(facts, {{mip: {sigma}, lowpass: {facts.clamp_px}}}); gl.useProgram(splatProgram.program);"
             "for (const name of ['mip', 'lowpass']) gl.uniform1f(splatProgram.at[name], facts[name])")  # fmt: skip


@pytest.mark.parametrize("mip_px", [0.0, 5.0])
def test_the_view_of_a_photograph_matches_the_rasterizer(page: Page, mip_px: float) -> None:
    set_mip_filter(page, mip_px)
    page.drag((320, 160), (380, 170))
    page.size(WIDTH, HEIGHT)
    try:
        page.ask("document.body.classList.add('bare'); goTo(3)")
        still(page)
        page.until("drawn === wanted")
        settings = replace(SETTINGS, mip_px=mip_px)
        with torch.no_grad():
            ours = rasterize(two_balls(), ONE_SIDE[3].camera, settings, backend="reference").color.numpy()
        error = ((page.image() - np.clip(ours, 0, 1)) ** 2).mean()
        assert -10 * np.log10(error) > 48
    finally:
        set_mip_filter(page, 0.0)
        page.ask("document.body.classList.remove('bare')")
        page.size(640, 420)


@pytest.mark.parametrize("mip_px", [0.0, 3.0])
def test_two_clicks_measure_a_distance_on_the_surface(page: Page, mip_px: float) -> None:
    set_mip_filter(page, mip_px)
    page.key("m")
    place = "JSON.stringify([[0, 0.3, 0], [0, -0.3, 0]].map(onScreen).map((p) => [p.x, p.y]))"
    red, green = json.loads(page.ask(place))
    eye = values(page, "camera.eye")[0]
    for x, y in (red, green):
        page.mouse("mousePressed", x, y)
        page.mouse("mouseReleased", x, y)
    assert values(page, "camera.eye")[0] == eye
    np.testing.assert_allclose(values(page, "ruler.ends")[0], [[0, 0.3, 0], [0, -0.3, 0]], atol=2e-3)
    assert page.ask("$('distance').textContent") == "0.6 units"
    assert page.ask("$('ruler').querySelector('text').textContent") == "0.6 units"
    page.ask("$('metres').value = 1.25; $('metres').oninput()")
    words = page.ask("$('scalecommand').value").split()
    assert words[:4] == ["gs2d", "survey", "RUN", "--known-distance"]
    np.testing.assert_allclose([float(word) for word in words[4:]], [100, -199.7, 50, 100, -200.3, 50, 1.25], atol=3e-3)
    page.key("Escape")
    assert values(page, "ruler.on", "$('measurepanel').hidden") == [False, True]
    set_mip_filter(page, 0.0)


def test_splats_without_cameras_open_with_nearly_all_of_them_in_the_window(tmp_path: Path) -> None:
    require_browser()
    rng = np.random.default_rng(0)
    means = (ORIGIN + rng.normal(0, (3.0, 0.5, 0.5), (2000, 3))).astype(np.float32)  # longer than wide
    rows = torch.from_numpy(means), torch.zeros(2000, 4), torch.zeros(2000, 2), torch.zeros(2000)
    splats = Splats(*rows, torch.zeros(2000, 1, 3), torch.zeros(2000, 0, 3))
    write_splats(tmp_path / "cloud.ply", splats)
    page_run(tmp_path / "cloud.ply")
    with browser() as tab:
        tab.size(640, 420)
        tab.open(f"file://{tmp_path / 'cloud.html'}")
        still(tab)
        origin = np.array(values(tab, "facts.origin")[0])
        within = f"{(means - origin).tolist()}.filter(isWithin).length"
        tab.ask("window.isWithin = (point) => isInImage(camera, point) && "
                "point.every((x, k) => x > facts.crop.low[k] && x < facts.crop.high[k])")  # fmt: skip
        assert 0.97 * 2000 < values(tab, within)[0] <= 2000
        before = np.array(values(tab, "camera.eye")[0])
        tab.drag((100, 160), (400, 160), steps=3)  # 103 degrees: no photograph limits the directions
        assert before @ np.array(values(tab, "camera.eye")[0]) < 0.5 * before @ before
        still(tab)
        assert values(tab, "$('note').hidden") == [True]
        assert tab.errors == []
