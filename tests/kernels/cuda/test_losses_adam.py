"""The CUDA Adam, executed on the CPU by the emulator, against torch's fused Adam: rows, frozen rows, the skip flag."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.optim.adam import adam

import emulate
from gs2d.kernels.cuda.adam import AdamUpdate, adam_step

WRITTEN = ("parameter", "mean", "square")
BETAS = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-15}
SHAPES = {"means": (3,), "quats": (4,), "log_scales": (2,), "opacity_logits": (), "sh0": (1, 3), "shN": (15, 3)}


def attribute(count: int, shape: tuple[int, ...], step: int = 7, seed: int = 0) -> AdamUpdate:
    """Parameters of different sizes, moments of some steps, gradients with exact zeros."""
    g = torch.Generator().manual_seed(seed)

    def rand() -> Tensor:
        return torch.randn(count, *shape, generator=g)

    gradient = torch.where(rand() < -1, 0.0, 1e-3 * rand())
    parameter = rand() * 10.0 ** (4 * rand() - 4).clamp(max=1)
    return AdamUpdate(parameter, 1e-3 * rand(), 1e-6 * rand() ** 2, gradient, 1.6e-4 * (1 + seed), step)


def copied(update: AdamUpdate) -> AdamUpdate:
    return replace(update, **{name: getattr(update, name).clone() for name in WRITTEN})


def by_torch(update: AdamUpdate) -> AdamUpdate:
    """The same step, of all rows."""
    out = copied(update)
    step = torch.tensor(float(update.step - 1))
    lists = [[t] for t in (out.parameter, out.gradient, out.mean, out.square)]
    adam(
        *lists, [], [step], fused=True, amsgrad=False, beta1=BETAS["beta1"], beta2=BETAS["beta2"], eps=BETAS["eps"],
        lr=update.rate, weight_decay=0.0, maximize=False,
    )  # fmt: skip
    return out


def assert_same(found: AdamUpdate, expected: AdamUpdate) -> None:
    for name in WRITTEN:
        assert torch.equal(getattr(found, name), getattr(expected, name)), name


def assert_stepped(found: AdamUpdate, expected: AdamUpdate, start: AdamUpdate) -> None:
    """To the last digits (torch contracts differently from one processor to another), and not where it began."""
    for name in WRITTEN:
        a, b, before = getattr(found, name), getattr(expected, name), getattr(start, name)
        assert bool(((a - b).abs() <= 5e-7 * (b.abs() + before.abs())).all()), name
        assert bool((a != before).any())


def test_all_attributes_take_torchs_fused_step_in_one_launch(emulator: emulate.Emulator) -> None:
    """70 rows of 45 are several blocks of 512; the others end within one."""
    launched = []

    class Counting:
        def launch(self, name: str, *arguments: object) -> None:
            launched.append(name)
            emulator.launch(name, *arguments)  # type: ignore[arg-type]

    updates = [attribute(70, shape, seed=k) for k, shape in enumerate(SHAPES.values())]
    before, expected = [copied(update) for update in updates], [by_torch(update) for update in updates]
    adam_step(updates, **BETAS, launcher=Counting())
    assert launched == ["adam_step"]
    for update, exact, start in zip(updates, expected, before, strict=True):
        assert_stepped(update, exact, start)


def test_rows_that_are_not_trained_keep_every_bit(emulator: emulate.Emulator) -> None:
    trained = torch.rand(70, generator=torch.Generator().manual_seed(1)) < 0.3
    for shape in SHAPES.values():
        start = attribute(70, shape)
        start.gradient[~trained] = float("nan")  # is not read
        whole = by_torch(start)
        for choice in ({"trained": trained}, {"rows": trained.nonzero().squeeze(1)}):
            found = replace(copied(start), **choice)  # type: ignore[arg-type]
            adam_step([found], **BETAS, launcher=emulator)
            assert_stepped(rows_of(found, trained), rows_of(whole, trained), rows_of(start, trained))
            assert_same(rows_of(found, ~trained), rows_of(start, ~trained))


def rows_of(update: AdamUpdate, rows: Tensor) -> AdamUpdate:
    return replace(update, **{name: getattr(update, name)[rows] for name in WRITTEN})


def test_a_compact_gradient_is_that_of_its_rows_in_their_order(emulator: emulate.Emulator) -> None:
    start, rows = attribute(40, (15, 3)), torch.tensor([39, 0, 7])
    whole = by_torch(start)
    found = replace(copied(start), rows=rows, gradient=start.gradient[rows], compact=True)
    adam_step([found], **BETAS, launcher=emulator)
    assert_stepped(rows_of(found, rows), rows_of(whole, rows), rows_of(start, rows))
    others = torch.ones(40, dtype=torch.bool)
    others[rows] = False
    assert_same(rows_of(found, others), rows_of(start, others))


def test_an_overflowed_step_changes_nothing(emulator: emulate.Emulator) -> None:
    start = attribute(20, (4,))
    stopped, going = copied(start), copied(start)
    adam_step([stopped], **BETAS, launcher=emulator, skip=torch.tensor(1, dtype=torch.int32))
    adam_step([going], **BETAS, launcher=emulator, skip=torch.tensor(0, dtype=torch.int32))
    assert_same(stopped, start)
    assert_stepped(going, by_torch(start), start)
