"""The commands that make a table, and each of its runs."""

from __future__ import annotations

import shlex

from gs2d.experiments.execute import SweepJob
from gs2d.experiments.plan import PaperOptions
from gs2d.experiments.tables import SWEEP
from gs2d.pipeline.options import TrainOptions


def paper_command(options: PaperOptions) -> str:
    """The command that makes this table."""
    table = ["sweep", *options.recipes] if options.table == SWEEP else ["paper", options.table]
    words = ["gs2d", *table, "--data", str(options.data), "--out", str(options.out)]
    words += ["--scenes", *options.scenes] if options.scenes else []
    if options.schedule_scale != 1.0:
        words += ["--schedule-scale", str(options.schedule_scale)]
    if options.downscale is not None:
        words += ["--downscale", str(options.downscale)]
    if options.seeds != (0,):  # one number alone would be a count
        words += ["--seeds", ",".join(map(str, options.seeds)) + ("," if len(options.seeds) == 1 else "")]
    for name in ("protocol", "backend"):
        if getattr(options, name) != "auto":
            words += [f"--{name}", getattr(options, name)]
    for name in ("cache", "truth", "lpips_weights"):
        if getattr(options, name) is not None:
            words += [f"--{name.replace('_', '-')}", str(getattr(options, name))]
    for text in options.overrides:
        words += ["--set", text]
    return shlex.join(words)


def commands_of(job: SweepJob) -> list[str]:
    """The `gs2d train` and `gs2d evaluate` lines that do what a job does."""
    plain, train = TrainOptions(scene=job.train.scene, out=job.train.out), job.train
    words = ["gs2d", "train", str(train.scene), "--out", str(train.out), "--recipe", str(train.recipe)]
    for name in ("protocol", "format", "backend", "schedule_scale", "downscale", "seed", "threads", "cache"):
        if getattr(train, name) != getattr(plain, name):
            words += [f"--{name.replace('_', '-')}", str(getattr(train, name))]
    words += [] if train.page else ["--no-page"]
    for text in train.overrides:
        words += ["--set", text]
    lines = [shlex.join(words)]
    if job.evaluate is not None:
        score = ["gs2d", "evaluate", str(train.out)]
        if job.evaluate.ground_truth is not None:
            score += ["--ground-truth", str(job.evaluate.ground_truth)]
        if job.evaluate.lpips_weights is not None:
            score += ["--lpips-weights", str(job.evaluate.lpips_weights)]
        lines.append(shlex.join(score))
    return lines
