"""Registers and memory of compiled CUDA kernels, from the compiler's log."""

from __future__ import annotations

import re
from dataclasses import dataclass

from gs2d.errors import BackendError
from gs2d.kernels.cuda.compile import Cubin


@dataclass(frozen=True)
class KernelUsage:
    """Resources of one kernel, as reported by ptxas.

    Attributes
    ----------
    registers : int
        Per thread.
    spilled_bytes, stack_bytes : int
        Local memory per thread, spill stores and loads together; 0 in a good kernel.
    shared_bytes : int
        Per block.
    """

    registers: int
    spilled_bytes: int
    stack_bytes: int
    shared_bytes: int


def usage_of(compiled: Cubin) -> dict[str, KernelUsage]:
    """Return the resources of each kernel, none if the code was cached."""
    found: dict[str, KernelUsage] = {}
    for part in compiled.log.split("Compiling entry function '")[1:]:
        found[part.partition("'")[0]] = KernelUsage(
            registers=_number(r"Used (\d+) registers", part),
            spilled_bytes=_number(r"(\d+) bytes spill stores", part) + _number(r"(\d+) bytes spill loads", part),
            stack_bytes=_number(r"(\d+) bytes stack frame", part),
            shared_bytes=_number(r"(\d+) bytes smem", part, missing=0),
        )
    return found


def _number(pattern: str, text: str, missing: int | None = None) -> int:
    match = re.search(pattern, text)
    if match is None:
        if missing is not None:
            return missing
        raise BackendError(f"the CUDA compiler's log has no {pattern!r}: expected the format of CUDA 12 or 13")
    return int(match.group(1))
