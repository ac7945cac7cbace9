"""Measuring in the viewer: where a ray meets the surface, the distance in words, and clicks that come and go."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from fake_viser import Control, Controls
from gs2d.core.camera import Camera
from gs2d.core.georeference import Georeference
from gs2d.core.splats import Splats
from gs2d.errors import DataError
from gs2d.pipeline.view import drawn
from gs2d.render.backends import get_backend
from gs2d.render.types import RasterSettings
from gs2d.viewer.exact import Drawn, Render, ViewerFrame
from gs2d.viewer.guard import problem_of
from gs2d.viewer.ruler import Ruler, distance_told, known_distance_command, surface_on_ray

FOV = np.radians(60.0)


def a_floor() -> Render:
    """An opaque disc of standard deviation 1 on z = 0, around (5, 0, 0)."""
    mean, turn = torch.tensor([[5.0, 0, 0]]), torch.tensor([[1.0, 0, 0, 0]])
    splats = Splats(mean, turn, torch.zeros(1, 2), torch.full((1,), 6.0), torch.zeros(1, 1, 3), torch.zeros(1, 0, 3))
    settings = RasterSettings(near=0.01, sh_degree=0)

    def render(camera: Camera, kind: str) -> Drawn:
        return drawn(splats, camera, kind, settings, get_backend("reference"), "median")

    return render


def test_a_ray_meets_the_surface_where_the_rasterizer_draws_it() -> None:
    eye, ahead = np.array([5.0, -2.0, 2.0]), np.array([5.1, -1.0, 1.0])  # meets z = 0 at (5.2, 0, 0)
    place = surface_on_ray(a_floor(), eye, ahead, FOV)
    assert place is not None
    np.testing.assert_allclose(place, [5.2, 0, 0], atol=1e-4)
    assert surface_on_ray(a_floor(), eye, eye + np.array([0, 0, 1.0]), FOV) is None  # the sky
    assert surface_on_ray(a_floor(), eye, np.array([15.0, 0, 0]), FOV) is None  # beside it


def test_a_distance_is_in_metres_where_the_size_is_known() -> None:
    a, b = np.zeros(3), np.array([0.0, 3.0, 4.0])
    assert distance_told(a, b, None) == ("5 units", "of the capture, whose size is not known")
    world = Georeference(4.0, np.eye(3), np.zeros(3), np.zeros(3), "a test", grid_scale=2.0)
    assert distance_told(a, b, world) == ("10 m", "level 6 m, height +8 m")
    assert known_distance_command("runs/my x", a, b, 1.25) == (
        "gs2d georeference 'runs/my x' --known-distance 0 0 0 0 3 4 1.25"
    )


class Page(Controls):
    """As much of a viser server as the ruler uses."""

    def __init__(self) -> None:
        super().__init__()
        self.clicked: list[Any] = []
        self.nodes: dict[str, Any] = {}

    atomic = Controls.add_folder

    def add_number(self, name: str, *, initial_value: float, **more: Any) -> Control:
        return self.controls.setdefault(name, Control(value=initial_value, **more))

    def add_markdown(self, content: str, **more: Any) -> Control:
        return self.controls.setdefault(f"text {len(self.controls)}", Control(content=content, **more))

    def on_click(self) -> Any:
        return self.clicked.append

    def remove_click_callback(self, call: Any) -> None:
        self.clicked.remove(call)

    def _node(self, name: str, *what: Any, **_: Any) -> Any:
        self.nodes[name] = what
        return SimpleNamespace(remove=lambda: self.nodes.pop(name))

    add_icosphere = add_line_segments = add_label = _node


def click(page: Page, place: tuple[float, float, float], told: list[str]) -> None:
    """One click at a place (world), from above, in a viewer whose frame is half as large."""
    eye = np.array([4.0, 0, 3.0])
    client = SimpleNamespace(camera=SimpleNamespace(fov=FOV), add_notification=lambda _, text, **__: told.append(text))
    (call,) = page.clicked
    call(SimpleNamespace(ray_origin=tuple(eye / 2), ray_direction=tuple(np.subtract(place, eye) / 2), client=client))


def test_two_clicks_are_a_distance_a_third_begins_anew_and_without_the_tick_nobody_listens() -> None:
    page, told, render = Page(), [], a_floor()
    ruler = Ruler(page, ViewerFrame(np.zeros(3), 2.0), lambda: render, "runs/x", of_run=True, world=None)
    assert page.clicked == []
    page.controls["measure"].set(True)
    text = page.controls["text 1"]
    click(page, (4.5, 0, 0), told)
    assert text.content.startswith("And now")
    click(page, (5.5, 0, 0), told)
    np.testing.assert_allclose(ruler.ends, [[4.5, 0, 0], [5.5, 0, 0]], atol=1e-4)
    assert "1 units" in text.content
    assert page.nodes["/ruler/label"] == ("1 units",)
    np.testing.assert_allclose(page.nodes["/ruler/line"][0], [[[2.25, 0, 0], [2.75, 0, 0]]], atol=1e-4)
    page.controls["truly, m"].set(2.5)
    command = next(c for name, c in page.controls.items() if name.startswith("text") and c is not text)
    assert command.content.endswith(" 2.5`")
    click(page, (40.0, 0, 0), told)  # no surface
    assert (ruler.ends, text.content) == ((), "Nothing solid there.")
    click(page, (5.0, 0, 0), told)
    assert len(ruler.ends) == 1
    page.controls["measure"].set(False)
    assert (page.clicked, page.nodes, ruler.ends, told) == ([], {}, (), [])


def test_splats_that_cannot_be_read_are_told_to_whoever_clicked() -> None:
    def broken() -> Render:
        raise DataError("a checkpoint is damaged")

    page, told = Page(), []
    Ruler(page, ViewerFrame(np.zeros(3), 2.0), broken, "x.ply", of_run=False, world=None)
    page.controls["measure"].set(True)
    click(page, (5.0, 0, 0), told)
    assert told == ["a checkpoint is damaged"]


def test_the_gate_lets_clicks_in_and_nothing_that_looks_like_one() -> None:
    msgspec = pytest.importorskip("msgspec", reason="viser is not installed (extra `view`)")
    pytest.importorskip("viser", reason="viser is not installed (extra `view`)")
    good: dict[str, Any] = {
        "type": "ScenePointerMessage", "event_type": "click", "ray_origin": [0.0, 0, 1], "ray_direction": [0.0, 0, -1],
        "screen_pos": [[0.5, 0.5]], "modifier": None,
    }  # fmt: skip

    def said(**changes: Any) -> str | None:
        return problem_of(msgspec.msgpack.encode(good | changes), lambda uuid: None)

    assert said() is None
    for changes in (
        {"event_type": "rect-select"}, {"ray_direction": [0, 0, 0]}, {"ray_origin": [0, float("nan"), 0]},
        {"ray_origin": None}, {"screen_pos": [[0, 0], [1, 1]]}, {"screen_pos": 3}, {"extra": 1},
    ):  # fmt: skip
        assert said(**changes) == "not a click", changes
