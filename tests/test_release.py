"""The wheel that is released: from `scripts/build_release.sh`, installed where there is nothing else."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import gs2d

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_the_wheel_runs_the_demo_in_an_empty_environment_without_a_compiler() -> None:
    wheels = sorted((ROOT / "dist").glob(f"2dgs_r-{gs2d.__version__}-py3-none-manylinux_*_x86_64.whl"))
    if not wheels:
        pytest.skip("no wheel in dist/: scripts/build_release.sh")
    script = str(ROOT / "scripts" / "check_release.sh")
    done = subprocess.run([script, str(wheels[-1]), sys.executable], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert f"gs2d {gs2d.__version__}" in done.stdout


def test_the_wheel_for_arm_holds_libraries_for_arm_that_need_an_old_glibc_alone() -> None:
    wheels = sorted((ROOT / "dist").glob(f"2dgs_r-{gs2d.__version__}-py3-none-manylinux_*_aarch64.whl"))
    if not wheels:
        pytest.skip("no aarch64 wheel in dist/: scripts/build_release.sh --aarch64")
    with zipfile.ZipFile(wheels[-1]) as wheel:
        libraries = [name for name in wheel.namelist() if name.endswith(".so")]
        assert {Path(name).name for name in libraries} == {"libgs2d_cpu_portable.so", "libgs2d_cpu_f64.so"}
        for name in libraries:
            data = wheel.read(name)
            assert data[:5] == b"\x7fELF\x02"  # 64 bits
            assert int.from_bytes(data[18:20], "little") == 183  # e_machine: EM_AARCH64
            versions = {tuple(map(int, found.split(b"."))) for found in re.findall(rb"GLIBC_(\d+\.\d+)\0", data)}
            told = re.search(r"manylinux_(\d+)_(\d+)", wheels[-1].name)
            assert told is not None
            assert max(versions) <= (int(told[1]), int(told[2]))


def test_the_conda_recipe_needs_what_pyproject_needs() -> None:
    """Names differ: conda has torch as pytorch, and matplotlib without a window system as matplotlib-base."""
    recipe = (ROOT / "packaging" / "conda" / "recipe.yaml").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    run = recipe.split("\n  run:\n")[1].split("\n\n")[0]
    listed = {line.strip().removeprefix("- ").replace(" ", "") for line in run.splitlines()}
    names = {"torch": "pytorch", "matplotlib": "matplotlib-base"}
    wanted = {re.sub(r"^[\w-]+", lambda name: names.get(name[0], name[0]), line) for line in project["dependencies"]}
    assert listed == wanted | {f"python{project['requires-python']}"}
    assert f'version: "{gs2d.__version__}"' in recipe
