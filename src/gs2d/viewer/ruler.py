"""Measuring in the viewer: two clicks on the surface, their distance, the command that gives a run its true size."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from typing import Any

import numpy as np

from gs2d.core.camera import look_at
from gs2d.core.georeference import Georeference
from gs2d.errors import Gs2dError
from gs2d.viewer.exact import Render, ViewerFrame

WINDOW = 1080  # px, of the height of a usual one: how large the pixel is that is looked at
_COLOR = (255, 210, 63)
_HELP = "Click one end of a distance on the surface, then the other."


def surface_on_ray(render: Render, eye: np.ndarray, ahead: np.ndarray, fov: float) -> np.ndarray | None:
    """Return the place [3] world units where a ray meets the surface, None where it meets nothing opaque.

    Parameters
    ----------
    render : callable
        Draws splats as they are measured.
    eye, ahead : ndarray [3] world units
        Where the ray begins, and a place on it.
    fov : float, rad
        The vertical angle of the picture that was clicked, of which one pixel is drawn.
    """
    ray = (ahead - eye) / np.linalg.norm(ahead - eye)
    up = np.eye(3)[np.abs(ray).argmin()]
    camera = look_at(eye, ahead, up, width=1, height=1, fx=WINDOW / 2 / np.tan(fov / 2))
    depth = float(render(camera, "depth").depth[0, 0])
    return eye + depth * ray if np.isfinite(depth) else None


def distance_told(start: np.ndarray, end: np.ndarray, world: Georeference | None) -> tuple[str, str]:
    """Return the distance between two places [3] of a run, in metres where ``world`` is known, and more about it."""
    way = end - start
    if world is None:
        return f"{np.linalg.norm(way):.4g} units", "of the capture, whose size is not known"
    way = world.ground_way(way)
    return f"{np.linalg.norm(way):.4g} m", f"level {np.hypot(*way[:2]):.4g} m, height {way[2]:+.4g} m"


def known_distance_command(source: str, start: np.ndarray, end: np.ndarray, metres: float) -> str:
    """Return the command that tells a run how far apart two of its places [3] truly are."""
    numbers = " ".join(f"{value:.6g}" for value in (*start, *end, metres))
    return f"gs2d georeference {shlex.quote(source)} --known-distance {numbers}"


class Ruler:
    """A box to tick, two clicks, and the distance.

    Parameters
    ----------
    server : viser.ViserServer
    frame : ViewerFrame
    render : callable
        Returns what draws the splats that are shown.
    source : str
        The run folder or the file that is measured.
    of_run : bool
        Whether ``source`` is a run, which can be given its size.
    world : Georeference or None
        Where it is in the world; None: distances are in units of the capture.
    """

    def __init__(
        self,
        server: Any,
        frame: ViewerFrame,
        render: Callable[[], Render],
        source: str,
        *,
        of_run: bool,
        world: Georeference | None,
    ) -> None:
        self._server, self._frame, self._render = server, frame, render
        self._source, self._of_run, self._world = source, of_run, world
        self._ends: list[np.ndarray] = []
        self._drawn: list[Any] = []
        gui = server.gui
        with gui.add_folder("measure", expand_by_default=False):
            self._on = gui.add_checkbox("measure", initial_value=False)
            self._text = gui.add_markdown(_HELP)
            self._truly = gui.add_number("truly, m", initial_value=1.0, min=0.0, visible=False)
            self._command = gui.add_markdown("", visible=False)
        self._on.on_update(lambda _: self._switch())
        self._truly.on_update(lambda _: self._tell())

    @property
    def ends(self) -> tuple[np.ndarray, ...]:
        """The places [3] world units that were clicked: none, one or two."""
        return tuple(self._ends)

    def _switch(self) -> None:
        """Take clicks while the box is ticked, and only then: they would be anybody's otherwise."""
        if self._on.value:
            self._server.scene.on_click()(self._clicked)
        else:
            self._server.scene.remove_click_callback(self._clicked)
        self._ends.clear()
        self._show()

    def _clicked(self, event: Any) -> None:
        eye, way = np.asarray(event.ray_origin, np.float64), np.asarray(event.ray_direction, np.float64)
        try:
            place = surface_on_ray(
                self._render(), self._frame.outside(eye), self._frame.outside(eye + way), event.client.camera.fov
            )
        except Gs2dError as error:
            event.client.add_notification("This cannot be measured", str(error), color="red")
            return
        if len(self._ends) == 2:
            self._ends.clear()
        if place is None:
            self._show()
            self._text.content = "Nothing solid there."
            return
        self._ends.append(place)
        self._show()

    def _show(self) -> None:
        """Draw ends, line and figure, and say them."""
        with self._server.atomic():
            for node in self._drawn:
                node.remove()
            inside = [self._frame.inside(end) for end in self._ends]
            self._drawn = [
                self._server.scene.add_icosphere(f"/ruler/{i}", radius=0.006, color=_COLOR, position=place)
                for i, place in enumerate(inside)
            ]
            if len(self._ends) == 2:
                start, end = self._ends
                line = self._server.scene.add_line_segments(
                    "/ruler/line", np.array([inside], np.float32), _COLOR, thickness=3.0, thickness_units="screen"
                )
                told, _ = distance_told(start, end, self._world)
                label = self._server.scene.add_label("/ruler/label", told, position=(inside[0] + inside[1]) / 2)
                self._drawn += [line, label]
            self._tell()

    def _tell(self) -> None:
        whole = len(self._ends) == 2
        self._truly.visible = self._command.visible = whole and self._of_run
        if not whole:
            self._text.content = "And now the other end." if self._ends else _HELP
            return
        start, end = self._ends
        self._text.content = "**{}**, {}".format(*distance_told(start, end, self._world))
        command = known_distance_command(self._source, start, end, self._truly.value)
        self._command.content = f"If it is truly so many metres:\n\n`{command}`"
