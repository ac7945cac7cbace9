"""Plans a table of ``gs2d sweep``: the tasks of all recipes, scenes and seeds."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, get_type_hints

from gs2d.config.arguments import Arg
from gs2d.config.presets import RECIPES, get_recipe
from gs2d.config.recipe import Recipe, validate
from gs2d.config.recipe_files import short_name
from gs2d.config.registry import did_you_mean
from gs2d.config.schedule import scale_schedule
from gs2d.config.serialize import apply_overrides, to_json
from gs2d.contrib.lab.lab_options import SWEEP, TABLES, SweepOptions
from gs2d.contrib.lab.paper_tables import PAPER_TABLES, PaperTable, recipe_table
from gs2d.contrib.lab.scenes import SweepScene, find_scenes
from gs2d.contrib.lab.training_task import TrainingTask, stage_keys
from gs2d.errors import RecipeError
from gs2d.io.run_dir import versions
from gs2d.pipeline.prepare.options import EvaluateOptions, TrainOptions


@dataclass(frozen=True)
class Plan:
    """The scenes of a table, and its tasks by (recipe, scene, seed)."""

    options: SweepOptions
    table: PaperTable
    scenes: tuple[SweepScene, ...]
    cells: Mapping[tuple[str, str, int], TrainingTask]

    @property
    def tasks(self) -> tuple[TrainingTask, ...]:
        """Return each task once; rows with equal recipes share tasks."""
        return tuple({task.name: task for task in self.cells.values()}.values())


def make_plan(options: SweepOptions) -> Plan:
    """Return the plan of a table, and check all options, before any image is read."""
    table = _table(options)
    if not options.seeds or len(set(options.seeds)) != len(options.seeds):
        raise RecipeError(
            f"--seeds must be different whole numbers, got {', '.join(map(str, options.seeds)) or 'none'}"
        )
    for name in ("downscale", "threads", "slots"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise RecipeError(f"--{name} must be a whole number >= 1, got {value}")
    scenes = find_scenes(options.data, options.scenes, protocol=options.protocol, truths=options.ground_truth)
    recipes = {row.recipe: trained_recipe(row.recipe, options) for row in table.rows if row.recipe is not None}
    _check_overrides(options.overrides, [get_recipe(name) for name in recipes])
    cells = {
        (name, scene.name, seed): make_task(options, scene, name, recipe, seed)
        for scene, seed, (name, recipe) in itertools.product(scenes, options.seeds, recipes.items())
    }
    return Plan(options, table, scenes, cells)


def _table(options: SweepOptions) -> PaperTable:
    """Return the table of the requested rows."""
    if options.table != SWEEP:
        return PAPER_TABLES[options.table]
    if not options.recipes:
        raise RecipeError("`gs2d sweep` needs the name of a recipe or more; `gs2d recipes` lists them")
    for name in options.recipes:
        if name not in RECIPES and (near := did_you_mean(name, TABLES)):
            raise RecipeError(f"no recipe and no table of the paper {name!r}{near}")
        get_recipe(name)  # unknown names raise first
    return recipe_table(options.recipes)


def trained_recipe(name: str, options: SweepOptions) -> Recipe:
    """Return a recipe with the schedule and overrides of the options."""
    recipe = scale_schedule(get_recipe(name), options.schedule_scale)
    return validate(apply_overrides(recipe, fitting_overrides(recipe, options.overrides)))


def fitting_overrides(recipe: Recipe, overrides: Sequence[str]) -> tuple[str, ...]:
    """Return the overrides of the recipe itself and of its stages."""
    stages = {stage.name for stage in recipe.stages}
    heads = {text: text.partition("=")[0].split(".") for text in overrides}
    return tuple(text for text in overrides if len(heads[text]) == 1 or heads[text][0] in stages)


def _check_overrides(overrides: Sequence[str], recipes: Sequence[Recipe]) -> None:
    for text in overrides:
        if not any(fitting_overrides(recipe, (text,)) for recipe in recipes):
            stages = dict.fromkeys(stage.name for recipe in recipes for stage in recipe.stages)
            raise RecipeError(f"--set {text} fits no recipe of the table; their stages are {', '.join(stages)}")


def make_task(options: SweepOptions, scene: SweepScene, name: str, recipe: Recipe, seed: int) -> TrainingTask:
    """Return the task that trains a recipe (``trained_recipe`` of ``name``) on a scene."""
    downscale = options.downscale or scene.downscale
    train = TrainOptions(
        scene=scene.path,
        out=options.out / "runs" / f"{scene.name}-{short_name(name)}-s{seed}",
        recipe=name,
        protocol=scene.protocol.name if options.protocol == "auto" else options.protocol,
        robust="auto" if options.table == SWEEP else "off",  # as in the paper
        backend=options.backend,
        format=scene.format,
        downscale=downscale,
        schedule_scale=options.schedule_scale,
        overrides=fitting_overrides(recipe, options.overrides),
        seed=seed,
        resume=True,
        cache=options.cache or options.out / "cache",
        threads=options.threads,
        page=False,  # as large as the splats
    )
    evaluate = None
    if scene.scored or options.lpips_weights is not None:
        evaluate = EvaluateOptions(ground_truth=scene.truth, lpips_weights=options.lpips_weights)
    settings = (str(scene.path.resolve()), scene.protocol, downscale, seed, options.backend, versions()["2dgs-r"])
    return TrainingTask(
        name=train.out.name,
        record=options.out / "jobs" / f"{train.out.name}.json",
        train=train,
        evaluate=evaluate,
        stage_keys=stage_keys((*map(repr, settings), recipe.init_points, recipe.sh_degree), to_json(recipe)["stages"]),
        scores=tuple(_scores(scene, options)),
    )


def _scores(scene: SweepScene, options: SweepOptions) -> Iterator[str]:
    """Yield the scores with their inputs; a run without one of them is scored again."""
    if scene.scored:
        yield f"surface: {scene.truth.resolve() if scene.truth else 'official'}"
    if options.lpips_weights is not None:
        yield f"lpips: {options.lpips_weights.resolve()}"


# -- command lines -----------------------------------------------------------------------------------------------------
def paper_command(options: SweepOptions) -> str:
    """Return the command line of a table."""
    omitted = ("recipes", "slots", "threads", "cluster", "train", "quiet", "verbose", "json")
    return _command(["sweep", *options.recipes], options, omitted)


def commands_of(task: TrainingTask) -> list[str]:
    """Return the `gs2d train` and `gs2d evaluate` commands of a task."""
    words = ["train", str(task.train.scene), "--out", str(task.train.out), "--recipe", str(task.train.recipe)]
    lines = [_command(words, task.train, ("scene", "out", "recipe", "resume"))]
    if task.evaluate is not None:
        lines.append(_command(["evaluate", str(task.train.out)], task.evaluate, ()))
    return lines


def _command(words: Sequence[str], options: Any, omitted: Sequence[str]) -> str:
    """Return a command line: its first words, and each option that differs from the default and is not ``omitted``."""
    line = ["gs2d", *words]
    hints = get_type_hints(type(options), include_extras=True)
    for field in fields(options):
        value = getattr(options, field.name)
        if field.name in omitted or value == field.default:
            continue
        if any(isinstance(mark, Arg) and mark.setting for mark in getattr(hints[field.name], "__metadata__", ())):
            parts = value if isinstance(value, tuple) else (value,)
            text = ",".join(str(part).lower() if isinstance(part, bool) else str(part) for part in parts)
            line += ["--set", f"{field.name}={text}"]
            continue
        flag = "--" + field.name.replace("_", "-")
        if field.name == "overrides":
            line += [word for text in value for word in ("--set", text)]
        elif field.name == "seeds":  # a single number would be a count
            line += [flag, ",".join(map(str, value)) + ("," if len(value) == 1 else "")]
        elif value is False:
            line.append(f"--no-{flag[2:]}")
        else:
            line += [flag, *map(str, value if isinstance(value, tuple) else (value,))]
    return shlex.join(line)
