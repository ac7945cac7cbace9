"""``gs2d view``: serve the page of a run or of a file of splats on this machine."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path

from gs2d.core.splats import Splats
from gs2d.data import View
from gs2d.errors import DataError
from gs2d.io.meshes import read_mesh, read_textured
from gs2d.io.run_dir import MESH, TEXTURED, RunFolder, load_tensors
from gs2d.meshing.web_mesh import web_mesh
from gs2d.pipeline.look.page import page_content, photograph_jpeg
from gs2d.training.events import OnEvent, Step, ignore
from gs2d.training.state import TrainState
from gs2d.viewer.packed_splats import PackedSplats
from gs2d.viewer.page_server import PageServer, Response, Route, number_in
from gs2d.viewer.scene_page import PageOffer, PageScene, pack_for, served_page, splats_response

FINAL = "final"
PHOTOGRAPH_SIDE = 640  # px, longer side
_TICK = 0.2  # s between checks for Ctrl-C


def open_viewer(path: Path, port: int | None = None, on_event: OnEvent = ignore) -> tuple[PageServer, list[str]]:
    """Start a server of a run or a file of splats; the caller must ``close`` it.

    Also returns what the page shows: "cameras", "mesh", "splats".
    """
    content = page_content(path, on_event)
    stages: dict[str, Callable[[], Splats]] = {FINAL: lambda: content.splats}
    meshes: dict[str, Route] = {}
    if content.run is not None:
        ends = [checkpoint for checkpoint in content.run.checkpoints() if checkpoint.iteration is None]
        earlier = {end.stage: partial(_splats_of, end.path) for end in ends[:-1]}  # the last one is splats.ply
        stages, meshes = {**earlier, **stages}, _mesh_routes(content.run)
    has_photographs = bool(content.photographs)
    page = served_page(content.scene, PageOffer(tuple(meshes), has_photographs, stages=tuple(stages)))
    routes: dict[str, Route] = {
        "": lambda _: Response("text/html; charset=utf-8", [page]),
        "splats": _stages_route(stages, content.scene),
        "photograph": photographs_route(content.photographs, content.scene.settings.background),
        **meshes,
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

    def respond(arguments: Mapping[str, str]) -> Response:
        view = views[number_in(arguments, "view", len(views))]
        return Response("image/jpeg", [photograph_jpeg(view, background, PHOTOGRAPH_SIDE)])

    return respond


def _stages_route(stages: Mapping[str, Callable[[], Splats]], scene: PageScene) -> Route:
    lock = threading.Lock()

    @lru_cache(maxsize=1)  # one stage in memory
    def packed(stage: str) -> PackedSplats:
        return pack_for(scene, stages[stage]())

    def respond(arguments: Mapping[str, str]) -> Response:
        stage = arguments.get("stage", "")
        if stage not in stages:
            raise DataError(f"stage must be one of {', '.join(stages)}, got {stage[:40]!r}")
        with lock:
            return splats_response(packed(stage))

    return respond


def _splats_of(checkpoint: Path) -> Splats:
    return TrainState.from_state_dict(load_tensors(checkpoint)["state"]).splats


def _mesh_routes(run: RunFolder) -> dict[str, Route]:
    """Return the routes of the meshes that a run has."""

    def respond(name: str, _: Mapping[str, str]) -> Response:
        mesh = read_mesh(run.file(MESH)) if name == "mesh" else read_textured(run.file(TEXTURED))
        return Response("application/octet-stream", [web_mesh(mesh)])

    files = {"mesh": MESH, "textured": TEXTURED}
    return {name: partial(respond, name) for name, file in files.items() if run.file(file).exists()}
