"""A box that clips the preview of the splats, moved by sliders, and the commands that cut mesh and splats to it."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gs2d.viewer.exact import ViewerFrame
from gs2d.viewer.splats import Preview

AXES = "xyz"
STEPS = 400  # of a slider, over what it spans
ROOM = 2.0  # times as far as the box at first reaches from its middle, which sliders span
_COLOR = (214, 39, 40)


class ClipBox:
    """Sliders for a box in the capture's frame, its edges in the scene, and the commands with its numbers.

    Parameters
    ----------
    server : viser.ViserServer
    frame : ViewerFrame
    box : ndarray [2, 3] world units
        At first.
    source : str
        What the commands cut: the run folder or the file.
    of_run : bool
        Whether ``source`` is a run, which can be meshed.
    on_change : callable
        Called when the splats to show have changed.
    """

    def __init__(
        self,
        server: Any,
        frame: ViewerFrame,
        box: np.ndarray,
        source: str,
        on_change: Callable[[], None],
        *,
        of_run: bool,
    ) -> None:
        self._server, self._frame, self._source, self._of_run = server, frame, source, of_run
        self._on_change = on_change
        middle, half = box.mean(axis=0), np.maximum((box[1] - box[0]) / 2, 1e-6 * frame.unit)
        gui = server.gui
        with gui.add_folder("clip box", expand_by_default=False):
            self._on = gui.add_checkbox("clip the preview", initial_value=False)
            self._sliders = [
                gui.add_multi_slider(
                    axis,
                    min=float(middle[k] - ROOM * half[k]),
                    max=float(middle[k] + ROOM * half[k]),
                    step=float(2 * ROOM * half[k] / STEPS),
                    initial_value=(float(box[0, k]), float(box[1, k])),
                )
                for k, axis in enumerate(AXES)
            ]
            self._text = gui.add_markdown("")
        self._edges: Any = None
        self._update(told=False)
        for control in (self._on, *self._sliders):
            control.on_update(lambda _: self._update())

    @property
    def box(self) -> np.ndarray:
        """Corners [2, 3] world units."""
        return np.array([sorted(slider.value) for slider in self._sliders], np.float64).T

    @property
    def commands(self) -> list[str]:
        """Command lines that cut the mesh and the splats to the box."""
        return clip_commands(self._source, self.box, of_run=self._of_run)

    def clipped(self, splats: Preview) -> Preview:
        """Return the splats whose centres are in the box, while it clips."""
        if not self._on.value:
            return splats
        low, high = self.box
        at = splats.centers.astype(np.float64) * splats.scale
        kept = ((at >= low) & (at <= high)).all(axis=1)
        return replace(
            splats,
            centers=splats.centers[kept],
            covariances=splats.covariances[kept],
            colors=splats.colors[kept],
            opacities=splats.opacities[kept],
        )

    def _update(self, *, told: bool = True) -> None:
        shown = bool(self._on.value)
        self._text.content = "\n\n".join(f"`{line}`" for line in self.commands)
        if self._edges is not None:
            self._edges.remove()
            self._edges = None
        if shown:
            self._edges = self._server.scene.add_line_segments(
                "/clip", self._segments(), _COLOR, thickness=2.0, thickness_units="screen"
            )
        if told:
            self._on_change()

    def _segments(self) -> np.ndarray:
        """Return the twelve edges [12, 2, 3] in the viewer's frame."""
        low, high = self.box
        corners = np.array([np.where(bits, high, low) for bits in itertools.product((0, 1), repeat=3)])
        pairs = [(i, i | 1 << k) for i in range(8) for k in range(3) if not i >> k & 1]
        return np.array(
            [[self._frame.inside(corners[a]), self._frame.inside(corners[b])] for a, b in pairs], np.float32
        )


def clip_commands(source: str, box: Sequence[Sequence[float]] | np.ndarray, *, of_run: bool) -> list[str]:
    """Return the command lines that cut the mesh of a run, and splats, to a box [2, 3]."""
    numbers = " ".join(f"{value:.5g}" for value in np.asarray(box, np.float64).ravel())
    name = shlex.quote(source)
    mesh = [f"gs2d mesh {name} --bbox {numbers}"] if of_run else []
    return [*mesh, f"gs2d export {name} --bbox {numbers} --out clipped.ply"]
