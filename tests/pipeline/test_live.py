"""`--viewer`: the same bytes, complete copies, and no waiting."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ball_runs import comparable, options
from cli_runs import TINY
from gs2d.core.splats import Splats
from gs2d.errors import DataError
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.prepare.loaded import LoadedRun, prepare_run
from gs2d.pipeline.train import live as module
from gs2d.pipeline.train.live import Live
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Event, Notice, Phase, Progress, StageEntering, Step, ignore
from gs2d.training.state import TrainState


def fetch(url: str, path: str) -> tuple[Any, bytes]:
    """Headers and body of an answer."""
    with urllib.request.urlopen(url.replace("/?", f"/{path}?"), timeout=120) as answer:
        return answer.headers, answer.read()


def test_the_viewer_does_not_change_the_bytes(
    undisturbed: RunFolder, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every progress event is fetched by a page, with photographs."""
    monkeypatch.setattr(module, "MIN_SECONDS", 0.0)
    monkeypatch.setattr(module, "MAX_FRACTION", 1e9)
    seen: list[dict[str, Any]] = []
    wrong: list[BaseException] = []
    done = threading.Event()

    def look(url: str) -> None:
        try:
            version = 0
            while version < 3:
                state = json.loads(fetch(url, "state")[1])
                if state["version"] != version:
                    version = state["version"]
                    headers, data = fetch(url, "splats")
                    seen.append({**json.loads(headers["X-Splats"]), "bytes": len(data)})
                    assert fetch(url + "&view=1", "photograph")[1][:2] == b"\xff\xd8"
        except BaseException as error:
            wrong.append(error)
        finally:
            done.set()

    def on_event(event: Event) -> None:
        if isinstance(event, Notice) and event.text.startswith("watch it at http://127.0.0.1:"):
            threading.Thread(target=look, args=[event.text.rpartition(" ")[2]], daemon=True).start()
        if isinstance(event, Step) and event.detail and not done.is_set():
            time.sleep(0.2)

    watched = train(options(capture, tmp_path / "run", viewer=0), on_event)
    assert done.wait(600)
    assert wrong == []
    assert comparable(watched) == comparable(undisturbed)
    assert all(told["bytes"] == (32 + 16 * told["texels"]) * told["splats"] > 0 for told in seen)


@pytest.fixture(scope="module")
def job(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> LoadedRun:
    return prepare_run(options(capture, tmp_path_factory.mktemp("runs") / "run"), ignore)


@pytest.fixture
def splats(undisturbed: RunFolder) -> Splats:
    from gs2d.io.splat_ply import read_splats

    return read_splats(undisturbed.file("splats.ply"))


@pytest.fixture
def heard() -> list[Event]:
    return []


@pytest.fixture
def live(job: LoadedRun, capture: Path, tmp_path: Path, heard: list[Event]) -> Iterator[Live]:
    watched = Live(job, heard.append)
    yield watched
    watched.close()


def progress(iteration: int = 10) -> Progress:
    return Progress("surface", 0, iteration, 30, {}, 0.1, 5, 0.5, 0.1, {}, 0)


def state_of(splats: Splats) -> TrainState:
    return TrainState(splats, torch.Generator())


def version_of(live: Live) -> int:
    """Ask as a page does."""
    return int(json.loads(bytes(live._state_response({}).parts[0]))["version"])


def test_the_page_shows_a_copy_of_the_splats(live: Live, splats: Splats) -> None:
    assert version_of(live) == 0
    with pytest.raises(DataError, match="there are no splats yet"):
        live._splats_response({})
    before = splats.means.clone()
    live.on_training_event(StageEntering("surface", 0, len(splats)), state_of(splats), None)  # not trained yet
    assert version_of(live) == 0
    live.on_training_event(progress(), state_of(splats), None)
    splats.means += 100.0  # training continues at once
    assert version_of(live) == 1
    answer = live._splats_response({})
    count = json.loads(answer.headers["X-Splats"])["splats"]
    words = np.frombuffer(answer.parts[0], np.float32).reshape(count, 8)
    for mean in words[:, :3] + live._scene.focus:
        assert np.abs(before.numpy() - mean).max(axis=1).min() < 1e-4
    assert bytes(live._splats_response({}).parts[0]) == bytes(answer.parts[0])  # another page gets the same


def test_splats_are_copied_only_for_an_open_page_after_the_previous_copy_was_fetched(
    live: Live, splats: Splats, monkeypatch: pytest.MonkeyPatch
) -> None:
    live.on_training_event(progress(), state_of(splats), None)
    assert version_of(live) == 0  # this page asks for the first time
    live.on_training_event(progress(), state_of(splats), None)
    assert version_of(live) == 1
    assert live._copy_at == math.inf
    live._splats_response({})
    assert live._copy_at - time.monotonic() == pytest.approx(module.MIN_SECONDS, abs=1.0)
    live.on_training_event(progress(20), state_of(splats), None)
    assert version_of(live) == 1
    live._copy_at = 0.0
    live.on_training_event(progress(20), state_of(splats), None)
    assert version_of(live) == 2
    live._splats_response({})
    live._copy_at = 0.0
    monkeypatch.setattr(module, "WATCHED", -1.0)  # the last question is too long ago
    live.on_training_event(progress(30), state_of(splats), None)
    assert version_of(live) == 2


def test_a_failing_viewer_is_reported_once_and_training_continues(live: Live, heard: list[Event]) -> None:
    live._server.failure = OSError("no memory")
    for _ in range(2):
        live.on_event(Phase("scoring", 3))
    told = [event.text for event in heard if isinstance(event, Notice)]
    assert told[1:] == ["the viewer failed, training continues: OSError: no memory"]


def test_a_command_with_the_viewer_ends_after_training(capture: Path, tmp_path: Path) -> None:
    words = ["train", str(capture), "--out", str(tmp_path / "run"), "--threads", "1", "--viewer", *TINY]
    done = subprocess.run([sys.executable, "-m", "gs2d", *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "watch" in done.stderr
    assert "Traceback" not in done.stderr
