"""The kernels in the waves of AMD's GPUs, by cuda/amd.h in the emulator: what warps of 32 give, bit for bit.

All other tests of this folder run in waves of 64 as well, where slow tests run.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

import emulate
import every_kernel
from gs2d.kernels.cuda.compile import kernel_sources

pytestmark = pytest.mark.timeout(560)  # 17 sources are compiled for each kind of wave
NOT_HERE = {"fuse_voxels"}  # no lane of it asks another; test_cuda_fuse.py


@pytest.fixture(scope="module")
def warps(emulator: emulate.Emulator) -> dict[str, torch.Tensor]:
    """What warps of 32 leave."""
    if emulator.wave:
        pytest.skip("these are waves themselves")
    return every_kernel.everything(emulator)


@pytest.mark.parametrize("wave", [64, pytest.param(32, marks=pytest.mark.slow)])
def test_every_kernel_leaves_the_same_bits_in_waves(warps: dict[str, torch.Tensor], wave: int) -> None:
    """Sums by atomics too: where no order is asked for, warps go from one collective to the next together."""
    waves = emulate.Emulator(wave=wave)
    found = every_kernel.everything(waves)
    different = [name for name in warps if not torch.equal(warps[name], found[name])]
    assert not different
    assert len(warps) > 75
    left = {name for name in kernel_sources() if name not in waves._built}
    assert left == NOT_HERE, left


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 9])
def test_waves_whose_warps_part_anywhere_change_what_only_the_order_of_atomics_may(
    warps: dict[str, torch.Tensor], seed: int
) -> None:
    found = every_kernel.everything(emulate.Emulator(wave=64, seed=seed))
    summed = ("all False", "colours False", "by transmittance", "whole")  # by atomics
    for name, tensor in warps.items():
        if name.startswith(summed) and not name.endswith("color"):
            assert float((tensor - found[name]).norm()) <= 1e-3 * float(tensor.norm()), name
        else:
            assert torch.equal(tensor, found[name]), name


def test_a_ballot_that_takes_the_whole_wave_for_a_warp_is_found(
    warps: dict[str, torch.Tensor], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lower half for both, as where masks of 64 bits are cut off."""
    package = tmp_path / "kernels"
    shutil.copytree(emulate.KERNELS, package, ignore=shutil.ignore_patterns("lib", "cpu", "__pycache__", "*.py"))
    header = package / "cuda" / "amd.h"
    text = header.read_text()
    assert "wave >> (threadIdx.x & 32u)" in text
    header.write_text(text.replace("wave >> (threadIdx.x & 32u)", "wave"))
    monkeypatch.setattr(emulate, "KERNELS", package)
    broken = emulate.Emulator(wave=64)
    cut = every_kernel.whole_steps(broken, every_kernel.many_tiles())
    assert any(not torch.equal(tensor, warps[name]) for name, tensor in cut.items())
