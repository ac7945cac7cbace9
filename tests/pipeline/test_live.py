"""A training that is watched: the same bytes, whole copies, pictures between iterations, and no wait for anybody."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ball_runs import comparable, options
from cli_runs import TINY, one_line
from gs2d.cli import run
from gs2d.core.splats import Splats
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline import live as module
from gs2d.pipeline.events import Event, Notice, Phase, Step, ignore
from gs2d.pipeline.job import Job, prepare_job
from gs2d.pipeline.live import Live
from gs2d.pipeline.train import train
from gs2d.training.events import Progress, StageEntering
from gs2d.training.state import TrainState
from gs2d.viewer.exact import Drawn
from gs2d.viewer.server import ViewerStage


def wait_for(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_a_watched_training_has_the_bytes_of_an_unwatched_one(
    undisturbed: RunFolder, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Refreshed all the time, paused, and asked for exact pictures from places of its own."""
    pytest.importorskip("viser", reason="viser is not installed (extra `view`)")
    from viser_client import Client

    monkeypatch.setattr(module, "MIN_SECONDS", 0.0)
    monkeypatch.setattr(module, "MAX_FRACTION", 1e9)
    seen: list[Client] = []
    wrong: list[BaseException] = []
    done = threading.Event()

    def look(url: str) -> None:
        try:
            client = Client(url)
            seen.append(client)
            client.wait(lambda: client.counts["GaussianSplatsMessage"] >= 3)  # empty ones, and two refreshes
            client.choose("pause training", True)
            for kind in ("exact", "normals", "depth"):
                before = client.counts["BackgroundImageMessage"]
                client.choose("splats", kind)
                client.look_from((0.5, -3.0, float(len(kind))))
                client.wait(lambda before=before: client.counts["BackgroundImageMessage"] >= before + 2)  # type: ignore[misc]
            client.choose("pause training", False)
        except BaseException as error:
            wrong.append(error)
        finally:
            done.set()

    def on_event(event: Event) -> None:
        if isinstance(event, Notice) and event.text.startswith("watch it at http://127.0.0.1:"):
            threading.Thread(target=look, args=[event.text.rpartition(" ")[2]], daemon=True).start()
        if isinstance(event, Step) and event.detail and not done.is_set():
            time.sleep(0.2)

    watched = train(options(capture, tmp_path / "run", viewer=True), on_event)
    assert done.wait(60)
    assert wrong == []
    assert comparable(watched) == comparable(undisturbed)
    assert seen[0].counts["CameraFrustumMessage"] == 6
    seen[0].close()


class FakeViewer:
    """What a training uses of the viewer."""

    failure: Exception | None = None

    def __init__(self) -> None:
        self.watchers = 1
        self.texts: list[str] = []
        self.stages: list[ViewerStage] = []
        self.switches: dict[str, Callable[[bool], None]] = {}
        self.broken: Exception | None = None
        self.closed = False

    def add_status(self, text: str) -> Callable[[str], None]:
        self.texts.append(text)
        return self.texts.append

    def add_stages(self, stages: dict[str, ViewerStage]) -> None:
        self.stages += stages.values()

    def add_switch(self, label: str, on_change: Callable[[bool], None]) -> None:
        self.switches[label] = on_change

    def replace_stage(self, _name: str, stage: ViewerStage) -> None:
        if self.broken is not None:
            raise self.broken
        self.stages.append(stage)

    def flush(self) -> None: ...

    def close(self) -> None:
        self.closed = True


