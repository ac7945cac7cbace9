"""Our files in other people's viewers, from npm in a headless browser: they show what we render."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from browser import require_browser
from gs2d.contrib.formats.sog import read_level
from npm import forget
from splat_scenes import a_ball
from viewers import VIEWERS, Camera, ViewerError, drawn_by, file_of, installed, psnr, served, written

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("native")]
CAMERA = Camera((0.6, -0.8, -3.0), (0.0, 0.0, 0.0))
REFUSED = {("spark", "spz4"), ("kellogg", "spz")}  # read by their documentation; these versions do not
BLANK = {("kellogg", "compressed")}  # of so few splats; of the guide's bottle it shows all
CASES = [(name, layout) for name, viewer in VIEWERS.items() for layout in viewer.frames]


@pytest.fixture(scope="module", autouse=True)
def _nothing_is_left() -> Iterator[None]:
    yield
    forget()


@pytest.mark.parametrize(("name", "layout"), [case for case in CASES if case not in REFUSED | BLANK])
def test_a_viewer_shows_our_file_as_we_render_it(name: str, layout: str, tmp_path: Path) -> None:
    require_browser()
    installed(VIEWERS[name], tmp_path)
    splats = a_ball()
    written(splats, [layout], tmp_path)
    with served(tmp_path) as address:
        shot = drawn_by(VIEWERS[name], layout, CAMERA, tmp_path, address)
    assert psnr(shot, CAMERA.drawn(splats)) > (30.0 if (name, layout) == ("babylon", "gltf") else 28.0)


@pytest.mark.parametrize(("name", "layout"), sorted(REFUSED))
def test_what_the_guide_says_a_viewer_does_not_open_is_still_so(name: str, layout: str, tmp_path: Path) -> None:
    """Where this fails, the guide's table has good news to tell."""
    require_browser()
    installed(VIEWERS[name], tmp_path)
    written(a_ball(), [layout], tmp_path)
    with served(tmp_path) as address, pytest.raises(ViewerError):
        drawn_by(VIEWERS[name], layout, CAMERA, tmp_path, address)


@pytest.mark.parametrize(("name", "layout"), sorted(BLANK))
def test_what_the_guide_says_a_viewer_shows_nothing_of_is_still_so(name: str, layout: str, tmp_path: Path) -> None:
    require_browser()
    installed(VIEWERS[name], tmp_path)
    written(a_ball(), [layout], tmp_path)
    with served(tmp_path) as address:
        assert drawn_by(VIEWERS[name], layout, CAMERA, tmp_path, address).min() > 0.99


def test_playcanvas_shows_each_level_of_our_stream_as_we_render_it(tmp_path: Path) -> None:
    require_browser()
    installed(VIEWERS["playcanvas"], tmp_path)
    written(a_ball(), ["streamed"], tmp_path)
    stream = tmp_path / file_of("streamed")
    levels = range(json.loads(stream.read_text())["lodLevels"])
    own = [CAMERA.drawn(read_level(stream, level).to_surfels(stream)) for level in levels]
    with served(tmp_path) as address:
        shots = [
            drawn_by(VIEWERS["playcanvas"], "streamed", CAMERA, tmp_path, address, level=level) for level in levels
        ]
    scores = [[psnr(shot, other) for other in own] for shot in shots]
    assert min(scores[level][level] for level in levels) > 28.0
    # Levels are shown, and not all of them alike: neighbours may look alike (here by 31 to 35 dB), the ends may not.
    assert scores[0][0] > scores[0][-1] + 5.0
    assert scores[-1][-1] > scores[-1][0] + 5.0
