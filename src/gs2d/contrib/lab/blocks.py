"""``gs2d blocks``: trains a coarse model, cuts it into blocks, trains and merges them.

The tasks are coarse -> partition -> blocks (in parallel) -> merge -> seams -> finish. Their state is in the run folder,
and finished tasks are not run again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gs2d.config.protocols import Protocol
from gs2d.config.serialize import decode
from gs2d.config.serialize import from_json as recipe_from_json
from gs2d.contrib.lab.block_start import TrainedPart, load_start
from gs2d.contrib.lab.execute import Workers, execute
from gs2d.contrib.lab.lab_options import BlocksOptions
from gs2d.contrib.lab.merged import MERGED, SEAM_VIEWS, finish_merged, read_seam_views, write_merged, write_result
from gs2d.contrib.lab.partition import Partition, from_json, make_partition
from gs2d.contrib.lab.settle import (
    block_folder,
    block_recipe,
    coarse_downscale,
    coarse_folder,
    coarse_recipe,
    definition_of,
    fitting_partition,
    partition_folder,
    seam_folder,
    seam_recipe,
    settle,
)
from gs2d.contrib.lab.split import CELLS, SEAMS, read_split, split_model, start_file
from gs2d.contrib.lab.tasks import Task, failures
from gs2d.core.json_files import read_json, write_json
from gs2d.errors import RecipeError, RunError
from gs2d.io.run_dir import LOCK, REPORT, SPLATS, RunFolder, check_claim, is_run, make_folder, open_run
from gs2d.pipeline.prepare.learned_views import with_learned_appearance
from gs2d.pipeline.prepare.limits import use_memory, use_threads
from gs2d.pipeline.prepare.loaded import LoadedRun, difference, finished_splats
from gs2d.pipeline.prepare.options import CommonTraining, Effort, TrainOptions, values
from gs2d.pipeline.prepare.resolve import check_options
from gs2d.pipeline.train.train_run import train
from gs2d.training.events import Notice, OnEvent, ignore

BLOCKS_JSON = "blocks.json"  # in the run folder: the definition of the blocks
COARSE, PARTITION, MERGE, FINISH = "coarse", "partition", "merge", "finish"
RETRIES = 2  # restarts of killed tasks, which may have run out of memory


# -- tasks -------------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class BlocksTask(Task):
    """A task of a training in blocks."""

    options: TrainOptions  # for one training of the whole scene; recipe and protocol are in ``blocks.json``
    step: Callable[[BlocksTask, OnEvent], dict[str, Any]]  # does the work, or continues it
    block: str = ""  # its name, for tasks of one block

    def work(self, on_event: OnEvent) -> dict[str, Any]:
        """Run the step; return entries of the record."""
        return self.step(self, on_event)

    def is_done(self) -> bool:
        """Return whether the task is finished; a skipped block has no outputs."""
        return super().is_done() or bool(self.status().get("skipped"))

    def with_threads(self, threads: int) -> BlocksTask:
        """Return the task with another number of CPU threads."""
        return replace(self, options=replace(self.options, threads=threads))

    def protocol(self) -> Protocol:
        """Return the protocol of all blocks."""
        protocol: Protocol = decode(settled_of(self.options.out)["protocol"], Protocol, "protocol")
        return protocol

    def train(self, part: TrainedPart, out: Path, on_event: OnEvent, *, downscale: int | None = None) -> RunFolder:
        """Train a part of the scene, or continue its training."""
        self.limit()
        downscale = self.options.downscale if downscale is None else downscale
        options = replace(self.options, memory=self.memory, out=out, downscale=downscale)
        return train(options, on_event, prepare=part.prepare)

    def limit(self) -> None:
        """Limit threads and memory to those of the task."""
        use_threads(self.options.threads)
        use_memory(self.memory)

    def partition(self) -> Partition:
        """Return the partition."""
        return from_json(settled_of(self.options.out)["partition"])

    def settled(self, on_event: OnEvent) -> LoadedRun:
        """Return the run settings that all blocks share, with the scene."""
        self.limit()
        data = settled_of(self.options.out)
        options = replace(self.options, memory=self.memory, protocol=self.protocol(), test_every=None)
        settled = settle(options, on_event, recipe_from_json(data["recipe"]))
        check_capture(self.options.out, data, settled.resolved.scene.digest)
        return settled


def train_coarse(task: BlocksTask, on_event: OnEvent) -> dict[str, Any]:
    """Train the coarse model of the whole scene."""
    settled, partition = task.settled(on_event), task.partition()
    downscale = coarse_downscale(settled.scene, partition, task.options.downscale or 1)
    recipe, out = coarse_recipe(settled.recipe, partition), coarse_folder(task.options.out)
    run = task.train(TrainedPart(recipe=recipe, protocol=settled.protocol), out, on_event, downscale=downscale)
    return {"stages": run.metrics()["stages"]}


def cut_coarse(task: BlocksTask, on_event: OnEvent) -> dict[str, Any]:
    """Cut the coarse model into blocks."""
    out, settled = task.options.out, task.settled(on_event)
    coarse = open_run(coarse_folder(out))
    make_folder(partition_folder(out))
    splats = finished_splats(coarse).to(settled.backend.device)
    split = split_model(
        settled.trained(splats, with_learned_appearance(coarse, settled.recipe, settled.scene)),
        task.partition(),
        partition_folder(out),
        on_event,
    )
    return {"blocks": {block.name: len(block.views) for block in split.blocks}}


def train_block(task: BlocksTask, on_event: OnEvent) -> dict[str, Any]:
    """Train one block, with the coarse model frozen around it."""
    out, partition = task.options.out, task.partition()
    split = read_split(partition_folder(out))
    blocks = {block.name: block for block in split.blocks}
    if task.block not in blocks:
        raise RunError(f"{partition_folder(out)} has no block {task.block}; delete the folder and run this again")
    block = blocks[task.block]
    if block.skipped:
        return {"skipped": block.skipped}
    whole = recipe_from_json(settled_of(out)["recipe"])
    recipe = block_recipe(whole, partition, block)
    region = split.cells.region(split.cells.names.index(task.block))
    start = start_file(partition_folder(out), task.block)
    part = TrainedPart(
        recipe=recipe,
        protocol=task.protocol(),
        views=block.views,
        extent=block.extent if partition.extent == "block" else None,
        **load_start(coarse_folder(out) / SPLATS, start, recipe, region),
    )
    run = task.train(part, block_folder(out, task.block), on_event)
    return {"stages": run.metrics()["stages"]}


def merge_blocks(task: BlocksTask, on_event: OnEvent) -> dict[str, Any]:
    """Crop each block to its cell and join them."""
    return write_merged(task.settled(on_event), task.options, task.partition(), on_event)


def train_seams(task: BlocksTask, on_event: OnEvent) -> dict[str, Any]:
    """Train the splats at seams once more, with all others frozen, and write the scene."""
    out, settled, partition = task.options.out, task.settled(on_event), task.partition()
    views = read_seam_views(out)
    if views:
        start = start_file(partition_folder(out), SEAMS)
        trained = [len(block.views) for block in read_split(partition_folder(out)).blocks if not block.skipped]
        recipe = seam_recipe(settled.recipe, partition, len(views) * len(trained) / max(1, sum(trained)))
        part = TrainedPart(
            recipe=recipe,
            protocol=settled.protocol,
            views=views,
            **load_start(out / MERGED, start, recipe),
        )
        task.train(part, seam_folder(out), on_event)
    return {"splats": write_result(settled, task.options, partition, on_event)}


def finish_scene(task: BlocksTask, on_event: OnEvent) -> dict[str, Any]:
    """Score and mesh the merged scene, write its page and report."""
    settled = task.settled(on_event)
    return finish_merged(settled, task.options, on_event)


def tasks_of(options: TrainOptions, partition: Partition, memory: float | None) -> list[BlocksTask]:
    """Return all tasks, each after the tasks that it needs."""
    out, jobs = options.out, options.out / "jobs"

    def common(name: str, after: Sequence[str] = ()) -> dict[str, Any]:
        return {"name": name, "record": jobs / f"{name}.json", "after": tuple(after), "retries": RETRIES}

    names = [f"block-{name}" for name in partition.names]
    whole: dict[str, Any] = {"options": options, "alone": True, "memory": options.memory}
    coarse, cells = coarse_folder(out) / SPLATS, partition_folder(out) / CELLS
    merged = (out / MERGED, out / SEAM_VIEWS)
    starts = {name: start_file(partition_folder(out), name) for name in partition.names}
    return [
        BlocksTask(**common(COARSE), **whole, step=train_coarse, outputs=(coarse,)),
        BlocksTask(
            **common(PARTITION, [COARSE]), **whole, step=cut_coarse, inputs=(coarse,), outputs=(cells, *starts.values())
        ),
        *(
            BlocksTask(
                **common(task, [PARTITION]),
                options=options,
                memory=memory,
                step=train_block,
                block=name,
                inputs=(coarse, cells, starts[name]),
                outputs=(block_folder(out, name) / SPLATS,),
            )
            for task, name in zip(names, partition.names, strict=True)
        ),
        BlocksTask(**common(MERGE, names), **whole, step=merge_blocks, inputs=(coarse, cells), outputs=merged),
        BlocksTask(**common(SEAMS, [MERGE]), **whole, step=train_seams, inputs=merged, outputs=(out / SPLATS,)),
        BlocksTask(
            **common(FINISH, [SEAMS]), **whole, step=finish_scene, inputs=(out / SPLATS,), outputs=(out / REPORT,)
        ),
    ]


# -- the command -------------------------------------------------------------------------------------------------------
def blocks(options: BlocksOptions, on_event: OnEvent = ignore) -> RunFolder:
    """Train a capture in blocks; the folder is the run of the merged scene.

    After an interruption the same call continues, and the result is byte-identical; so do finished tasks after an
    error.
    """
    partition = make_partition(options.blocks, options.partition_changes)
    if options.slots is not None and options.slots < 1:
        raise RecipeError(f"--set slots must be a whole number >= 1, got {options.slots}")
    training = training_of(options)
    check_options(training)
    check_folder(options.out)
    use_threads(options.threads)
    share = _share(options.memory, None if options.cluster else options.slots)  # on a cluster: of each machine
    use_memory(share)
    begun = (options.out / BLOCKS_JSON).exists()
    if not begun and is_run(options.out):  # without blocks
        return _one_training(options, training, on_event)
    if begun and training.downscale is None:
        training = replace(training, downscale=settled_of(options.out).get("downscale"))
    settled = settle(training, on_event)
    if not partition.grid and begun:
        saved = settled_of(options.out)["partition"]
        partition = replace(from_json(saved), **_requested(partition))
    elif not partition.grid:
        fitting = fitting_partition(settled, training, partition, on_event)
        if fitting is None:
            return _one_training(options, training, on_event)
        partition = fitting
    if partition.blocks == 1:
        return _one_training(options, training, on_event)
    use_memory(options.memory)
    definition = definition_of(settled, training, partition)
    if begun:
        check_same_definition(options.out, definition)
    settings = settled.resolved
    training = replace(training, downscale=settings.downscale, schedule_scale=settings.schedule_scale)
    tasks = tasks_of(replace(training, recipe="", overrides=(), resume=True), partition, share)

    def write() -> None:
        if not (options.out / BLOCKS_JSON).exists():
            write_json(options.out / BLOCKS_JSON, definition)
        check_same_definition(options.out, definition)

    execute(
        tasks,
        options.out,
        on_event,
        workers=Workers(**values(Workers, options)),
        before=write,
    )
    _check_all_done(tasks)
    return RunFolder(options.out)


def _one_training(options: BlocksOptions, training: TrainOptions, on_event: OnEvent) -> RunFolder:
    """Train without blocks."""
    if options.cluster is not None:
        on_event(Notice("one training, without blocks: it runs on this machine, not on the cluster"))
    return train(training, on_event)


def training_of(options: BlocksOptions) -> TrainOptions:
    """Return the options of one training of the whole scene."""
    return TrainOptions(
        scene=options.scene,
        out=options.out,
        format=options.format,
        masks=options.masks,
        backend=options.backend,
        seed=options.seed,
        threads=options.threads,
        resume=True,
        memory=options.memory,
        **values(Effort, options),
        **(values(CommonTraining, options) | {"overrides": options.recipe_changes}),
    )


def check_folder(out: Path) -> None:
    """Raise if a folder contains other files than those of a training in blocks."""
    if (out / BLOCKS_JSON).exists():
        return
    check_claim(out, resume=True, overwrite=False, allowed=(LOCK, "jobs"))


def settled_of(out: Path) -> dict[str, Any]:
    """Return the content of ``blocks.json``, or raise DataError or RunError."""
    data = read_json(out / BLOCKS_JSON)
    if isinstance(data, dict) and data.keys() >= {"recipe", "protocol", "partition"}:
        return data
    raise RunError(f"{out / BLOCKS_JSON} must hold recipe, protocol and partition, got something else; restore it")


def check_same_definition(out: Path, definition: dict[str, Any]) -> None:
    """Raise RunError, with the first difference, if the folder was begun with another definition."""
    before = settled_of(out)
    for name, value in definition.items():
        old = before.get(name)
        if name == "capture":
            check_capture(out, before, value["digest"])
        elif old != value:
            raise RunError(
                f"{out} was begun with another {name}{difference(old, value)}; continue with the same options, or "
                "choose another --out"
            )


def check_capture(out: Path, before: dict[str, Any], digest: str) -> None:
    """Raise RunError if the capture is not that of ``blocks.json``."""
    old = before.get("capture")
    if not isinstance(old, dict) or old.get("digest") != digest:
        where = old.get("path") if isinstance(old, dict) else "the capture"
        raise RunError(
            f"{out} was begun with another capture: photographs, cameras or points of {where} changed; restore them, "
            "or choose another --out"
        )


def _requested(partition: Partition) -> dict[str, Any]:
    """Return the requested fields of a partition with an open grid, without those that were set by memory."""
    decided = ("grid", "splats", "coarse")
    return {name: value for name, value in vars(partition).items() if name not in decided}


def _share(memory: float | None, slots: int | None) -> float | None:
    return None if memory is None else max(memory / (slots or 1), 0.5)


def _check_all_done(tasks: Sequence[Task]) -> None:
    failed = failures(tasks)
    own = {name: reason for name, reason in failed.items() if not reason.startswith("not started: ")} or failed
    if own:
        name, reason = next(iter(own.items()))
        more = f" (and {len(own) - 1} more, in {tasks[0].record.parent})" if len(own) > 1 else ""
        raise RunError(f"{name} failed: {reason}{more}; finished tasks are kept; fix that and run the command again")
