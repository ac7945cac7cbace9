"""COLMAP's incremental mapping, which goes on after an interruption: models that are done, and snapshots of one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gs2d.sfm.steps import Snapshots, Steps

Count = Callable[[int], None]
_RELAXED = 2  # times that the demands on the first pair of a model are halved, as COLMAP's own pipeline does


class _Growing:
    """One call of COLMAP's pipeline: counts photographs, writes snapshots and each model that is done."""

    def __init__(self, pycolmap: Any, options: Any, source: Any, manager: Any, count: Count) -> None:
        self._manager = manager
        self.pipeline = pycolmap.IncrementalPipeline(options, source, manager)
        self._count = count
        callbacks = pycolmap.IncrementalPipelineCallback
        self.pipeline.add_callback(int(callbacks.INITIAL_IMAGE_PAIR_REG_CALLBACK), lambda: self._more(2))
        self.pipeline.add_callback(int(callbacks.NEXT_IMAGE_REG_CALLBACK), lambda: self._more(1))
        self.pipeline.add_callback(int(callbacks.LAST_IMAGE_REG_CALLBACK), self._one_is_done)
        self.snapshots: Snapshots | None = None
        self.on_model: Callable[[Any], None] = lambda _model: None
        self._done = manager.size()

    def _more(self, number: int) -> None:
        self._count(number)
        if self.snapshots is not None:
            self.snapshots.offer(lambda: self._manager.get(self._manager.size() - 1))

    def _one_is_done(self) -> None:
        for i in range(self._done, self._manager.size()):
            self.on_model(self._manager.get(i))
        self._done = max(self._done, self._manager.size())


def grow_all(pycolmap: Any, database: str, options: Any, steps: Steps, name: str, count: Count, *, often: bool) -> None:
    """Grow models from nothing, or the rest of them; each is in ``steps`` as ``NAME-0``, ``NAME-1`` ...

    Parameters
    ----------
    count : function of a number
        Called with how many photographs more have a place.
    often : bool
        Write snapshots, and go on after them. Without them all models are grown again, to the same bytes.
    """
    done: list[str] = []
    snapshots = Snapshots(steps, f"{name}-snapshot") if often else None

    def keep(model: Any) -> None:
        steps.write(f"{name}-{len(done)}", model)
        done.append(f"{name}-{len(done)}")
        if snapshots is not None:
            snapshots.clear()

    if not often:
        for grown in steps.names(f"{name}-"):
            steps.remove(grown)
    while often and steps.has(f"{name}-{len(done)}"):
        done.append(f"{name}-{len(done)}")
        count(steps.read(pycolmap, done[-1]).num_reg_images())
    opened = pycolmap.Database.open(database)
    try:
        if snapshots is not None and (begun := snapshots.newest()) is not None:
            keep(_finish(pycolmap, opened, options, steps, begun, count, snapshots))
        manager = pycolmap.ReconstructionManager()
        if done:
            _grow_more(pycolmap, opened, options, steps, done, manager, snapshots, keep, count)
        else:
            growing = _Growing(pycolmap, options, opened, manager, count)
            growing.snapshots, growing.on_model = snapshots, keep
            growing.pipeline.run()
    finally:
        opened.close()


def grow_on(
    pycolmap: Any, database: str, options: Any, steps: Steps, start: str, count: Count, *, often: bool
) -> Any | None:
    """Return the model ``start`` of ``steps`` with what more photographs could be placed; None if that failed."""
    snapshots = Snapshots(steps, f"{start}-snapshot") if often else None
    begun = snapshots.newest() if snapshots is not None else None
    opened = pycolmap.Database.open(database)
    try:
        return _finish(pycolmap, opened, options, steps, begun or start, count, snapshots)
    finally:
        opened.close()


def _finish(
    pycolmap: Any, source: Any, options: Any, steps: Steps, begun: str, count: Count, snapshots: Snapshots | None
) -> Any:
    """Grow one model on, from a snapshot or another start."""
    manager = pycolmap.ReconstructionManager()
    manager.read(str(steps.folder / begun))
    count(manager.get(0).num_reg_images())
    growing = _Growing(pycolmap, options, source, manager, count)
    growing.snapshots = snapshots
    growing.pipeline.run()
    return manager.get(0) if manager.size() else None


def _grow_more(
    pycolmap: Any,
    source: Any,
    options: Any,
    steps: Steps,
    done: list[str],
    manager: Any,
    snapshots: Snapshots | None,
    keep: Callable[[Any], None],
    count: Count,
) -> None:
    """Grow further models of photographs that those that are done have not placed."""
    from_database = pycolmap.DatabaseCacheOptions()
    from_database.min_num_matches = options.min_num_matches
    cache = pycolmap.DatabaseCache.create(source, from_database)
    mapper = pycolmap.IncrementalMapper(cache)
    for name in done:  # the mapper learns which photographs have a place
        manager.read(str(steps.folder / name))
        mapper.begin_reconstruction(manager.get(manager.size() - 1))
        mapper.end_reconstruction(False)
    growing = _Growing(pycolmap, options, cache, manager, count)
    growing.snapshots, growing.on_model = snapshots, keep
    demands = options.get_mapper()
    stop = pycolmap.IncrementalPipelineStatus.STOP
    for time in range(2 * _RELAXED + 1):
        if mapper.num_total_reg_images() == cache.num_images():
            return
        if growing.pipeline.reconstruct(mapper, demands, False) == stop:
            return
        if time % 2 == 0:
            demands.init_min_num_inliers //= 2
        else:
            demands.init_min_tri_angle /= 2
        mapper.reset_initialization_stats()
