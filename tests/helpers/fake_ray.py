"""A fake Ray module: runs tasks immediately in this process and records them."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any


class WorkerCrashedError(Exception):
    """Has the name of Ray's exception."""


class TaskCancelledError(Exception):
    """Has the name of Ray's exception."""


class Remote:
    """A remote function: runs immediately in this process unless ``FakeRay.lost`` lists it as lost."""

    def __init__(self, ray: FakeRay, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.ray, self.function, self.taken = ray, function, options

    def options(self, **options: Any) -> Remote:
        return Remote(self.ray, self.function, {**self.taken, **options})

    def remote(self, *args: Any) -> object:
        ref = object()
        self.ray.asked[self.taken["name"]] = self.taken
        if self.taken["name"] in self.ray.lost:
            self.ray.results[ref] = WorkerCrashedError("a\nlong\nstory")
        elif self.taken["name"] not in self.ray.never:
            self.ray.results[ref] = self.function(*args)
        return ref


class FakeRay(ModuleType):
    """The part of Ray's API that gs2d uses."""

    def __init__(self) -> None:
        super().__init__("ray")
        self.asked: dict[str, dict[str, Any]] = {}
        self.results: dict[object, Any] = {}
        self.lost, self.never, self.cancelled = set[str](), set[str](), list[bool]()
        self.resources: list[dict[str, float]] = [{"CPU": 0.0}, {"CPU": 4.0, "memory": 8.0 * 2**30}]
        self.is_connected = False
        self.cloudpickle = SimpleNamespace(register_pickle_by_value=lambda _module: None)

    def is_initialized(self) -> bool:
        return self.is_connected

    def init(self, **_options: Any) -> None:
        self.is_connected = True

    def shutdown(self) -> None:
        self.is_connected = False

    def nodes(self) -> list[dict[str, Any]]:
        return [{"Alive": True, "Resources": resources} for resources in self.resources] + [
            {"Alive": False, "Resources": {"CPU": 64.0, "GPU": 8.0}}
        ]

    def remote(self, **options: Any) -> Callable[[Callable[..., Any]], Remote]:
        return lambda function: Remote(self, function, options)

    def get_runtime_context(self) -> Any:
        return SimpleNamespace(get_node_id=lambda: "here")

    def wait(self, refs: list[object], *, num_returns: int, timeout: float) -> tuple[list[object], list[object]]:
        ready = [ref for ref in refs if ref in self.results]
        return ready, [ref for ref in refs if ref not in self.results]

    def get(self, ref: object) -> Any:
        found = self.results[ref]
        if isinstance(found, Exception):
            raise found
        return found

    def cancel(self, ref: object, *, force: bool) -> None:
        self.cancelled.append(force)
        if force:
            self.results[ref] = TaskCancelledError()


class FakeQueue:
    """Behaves like ray.util.queue.Queue."""

    def __init__(self, actor_options: dict[str, Any]) -> None:
        assert actor_options["num_cpus"] == 0
        self.items: list[Any] = []

    def size(self) -> int:
        return len(self.items)

    def put_nowait(self, item: Any) -> None:
        self.items.append(pickle.loads(pickle.dumps(item)))

    def get_nowait_batch(self, size: int) -> list[Any]:
        found, self.items = self.items[:size], self.items[size:]
        return found

    def shutdown(self, force: bool) -> None:
        assert force
