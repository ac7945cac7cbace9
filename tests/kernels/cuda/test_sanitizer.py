"""No kernel reads or writes beyond a tensor: emulated under AddressSanitizer, which knows where each one ends.

It must be in the process from its start, so the kernels run in one of their own.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HELPERS = Path(__file__).resolve().parents[2] / "helpers"
pytestmark = [pytest.mark.slow, pytest.mark.timeout(200)]

COMMON = """
import sys
from pathlib import Path

sys.path.insert(0, sys.argv[1])
import numpy as np
import torch
from emulate import Emulator

emulator = Emulator(Path(sys.argv[2]), addresses=True)
"""

BEYOND = """
from gs2d.kernels.cuda.arguments import BlurArguments, fill

arguments = BlurArguments(20, 20)
image, out = torch.rand(20 * 20 * 3 - 1), torch.rand(20 * 20 * 3)  # one number too few
fill(arguments, image=image, out=out)
emulator.launch("blur_image", 1, 128, arguments)
"""

EVERYTHING = """
from functools import partial

import two_views
from kernel_cases import SETTINGS, many_tiles
from render_scenes import contraction, random_cotangents

from gs2d.config.multiview import MultiView
from gs2d.kernels.cuda import losses as ops
from gs2d.kernels.cuda.adam import AdamUpdate, adam_step
from gs2d.kernels.cuda.multiview import compare_views
from gs2d.render import cuda
from gs2d.core.splats import Splats

case = many_tiles()  # 70 x 45 px, no multiple of anything
cotangents = random_cotangents(np.random.default_rng(1), case.camera)

def render(trained, **options):
    leaves = Splats(**{name: t.clone().requires_grad_(name in trained) for name, t in case.splats.items()})
    probe = torch.zeros(len(leaves), 4, requires_grad=True) if "means" in trained else None
    output = cuda.rasterize_with(emulator, leaves, case.camera, SETTINGS, probe, **options)
    contraction(output, cotangents).backward()

every = [name for name, _ in case.splats.items()]
rows = torch.arange(len(case.splats)) % 3 == 0
for sure in (False, True):
    render(every, deterministic=sure)
    render(("sh0", "shN"), deterministic=sure, gradient_rows=rows)
image, mask = torch.rand(45, 70, 3), torch.rand(45, 70) > 0.3
for occlusion in (False, True):
    cuda.splat_errors_with(emulator, case.splats, case.camera, image, SETTINGS, mask, occlusion)

for size in ((37, 44), (1, 1), (12, 43)):
    x, y, m = torch.rand(*size, 3, requires_grad=True), torch.rand(*size, 3), torch.rand(*size) > 0.4
    depth, alpha = torch.rand(*size).add(1).requires_grad_(), torch.rand(*size).requires_grad_()
    l1, ssim = ops.photometric(x, y, m, ops.blur(y, launcher=emulator), launcher=emulator)
    l1_too, ssim_too = ops.photometric(x, y, launcher=emulator)
    camera = case.camera.resized(size[1], size[0])
    normals = sum(
        ops.normal_consistency(
            x, depth, alpha, camera, m, per_splat=form, edges=edges, weights=y[..., 0], launcher=emulator
        )
        for form, edges in ((False, "undefined"), (True, "camera"))
    )
    (l1 + ssim + l1_too + ssim_too + normals + ops.masked_mean(depth, m, launcher=emulator)).backward()

pair = two_views.scenario(settings=MultiView(patches=61, radius=3, texture=0.03, occluded=4.0), masked=True)
leaves = pair.depth.requires_grad_(), pair.normal.requires_grad_(), torch.zeros(6, requires_grad=True)
sum(pair.views(*leaves).compared(partial(compare_views, launcher=emulator))).backward()

settings = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-8, "launcher": emulator}
trained = torch.arange(57) % 2 == 0
index = trained.nonzero().squeeze(1)
for columns in ((3,), (15, 3), ()):
    tensors = [torch.rand(57, *columns) for _ in range(3)]
    gradient = torch.rand(57, *columns)
    for choice in ({}, {"trained": trained}, {"rows": index}):
        adam_step([AdamUpdate(*tensors, gradient, 0.1, 1, **choice)], **settings)
    adam_step([AdamUpdate(*tensors, gradient[index], 0.1, 1, rows=index, compact=True)], **settings)
print("all done")
"""


def run(script: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """The script under AddressSanitizer."""
    if shutil.which("g++") is None:
        pytest.skip("no g++ here")
    named = subprocess.run(["g++", "-print-file-name=libasan.so"], capture_output=True, text=True, check=True)
    library = Path(named.stdout.strip())
    if not library.is_absolute():
        pytest.skip("this g++ has no AddressSanitizer")
    # Fibers have stacks of their own, which it does not follow; the rest is about other libraries.
    options = "detect_leaks=0:detect_stack_use_after_return=0:alloc_dealloc_mismatch=0:detect_odr_violation=0"
    settings = {**os.environ, "LD_PRELOAD": str(library), "ASAN_OPTIONS": options, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", COMMON + script, str(HELPERS), str(folder)]
    return subprocess.run(command, env=settings, capture_output=True, text=True, timeout=180, check=False)


def test_a_read_beyond_a_tensor_is_found_with_its_line(tmp_path: Path) -> None:
    done = run(BEYOND, tmp_path)
    assert done.returncode != 0
    assert "heap-buffer-overflow" in done.stderr
    assert "photometric.cu" in done.stderr


def test_no_kernel_reads_or_writes_beyond_a_tensor(tmp_path: Path) -> None:
    done = run(EVERYTHING, tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout == "all done\n"
