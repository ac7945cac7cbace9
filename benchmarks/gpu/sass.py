"""Disassemble the compiled kernels: registers, instructions, loops, and memory access widths.

``python -m benchmarks.gpu.sass [--arch sm_90] [NAME ...]`` prints a row per kernel, or only for kernels whose name
contains one of the words. Needs NVRTC and ``nvdisasm``, but no GPU.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

INSTRUCTION = re.compile(r"^\s*/\*([0-9a-f]{4,})\*/\s+(?:@!?U?P\w+\s+)?(\S[^;]*?)\s*;")
GLOBAL = re.compile(r"^(LDG|STG|RED|ATOMG)\.")


@dataclass(frozen=True)
class Listing:
    """Instructions of a kernel, without predicates, and their labels."""

    instructions: tuple[str, ...]
    labels: dict[str, int]  # index of the following instruction

    def loops(self) -> list[tuple[str, ...]]:
        """Return the bodies of backward branches."""
        found = []
        for index, line in enumerate(self.instructions):
            target = re.search(r"`\((\.L_x_\d+)\)", line)
            if line.startswith("BRA") and target and self.labels[target[1]] <= index:
                body = self.instructions[self.labels[target[1]] : index + 1]
                if len(body) > 1:  # skip the final jump to itself
                    found.append(body)
        return found

    def accesses(self) -> dict[str, int]:
        """Count global memory accesses by kind and width: ``{"LDG.128": 4, "STG.32": 3}``."""
        found: Counter[str] = Counter()
        for line in self.instructions:
            if GLOBAL.match(line):
                kind = line.split()[0]
                width = next((w for w in ("128", "64", "U8", "S8", "U16", "S16") if f".{w}" in kind), "32")
                found[f"{kind.partition('.')[0]}.{width.lstrip('US')}"] += 1
        return dict(sorted(found.items()))


def disassembler() -> str | None:
    """Return the path of ``nvdisasm``, from a toolkit or its wheel."""
    found = shutil.which("nvdisasm")
    if found:
        return found
    wheels = (Path(folder) / "nvidia" for folder in sys.path)
    return next((str(path) for folder in wheels for path in folder.glob("*/bin/nvdisasm")), None)


def listing(code: bytes) -> dict[str, Listing]:
    """Return the kernels of a cubin by name.

    Raises
    ------
    FileNotFoundError
        If ``nvdisasm`` is not installed.
    """
    program = disassembler()
    if program is None:
        raise FileNotFoundError("nvdisasm is not here; pip install nvidia-cuda-nvdisasm")
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(code)
        file.flush()
        done = subprocess.run([program, "-c", file.name], capture_output=True, text=True, check=True, timeout=120)
    found: dict[str, Listing] = {}
    for part in re.split(r"^\.text\.", done.stdout, flags=re.MULTILINE)[1:]:
        lines: list[str] = []
        labels: dict[str, int] = {}
        for line in part.splitlines():
            match = INSTRUCTION.match(line)
            if match:
                lines.append(match[2])
            elif re.match(r"^\.L_x_\d+:", line):
                labels[line.strip().rstrip(":")] = len(lines)
        found[part.partition(":")[0].strip()] = Listing(tuple(lines), labels)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a row per kernel."""
    from benchmarks.kernel_usage import usage_of
    from gs2d.kernels.cuda.compile import compile_source, source_names

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--arch", default="sm_90")
    args = parser.parse_args(arguments)
    print("kernel: registers, shared bytes, instructions, accesses to global memory")
    for source in source_names():
        compiled = compile_source(source, args.arch)
        kernels = listing(compiled.code)
        for name, usage in sorted(usage_of(compiled).items()):
            if not args.names or any(word in name for word in args.names):
                made = kernels[name]
                row = f"{usage.registers}, {usage.shared_bytes}, {len(made.instructions)}, {made.accesses()}"
                print(f"{name}: {row}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
