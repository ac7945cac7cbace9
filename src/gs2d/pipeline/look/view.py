"""``gs2d view``: serve the page of a run or of a file of splats on this machine."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path

from gs2d.data import View
from gs2d.io.meshes import read_mesh, read_textured
from gs2d.io.run_dir import MESH, TEXTURED, RunFolder
from gs2d.meshing.web_mesh import web_mesh
from gs2d.pipeline.look.page import page_content, photograph_jpeg
from gs2d.training.events import OnEvent, Step, ignore
from gs2d.viewer.page_server import Answer, PageServer, Route, number_in
from gs2d.viewer.scene_page import PageOffer, pack_for, served_page, splats_answer

PHOTOGRAPH_SIDE = 640  # px, longer side
_TICK = 0.2  # s between checks for Ctrl-C


def open_viewer(path: Path, port: int | None = None, on_event: OnEvent = ignore) -> tuple[PageServer, list[str]]:
    """Start a server of a run or a file of splats; the caller must ``close`` it.

    Returns
    -------
    server : PageServer
    shown : list of str
        What the page shows: "cameras", "mesh", "splats".
    """
    content = page_content(path, on_event)
    meshes = {} if content.run is None else _meshes_of(content.run)
    packed = cache(lambda: pack_for(content.scene, content.splats))
    has_photographs = bool(content.photographs)
    page = served_page(content.scene, PageOffer(tuple(meshes), has_photographs))
    routes: dict[str, Route] = {
        "": lambda _: Answer("text/html; charset=utf-8", [page]),
        "splats": lambda _: splats_answer(packed()),
        "photograph": photographs_route(content.photographs, content.scene.settings.background),
        **{name: partial(_mesh_answer, block) for name, block in meshes.items()},
    }
    shown = [*(["cameras"] if has_photographs else []), *(["mesh"] if meshes else []), "splats"]
    return PageServer(port, routes), shown


def serve(server: PageServer, on_event: OnEvent = ignore) -> None:
    """Wait until Ctrl-C, or until a request fails; raise its error."""
    while server.failure is None:
        on_event(Step(0))  # raises a Ctrl-C that was swallowed elsewhere
        time.sleep(_TICK)
    raise server.failure


def photographs_route(views: Sequence[View], background: Sequence[float]) -> Route:
    """Return the route of the photographs of the views, as small JPEG files."""

    def answer(arguments: Mapping[str, str]) -> Answer:
        view = views[number_in(arguments, "view", len(views))]
        return Answer("image/jpeg", [photograph_jpeg(view, background, PHOTOGRAPH_SIDE)])

    return answer


def _meshes_of(run: RunFolder) -> dict[str, Callable[[], bytes]]:
    """Return functions that read the meshes of a run for the page."""
    readers: dict[str, Callable[[], bytes]] = {
        "mesh": lambda: web_mesh(read_mesh(run.file(MESH))),
        "textured": lambda: web_mesh(read_textured(run.file(TEXTURED))),
    }
    files = {"mesh": MESH, "textured": TEXTURED}
    return {name: read for name, read in readers.items() if run.file(files[name]).exists()}


def _mesh_answer(block: Callable[[], bytes], _: Mapping[str, str]) -> Answer:
    return Answer("application/octet-stream", [block()])
