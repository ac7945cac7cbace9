"""The recipe of each row of the tables of the 2DGS-R paper, besides ``2dgs`` and ``2dgs-r``.

Pure Python; never imports torch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType

from gs2d.config.presets import (
    PHOTOMETRIC,
    add_recipe,
    appearance,
    rates_after_surface,
    refine,
    surface,
    two_dgs,
    two_dgs_r,
)
from gs2d.config.recipe import ALPHA, SH, GradDensify, LossTerm, Recipe, Stage

# AbsGS, the numbers of its released code: clone 2e-4 signed, split 4e-4 absolute, percent_dense 0.001, cull 0.005,
# reset every 3000, opacity capped at 0.8 every 500. "D" in the paper's table.
ABSGS_DEFAULT = GradDensify(
    absolute=True,
    abs_threshold=4e-4,
    percent_dense=0.001,
    opacity_cull=0.005,
    cap_every=500,
    reset_at_start_on_white=False,  # stage 3 starts from a trained scene, not from random points
)
# "A": "more sensitive thresholds for size and positional gradient", without numbers in the paper. Half of D's gradient
# thresholds were best in a sweep on lego (`python -m benchmarks.absgs`); the size threshold had no effect.
ABSGS_ADJUSTED = replace(ABSGS_DEFAULT, grad_threshold=1e-4, abs_threshold=2e-4, percent_dense=0.0005)


def continue_training() -> Stage:
    """Return a stage that continues stage 1 with its last rates and moments, NC, and no densification."""
    return Stage(
        "continue",
        30_000,
        losses=(*PHOTOMETRIC, LossTerm("normal_consistency", 0.05)),
        lr=rates_after_surface(),
        moments="kept",
    )


def two_dgs_60k(*, name: str = "2dgs-60k") -> Recipe:
    """Return the control of 2DGS-R: 2DGS for as many iterations; its first stage is that of ``2dgs``."""
    return Recipe(name, (surface(), continue_training()))


def _register_rows() -> None:
    def add(name: str, about: str, build: Callable[..., Recipe]) -> None:
        add_recipe(name, about, build, module=__name__)

    add("2dgs-no-nc", "2DGS without normal consistency", partial(two_dgs, nc=0.0))
    add("2dgs-60k", "2DGS for as many iterations as 2DGS-R: its control", two_dgs_60k)
    for label, nc in {"distortion": 0.05, "distortion-no-nc": 0.0}.items():
        about = f"Table 1: protocol's distortion weight (100/10), NC {nc:g}"
        add(f"2dgs-{label}", about, partial(two_dgs, nc, None))
    for nc in (0.1, 0.3):
        add(f"2dgs-nc-{nc}", f"Table 1: NC {nc}", partial(two_dgs, nc))
    for k in (3, 5, 10, 30, 50):
        add(f"2dgs-r-k{k}", f"K ablation: the worst {k} %", partial(two_dgs_r, stage_2=appearance(float(k))))
    for label, freeze in {"none": (), "alpha-sh": ALPHA + SH, "sh": SH}.items():
        about = f"Freeze ablation: {', '.join(freeze) or 'nothing'} in stage 3"
        add(f"2dgs-r-freeze-{label}", about, partial(two_dgs_r, stage_3=refine(freeze=freeze)))
    module_ii = partial(two_dgs_r, stage_3=refine(nc=0.0, freeze=()))
    add("2dgs-r-module-ii", "Module row II: clone; opacity free, no NC in stage 3", module_ii)
    add("2dgs-r-module-iii", "Module row III: II with opacity frozen", partial(two_dgs_r, stage_3=refine(nc=0.0)))
    for label, densify in {"d": ABSGS_DEFAULT, "a": ABSGS_ADJUSTED}.items():
        stage_3 = refine(freeze=(), densify=densify)
        about = f"AbsGS-{label.upper()} in stage 3 instead of the clone; opacity free"
        add(f"2dgs-r-absgs-{label}", about, partial(two_dgs_r, stage_3=stage_3))


_register_rows()

# Tables of the paper: row label -> recipe. "tab:..." are its LaTeX labels.
TABLES: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "regularisation": {  # tab:alpha_beta
            "alpha=0 beta=0": "2dgs-no-nc",
            "alpha=100/10 beta=0": "2dgs-distortion-no-nc",
            "alpha=100/10 beta=0.05": "2dgs-distortion",
            "alpha=0 beta=0.05": "2dgs",
            "alpha=0 beta=0.1": "2dgs-nc-0.1",
            "alpha=0 beta=0.3": "2dgs-nc-0.3",
        },
        "benchmark": {  # tab:benchmark, and a control
            "2DGS": "2dgs",
            "2DGS (w/o NC)": "2dgs-no-nc",
            "2DGS-R": "2dgs-r",
            "2DGS (60k)": "2dgs-60k",
        },
        "k": {"K=1": "2dgs-r", **{f"K={k}": f"2dgs-r-k{k}" for k in (3, 5, 10, 30, 50)}},  # tab:ablation_K
        "freeze": {  # tab:ablation_freeze
            "(,)": "2dgs-r-freeze-none",
            "(alpha,SHs)": "2dgs-r-freeze-alpha-sh",
            "(SHs)": "2dgs-r-freeze-sh",
            "(alpha)": "2dgs-r",
        },
        "modules": {  # tab:ab_module
            "(I)": "2dgs",
            "(II)": "2dgs-r-module-ii",
            "(III)": "2dgs-r-module-iii",
            "(IV)": "2dgs-r",
        },
        "absgs": {  # tab:absgs
            "2DGS (w/o NC)": "2dgs-no-nc",
            "2DGS (w NC)": "2dgs",
            "2DGS-R (AbsGS-D)": "2dgs-r-absgs-d",
            "2DGS-R (AbsGS-A)": "2dgs-r-absgs-a",
            "2DGS-R (ours)": "2dgs-r",
        },
    }
)
