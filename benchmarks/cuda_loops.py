"""Count registers, shared memory and inner-loop instructions of the compiled CUDA kernels, without a GPU.

::

    python -m benchmarks.cuda_loops            compare with results/cuda_loops.json (exit status 1 if it differs)
    python -m benchmarks.cuda_loops --update   write that file, after a change that is meant

Every kernel is compiled for sm_90 and disassembled with nvdisasm (``pip install nvidia-cuda-nvdisasm``). For blend
kernels, the innermost loop with the most arithmetic is counted: one iteration processes one splat at the 8x8 pixels of
a warp. Both halves and all branches are counted. Figures of different compilers are not compared.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.kernel_usage import usage_of
from gs2d.errors import BackendError
from gs2d.kernels.cuda.compile import compile_source, nvrtc_version, source_names

COMMITTED = Path(__file__).parent / "results" / "cuda_loops.json"
ARCHITECTURE = "sm_90"
TOLERANCE = 0.03
LOOPS_OF = ("blend_", "splat_errors")  # kernels whose innermost loop is counted
CLASSES = {
    "arithmetic": r"FFMA|FADD|FMUL",
    "select": r"FSEL|FSETP|FMNMX|SEL|PLOP3|ISETP|FCHK",
    "special": r"MUFU",
    "shuffle": r"SHFL|VOTEU?",
    "shared": r"LDS|STS",
    "atomic": r"REDG?|ATOMG?",
    "branch": r"BRA|BSSY|BSYNC|CALL|WARPSYNC|EXIT|YIELD",
    "local": r"LDL|STL",
}
Counts = dict[str, int]


class Unavailable(Exception):
    """Raised if a required tool is missing; the message says how to install it."""


def _disassembler() -> str:
    beside = [str(Path(folder, "nvidia", "cu13", "bin")) for folder in sys.path]
    path = shutil.which("nvdisasm") or shutil.which("nvdisasm", path=":".join(beside))
    if path is None:
        raise Unavailable("nvdisasm is not installed (pip install nvidia-cuda-nvdisasm)")
    return path


def compiler_version() -> str:
    """Return the compiler name and version, for instance "NVRTC 13.0"."""
    try:
        return "NVRTC {}.{}".format(*nvrtc_version())
    except BackendError as error:
        raise Unavailable(str(error)) from error


def innermost_loops(listing: str) -> dict[str, list[list[str]]]:
    """Return the instructions of each kernel's innermost loops; loops that are only a jump are skipped."""
    loops: dict[str, list[list[str]]] = {}
    for part in re.split(r"\.section\s+\.text\.", listing)[1:]:
        name = re.match(r"\w+", part)
        assert name is not None
        instructions: list[str] = []
        labels: dict[str, int] = {}
        for line in re.split(r"\n\s*\.section\s", part)[0].splitlines():
            label = re.match(r"\s*(\.L_\w+):", line)
            if label:
                labels[label[1]] = len(instructions)
            instruction = re.search(r"/\*[0-9a-f]{4,}\*/\s+(.*?);", line)
            if instruction:
                instructions.append(instruction[1].strip())
        spans = set()
        for i, text in enumerate(instructions):
            target = re.search(r"BRA.*`\((\.L_\w+)\)", text)
            if target and labels.get(target[1], len(instructions)) < i:
                spans.add((labels[target[1]], i))
        inner = [a for a in spans if not any(a != b and a[0] <= b[0] and b[1] <= a[1] for b in spans)]
        loops[name[0]] = [instructions[begin : end + 1] for begin, end in sorted(inner)]
    return loops


def mix(instructions: Sequence[str]) -> Counts:
    """Return instruction counts by class and in total; the rest is integer work and moves."""
    found: Counter[str] = Counter(total=len(instructions))
    for text in instructions:
        operation = re.sub(r"^@!?\w+\s+", "", text).split()[0].split(".")[0]
        kind = next((name for name, pattern in CLASSES.items() if re.fullmatch(pattern, operation)), "other")
        found[kind] += 1
    return dict(sorted(found.items()))


def count() -> dict[str, dict[str, Any]]:
    """Return registers, shared memory and spilled bytes by kernel, and the innermost loop of blend kernels."""
    tool = _disassembler()
    kernels: dict[str, dict[str, Any]] = {}
    for source in source_names():
        compiled = compile_source(source, ARCHITECTURE)
        with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
            file.write(compiled.code)
            file.flush()
            words = [tool, "-c", file.name]
            listing = subprocess.run(words, capture_output=True, text=True, check=True, timeout=60).stdout
        loops = innermost_loops(listing)
        for kernel, usage in usage_of(compiled).items():
            kernels[kernel] = {
                "registers": usage.registers,
                "shared_bytes": usage.shared_bytes,
                "spilled_bytes": usage.spilled_bytes,
            }
            if kernel.startswith(LOOPS_OF):
                kernels[kernel]["loop"] = max(
                    (mix(loop) for loop in loops[kernel]), key=lambda m: m.get("arithmetic", 0)
                )
    return dict(sorted(kernels.items()))


def differences(measured: dict[str, dict[str, Any]], committed: dict[str, dict[str, Any]]) -> list[str]:
    """Return one line per figure outside its tolerance, in either direction: gains must be committed too."""
    if measured.keys() != committed.keys():
        return [f"kernels that only one side has: {', '.join(sorted(measured.keys() ^ committed.keys()))}"]
    lines = []
    for kernel, now in measured.items():
        pairs = {name: (now[name], committed[kernel][name]) for name in ("registers", "shared_bytes", "spilled_bytes")}
        if "loop" in now:
            pairs["instructions of a round"] = (now["loop"]["total"], committed[kernel]["loop"]["total"])
            pairs["shuffles of a round"] = (now["loop"].get("shuffle", 0), committed[kernel]["loop"].get("shuffle", 0))
        lines += [
            f"{kernel}: {name} {a}, committed {b}" for name, (a, b) in pairs.items() if abs(a - b) > TOLERANCE * abs(b)
        ]
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare with the committed file, or write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--update", action="store_true")
    args = parser.parse_args(arguments)
    document: dict[str, Any] = {"compiler": compiler_version(), "architecture": ARCHITECTURE, "kernels": count()}
    if args.update:
        COMMITTED.write_text(json.dumps(document, indent=1) + "\n")
        return 0
    for kernel, figures in document["kernels"].items():
        print(f"{kernel:28} {json.dumps(figures)}")
    over = differences(document["kernels"], json.loads(COMMITTED.read_text())["kernels"])
    print("\n".join(over) or "as committed")
    return int(bool(over))


if __name__ == "__main__":
    sys.exit(main())
