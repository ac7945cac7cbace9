"""Names that recipes and run folders of version 0.1 had for what is called otherwise now. Pure Python.

Every reader of ``run.json`` and of recipe JSON goes through :func:`current_names`, so the rest of the program knows one
name for each thing.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

DECAY = MappingProxyType({"horizon": "decay_steps", "final": "final_factor"})
# Key of the object in JSON -> names of its fields, old to new. Objects in a list have the key of the list.
RENAMED: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "stages": MappingProxyType({"rates": "lr"}),
        "lr": MappingProxyType({"means_horizon": "means_decay_steps"}),
        "exposure": DECAY,
        "poses": DECAY,
        "depth_prior": DECAY,
        "normal_prior": DECAY,
        "protocol": MappingProxyType({"crossing": "near_plane_policy"}),
        "raster": MappingProxyType({"crossing": "near_plane_policy"}),
    }
)


def current_names(data: Any, key: str = "") -> Any:
    """Return JSON data with today's names; data that has them already comes back equal.

    Parameters
    ----------
    data : dict, list or plain value
        A recipe, or the definition of a run (``run.json``).
    key : str
        Under which ``data`` stands in what holds it.
    """
    if isinstance(data, Mapping):
        new = RENAMED.get(key, {})
        pairs = ((new.get(name, name), value) for name, value in data.items())
        return {name: current_names(value, name) for name, value in pairs}
    if isinstance(data, list | tuple):
        return [current_names(value, key) for value in data]
    return data


def current_path(words: list[str]) -> list[str]:
    """Return the path of an override (``--set``) with today's names: ``surface.rates.sh0`` is ``surface.lr.sh0``."""
    fields = {old: new for names in RENAMED.values() for old, new in names.items()}
    return [words[0], *(fields.get(word, word) for word in words[1:])]
