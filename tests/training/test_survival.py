"""No schedule scale kills the scene: N never falls below half of what it was before an opacity reset."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from fake_backends import altered
from gs2d.config.presets import get_recipe, surface
from gs2d.config.protocols import GENERIC, NERF_SYNTHETIC, Protocol
from gs2d.config.recipe import GradDensify, LearningRates, LossTerm, Recipe
from gs2d.config.schedule import scale_schedule
from gs2d.core.camera import Camera
from gs2d.core.splats import Splats
from gs2d.data.scene import Scene
from gs2d.errors import BackendError
from gs2d.render.backends import PLAIN, Backend, get_backend
from gs2d.render.types import RasterSettings, RenderOutput
from gs2d.training import events
from gs2d.training.trainer import Trainer

BLACK = GENERIC
WHITE = replace(GENERIC, background=NERF_SYNTHETIC.background)


def opacity_model() -> Backend:
    """A rasterizer in which every second splat is seen, in turn, and the picture wants all of them denser.

    With Adam's betas at 0 each logit that is seen rises by exactly the rate, 0.05: the most that Adam's step is good
    for in the long run, and far less than it does just after its moments were zeroed.
    """
    turn = [0]

    def rasterize(
        splats: Splats, camera: Camera, settings: RasterSettings, probe: torch.Tensor | None = None
    ) -> RenderOutput:
        turn[0] += 1
        seen = (torch.arange(len(splats)) + turn[0]) % 2 == 0
        sign = 1.0 if settings.background[0] == 0.0 else -1.0  # towards the photograph, which is grey
        pull = sign * 1e-6 * (splats.opacity_logits * seen).sum()
        color = torch.tensor(settings.background).expand(camera.height, camera.width, 3) + pull
        flat = torch.zeros(camera.height, camera.width)
        if probe is not None:
            color = color + 0.0 * probe.sum()
        return RenderOutput(color, flat, torch.zeros(camera.height, camera.width, 3), flat, flat, flat, seen.float())

    def no_errors(*args: object) -> torch.Tensor:
        raise AssertionError("not ranked here")

    return altered(PLAIN, rasterize=rasterize, splat_errors=no_errors)


def first_stage(factor: float, **changes: object) -> Recipe:
    """Stage 1 of 2DGS until densification ends, for the opacity model."""
    stage = scale_schedule(get_recipe("2dgs"), factor).stages[0]
    assert stage.densify is not None
    return Recipe(
        "model",
        (
            replace(
                stage,
                iterations=stage.densify.stop,
                train={"opacity_logits": "all"},
                losses=(LossTerm("l1", 1.0),),
                lr=LearningRates(beta1=0.0, beta2=0.0),
                densify=replace(stage.densify, **changes),  # type: ignore[arg-type]
            ),
        ),
        sh_degree=0,
    )


def least_after_resets(scene: Scene, recipe: Recipe, protocol: Protocol, backend: Backend | str) -> list[float]:
    """Per opacity reset: the least N until the next one, divided by N just before it."""
    ratios: list[list[float]] = []
    before = [0]

    def on_event(event: events.Event) -> None:
        if isinstance(event, events.OpacityLimited) and event.reset:
            before[0] = len(trainer.splats)
            ratios.append([1.0])
        elif isinstance(event, events.Densified) and ratios:
            ratios[-1].append(event.splats / before[0])

    trainer = Trainer(scene, recipe, protocol, backend=backend, on_event=on_event, progress_every=1000)
    trainer.run()
    assert len(trainer.splats) > 0
    return [min(counts) for counts in ratios]


@pytest.mark.parametrize(
    ("factor", "protocol", "resets"),
    [
        pytest.param(1.0, WHITE, 5, marks=pytest.mark.slow),
        (0.5, BLACK, 2),
        (0.1, BLACK, 0),
        (0.1, WHITE, 1),
        (0.03, WHITE, 1),
        (0.01, WHITE, 0),
    ],
)
def test_half_of_the_splats_outlive_every_reset(scene: Scene, factor: float, resets: int, protocol: Protocol) -> None:
    ratios = least_after_resets(scene, first_stage(factor), protocol, opacity_model())
    assert len(ratios) == resets
    assert all(ratio >= 0.5 for ratio in ratios)


@pytest.mark.parametrize("factor", [0.03, 0.01])
def test_a_real_short_run_keeps_its_splats_and_learns(scene: Scene, factor: float) -> None:
    backend = get_backend("reference")
    try:
        backend = get_backend("cpu")
    except BackendError:
        if factor > 0.01:
            pytest.skip("takes minutes on the reference; the native library is not built")
    stage = scale_schedule(Recipe("r", (surface(),)), factor).stages[0]
    assert isinstance(stage.densify, GradDensify)
    recipe = Recipe("r", (replace(stage, densify=replace(stage.densify, max_splats=150)),))
    counts, losses = [60], []

    def on_event(event: events.Event) -> None:
        if isinstance(event, events.Densified):
            counts.append(event.splats)
        elif isinstance(event, events.Progress):
            losses.append(event.losses["l1"])

    for protocol in (BLACK, WHITE) if backend.name == "cpu" else (BLACK,):
        Trainer(scene, recipe, protocol, backend=backend, on_event=on_event).run()
        assert min(counts) >= 30
        assert len(counts) >= 11  # the start, and ten densifications
        assert sum(losses[-3:]) < 0.7 * sum(losses[:3])
        counts, losses = [60], []
