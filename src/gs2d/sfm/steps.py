"""Finished steps of a mapping: their results and models in a folder, so that an interrupted search can continue."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

from gs2d.core.atomic_files import atomic_write


class Steps:
    """A folder with the results of finished steps. Each file and each model is complete or absent."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def facts(self, name: str) -> Any | None:
        """Return the result of a finished step, or None."""
        try:
            return json.loads((self.folder / f"{name}.json").read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None

    def finish(self, name: str, facts: Any) -> None:
        """Record that a step is finished, with its result."""
        with atomic_write(self.folder / f"{name}.json", "w") as file:
            json.dump(facts, file)

    def write(self, name: str, model: Any) -> None:
        """Write a model (pycolmap.Reconstruction), replacing one of the same name."""
        whole, part = self.folder / name, self.folder / f"{name}.part"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        model.write(str(part))
        shutil.rmtree(whole, ignore_errors=True)
        os.rename(part, whole)

    def names(self, prefix: str) -> list[str]:
        """Return the names of all models that start with ``prefix``."""
        return sorted(path.name for path in self.folder.glob(f"{prefix}*") if path.is_dir())

    def remove(self, name: str) -> None:
        """Remove a model."""
        shutil.rmtree(self.folder / name, ignore_errors=True)

    def read(self, pycolmap: Any, name: str) -> Any:
        """Read a model. Every step reads its input from disk, so an interruption does not change the result."""
        return pycolmap.Reconstruction(str(self.folder / name))
