"""The native library built with sanitizers: its tests run on that build, in a process that aborts on an error.

Slow: a build takes minutes. A seeded fault confirms that errors abort the process.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3000)]

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent
FINDING = 66  # exit code after a sanitizer error
USE = """
import os
from pathlib import Path

import gs2d.kernels.library as library

library.FOLDER = Path(os.environ["GS2D_SANITIZED"])
"""
FAULTS = """
#include <thread>
extern "C" int past_the_end(int n) {
    volatile int* numbers = new int[4];
    numbers[n] = 1;
    return numbers[0];
}
extern "C" int overflow(int n) { return 2147483647 + n; }
extern "C" int race(int n) {
    int shared = 0;
    std::thread other([&] { for (int i = 0; i < 1000 * n; ++i) ++shared; });
    for (int i = 0; i < 1000 * n; ++i) ++shared;
    other.join();
    return shared;
}
"""


@dataclass(frozen=True)
class Sanitizer:
    """Build flags of a sanitizer, and the environment of a process that uses such a library."""

    flags: str
    runtime: str

    def environment(self) -> dict[str, str]:
        """Return the environment: preloads the runtime, and libstdc++, whose throw it wraps."""
        preload = " ".join(_of_compiler(name) for name in (self.runtime, "libstdc++.so"))
        common = f"exitcode={FINDING}:handle_segv=0"
        return os.environ | {
            "LD_PRELOAD": preload,
            "ASAN_OPTIONS": f"{common}:detect_leaks=0",  # Python does not free everything at exit
            "UBSAN_OPTIONS": "print_stacktrace=1",
            "TSAN_OPTIONS": f"{common}:report_signal_unsafe=0",
            "OMP_NUM_THREADS": "1",
        }


SANITIZERS = {
    "address": Sanitizer("-fsanitize=address,undefined -fno-sanitize-recover=all", "libasan.so"),
    "thread": Sanitizer("-fsanitize=thread", "libtsan.so"),
}


def _of_compiler(name: str) -> str:
    found = subprocess.run(["g++", f"-print-file-name={name}"], capture_output=True, text=True, check=True).stdout
    return found.strip()


@pytest.fixture(scope="module", params=list(SANITIZERS))
def sanitizer(request: pytest.FixtureRequest) -> Sanitizer:
    """Return each sanitizer whose runtime the compiler provides."""
    found = SANITIZERS[request.param]
    if sys.platform != "linux" or shutil.which("g++") is None or shutil.which("setarch") is None:
        pytest.skip("needs Linux with g++ and setarch")
    if not Path(_of_compiler(found.runtime)).is_absolute():
        pytest.skip(f"g++ has no {found.runtime} here")
    return found


def _run(sanitizer: Sanitizer, *command: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run Python with a sanitizer's runtime, without address randomisation, which older runtimes partly lack."""
    return subprocess.run(
        ["setarch", "-R", sys.executable, *command],
        cwd=ROOT,
        env=sanitizer.environment() | environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("fault", ["past_the_end", "overflow", "race"])
def test_a_seeded_fault_stops_the_process(sanitizer: Sanitizer, fault: str, tmp_path: Path) -> None:
    if (fault == "race") != (sanitizer is SANITIZERS["thread"]):
        pytest.skip("another sanitizer's fault")
    source, library = tmp_path / "faults.cpp", tmp_path / "faults.so"
    source.write_text(FAULTS)
    flags = [*sanitizer.flags.split(), "-O0", "-g", "-shared", "-fPIC", "-std=c++20"]
    subprocess.run(["g++", *flags, source, "-o", library], check=True)
    call = f"import ctypes; print(ctypes.CDLL({str(library)!r}).{{}}({{}}))"
    assert _run(sanitizer, "-c", call.format(fault, 0)).returncode == 0
    found = _run(sanitizer, "-c", call.format(fault, 4))
    assert found.returncode != 0
    assert "runtime error" in found.stderr or "Sanitizer" in found.stderr


def _built(sanitizer: Sanitizer, folder: Path) -> Path:
    """Build the libraries of every instruction set with a sanitizer, and return their folder."""
    tools = Path(sys.executable).parent
    cmake = shutil.which("cmake", path=f"{tools}{os.pathsep}{os.environ.get('PATH', '')}")
    if cmake is None:
        pytest.skip("needs cmake")
    flags = f"-O1 -g -fno-omit-frame-pointer {sanitizer.flags}"
    configure = [cmake, "-S", ROOT, "-B", folder, "-DCMAKE_BUILD_TYPE=None", f"-DCMAKE_CXX_FLAGS={flags}"]
    for command in (configure, [cmake, "--build", folder, "--parallel", "2"]):
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return folder


def test_the_kernels_tests_find_no_fault_that_a_sanitizer_sees(sanitizer: Sanitizer, tmp_path: Path) -> None:
    libraries = _built(sanitizer, tmp_path / "build")
    plugins = tmp_path / "plugins"
    plugins.mkdir()
    (plugins / "use_sanitized.py").write_text(USE)
    files = sorted(path for path in HERE.glob("test_*.py") if path.name != Path(__file__).name)
    ran = _run(
        sanitizer,
        *("-m", "pytest", "-p", "use_sanitized", "-p", "no:cacheprovider", "-q", "-s"),
        *("-m", "not slow and not gpu", *files),
        GS2D_SANITIZED=str(libraries),
        PYTHONPATH=os.pathsep.join([str(plugins), *filter(None, [os.environ.get("PYTHONPATH")])]),
    )
    assert ran.returncode == 0, (ran.stdout + ran.stderr)[-6000:]
    assert " passed" in ran.stdout
