"""Photographs that do not fit into the available memory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ball_runs import options
from gs2d.core.memory_limit import MemoryLimit
from gs2d.errors import DataError
from gs2d.pipeline.prepare import limits as module
from gs2d.pipeline.prepare.limits import check_memory
from gs2d.pipeline.prepare.loaded import prepare_run
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Notice
from tiny import write_capture

GB = 10**9


def scene(width: int, height: int) -> Any:
    view = SimpleNamespace(camera=SimpleNamespace(width=width, height=height))
    return SimpleNamespace(train=(view, view), test=())


def limited(monkeypatch: pytest.MonkeyPatch, total: float, used: float) -> None:
    limit = MemoryLimit(int(total * GB), int(used * GB), "the control group (memory.max)")
    monkeypatch.setattr(module, "memory_limit", lambda: limit)


def test_photographs_that_do_not_fit_into_memory_are_an_error_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    limited(monkeypatch, 1.3, 0.35)
    with pytest.raises(DataError) as refused:
        check_memory(scene(5888, 3926), 1, on_host=True)
    said = str(refused.value)
    assert "\n" not in said
    assert "23.1 megapixels" in said
    assert "memory.max" in said
    assert "raise the limit" in said
    downscale = int(said.partition("--downscale ")[2].split(",")[0])
    assert downscale > 1
    check_memory(scene(5888 // downscale, 3926 // downscale), downscale, on_host=True)  # as the line says
    needed = 5888 * 3926 * (module.ITERATION_BYTES / downscale**2 + module.DECODING_BYTES)
    assert needed < 0.6 * 0.95 * GB  # leaves memory for caches


def test_photographs_shrink_to_fit_into_memory_by_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = write_capture(tmp_path / "ball", train=3, test=1, size=24)
    need = 24 * 24 * module.DECODING_BYTES + 12 * 12 * module.ITERATION_BYTES
    limit = MemoryLimit(10**6, 10**6 - need * 10 // 6 - 2, "the control group (memory.max)")
    monkeypatch.setattr(module, "memory_limit", lambda: limit)
    heard: list[Any] = []
    mine = options(capture, tmp_path / "run")
    job = prepare_run(mine, heard.append)
    assert (job.resolved.downscale, job.scene.train[0].camera.width) == (2, 12)
    notices = [event.text for event in heard if isinstance(event, Notice)]
    (told,) = [text for text in notices if "megapixels" in text]
    assert told.startswith("photographs of up to 0.000576 megapixels need about")
    assert told.endswith("(the control group (memory.max)): they are shrunk by 2, as by --downscale 2")
    assert len(notices) == len(set(notices))
    with pytest.raises(DataError, match="--downscale"):
        prepare_run(replace(mine, downscale=1), heard.append)


def test_a_resumed_run_keeps_its_downscale(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = write_capture(tmp_path / "ball", train=3, test=1, size=24)
    mine = options(capture, tmp_path / "run", schedule_scale=0.0002)
    train(replace(mine, downscale=2))
    assert prepare_run(replace(mine, resume=True), lambda _event: None).resolved.downscale == 2
    assert prepare_run(replace(mine, resume=True, downscale=1), lambda _event: None).resolved.downscale == 1
