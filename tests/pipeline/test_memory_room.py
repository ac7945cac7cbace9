"""Photographs that cannot fit into the memory that a process may have."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from gs2d.core.memory_limit import MemoryLimit
from gs2d.errors import DataError
from gs2d.pipeline import memory as module
from gs2d.pipeline.memory import check_memory

GB = 10**9


def scene(width: int, height: int) -> Any:
    view = SimpleNamespace(camera=SimpleNamespace(width=width, height=height))
    return SimpleNamespace(train=(view, view), test=())


def limited(monkeypatch: pytest.MonkeyPatch, total: float, used: float) -> None:
    limit = MemoryLimit(int(total * GB), int(used * GB), "the control group (memory.max)")
    monkeypatch.setattr(module, "memory_limit", lambda: limit)


def test_what_cannot_fit_is_refused_with_the_number_and_a_remedy_that_works(monkeypatch: pytest.MonkeyPatch) -> None:
    limited(monkeypatch, 1.3, 0.35)
    with pytest.raises(DataError) as refused:
        check_memory(scene(5888, 3926), 1, "cpu")
    said = str(refused.value)
    assert "\n" not in said
    assert "23.1 megapixels" in said
    assert "memory.max" in said
    assert "raise the limit" in said
    downscale = int(said.partition("--downscale ")[2].split(",")[0])
    assert downscale > 1
    check_memory(scene(5888 // downscale, 3926 // downscale), downscale, "cpu")  # as the line says
    with pytest.raises(DataError):
        check_memory(scene(5888 // (downscale - 1), 3926 // (downscale - 1)), downscale - 1, "cpu")


def test_what_fits_is_not_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    limited(monkeypatch, 16, 0.35)
    check_memory(scene(5888, 3926), 1, "cpu")
    limited(monkeypatch, 1.3, 0.35)
    check_memory(scene(5888, 3926), 1, "cuda:0")  # the host only decodes
    monkeypatch.setattr(module, "memory_limit", lambda: None)
    check_memory(scene(10**5, 10**5), 1, "cpu")


def test_where_not_even_decoding_fits_no_downscale_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    limited(monkeypatch, 0.5, 0.45)
    with pytest.raises(DataError, match="smaller files of the photographs"):
        check_memory(scene(20000, 10000), 1, "cpu")