@pytest.fixture(scope="module")
def job(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Job:
    return prepare_job(options(capture, tmp_path_factory.mktemp("runs") / "run"), ignore)


@pytest.fixture
def splats(undisturbed: RunFolder) -> Splats:
    from gs2d.io.splat_ply import read_splats

    return read_splats(undisturbed.file("splats.ply"))


def progress(iteration: int = 10) -> Progress:
    return Progress("surface", 0, iteration, 30, {}, 0.1, 5, 0.5, 0.1, {}, 0)


def state_of(splats: Splats) -> TrainState:
    return TrainState(splats, torch.Generator())


def test_what_is_shown_is_a_copy_taken_at_an_event(job: Job, splats: Splats) -> None:
    viewer = FakeViewer()
    live = Live(viewer, job, ignore)  # type: ignore[arg-type]
    before = splats.means.clone()
    live.on_training_event(StageEntering("surface", 0, len(splats)), state_of(splats))  # no stretch of iterations yet
    live.on_training_event(progress(), state_of(splats))
    splats.means += 100.0  # training goes on at once
    wait_for(lambda: len(viewer.stages) == 2)
    shown = viewer.stages[1].preview()
    np.testing.assert_allclose(shown.centers * shown.scale, before.numpy(), rtol=1e-5, atol=1e-5)
    live.close("end")
    assert viewer.closed


def test_nothing_is_copied_while_nobody_looks_or_too_soon(job: Job, splats: Splats) -> None:
    viewer = FakeViewer()
    live = Live(viewer, job, ignore)  # type: ignore[arg-type]
    viewer.watchers = 0
    live.on_training_event(progress(), state_of(splats))
    time.sleep(0.05)
    assert len(viewer.stages) == 1  # the empty one
    viewer.watchers = 1
    live.on_training_event(progress(), state_of(splats))
    wait_for(lambda: len(viewer.stages) == 2)
    live.on_training_event(progress(20), state_of(splats))
    time.sleep(0.05)
    assert len(viewer.stages) == 2
    live.close("end")


def test_refreshes_take_a_small_share_of_the_time(job: Job, splats: Splats, monkeypatch: pytest.MonkeyPatch) -> None:
    def work(*_: Any) -> None:
        end = time.thread_time() + 0.1
        while time.thread_time() < end:
            pass

    monkeypatch.setattr(module, "preview", work)
    monkeypatch.setattr(module, "MAX_FRACTION", 0.01)
    viewer = FakeViewer()
    live = Live(viewer, job, ignore)  # type: ignore[arg-type]
    live.on_training_event(progress(), state_of(splats))
    wait_for(lambda: live._refresh_at < float("inf"))
    assert live._refresh_at - time.perf_counter() == pytest.approx(10.0, abs=3.0)  # 0.1 s is a hundredth of that
    live.close("end")


def test_exact_pictures_are_drawn_by_the_training_thread_in_its_turn(job: Job, splats: Splats) -> None:
    viewer = FakeViewer()
    live = Live(viewer, job, ignore)  # type: ignore[arg-type]
    live.on_training_event(progress(), state_of(splats))
    wait_for(lambda: len(viewer.stages) == 2)
    got: list[Drawn] = []
    camera = job.scene.train[0].camera
    thread = threading.Thread(target=lambda: got.append(viewer.stages[1].render()(camera, "exact")))
    thread.start()
    wait_for(lambda: live.waiting)
    assert got == []
    live.turn()
    thread.join()
    assert not live.waiting
    assert got[0].image.shape == (camera.height, camera.width, 3)
    live.close("end")


def test_a_picture_that_cannot_be_drawn_stops_its_thread_only_and_the_end_keeps_nobody_waiting(
    job: Job, splats: Splats, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> Drawn:
        raise ValueError("no picture")

    monkeypatch.setattr(module, "drawn", fail)
    viewer = FakeViewer()
    live = Live(viewer, job, ignore)  # type: ignore[arg-type]
    live.on_training_event(progress(), state_of(splats))
    wait_for(lambda: len(viewer.stages) == 2)
    errors: list[Exception] = []

    def ask() -> None:
        try:
            viewer.stages[1].render()(job.scene.train[0].camera, "exact")
        except Exception as error:
            errors.append(error)

    for expected in ("no picture", "training has ended"):
        thread = threading.Thread(target=ask)
        thread.start()
        wait_for(lambda: live.waiting)
        live.turn() if expected == "no picture" else live.close("end")
        thread.join(timeout=10)
        assert str(errors[-1]) == expected
    ask()
    assert str(errors[-1]) == "training has ended"


def test_a_viewer_that_fails_is_told_once_and_training_goes_on(job: Job, splats: Splats) -> None:
    viewer, heard = FakeViewer(), []
    viewer.broken = OSError("no socket")
    live = Live(viewer, job, heard.append)  # type: ignore[arg-type]
    live.on_training_event(progress(), state_of(splats))
    wait_for(lambda: live._failure is not None)
    for _ in range(2):
        live.on_event(Phase("scoring", 3))
    told = [event.text for event in heard if isinstance(event, Notice)]
    assert told == ["the viewer stopped, training goes on: OSError: no socket"]
    live.close("end")


def test_a_pause_ends_when_the_last_browser_goes(job: Job) -> None:
    viewer = FakeViewer()
    live = Live(viewer, job, ignore)  # type: ignore[arg-type]
    viewer.switches["pause training"](True)
    thread = threading.Thread(target=live.turn)
    thread.start()
    time.sleep(0.1)
    assert thread.is_alive()
    viewer.watchers = 0
    thread.join(timeout=10)
    assert not thread.is_alive()
    live.close("end")


def test_the_page_says_what_is_done(job: Job) -> None:
    viewer = FakeViewer()
    live = Live(viewer, job, ignore)  # type: ignore[arg-type]
    live.on_event(Phase("training 2dgs-r", 6000))
    live.scored(24.318)
    time.sleep(module.STATUS_SECONDS)
    live.on_event(Step(1200, "surface 1,200/3,000  52,787 splats"))
    assert viewer.texts[-1] == (
        "**training 2dgs-r** 1,200/6,000<br>surface 1,200/3,000  52,787 splats<br>PSNR 24.32 dB"
    )
    viewer.switches["pause training"](True)
    live.on_event(Step(1210, "surface 1,210/3,000"))  # returns: the pause comes when the clock is stopped
    viewer.switches["pause training"](False)
    live.close("**finished**")
    assert viewer.texts[-1] == "**finished**"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--viewer-port", "9000"], "--viewer-port belongs to --viewer, which was not given; give both"),
        (["--viewer", "--viewer-port", "0"], "--viewer-port must be 1 to 65535, got 0"),
        (["--viewer", "--viewer-port", "{taken}"], "a free port on 127.0.0.1 was expected, port {taken}"),
    ],
)
@pytest.mark.parametrize("command", ["train", "demo"])
def test_a_port_that_cannot_be_had_is_refused_before_the_work(
    command: str, words: list[str], message: str, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("viser", reason="viser is not installed (extra `view`)")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        scene = [str(capture)] if command == "train" else []
        words = [word.format(taken=port) for word in words]
        assert run([command, *scene, "--out", str(tmp_path / "run"), "--quiet", *words]) == 2
    assert message.format(taken=port) in one_line(capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


def test_without_viser_one_line_names_the_extra(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert run(["train", str(capture), "--out", str(tmp_path / "run"), "--quiet", "--viewer"]) == 2
    assert "the viewer needs viser, which is not installed; pip install 'viser>=" in one_line(capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


def test_a_watched_command_ends_when_the_work_is_done(capture: Path, tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="viser is not installed (extra `view`)")
    words = ["train", str(capture), "--out", str(tmp_path / "run"), "--threads", "1", "--viewer", *TINY]
    done = subprocess.run([sys.executable, "-m", "gs2d", *words], capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    assert "watch it at http://127.0.0.1:" in done.stderr
    assert "Traceback" not in done.stderr
    assert "viser" not in done.stdout
