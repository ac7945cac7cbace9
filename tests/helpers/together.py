"""Single-process batches of several views for comparison, and a program that trains toys in several processes.

Run as a program (``python together.py CASE,CASE FOLDER``), each process runs the cases in order and writes the results
to ``FOLDER/CASE.RANK.pt``. Ranks come from the environment, as with torchrun.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gs2d.config.presets import two_dgs, with_robustness
from gs2d.config.protocols import GENERIC
from gs2d.config.quantities import EXPOSURE, POSES
from gs2d.config.recipe import DenseStart, LossTerm, Recipe, Removal
from gs2d.config.schedule import scale_schedule
from gs2d.errors import Gs2dError
from gs2d.training import events
from gs2d.training.parallel import ProcessGroup, Turn
from gs2d.training.state import TrainState
from gs2d.training.step_result import StepResult
from gs2d.training.trainer import Trainer
from train_toys import backends, grouped, make_scene, short
from wall_scene import wall


class Batch(ProcessGroup):
    """Emulates several processes in one: renders the views of an iteration one by one and averages the gradients."""

    def __init__(self, views: int) -> None:
        super().__init__()
        self.views = views
        self.results: list[StepResult] = []

    @property
    def size(self) -> int:
        return self.views

    def evaluate(
        self,
        turns: Sequence[Turn],
        one: Callable[[Turn], StepResult],
        idle: Callable[[], StepResult],
        *,
        rows: Tensor | None,
        learned: Mapping[str, tuple[int, ...]],
    ) -> tuple[StepResult, Sequence[Mapping[str, Tensor]]]:
        self.results = [_own_signal(one(turn)) for turn in turns]
        total: dict[str, Tensor] = {}
        for result in self.results:
            for name in result.gradients:
                own = result.gradients[name]
                own = own if rows is None or result.rows is not None else own[rows]
                total[name] = total[name] + own if name in total else own.clone()
        mean = {name: tensor / len(turns) for name, tensor in total.items()}
        each = [result.learned for result in self.results]
        return replace(self.results[0], gradients=mean, rows=rows), each

    def gather(self, statistics: Any, result: StepResult, add: Callable[[Any, StepResult], Any]) -> None:
        each = [{name: torch.zeros_like(tensor) for name, tensor in statistics.items()} for _ in self.results]
        for own, one in zip(each, self.results, strict=True):
            add(own, one)
        for name, tensor in statistics.items():
            tensor.add_(sum(own[name] for own in each))

    def mean_losses(self, losses: Any, views: int) -> Mapping[str, float]:
        kinds = dict.fromkeys(kind for result in self.results for kind in result.losses)
        return {kind: sum(float(result.losses.get(kind, 0)) for result in self.results) / views for kind in kinds}


def _own_signal(result: StepResult) -> StepResult:
    """Return a result with its own copy of the signal: all views share one probe, which accumulates."""
    if result.signal is None:
        return result
    signal = result.signal.clone()
    result.signal.zero_()
    return replace(result, signal=signal)


def learning() -> Recipe:
    """Return ``short`` with exposures and poses learned from the third iteration on."""
    return short().with_learned(*(replace(quantity, start=2, decay_steps=20) for quantity in (EXPOSURE, POSES)))


def cached() -> Recipe:
    """Return a recipe whose stage 2 is long enough for cached views; ``ROOM`` holds four of the six."""
    first, second, _ = short().stages
    return Recipe("cached", (replace(first, iterations=3), replace(second, iterations=25)))


def dropping() -> Recipe:
    """Return a recipe with splat dropout."""
    return replace(short(), removal=Removal(decay=0.0, dropout=0.3))


def robust() -> Recipe:
    """Return 15 iterations on a wall, with a dense start, floater removal and a search for shiny surface."""
    made = scale_schedule(with_robustness(two_dgs()), 0.0005)
    start = DenseStart(side=48, min_angle=1.0, adjust=True)
    made = replace(made, dense_start=start, removal=Removal(every=5, decay=0.1))
    made = replace(made, stages=(replace(made.stages[0], densify=None),), sh_degree=1)
    return made.with_loss(LossTerm("normal_smoothness", 0.4))


ROOM = 90_000  # bytes per process for cached views
RECIPES: dict[str, Callable[[], Recipe]] = {
    "cached": cached,
    "robust": robust,
    "short": short,
    "absgs": lambda: short(absgs=True),
    "dropping": dropping,
    "learning": learning,
}


def trained(
    recipe: Recipe, together: ProcessGroup, state: dict[str, Any] | None = None, **options: Any
) -> tuple[TrainState, dict[str, Any]]:
    """Train to the end; return the state, and the recorded losses and resumable states."""
    heard: dict[str, Any] = {"losses": [], "states": []}

    def on_event(event: events.TrainingEvent) -> None:
        if isinstance(event, events.Progress):
            heard["losses"].append((event.stage, event.iteration, dict(event.losses), dict(event.lr)))
            heard["states"].append(trainer.state.state_dict())

    begun = None if state is None else TrainState.from_state_dict(state)
    room = ROOM * together.place.local_size
    given = {"backend": backends()[-1], "progress_every": 1, "stage2_cache_bytes": room} | options
    given["processes"] = together
    scene = wall() if recipe.removal else make_scene()
    trainer = Trainer(scene, recipe, GENERIC, on_event=on_event, state=begun, **grouped(given))
    trainer.run()
    return trainer.state, heard


def flat(value: Any, at: str = "") -> dict[str, Tensor]:
    """Flatten all tensors and numbers of a state, keyed by path."""
    if isinstance(value, dict):
        return {k: v for name, inner in value.items() for k, v in flat(inner, f"{at}/{name}").items()}
    return {at: value if isinstance(value, Tensor) else torch.as_tensor(value)} if value is not None else {}


def free_port() -> int:
    """Return an unused port below 32768, the start of the ephemeral range, unlikely to clash between test workers."""
    first = 15_000 + os.getpid() * 37 % 15_000 + next(_PORTS)
    for port in range(first, 32_768):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise OSError("no port is free")


_PORTS = itertools.count()


def environment(rank: int, size: int, port: int) -> dict[str, str]:
    """Return the environment that torchrun sets for a process."""
    said = {"RANK": rank, "WORLD_SIZE": size, "LOCAL_RANK": rank, "LOCAL_WORLD_SIZE": size, "MASTER_PORT": port}
    own = {"MASTER_ADDR": "127.0.0.1", "OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    return {**os.environ, **own, **{name: str(value) for name, value in said.items()}}


def launch(size: int, words: Sequence[str]) -> list[subprocess.Popen[str]]:
    """Start a Python program in ``size`` processes that connect to each other."""
    port = free_port()
    return [
        subprocess.Popen(
            [sys.executable, *words],
            env=environment(rank, size, port),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(size)
    ]


def ended(processes: Sequence[subprocess.Popen[str]], seconds: float = 600) -> list[tuple[int, str]]:
    """Wait for processes; return exit code and stderr of each."""
    said = [process.communicate(timeout=seconds)[1] for process in processes]
    return [(process.returncode, text) for process, text in zip(processes, said, strict=True)]


def together_in(size: int, cases: Sequence[str], folder: Path) -> dict[str, list[Any]]:
    """Run cases in ``size`` processes; return each process's results by case."""
    for code, text in ended(launch(size, [__file__, ",".join(cases), str(folder)])):
        assert code == 0, text
    found = {case: [folder / f"{case}.{rank}.pt" for rank in range(size)] for case in cases}
    return {case: [torch.load(path, weights_only=False) for path in paths] for case, paths in found.items()}


