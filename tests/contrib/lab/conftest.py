"""What tests of blocks and of the cluster share."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from fake_ray import FakeQueue, FakeRay
from flown import write_tiny_flight
from gs2d.contrib.lab import cluster as module
from gs2d.contrib.lab import cluster_task
from room_photos import Room, found_room


@pytest.fixture
def ray(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeRay]:
    fake, queue, strategies = FakeRay(), ModuleType("ray.util.queue"), ModuleType("ray.util.scheduling_strategies")
    queue.Queue = FakeQueue  # type: ignore[attr-defined]
    strategies.NodeAffinitySchedulingStrategy = lambda node, soft: (node, soft)  # type: ignore[attr-defined]
    for name, part in (("ray", fake), ("ray.util.queue", queue), ("ray.util.scheduling_strategies", strategies)):
        monkeypatch.setitem(sys.modules, name, part)
    monkeypatch.setattr(module, "check_address", lambda _address: None)
    monkeypatch.setattr(module, "check_cluster", lambda _address: None)
    monkeypatch.setattr(cluster_task, "WAIT_SECONDS", 0.1)
    monkeypatch.setattr(module, "GOODBYE_SECONDS", 0.1)
    yield fake
    assert not fake.is_connected, "the connection was left open"


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Room:
    """Twelve photographs of a room, and their cameras."""
    pytest.importorskip("pycolmap")
    return found_room(tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny flight, which tests must not change."""
    return write_tiny_flight(tmp_path_factory.mktemp("flight") / "capture")
