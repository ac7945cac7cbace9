"""NVRTC: every kernel compiles for every architecture without spills; the cache detects corruption."""

from __future__ import annotations

import multiprocessing
import sys
from pathlib import Path

import pytest
from benchmarks.kernel_usage import usage_of

from gs2d.errors import BackendError
from gs2d.kernels.cuda import compile as nvrtc_compile
from gs2d.kernels.cuda.compile import ARCHITECTURES, compile_source, cubin, source_names


def _absent() -> str:
    try:
        nvrtc_compile._nvrtc()
    except BackendError as error:
        return str(error)
    return ""


needs_nvrtc = pytest.mark.skipif(bool(_absent()), reason=_absent() or "NVRTC is here")


MEASURED = "sm_90"  # the architecture of the GPU used for measurements


@needs_nvrtc
@pytest.mark.parametrize("name", source_names())
@pytest.mark.parametrize(
    "arch", [pytest.param(a, marks=() if a == MEASURED else pytest.mark.slow) for a in ARCHITECTURES]
)
def test_every_kernel_compiles_without_spills_or_stack(name: str, arch: str) -> None:
    compiled = compile_source(name, arch)
    usage = usage_of(compiled)
    assert usage
    assert compiled.code.startswith(b"\x7fELF")
    assert "warning" not in compiled.log
    for kernel, used in usage.items():
        assert used.spilled_bytes == 0, kernel
        assert used.stack_bytes == 0, kernel


@needs_nvrtc
def test_the_spill_gate_sees_spills(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nvrtc_compile, "sources", lambda: {"cuda/greedy.cu": GREEDY})
    usage = usage_of(compile_source("cuda/greedy.cu", "sm_90"))["greedy"]
    assert usage.spilled_bytes > 0
    assert usage.stack_bytes > 0
    assert usage.registers <= 32


GREEDY = """
extern "C" __global__ void __launch_bounds__(1024, 2) greedy(float* p) {
    float v[96];
    #pragma unroll
    for (int i = 0; i < 96; ++i) v[i] = p[i * 1024 + threadIdx.x];
    __syncthreads();
    #pragma unroll
    for (int i = 0; i < 96; ++i) p[(95 - i) * 1024 + threadIdx.x] = v[i] * v[(i * 7) % 96];
}
"""


@needs_nvrtc
def test_contraction_is_off(monkeypatch: pytest.MonkeyPatch) -> None:
    source = 'extern "C" __global__ void f(float* p) { p[0] = p[1] * p[2] + p[3]; }'
    monkeypatch.setattr(nvrtc_compile, "sources", lambda: {"cuda/f.cu": source})
    fused = compile_source("cuda/f.cu", "sm_90", ("--fmad=true", "--ptxas-options=-v"))
    assert compile_source("cuda/f.cu", "sm_90").code != fused.code


@needs_nvrtc
def test_a_source_that_does_not_compile_is_reported_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nvrtc_compile, "sources", lambda: {"cuda/bad.cu": "__global__ void f() { nonsense; }"})
    with pytest.raises(BackendError, match=r"bad\.cu") as error:
        compile_source("cuda/bad.cu", "sm_90")
    assert "\n" not in str(error.value)


@needs_nvrtc
def test_a_changed_source_architecture_or_option_is_another_entry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cubin("cuda/emit.cu", "sm_90", tmp_path)
    cubin("cuda/emit.cu", "sm_80", tmp_path)
    files = nvrtc_compile.sources()
    monkeypatch.setattr(
        nvrtc_compile, "sources", lambda: files | {"core/base.h": files["core/base.h"] + "// changed\n"}
    )
    cubin("cuda/emit.cu", "sm_90", tmp_path)
    monkeypatch.setattr(nvrtc_compile, "OPTIONS", (*nvrtc_compile.OPTIONS, "--ftz=true"))
    cubin("cuda/emit.cu", "sm_90", tmp_path)
    assert len(list(tmp_path.iterdir())) == 4


@needs_nvrtc
@pytest.mark.parametrize("damage", ["empty", "cut", "flipped"])
def test_a_damaged_entry_is_compiled_again(tmp_path: Path, damage: str) -> None:
    # Not emit.cu: the compiler's instruction order for emit_entries_* varies between runs.
    whole = cubin("cuda/slots.cu", "sm_90", tmp_path).code
    (path,) = tmp_path.iterdir()
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes({"empty": b"", "cut": bytes(data[:1000]), "flipped": bytes(data)}[damage])
    again = cubin("cuda/slots.cu", "sm_90", tmp_path)
    assert again.code == whole
    assert again.log
    assert cubin("cuda/slots.cu", "sm_90", tmp_path).log == ""


@needs_nvrtc
def test_without_a_home_kernels_are_compiled_and_nothing_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """A container user may be a number without a name or a home directory."""
    for name in ("HOME", "GS2D_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # what it does without a home directory
    assert nvrtc_compile.cache_folder() is None
    assert not nvrtc_compile.is_writable(None)
    monkeypatch.setattr(nvrtc_compile, "_write", lambda path, code: pytest.fail(f"written: {path}"))
    assert cubin("cuda/slots.cu", "sm_90").log


def _compile_in(folder: Path) -> int:
    return len(cubin("cuda/emit.cu", "sm_90", folder).code)


@needs_nvrtc
def test_two_processes_at_once_share_one_cache(tmp_path: Path) -> None:
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        sizes = pool.map(_compile_in, [tmp_path] * 2)
    assert sizes[0] == sizes[1] > 0
    (entry,) = tmp_path.iterdir()
    assert entry.suffix == ".cubin"
    assert cubin("cuda/emit.cu", "sm_90", tmp_path).log == ""


def test_without_nvrtc_the_error_names_the_package_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cuda.bindings", None)
    with pytest.raises(BackendError, match="bindings"):
        compile_source("cuda/emit.cu", "sm_90")
