"""``--help``: what one needs first; ``--help-all``: everything. It loads no torch, so that it is instant."""

from __future__ import annotations

from collections.abc import Sequence

import gs2d
from gs2d.cli.arguments import NAMES, Option, about, options_of
from gs2d.cli.commands import Common
from gs2d.cli.layout import entries, terminal_width, wrapped
from gs2d.pipeline.prepare.options import CommonTraining, Finding, HowItRuns, Training

_SLOGAN = "Photographs in; a surface mesh and a scene of 2D Gaussian splats out."
_FIRST_DAY = (
    ("gs2d doctor", "what this machine can run, and how to get the rest"),
    ("gs2d demo", "try everything on a small synthetic scene: minutes"),
    ("gs2d reconstruct PHOTOS --out RUN", "photographs or a video to cameras, splats, mesh, report and page"),
    ("gs2d view RUN", "look at a run in the browser, while it is served"),
    ("gs2d mesh RUN --texture", "the mesh once more, with a texture or other settings"),
)
GROUPS: dict[str, tuple[str, ...]] = {
    "To begin with": ("doctor", "demo", "reconstruct", "view", "completion"),
    "Step by step": ("poses", "plan", "train", "blocks", "mesh"),
    "Look, keep and share": ("info", "render", "page", "export", "report"),
    "Real-world coordinates": ("georeference", "orthophoto"),
    "Measure and compare": ("evaluate", "recipes", "sweep", "paper"),
}
_PROGRAM_OPTIONS = (
    ("--version", "Print the version."),
    ("--help", "This list; `gs2d COMMAND --help`: what one needs first of a command."),
    ("--help-all", "Every option of every command; `gs2d COMMAND --help-all`: of one."),
)
_FIRST: dict[str, tuple[str, ...]] = {  # options that `--help` explains; of other commands all but those of every one
    "demo": ("out", "schedule_scale", "viewer", "resume", "overwrite"),
    "reconstruct": ("photos", "out", "quality", "texture", "viewer", "resume", "overwrite"),
    "poses": ("photos", "out", "frames", "camera_model", "max_size", "overwrite"),
    "plan": ("scene", "quality", "recipe", "schedule_scale", "downscale", "memory", "disk"),
    "train": (
        "scene", "out", "quality", "recipe", "schedule_scale", "downscale", "exposure", "viewer", "resume", "overwrite"
    ),
    "blocks": ("scene", "out", "blocks", "recipe", "schedule_scale", "downscale", "memory", "slots"),
    "mesh": ("run", "out", "texture", "voxel", "bbox", "unbounded"),
    "render": ("run", "split", "orbit", "flight", "width", "video", "out"),
    "evaluate": ("run", "ground_truth", "thresholds", "lpips_weights"),
    "paper": ("table", "data", "out", "scenes", "schedule_scale", "train"),
    "sweep": ("recipes", "data", "out", "seeds", "schedule_scale", "train"),
}  # fmt: skip
_OWN = "Of this command"
TITLES = {  # in the order in which they are shown
    Finding: "Cameras of photographs",
    CommonTraining: "Training",
    Training: "Training",
    HowItRuns: "How it runs",
    Common: "What is printed",
}


def first_day() -> list[str]:
    """Return what ``gs2d`` alone shows: the five commands of a first day."""
    width = terminal_width()
    return [
        *wrapped(f"gs2d {gs2d.__version__}. {_SLOGAN}", width),
        "",
        "usage: gs2d COMMAND [OPTIONS]",
        "",
        *entries(_FIRST_DAY, width),
        "",
        *wrapped(
            "`gs2d --help` lists all commands, `gs2d COMMAND --help` what one needs of a command, "
            "`gs2d --version` the version.",
            width,
        ),
    ]


def program_help(*, everything: bool = False) -> list[str]:
    """Return the help of ``gs2d``: all commands in groups; with ``everything`` all options of each, too."""
    width = terminal_width()
    lines = ["usage: gs2d COMMAND [OPTIONS]", "", *wrapped(_SLOGAN, width)]
    for title, names in GROUPS.items():
        lines += ["", f"{title}:", *entries([(name, about(NAMES[name])) for name in names], width)]
    lines += ["", "Options:", *entries(_PROGRAM_OPTIONS, width)]
    if everything:
        for names in GROUPS.values():
            for name in names:
                lines += ["", "-" * min(width, 40), *command_help(name, everything=True)]
    return lines


def command_help(name: str, *, everything: bool = False) -> list[str]:
    """Return the help of a command: the options needed first and the number of the others, or all of them in groups."""
    width, options = terminal_width(), options_of(NAMES[name])
    needed = [option for option in options if option.required or not option.flags]
    words = sorted(needed, key=lambda option: bool(option.flags))
    usage = " ".join(option.usage if option.required else f"[{option.usage}]" for option in words)
    lines = wrapped(f"gs2d {name} {usage} [OPTIONS]".replace("  ", " "), width, first="usage: ", rest="  ")
    lines += ["", *wrapped(about(NAMES[name]), width)]
    groups = _groups(name, options)
    if everything:
        return [*lines, *(line for title in groups for line in ("", f"{title}:", *_explained(groups[title], width)))]
    if first := groups.pop("First", []):
        lines += ["", *_explained(first, width)]
    if more := len(options) - len(first):
        lines += ["", f"{more} more options: gs2d {name} --help-all"]
    return lines


def _first(name: str, options: Sequence[Option]) -> list[Option]:
    """Return the options that are explained at once, in the order in which they are needed."""
    if name not in _FIRST:
        return _needed_first([option for option in options if option.owner is not Common])
    by_field = {option.field: option for option in options}
    return [by_field[field] for field in _FIRST[name]]


def _needed_first(options: Sequence[Option]) -> list[Option]:
    return sorted(options, key=lambda option: (bool(option.flags), not option.required))


def _groups(name: str, options: Sequence[Option]) -> dict[str, list[Option]]:
    """All options by heading: those of the first help, the others of the command itself, then what it shares."""
    groups: dict[str, list[Option]] = {title: [] for title in ("First", _OWN, *TITLES.values())}
    groups["First"] = first = _first(name, options)
    for option in options:
        if option not in first:
            groups[TITLES.get(option.owner, _OWN)].append(option)
    return {title: group for title, group in groups.items() if group}


def _explained(options: Sequence[Option], width: int) -> list[str]:
    return entries([(option.usage, option_text(option)) for option in options], width)


def option_text(option: Option) -> str:
    """Return the help of an option: its docstring, the values where no room was before, and the default."""
    values = "" if all(choice in option.usage for choice in option.choices) else f" {', '.join(option.choices)}."
    said = "default:" in option.about or option.kind is bool or option.default in (None, (), "")
    return option.about + values + ("" if said else f" (default: {_shown(option.default)})")


def _shown(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
