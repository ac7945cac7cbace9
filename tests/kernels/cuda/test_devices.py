"""Device placement with splats on a GPU: kernels get no host tensors, and devices are never mixed.

torch's fake tensors report "cuda:0" without a GPU. They have shapes and devices but no values, and refuse mixed
devices. Reading a value, which would block the host, is an error. A torch without CUDA needs a device guard, which is
compiled here.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

COMMON = """
import ctypes, sys
from dataclasses import replace
from types import SimpleNamespace

import torch
from torch._subclasses.fake_tensor import FakeTensorMode

ctypes.CDLL(sys.argv[1])
sys.path.insert(0, sys.argv[2])

from gs2d.kernels.cuda import cuda_adam as adam, kernel_arguments as arguments, launch, cuda_losses as ops
from gs2d.render import kernel_backend, pair_budget as cuda_budget, cuda_passes, cuda_works
from fake_backends import altered
from gs2d.render.cuda_backend import CudaBackend

launched, pointers = set(), [0]

def fill(structure, **tensors):
    for name, tensor in tensors.items():
        if isinstance(tensor, torch.Tensor):
            assert tensor.device == torch.device("cuda:0"), (name, tensor.device)
            assert tensor.is_contiguous(), name
            pointers[0] += 1

for module in (adam, arguments, cuda_passes):
    module.fill = fill
launcher = SimpleNamespace(launch=lambda name, *rest: launched.add(name))

def launcher_for(device):
    assert device == torch.device("cuda:0"), device
    return launcher

launch.launcher_for = launcher_for
cuda_budget.PairBudget.fetch = lambda self, key, room, pairs: setattr(self, "overflow", (pairs > room).to(torch.int32))
budget = cuda_budget.PairBudget()
"""

ITERATIONS = """
import train_toys
from gs2d.config.protocols import GENERIC
from gs2d.training import trainer as loop
from gs2d.training.start.initialize import initial_splats
from gs2d.training.state import TrainState

backend = CudaBackend()
backend.device = "cuda:0"
# An iteration by kernels alone makes no tensors that could lie elsewhere.
CudaBackend.takes_whole_steps = lambda self: False
CudaBackend.for_training = lambda self: altered(self, _budget=cuda_budget.PairBudget())
recipe, scene, generator = train_toys.short(), train_toys.make_scene(), torch.Generator()
start = initial_splats(scene, sh_degree=recipe.sh_degree, random_points=50, near=0.2, generator=generator)
loop.validate = lambda recipe: recipe  # entry actions look at values: the groups that they write are made below
loop.Trainer._check_parameters = lambda *_: None
torch.Tensor.backward = lambda self: None  # torch's engine wants a real device: the other test has the gradients

def quiet(stage):
    densify = stage.densify and replace(stage.densify, start=10**5, stop=10**6, reset_every=0, cap_every=0)
    losses = tuple(replace(term, start=0) for term in stage.losses)
    return replace(stage, densify=densify, iterations=10**4, on_enter=(), losses=losses)

recipe = replace(recipe, stages=tuple(quiet(stage) for stage in recipe.stages))
with FakeTensorMode(allow_non_fake_inputs=True):
    state = TrainState(start.splats, generator, queue=[0, 1] * 10)
    options = loop.TrainerOptions(progress_every=10**9)
    trainer = loop.Trainer(scene, recipe, GENERIC, backend=backend, state=state, options=options)
    trainer._learner._budget.room = lambda tiles: 1000
    ones = torch.ones(len(start.splats), dtype=torch.bool, device="cuda:0")
    trainer.state.groups = {g: ones for stage in recipe.stages for g in stage.train.values() if g != "all"}
    for index, _ in enumerate(recipe.stages):
        trainer.enter(index)
        trainer.step()
        trainer.step()
    devices = {str(tensor.device) for _, tensor in trainer.splats.items()}
assert trainer.state.moments["sh0"].steps > 1
print(sorted(devices), sorted(launched), pointers[0])
"""

GRADIENTS = """
from functools import partial

import numpy as np
from gs2d.kernels import loss_operations
from gs2d.kernels.loss_operations import NormalOptions
from render_scenes import front_camera
from gs2d.render.types import RasterSettings

