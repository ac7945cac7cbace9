"""Whether this machine can run the kernels: on an AMD GPU where torch is built for ROCm, else on one of NVIDIA's."""

from __future__ import annotations

import torch

from gs2d.kernels.cuda import diagnose, diagnose_amd
from gs2d.kernels.cuda.diagnose import MissingFile

__all__ = ["report"]


def report() -> tuple[MissingFile | None, str]:
    """Return what keeps the backend from running here, and a line about the machine where nothing does."""
    if torch.version.hip is not None:
        found = diagnose_amd.gather()
        lacking = diagnose_amd.missing(found)
        return lacking, "" if lacking is not None else diagnose_amd.describe(found)
    facts = diagnose.gather()
    lacking = diagnose.missing(facts)
    return lacking, "" if lacking is not None else diagnose.describe(facts)
