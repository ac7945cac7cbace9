"""Count executed instructions of the AVX2 build and loop lengths of the AVX-512 build, which have no noise.

::

    python -m benchmarks.instructions            compare with results/instructions.json (exit status 1 if over)
    python -m benchmarks.instructions --update   write that file, after a change that is meant

Callgrind does not support AVX-512, so it counts the instructions of the AVX2 library on a small fixed view
(``callgrind/driver.cpp``, one thread). The AVX-512 blend loops are compiled with the flags of CMakeLists.txt, and the
instructions in their vector loops are counted with objdump. Both depend on the compiler: figures of another major
version are not compared.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gs2d.kernels.library import available_variants, load

ROOT = Path(__file__).resolve().parents[1]
COMMITTED = Path(__file__).parent / "results" / "instructions.json"
CALLGRIND_TOLERANCE = 0.02
LOOP_TOLERANCE = 0.03
MIN_VECTOR, LONGEST = 15, 400  # minimum zmm instructions of a counted loop; longer loops jump back from cold code
# mangled names of the functions with the blend loops -> label
LOOP_FUNCTIONS = {
    "blend_tileERNS": "forward",
    "finish_batchILb1ELb1ELb0ELb0ELb0E": "backward, all images",
    "finish_batchILb0ELb0ELb0ELb0ELb0E": "backward, colour image only",
}
Counts = dict[str, int]


class Unavailable(Exception):
    """Raised if a required tool is missing; the message says how to install it."""


def _tool(name: str, package: str) -> str:
    beside_python = str(Path(sys.executable).parent)  # pip installs cmake here
    path = shutil.which(name, path=os.pathsep.join((beside_python, os.environ.get("PATH", os.defpath))))
    if path is None:
        raise Unavailable(f"{name} is not installed (Debian: apt install {package})")
    return path


def _run(words: Sequence[str], **options: Any) -> str:
    result = subprocess.run(words, capture_output=True, text=True, check=False, timeout=200, **options)
    if result.returncode != 0:
        raise RuntimeError(f"{shlex.join(words)} failed with {result.returncode}:\n{result.stderr[-2000:]}")
    return result.stdout + result.stderr


def compiler_version() -> str:
    """Return name and major version of the compiler, for instance "g++ 12"."""
    compiler = os.environ.get("CXX", "g++")
    version = _run([_tool(compiler, "g++"), "-dumpversion"]).strip()
    return f"{Path(compiler).name} {version.split('.')[0]}"


def callgrind_counts() -> Counts:
    """Return the instructions of each library call on the driver's view, AVX2 build."""
    valgrind, compiler = _tool("valgrind", "valgrind"), _tool(os.environ.get("CXX", "g++"), "g++")
    if "v3" not in available_variants():
        raise Unavailable("the AVX2 library was not built, or this processor cannot run it")
    counts = {}
    with tempfile.TemporaryDirectory() as folder:
        driver = f"{folder}/driver"
        source = str(ROOT / "benchmarks" / "callgrind" / "driver.cpp")
        kernels = str(ROOT / "src" / "gs2d" / "kernels")
        _run([compiler, "-std=c++20", "-O1", "-w", "-I", kernels, source, "-o", driver, "-ldl"])
        for label, function, mode in (
            ("forward", "gs2d_raster_forward", "all"),
            ("backward, all images", "gs2d_raster_backward", "all"),
            ("backward, colours only", "gs2d_raster_backward", "color"),
        ):
            words = [valgrind, "--tool=callgrind", f"--callgrind-out-file={folder}/out", f"--toggle-collect={function}"]
            output = _run([*words, driver, str(load("v3").path), mode])
            found = re.search(r"Collected : (\d+)", output)
            if found is None or int(found[1]) == 0:
                raise RuntimeError(f"callgrind collected nothing in {function}:\n{output[-2000:]}")
            counts[label] = int(found[1])
    return counts


