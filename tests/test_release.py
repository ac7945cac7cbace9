"""The released wheel, built by `scripts/build_release.sh` and installed into an empty environment."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scripts.compare_machines import IMAGES, compare

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


def test_the_arm_wheel_contains_arm_libraries_for_an_old_glibc() -> None:
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


def test_the_conda_recipe_has_the_dependencies_of_pyproject() -> None:
    """Names differ: conda has torch as pytorch, and matplotlib without a window system as matplotlib-base."""
    recipe = (ROOT / "packaging" / "conda" / "recipe.yaml").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    run = recipe.split("\n  run:\n")[1].split("\n\n")[0]
    listed = {line.strip().removeprefix("- ").replace(" ", "") for line in run.splitlines()}
    names = {"torch": "pytorch", "matplotlib": "matplotlib-base"}
    wanted = {re.sub(r"^[\w-]+", lambda name: names.get(name[0], name[0]), line) for line in project["dependencies"]}
    assert listed == wanted | {f"python{project['requires-python']}"}
    assert f'version: "{gs2d.__version__}"' in recipe


def test_two_processors_may_differ_by_rounding_only(tmp_path: Path) -> None:
    """The comparison of `scripts/check_aarch64.sh`, on artificial results."""
    rng = np.random.default_rng(0)
    here = {f"image {name}": rng.random((20, 30, 3), dtype=np.float32) for name in IMAGES}
    here |= {"gradient means": rng.random((50, 3), dtype=np.float32)}
    here |= {"training psnr": np.array(20.0), "training splats": np.array(1000)}
    np.savez(tmp_path / "here.npz", **here)

    def faults(**changed: np.ndarray) -> int:
        np.savez(
            tmp_path / "there.npz", **(here | {name.replace("_", " ", 1): value for name, value in changed.items()})
        )
        return compare(tmp_path / "here.npz", tmp_path / "there.npz")

    rounding = np.float32(1 + 1e-6)
    assert faults(image_color=here["image color"] * rounding, gradient_means=here["gradient means"] * rounding) == 0
    assert faults(image_color=here["image color"] * np.float32(1.001)) == 1
    assert faults(gradient_means=here["gradient means"] * np.float32(1.01)) == 1
    assert faults(training_psnr=np.array(19.5), training_splats=np.array(1200)) == 2
    assert faults(image_alpha=here["image alpha"] * np.float32(np.nan)) == 1
