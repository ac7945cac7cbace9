"""Backends for tests: with replaced methods, or with incomplete images."""

from __future__ import annotations

from copy import copy
from typing import Any

import torch

from gs2d.render.backends import Backend
from gs2d.render.cuda_backend import CudaBackend
from gs2d.render.pair_budget import PairBudget


def altered(backend: Backend, **changes: Any) -> Backend:
    """Return a copy with replaced attributes; replacement functions get no ``self``."""
    changed = copy(backend)
    for name, value in changes.items():
        assert hasattr(backend, name), name
        setattr(changed, name, value)
    return changed


def cuda_on_host() -> Backend:
    """Return the cuda backend for tensors in host memory, with an emulator as launcher."""

    def for_training() -> Backend:
        return altered(CudaBackend(PairBudget()), device="cpu")

    return altered(CudaBackend(), device="cpu", for_training=for_training)


def lacking(pairs: int) -> Backend:
    """Return the cuda backend in an iteration that is short of ``pairs`` pairs."""
    budget = PairBudget()
    budget.overflow = torch.tensor(min(pairs, 1), dtype=torch.int32)
    return altered(CudaBackend(budget), device="cpu")
