"""No kernel accesses memory out of bounds or has undefined behaviour: emulated under gcc's sanitizers.

Sanitizers must be loaded at process start, so the kernels run in a subprocess.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HELPERS = Path(__file__).resolve().parents[2] / "helpers"
pytestmark = pytest.mark.slow

COMMON = """
import sys

sys.path.insert(0, sys.argv[1])
import numpy as np
import torch
from emulate import Emulator

emulator = Emulator(**{sys.argv[2]: True})
"""

BEYOND = """
from gs2d.kernels.cuda.kernel_arguments import work_of

target, rendered = torch.rand(20 * 20 * 3 - 1), torch.rand(20 * 20 * 3)  # one number too few
given = {"rendered": rendered, "target": target, "partials": torch.rand(4)}
emulator.run([work_of("photometric_forward", 1, given, height=20, width=20)])
"""

EVERYTHING = """
import every_kernel

every_kernel.everything(emulator)
print("all done")
"""

MISPLACED = """
from gs2d.kernels.cuda.kernel_arguments import work_of

words = torch.zeros(64)
emulator.run([work_of("clear_words", 1, threads=256, words=words.data_ptr() + 4, count=3)])  # of 16 bytes each
"""
SANITIZERS = {"addresses": "libasan.so", "undefined": "libubsan.so"}


def run(script: str, kind: str = "addresses") -> subprocess.CompletedProcess[str]:
    """Run the script under a sanitizer."""
    if shutil.which("g++") is None:
        pytest.skip("no g++ here")
    named = subprocess.run(["g++", f"-print-file-name={SANITIZERS[kind]}"], capture_output=True, text=True, check=True)
    library = Path(named.stdout.strip())
    if not library.is_absolute():
        pytest.skip("this g++ has no such sanitizer")
    # Fibers have their own stacks, which it cannot follow; the other options concern other libraries.
    options = "detect_leaks=0:detect_stack_use_after_return=0:alloc_dealloc_mismatch=0:detect_odr_violation=0"
    settings = {**os.environ, "LD_PRELOAD": str(library), "ASAN_OPTIONS": options, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", COMMON + script, str(HELPERS), kind]
    return subprocess.run(command, env=settings, capture_output=True, text=True, check=False)


def test_a_read_beyond_a_tensor_is_reported_with_its_line() -> None:
    done = run(BEYOND)
    assert done.returncode != 0
    assert "heap-buffer-overflow" in done.stderr
    assert "photometric.cu" in done.stderr


def test_misaligned_words_are_reported_with_their_line() -> None:
    done = run(MISPLACED, "undefined")
    assert done.returncode != 0
    assert "misaligned address" in done.stderr
    assert "sort.cu" in done.stderr


@pytest.mark.parametrize("kind", list(SANITIZERS))
def test_no_kernel_accesses_memory_beyond_a_tensor_or_has_undefined_behaviour(kind: str) -> None:
    done = run(EVERYTHING, kind)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout == "all done\n"