def loop_counts() -> Counts:
    """Return instructions in the vector loops of the AVX-512 blend functions by function; "..., zmm": zmm only."""
    cmake, objdump = _tool("cmake", "cmake"), _tool("objdump", "binutils")
    counts: Counts = {}
    with tempfile.TemporaryDirectory() as folder:
        options = ["-DCMAKE_BUILD_TYPE=Release", "-DCMAKE_EXPORT_COMPILE_COMMANDS=ON"]
        _run([cmake, "-S", str(ROOT), "-B", folder, *options])
        for entry in json.loads(Path(folder, "compile_commands.json").read_text()):
            if "gs2d_cpu_v4.dir" in entry["command"] and entry["file"].endswith(("/forward.cpp", "/backward.cpp")):
                words, target = shlex.split(entry["command"]), f"{folder}/blend.o"
                words[words.index("-o") + 1] = target
                _run(words, cwd=folder)
                listing = _run([objdump, "-d", "--no-show-raw-insn", target])
                for label, function in _functions(listing).items():
                    loops = vector_loops(function)
                    counts[label] = sum(length for length, _ in loops)
                    counts[f"{label}, zmm"] = sum(vectors for _, vectors in loops)
    if len(counts) != 2 * len(LOOP_FUNCTIONS):
        raise Unavailable(f"expected the loops of {', '.join(LOOP_FUNCTIONS.values())}, found {', '.join(counts)}")
    return counts


def _functions(listing: str) -> dict[str, str]:
    """Return the disassembly of each function of LOOP_FUNCTIONS."""
    found = {}
    for part in re.split(r"\n(?=[0-9a-f]+ <)", listing):
        for name, label in LOOP_FUNCTIONS.items():
            head = part.partition("\n")[0]
            if name in head and ".cold" not in head:
                found[label] = part
    return found


def vector_loops(disassembly: str) -> list[tuple[int, int]]:
    """Return sorted (instructions, zmm instructions) of innermost loops with at least MIN_VECTOR zmm instructions."""
    lines = re.findall(r"^\s+([0-9a-f]+):\t(\S+)\s*(.*)$", disassembly, flags=re.MULTILINE)
    index = {int(address, 16): i for i, (address, _, _) in enumerate(lines)}
    loops = set()
    for i, (_, operation, operands) in enumerate(lines):
        target = re.match(r"[0-9a-f]+", operands)
        if operation.startswith("j") and target and index.get(int(target[0], 16), len(lines)) <= i:
            loops.add((index[int(target[0], 16)], i))
    inner = [a for a in loops if not any(a != b and a[0] <= b[0] and b[1] <= a[1] for b in loops)]
    measured = [(end - start + 1, sum("zmm" in line[2] for line in lines[start : end + 1])) for start, end in inner]
    return sorted(pair for pair in measured if pair[1] >= MIN_VECTOR and pair[0] <= LONGEST)


def excess(measured: Counts, committed: Counts, tolerance: float) -> list[str]:
    """Return a line per count that differs from the committed one by more than the tolerance, in either direction.

    A large gain must be committed too; otherwise a later loss would go unnoticed.
    """
    if measured.keys() != committed.keys():
        return [f"counted {', '.join(measured)}; the committed file has {', '.join(committed)}"]
    return [
        f"{name}: {measured[name]} instructions, committed {committed[name]} ({measured[name] / committed[name]:.3f} x)"
        for name in measured
        if abs(measured[name] - committed[name]) > tolerance * committed[name]
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare with the committed file, or write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--update", action="store_true")
    args = parser.parse_args(arguments)
    counts, loops = callgrind_counts(), loop_counts()
    if args.update:
        document = {"compiler": compiler_version(), "callgrind_avx2": counts, "loops_avx512": loops}
        COMMITTED.write_text(json.dumps(document, indent=1) + "\n")
        return 0
    committed = json.loads(COMMITTED.read_text())
    print(json.dumps({"callgrind_avx2": counts, "loops_avx512": loops}, indent=1))
    over = excess(counts, committed["callgrind_avx2"], CALLGRIND_TOLERANCE)
    over += excess(loops, committed["loops_avx512"], LOOP_TOLERANCE)
    print("\n".join(over) or "as committed")
    return int(bool(over))


if __name__ == "__main__":
    sys.exit(main())
