"""The clip box of the viewer: what it leaves of a preview, and the commands that it names."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from fake_viser import Control, Controls
from gs2d.viewer.clip import ClipBox, clip_commands
from gs2d.viewer.exact import ViewerFrame
from gs2d.viewer.splats import Preview


class Page(Controls):
    """As much of a viser server as the clip box uses."""

    def __init__(self) -> None:
        super().__init__()
        self.edges: list[np.ndarray] = []

    def add_multi_slider(self, name: str, *, initial_value: tuple[float, float], **limits: float) -> Control:
        return self.controls.setdefault(name, Control(value=initial_value, **limits))

    def add_markdown(self, content: str) -> Control:
        return self.controls.setdefault("text", Control(content=content))

    def add_line_segments(self, _name: str, points: np.ndarray, _color: Any, **_: Any) -> Any:
        self.edges.append(points)
        return SimpleNamespace(remove=self.edges.clear)


def test_the_box_clips_the_preview_while_it_is_on_and_names_the_commands() -> None:
    page, changes = Page(), []
    frame = ViewerFrame(np.array([10.0, 0, 0]), 2.0)
    box = np.array([[9.0, -1, -1], [11.0, 1, 1]])
    clip = ClipBox(page, frame, box, "runs/my x", lambda: changes.append(1), of_run=True)
    centers = np.array([[10.0, 0, 0], [10.9, 0.9, 0], [12, 0, 0]], np.float32)
    splats = Preview(0.5, centers / 0.5, np.zeros((3, 3, 3), np.float32), centers, np.ones((3, 1), np.float32))
    assert clip.clipped(splats) is splats
    assert page.edges == []
    page.controls["clip the preview"].set(True)
    assert len(changes) == 1
    np.testing.assert_array_equal(clip.clipped(splats).centers, splats.centers[:2])
    assert page.edges[0].shape == (12, 2, 3)
    np.testing.assert_allclose(page.edges[0].reshape(-1, 3).min(axis=0), [-0.5, -0.5, -0.5])  # in the viewer's frame
    page.controls["x"].set((9.5, 10.5))
    np.testing.assert_array_equal(clip.clipped(splats).centers, splats.centers[:1])
    assert clip.commands[0] == "gs2d mesh 'runs/my x' --bbox 9.5 -1 -1 10.5 1 1"
    assert clip.commands[1] in page.controls["text"].content
    page.controls["clip the preview"].set(False)
    assert page.edges == []


def test_a_file_of_splats_has_no_mesh_to_cut() -> None:
    box = [[0, 0, 0], [1, 2, 3.00001]]
    assert clip_commands("a.ply", box, of_run=False) == ["gs2d export a.ply --bbox 0 0 0 1 2 3 --out clipped.ply"]