def do(case: str, many: Any) -> Any:
    """Run one case in this process."""
    if case in RECIPES:
        state, heard = trained(RECIPES[case](), many)
        return {"state": state.state_dict(), "losses": heard["losses"]}
    if case == "resumed":  # in mid-stage: only process 0 passes a state
        whole, heard = trained(short(), many)
        kept = many.broadcast(heard["states"][3]) if many.leads else many.broadcast(None)
        state, _ = trained(short(), many, kept if many.leads else None)
        return {"state": state.state_dict(), "whole": whole.state_dict(), "at": (kept["stage"], kept["step"])}
    if case == "differing":  # a bit of one splat flips in the last process

        def flip(self: Trainer) -> None:
            if self.state.step == 2 and many.place.rank == many.size - 1:
                self.state.splats.means.view(torch.int32)[0, 0] ^= 1
            step(self)

        step, Trainer.step = Trainer.step, flip  # type: ignore[method-assign]
        try:
            trained(short(), many)
        except Gs2dError as error:
            return str(error)
        finally:
            Trainer.step = step  # type: ignore[method-assign]
        return ""
    raise ValueError(case)


def main() -> None:
    """Run the cases named on the command line."""
    from gs2d.pipeline.train.process_group import connected

    torch.set_num_threads(1)
    cases, folder = sys.argv[1].split(","), Path(sys.argv[2])
    with connected("cpu") as many:
        for case in cases:
            torch.save(do(case, many), folder / f"{case}.{many.place.rank}.pt")


if __name__ == "__main__":
    main()
