"""What the optional dependencies add, and which of them this environment has."""

from __future__ import annotations

import importlib.metadata
from dataclasses import dataclass


@dataclass(frozen=True)
class Extra:
    """An extra of the distribution: the packages that must be there for a command."""

    name: str
    packages: tuple[str, ...]
    command: str

    def missing(self) -> list[str]:
        """Packages that are not installed."""
        return [name for name in self.packages if _version(name) is None]

    def line(self) -> str:
        """One line for people."""
        missing = self.missing()
        if missing:
            return f'  no   {self.command}: {", ".join(missing)} missing: pip install "2dgs-r[{self.name}]"'
        return f"  yes  {self.command}: {', '.join(f'{name} {_version(name)}' for name in self.packages)}"


EXTRAS = (
    Extra("sfm", ("pycolmap",), "gs2d poses"),
    Extra("texture", ("xatlas", "fast-simplification"), "gs2d mesh --texture"),
    Extra("slurm", ("submitit",), "gs2d paper --slurm"),
)


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
