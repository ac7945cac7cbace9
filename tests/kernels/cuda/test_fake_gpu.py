"""Training, meshing and scoring with tensors on "cuda" that have values: host and device are never mixed.

``fake_gpu.py`` acts as the GPU for torch, the emulator runs the kernels. ``test_devices.py`` covers a single iteration
and synchronisation; densification, ranking, cloning, checkpoints, fusion and scores also read values.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import emulate

COMMON = """
import sys
from pathlib import Path

guard, helpers, folder = sys.argv[1], *map(Path, sys.argv[2:4])
sys.path.insert(0, str(helpers))
import fake_gpu
import torch
from emulate import Emulator

emulator = Emulator()
"""

RULES = """
fake_gpu.install(guard, emulator)
there, here = torch.arange(4.0, device="cuda"), torch.ones(4)
assert (there.device, there.is_cuda, there.device == torch.device("cuda")) == (torch.device("cuda:0"), True, False)
for mixed in (lambda: there + here, lambda: torch.cat([there, here]), lambda: here[there.long()]):
    try:
        mixed()
        print("mixed")
    except RuntimeError as error:
        assert "of the host and of the device are mixed" in str(error), error
try:
    there.numpy()
    print("seen by numpy")
except TypeError as error:
    print(str(error).partition(":")[0])
assert not (there + torch.tensor(2.0)).cpu().is_cuda and there.sum().item() == 6
leaf = there.clone().requires_grad_()
((leaf * leaf).sum() + 3 * leaf[1:].max()).backward()  # 2 x, and 3 at the last
print(leaf.grad.tolist())
"""

TRAINING = """
import train_toys
from fake_backends import cuda_on_host
from gs2d.render.backends import get_backend
from gs2d.config.protocols import GENERIC
from gs2d.kernels.cuda import launch
from gs2d.training.trainer import Trainer, TrainerOptions

def trained(backend):
    given = train_toys.make_scene(), train_toys.short(), GENERIC
    options = TrainerOptions(progress_every=100)  # iterations that nobody looks at are by kernels alone
    made = Trainer(*given, backend=backend, options=options)
    made.run()
    return made

before, launch.launcher_for = launch.launcher_for, lambda device: emulator
plain = trained(cuda_on_host())  # on the host
launch.launcher_for = before
launched = fake_gpu.install(guard, emulator)
trainer = trained(get_backend("cuda"))
assert str(trainer.splats.device) == "cuda:0"
for name, tensor in trainer.splats.items():
    print(name, len(tensor), torch.equal(tensor.cpu(), getattr(plain.splats, name)))
saved = trainer.state.state_dict()
assert not any(t.is_cuda for t in saved["splats"].values())
assert {"adam_step", "splat_errors", "blend_vjp_learning", "running_counts"} <= set(launched)
"""

WHOLE_PATH = """
from functools import partial
from gs2d.contrib.lab.surface_score import evaluate_surface
from gs2d.contrib.lab import visible_surface
from gs2d.pipeline.finish.evaluate import evaluate_run
from gs2d.pipeline.finish.run_mesh import mesh_run
from gs2d.contrib.pictures.render_run import render_run
from gs2d.pipeline.prepare.options import TrainOptions
from gs2d.contrib.pictures.pictures_command import RenderOptions
from gs2d.pipeline.train.train_run import train
import tiny

launched = fake_gpu.install(guard, emulator)
visible_surface.evaluate_surface = partial(evaluate_surface, samples=300)
capture = tiny.write_capture(folder / "ball")
tiny.write_ball_mesh(capture / "mesh_gt.ply")
few = ("init_points=60", "surface.densify.max_splats=90")
options = TrainOptions(scene=capture, out=folder / "run", backend="cuda", schedule_scale=0.0005, overrides=few)
last = train(options, lambda event: None).metrics()["stages"][-1]
print(last["test"]["psnr"] > 5)
launched.clear()
print(mesh_run(folder / "run")["fused_by"], launched["fuse_voxels"] > 0)
print(evaluate_run(folder / "run")["surface"]["chamfer"] > 0)
print(render_run(folder / "run", RenderOptions(orbit=1))["images"])
"""


def said(script: str, guard: Path, emulator: emulate.Emulator, folder: Path) -> list[str]:
    """Return a script's output from a subprocess; it reuses the kernels compiled for these tests."""
    given = [str(guard), str(Path(__file__).resolve().parents[2] / "helpers"), str(folder)]
    command = [sys.executable, "-c", COMMON + script, *given]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=dict(os.environ))
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout.splitlines()


def test_the_fake_gpu_refuses_the_same_operations_as_a_gpu(
    guard: Path, emulator: emulate.Emulator, tmp_path: Path
) -> None:
    words, gradient = said(RULES, guard, emulator, tmp_path)
    assert words == "can't convert cuda"
    assert gradient == "[0.0, 2.0, 4.0, 9.0]"


@pytest.mark.slow
def test_three_stages_train_on_the_device_to_the_same_bits(
    guard: Path, emulator: emulate.Emulator, tmp_path: Path
) -> None:
    lines = [line.split() for line in said(TRAINING, guard, emulator, tmp_path)]
    assert len(lines) == 6
    assert all(same == "True" for _, _, same in lines), lines
    assert int(lines[0][1]) > 60  # some were added


@pytest.mark.slow
def test_a_run_is_trained_meshed_scored_and_rendered_on_the_device(
    guard: Path, emulator: emulate.Emulator, tmp_path: Path
) -> None:
    assert said(WHOLE_PATH, guard, emulator, tmp_path) == ["True", "cuda True", "True", "1"]
