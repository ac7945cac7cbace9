"""Precompiled machine code in a wheel is used if it matches sources and version; then nothing is compiled."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

import gs2d
from gs2d.errors import BackendError
from gs2d.kernels.cuda import compile as nvrtc
from gs2d.kernels.cuda import shipped

ROOT = Path(__file__).resolve().parents[3]


def folder_with(folder: Path, architectures: tuple[str, ...], **changes: object) -> Path:
    """Write a folder as scripts/build_cubins.py does, with text in place of machine code."""
    folder.mkdir(exist_ok=True)
    for arch in architectures:
        with zipfile.ZipFile(folder / f"{arch}.zip", "w") as archive:
            for name in nvrtc.source_names():
                archive.writestr(shipped.entry_of(name), f"{name} for {arch}")
    digest = shipped.digest_of(nvrtc.sources(), nvrtc.OPTIONS)
    manifest = {"version": gs2d.__version__, "sources": digest, "cuda": [12, 8], "architectures": architectures}
    (folder / shipped.MANIFEST).write_text(json.dumps(manifest | changes))
    return folder


def no_compiler() -> ModuleType:
    raise BackendError("the CUDA compiler NVRTC is missing; install it")


@pytest.fixture
def bring(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., None]:
    """Let the package ship a folder, on a machine without a compiler."""

    def with_folder(*architectures: str, **changes: object) -> None:
        folder = folder_with(tmp_path / "brought", architectures, **changes)
        take = shipped.shipped.__wrapped__
        monkeypatch.setattr(nvrtc, "_shipped", lambda version, digest: take(version, digest, folder))
        monkeypatch.setattr(nvrtc, "_nvrtc", no_compiler)

    return with_folder


def test_every_kernel_comes_with_the_package_and_nothing_is_compiled_or_written(
    bring: Callable[..., None], tmp_path: Path
) -> None:
    bring(*shipped.SHIPPED, shipped.PTX)
    for capability, arch in (((9, 0), "sm_90"), ((7, 5), "sm_75"), ((12, 1), "sm_120"), ((10, 3), "sm_100")):
        assert nvrtc.architecture_for(capability) == arch
        for name in nvrtc.source_names():
            assert nvrtc.cubin(name, arch, tmp_path / "cache").code == f"{name} for {arch}".encode()
    assert not (tmp_path / "cache").exists()


@pytest.mark.parametrize("changes", [{"version": "0.0.1"}, {"sources": "of others"}, {"cuda": None}])
def test_code_of_other_sources_or_of_another_version_is_not_taken(
    bring: Callable[..., None], changes: dict[str, object], tmp_path: Path
) -> None:
    bring("sm_90", **changes)
    assert nvrtc.shipped_kernels() is None
    with pytest.raises(BackendError, match="NVRTC is missing"):
        nvrtc.cubin("cuda/slots.cu", "sm_90", tmp_path)


def test_a_warm_cache_needs_no_compiler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nvrtc, "shipped_kernels", lambda: None)
    monkeypatch.setattr(nvrtc, "_nvrtc", no_compiler)
    arch = nvrtc.architecture_for((9, 0))
    with pytest.raises(BackendError, match="NVRTC is missing"):
        nvrtc.cubin("cuda/slots.cu", arch, tmp_path)
    monkeypatch.setattr(nvrtc, "compile_source", lambda name, arch: nvrtc.Cubin(b"compiled", "log"))
    nvrtc.cubin("cuda/slots.cu", arch, tmp_path)
    monkeypatch.setattr(nvrtc, "compile_source", lambda name, arch: pytest.fail("compiled again"))
    assert nvrtc.cubin("cuda/slots.cu", arch, tmp_path).code == b"compiled"


def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("build_cubins", ROOT / "scripts" / "build_cubins.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_package_loads_the_archives_of_the_build_script(tmp_path: Path) -> None:
    try:
        version = nvrtc.nvrtc_version()
    except BackendError as error:
        pytest.skip(str(error))
    size = script().build(tmp_path, ("sm_90", shipped.PTX), ["cuda/slots.cu"])
    assert size == sum(path.stat().st_size for path in tmp_path.iterdir())
    found = shipped.shipped(gs2d.__version__, shipped.digest_of(nvrtc.sources(), nvrtc.OPTIONS), tmp_path)
    assert found is not None
    assert found.compiler == version
    code, text = (found.code("cuda/slots.cu", arch) for arch in ("sm_90", shipped.PTX))
    assert code is not None
    assert code.startswith(b"\x7fELF")
    assert text is not None
    assert b".target sm_80" in text
    assert found.code("cuda/emit.cu", "sm_90") is None
    assert found.code("cuda/slots.cu", "sm_86") is None


@pytest.mark.slow
def test_a_wheel_carries_them_though_git_ignores_them(tmp_path: Path) -> None:
    checkout = tmp_path / "checkout"
    checkout.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE", "CMakeLists.txt", ".gitignore"):
        shutil.copy(ROOT / name, checkout)
    shutil.copytree(ROOT / "src", checkout / "src", ignore=shutil.ignore_patterns("__pycache__", "lib", "cubins"))
    folder_with(checkout / "src" / "gs2d" / "kernels" / "cuda" / shipped.FOLDER, ("sm_90",))
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        ".",
        "--no-deps",
        "--no-build-isolation",
        "-q",
        "-w",
        str(tmp_path),
    ]
    done = subprocess.run(
        [*command, "-C", "wheel.cmake=false"], cwd=checkout, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert {f"gs2d/kernels/cuda/cubins/{name}" for name in ("manifest.json", "sm_90.zip")} <= set(names)
