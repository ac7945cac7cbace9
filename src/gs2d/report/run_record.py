"""The data of a run folder, read once for all sections of the report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import UndefinedError

from gs2d.errors import DataError
from gs2d.io.run_dir import open_run


@dataclass(frozen=True)
class RunRecord:
    """The data of a run for the sections of its report."""

    path: Path  # the run folder
    definition: dict[str, Any]  # ``run.json``
    stages: tuple[dict[str, Any], ...] = ()  # entries of ``metrics.json``, one per finished stage
    surface: dict[str, Any] | None = None  # surface metrics
    events: Sequence[dict[str, Any]] = ()  # ``events.jsonl``

    @property
    def last(self) -> Mapping[str, Any]:
        """Return the entry of the last finished stage; empty where there is none."""
        return self.stages[-1] if self.stages else {}

    @property
    def split(self) -> str:
        """Return the scored split: "test" if there are test views, else "train"."""
        return "test" if any(stage.get("test") for stage in self.stages) else "train"

    @property
    def recipe(self) -> Mapping[str, Any]:
        """Return the recipe of ``run.json``."""
        recipe: Mapping[str, Any] = self.definition["recipe"]
        return recipe

    @property
    def unfinished(self) -> list[str]:
        """Return the names of the stages that are planned but not finished."""
        done = [stage["name"] for stage in self.stages]
        return [name for name in map(name_of, self.recipe.get("stages", ())) if name not in done]

    @property
    def title(self) -> str:
        """Return the heading of the report."""
        return str(self.definition.get("title") or self.definition["scene"]["name"])


def read_record(folder: Path) -> RunRecord:
    """Read the data of a run folder for its report.

    Raise RunError if the folder is not a run, DataError if a file is not JSON.
    """
    run = open_run(folder)
    metrics = run.metrics()
    return RunRecord(
        path=Path(folder),
        definition=run.definition(),
        stages=tuple(metrics.get("stages") or ()),
        surface=metrics.get("surface"),
        events=run.events.read(),
    )


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Convert errors about the content of a file to a DataError that names the file."""
    try:
        yield
    except DataError:
        raise
    except (LookupError, TypeError, ValueError, OverflowError, AttributeError, UndefinedError) as error:
        raise DataError(f"{path} is damaged: {error!r}; repeat the gs2d command that wrote it") from error


def name_of(value: Any) -> str:
    """Return the name of an entry of ``run.json``, which is an object with a name or the name itself."""
    return str(value.get("name", "unnamed") if isinstance(value, Mapping) else value)


def number(value: Any) -> float | None:
    """Return a value if it is a number, else None."""
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None
