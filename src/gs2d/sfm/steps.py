"""Which steps of a mapping are done, and what they made: models and facts in a folder, each there as a whole or not."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gs2d.core.files import atomic_write

SHARE = 30.0  # a snapshot is written when so many times what the last one took has gone by: 3 % of the time
SOONEST = 20.0  # s between snapshots


class Steps:
    """The steps that are done, in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def facts(self, name: str) -> Any | None:
        """Return what a step that is done left, or None."""
        try:
            return json.loads((self.folder / f"{name}.json").read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None

    def finish(self, name: str, facts: Any) -> None:
        """Say that a step is done."""
        with atomic_write(self.folder / f"{name}.json", "w") as file:
            json.dump(facts, file)

    def write(self, name: str, model: Any) -> None:
        """Write a model (pycolmap.Reconstruction), in place of another of this name."""
        whole, part = self.folder / name, self.folder / f"{name}.part"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        model.write(str(part))
        shutil.rmtree(whole, ignore_errors=True)
        os.rename(part, whole)

    def has(self, name: str) -> bool:
        """Whether a model of this name is there, as a whole."""
        return (self.folder / name).is_dir()

    def names(self, beginning: str) -> list[str]:
        """Return the names of models that begin so."""
        return sorted(path.name for path in self.folder.glob(f"{beginning}*") if path.is_dir())

    def written(self, name: str) -> int:
        """When a model was written, ns."""
        return (self.folder / name).stat().st_mtime_ns

    def remove(self, name: str) -> None:
        """Remove a model."""
        shutil.rmtree(self.folder / name, ignore_errors=True)

    def read(self, pycolmap: Any, name: str) -> Any:
        """Return a model. All steps begin with one that was read, so that one that was interrupted changes nothing."""
        return pycolmap.Reconstruction(str(self.folder / name))


class Snapshots:
    """The model that grows, written now and then; two names in turn, so that one is whole whenever the process ends."""

    def __init__(self, steps: Steps, name: str, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._steps, self._names = steps, (f"{name}-a", f"{name}-b")
        self._clock, self._took = clock, 0.0
        self._last = clock()

    def newest(self) -> str | None:
        """Return the name of the newest snapshot, or None."""
        there = [name for name in self._names if self._steps.has(name)]
        return max(there, key=self._steps.written, default=None)

    def offer(self, model: Callable[[], Any]) -> None:
        """Write the model if it is time."""
        now = self._clock()
        if now - self._last < max(SOONEST, SHARE * self._took):
            return
        self._names = self._names[::-1]
        self._steps.write(self._names[0], model())
        self._last = self._clock()
        self._took = self._last - now

    def clear(self) -> None:
        """Remove them: the model is done."""
        for name in self._names:
            self._steps.remove(name)
