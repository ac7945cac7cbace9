"""Run ``gs2d`` in one of several processes, without mesh and report.

``python together_run.py [signal=RANK:STEP:NUMBER] [seed=RANK:SEED] WORDS...``: the process of this rank uses another
seed, or sends itself a signal at the start of a step (counted over all stages) unless it was restarted.
"""

from __future__ import annotations

import itertools
import os
import sys

import gs2d.cli
import gs2d.pipeline.train.train_run as pipeline
from gs2d.io.splat_ply import write_splats
from gs2d.training.trainer import Trainer


def main() -> None:
    """Run the command and exit with its code."""
    rank, words = int(os.environ.get("RANK", "0")), sys.argv[1:]
    while "=" in words[0]:
        name, _, value = words.pop(0).partition("=")
        where, *numbers = map(int, value.split(":"))
        if where != rank or os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") != "0":
            continue
        if name == "seed":
            words += ["--seed", str(numbers[0])]
        else:
            _signalled(*numbers)
    pipeline.finish = lambda run, trained, *_, **__: write_splats(run.file("splats.ply"), trained.splats)
    gs2d.cli.main(words)


def _signalled(at: int, number: int) -> None:
    step, count = Trainer.step, itertools.count(1)

    def signalled(self: Trainer) -> None:
        if next(count) == at:
            os.kill(os.getpid(), number)
        step(self)

    Trainer.step = signalled  # type: ignore[method-assign]


if __name__ == "__main__":
    main()
