"""Measure ceilings of this GPU: instruction rates by kind, atomic additions, copying."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import torch

from benchmarks.gpu.bench import Bench, rounded
from gs2d.kernels.cuda.compile import KERNEL, compile_text
from gs2d.kernels.cuda.launch import GpuLauncher

SOURCE = Path(__file__).with_name("probes.cu")
CHAINS, THREADS = 16, 128
LINES = 1 << 20
REDS = (
    (1, 1),
    (16, 1),
    (32, 1),
    (32, 0),
    (16, 0),
)  # lanes, address stride in floats (0: one address)


class _Arguments(ctypes.Structure):
    _fields_ = (
        ("out", ctypes.c_void_p),
        ("rounds", ctypes.c_uint64),
        ("stride", ctypes.c_int32),
        ("lanes", ctypes.c_int32),
    )


def ceilings(bench: Bench) -> dict[str, Any]:
    """Return warp instructions (1e12/s), atomic additions to memory (1e9 warps/s) and copy bandwidth (1e12 B/s)."""
    if bench.dry:
        return {"skipped": "the probes need a GPU"}
    text = SOURCE.read_text()
    launcher = GpuLauncher(
        bench.device,
        code_of=lambda name, arch: compile_text(text, name, arch).code,
        source_of=dict.fromkeys(KERNEL.findall(text), SOURCE.name),
    )
    out = torch.zeros(LINES * 32, device=bench.device)
    processors = torch.cuda.get_device_properties(bench.device).multi_processor_count
    blocks = processors * 16
    warps = blocks * THREADS // 32

    def milliseconds(name: str, rounds: int, stride: int = 1, lanes: int = 32) -> float:
        arguments = _Arguments(out.data_ptr(), rounds, stride, lanes)
        return bench.times(lambda _: launcher.launch(name, blocks, THREADS, arguments), repeats=10, warmup=3)["best"]

    found: dict[str, Any] = {}
    for name, rounds in (("fma", 4096), ("shuffle", 1024), ("exp2", 1024)):
        time = milliseconds(f"probe_{name}", rounds)
        found[f"{name}_1e12_warp_instructions_per_s"] = warps * rounds * CHAINS / time * 1e3 / 1e12
    for lanes, stride in REDS:
        time = milliseconds("probe_red", 256, stride, lanes)
        kind = "one_line" if stride else "one_address"
        found[f"red_{lanes}_lanes_{kind}_1e9_per_s"] = warps * 256 / time * 1e3 / 1e9
    source, target = (torch.empty(1 << 28, dtype=torch.float32, device=bench.device) for _ in range(2))
    time = bench.times(lambda _: target.copy_(source), repeats=10, warmup=3)["best"]
    found["copy_1e12_bytes_per_s"] = 2 * source.nbytes / time * 1e3 / 1e12
    return rounded(found)
