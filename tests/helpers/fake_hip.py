"""A run-time library of AMD's for the launcher's tests: fake_hip.cpp, which says what arrived and may run kernels."""

from __future__ import annotations

import ctypes
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from emulate import Emulator
from gs2d.kernels.cuda.hip import HipDriver
from gs2d.kernels.cuda.launch import GpuLauncher, hip_launcher

RUNNER = ctypes.CFUNCTYPE(None, ctypes.c_char_p, ctypes.c_uint, ctypes.c_uint, ctypes.c_void_p)


class FakeHip:
    """The library, as the tests talk to it."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self.library, self.errors = library, list[BaseException]()
        library.fake_hip_log.restype = ctypes.c_char_p
        self.driver = HipDriver(library)
        self._runner: Any = None

    def said(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.library.fake_hip_log().decode().splitlines()]

    def run_by(self, emulator: Emulator | None) -> None:
        def run(kernel: bytes, blocks: int, threads: int, argument: int) -> None:
            try:
                assert emulator is not None
                emulator.launch(kernel.decode(), blocks, threads, ctypes.c_char.from_address(argument))  # type: ignore[arg-type]
            except BaseException as error:  # ctypes would only print it
                self.errors.append(error)

        self._runner = RUNNER(run) if emulator is not None else RUNNER()
        self.library.fake_hip_runner(self._runner)

    def launcher(self, index: int = 0, **options: Any) -> GpuLauncher:
        given = {
            "driver": self.driver,
            "stream_of": lambda device: 0x77,
            "architecture_of": lambda device: "gfx942",
            "code_of": lambda name, arch: b"\x7fELF" + bytes(100),
        }
        return hip_launcher(torch.device("cuda", index), **{**given, **options})


def build(folder: Path) -> FakeHip:
    """Compile the library, and load it."""
    if shutil.which("g++") is None or sys.platform != "linux":
        pytest.skip("no g++ on Linux here to build a fake libamdhip64")
    library = folder / "libamdhip64.so"
    source = Path(__file__).parent / "fake_hip.cpp"
    command = ["g++", "-std=c++20", "-O1", "-fPIC", "-shared", "-Wall", str(source), "-o", str(library)]
    subprocess.run(command, check=True, timeout=60)
    return FakeHip(ctypes.CDLL(str(library)))