class Context:
    needs_input_grad = ()
    def save_for_backward(self, *tensors): self.saved_tensors = tensors
    def mark_non_differentiable(self, *tensors): pass
    def set_materialize_grads(self, value): pass

def there_and_back(function, needs, *given):
    ctx = Context()
    ctx.needs_input_grad = needs
    out = function.forward(ctx, *given)
    out = out if isinstance(out, tuple) else (out,)
    for gradient in function.backward(ctx, *(torch.ones_like(x) for x in out)):
        if gradient is not None and gradient.is_cuda:  # that of the intrinsics is where they are
            fill(None, gradient=gradient.contiguous())

camera = front_camera(40, 24)
budget.room = lambda tiles: 1000
with FakeTensorMode():
    def rand(*shape): return torch.rand(*shape, device="cuda:0")
    tensors = (rand(9, 3), rand(9, 4), rand(9, 2), rand(9), rand(9, 1, 3), rand(9, 15, 3))
    splats = dict(zip(("means", "quats", "log_scales", "opacity_logits", "sh0", "shN"), tensors))
    view = cuda_passes.view_of(camera, RasterSettings())
    rows = torch.ones(9, dtype=torch.bool, device="cuda:0")
    for sure, transmittance in ((False, False), (True, False), (False, True), (True, True)):
        chosen = CudaBackend(budget, launcher=launcher, deterministic=sure)
        settings = RasterSettings(with_transmittance_depth=transmittance)
        options = kernel_backend._View(chosen, camera, settings, rows, None)
        for columns in (2, 4):
            intrinsics = torch.rand(4)  # in the host's memory, where cameras are
            needs = (False, True, True, False, *[True] * 6)
            there_and_back(kernel_backend._Rasterize, needs, options, rand(9, columns), intrinsics, None, *tensors)
        there_and_back(kernel_backend._Rasterize, (*[False] * 8, True, True), options, None, None, None, *tensors)
    image, plane, mask = rand(24, 40, 3), rand(24, 40), torch.ones(24, 40, dtype=torch.bool, device="cuda:0")
    fused, apply = ops.CudaLosses(launcher), loss_operations._Fused
    comparing = partial(fused._photometric, expected=(0.8, -0.2, 0.0), grad=True)
    there_and_back(apply, (False, True, False, False, False), comparing, image, rand(24, 40, 3), mask, None)
    for form, weights in ((False, None), (True, plane)):
        how = NormalOptions(camera, mask, weights, form, form)
        bending = partial(fused._normal_consistency, how=how, expected=1.0, grad=True)
        there_and_back(apply, (False, True, True, True), bending, image, plane, plane)
    there_and_back(apply, (False, True, False), fused._masked_mean, plane, mask)
    cuda_passes.errors(launcher, view, splats, image, mask)
    print(sorted(launched), pointers[0])
    torch.cumsum = lambda x, *_, **__: torch.arange(len(x))  # in host memory
    try:
        cuda_passes.forward(launcher, view, splats, budget=budget)
    except AssertionError as error:
        print("refused:", error)
"""


@pytest.fixture(scope="module")
def said(guard: Path) -> list[str]:
    """Return the output lines of both scripts and the error, from a subprocess, because the guard stays loaded."""
    given = [str(guard), str(Path(__file__).resolve().parents[2] / "helpers")]
    command = [sys.executable, "-c", COMMON + ITERATIONS + "launched.clear()\n" + GRADIENTS, *given]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=dict(os.environ))
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout.splitlines()


def test_an_iteration_of_each_stage_stays_on_the_device(said: list[str]) -> None:
    assert said[0].startswith("['cuda:0']")
    for kernel in ("project_splats", "blend_forward", "photometric_forward", "normal_consistency", "adam_step"):
        assert f"'{kernel}'" in said[0]


def test_gradients_and_splat_errors_stay_on_the_device(said: list[str]) -> None:
    for kernel in (
        "blend_vjp_distortion_abs",
        "blend_vjp_distortion_transmittance_abs",
        "blend_vjp_learning",
        "sum_slots",
        "photometric_vjp",
        "splat_errors",
    ):
        assert f"'{kernel}'" in said[1]


def test_a_tensor_in_host_memory_is_detected(said: list[str]) -> None:
    assert said[2] == "refused: ('ends', device(type='cpu'))"
