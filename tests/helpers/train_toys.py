"""Toys for trainer tests: random splats, a full state, and a ball of 80 splats with six cameras of 24x24 px."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch

from gs2d.config.presets import appearance, refine, surface
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import GradDensify, LearningRates, Recipe
from gs2d.core.camera import look_at
from gs2d.core.splats import Splats
from gs2d.core.transforms import camera_extent
from gs2d.data.scene import PointCloud, Scene, View
from gs2d.errors import BackendError
from gs2d.render.api import rasterize
from gs2d.render.backends import get_backend
from gs2d.render.types import RasterSettings
from gs2d.training import events
from gs2d.training.state import Moments, TrainState
from gs2d.training.trainer import Trainer, TrainerOptions

VIEWS, SIZE, POINTS = 6, 24, 60


def random_splats(count: int, seed: int = 0, degree: int = 3, dtype: torch.dtype = torch.float32) -> Splats:
    """Return splats in the unit ball with random attributes."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64).to(dtype)

    return Splats(
        means=0.4 * normal(count, 3),
        quats=normal(count, 4),
        log_scales=-1.8 + 0.3 * normal(count, 2),
        opacity_logits=1.0 + normal(count),
        sh0=0.8 * normal(count, 1, 3),
        shN=0.05 * normal(count, (degree + 1) ** 2 - 1, 3),
    )


def full_state(count: int = 10, seed: int = 0) -> TrainState:
    """Return a state that has all per-row data, different in every row."""
    splats = random_splats(count, seed)
    state = TrainState(splats, torch.Generator().manual_seed(seed))
    state.moments = {
        name: Moments(torch.randn_like(tensor), torch.rand_like(tensor), 7) for name, tensor in splats.items()
    }
    state.groups = {"high_error": torch.arange(count) % 3 == 0}
    tensors = (torch.rand(count), torch.rand(count), torch.arange(count).float())
    state.statistics = dict(zip(("signed", "absolute", "count"), tensors, strict=True))
    return state


def make_scene() -> Scene:
    """Render six views of random splats with the reference; the initial points are noisy."""
    truth = random_splats(80, seed=3)
    cameras = [
        look_at(
            np.array([3 * np.cos(a), 3 * np.sin(a), 1.0]),
            np.zeros(3),
            np.array([0.0, 0.0, 1.0]),
            width=SIZE,
            height=SIZE,
            fx=30.0,
        )
        for a in np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)
    ]
    views = []
    for i, camera in enumerate(cameras):
        with torch.no_grad():
            color = rasterize(truth, camera, RasterSettings(), backend="reference").color
        image = (color.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        views.append(View.from_arrays(f"{i:03d}.png", camera, image))
    noise = np.random.default_rng(0).normal(size=(POINTS, 3)) * 0.05
    points = truth.means.numpy()[:POINTS].astype(np.float64) + noise
    return Scene(
        name="ball",
        format="colmap",
        train=tuple(views),
        test=(),
        points=PointCloud(points, np.full((POINTS, 3), 128, np.uint8)),
        extent=camera_extent(cameras),
        bounds=np.array([[-1.0] * 3, [1.0] * 3]),
    )


def short(absgs: bool = False) -> Recipe:
    """Return 2DGS-R in 10 + 4 + 5 iterations: densified at 3, 6 and 9, reset after 5, normal consistency after 4."""
    densify = GradDensify(
        every=3, start=1, stop=10, reset_every=5, scale_cull_start=0, opacity_cull=0.005, max_splats=75, absolute=absgs
    )
    first = surface()
    return Recipe(
        "short",
        (
            replace(
                first,
                iterations=10,
                densify=densify,
                sh_interval=3,
                losses=tuple(replace(term, start=min(term.start, 4)) for term in first.losses),
                lr=LearningRates(means_decay_steps=10),
            ),
            replace(appearance(k=20.0), iterations=4),
            replace(refine(), iterations=5),
        ),
    )


def backends() -> list[str]:
    try:
        get_backend("cpu")
    except BackendError:
        return ["reference"]
    return ["reference", "cpu"]


class RunLogger:
    """Records the events, and a copy of the splats at each."""

    def __init__(self) -> None:
        self.events: list[events.TrainingEvent] = []
        self.splats: list[Splats] = []
        self.trainer: Trainer | None = None

    def __call__(self, event: events.TrainingEvent) -> None:
        self.events.append(event)
        assert self.trainer is not None
        self.splats.append(self.trainer.splats.clone())

    def at(self, kind: type, stage: str) -> Splats:
        """Return the splats at the first event of a kind in a stage."""
        for event, splats in zip(self.events, self.splats, strict=True):
            if isinstance(event, kind) and event.stage == stage:  # type: ignore[attr-defined]
                return splats
        raise AssertionError(f"no {kind.__name__} in {stage}")


def grouped(values: dict[str, Any]) -> dict[str, Any]:
    """Return trainer arguments with option fields grouped into their option objects."""
    names = {entry.name for entry in fields(TrainerOptions)} & values.keys()
    rest = {name: value for name, value in values.items() if name not in names}
    return rest | {"options": TrainerOptions(**{name: values[name] for name in names})}


def train(scene: Scene, recipe: Recipe, **options: object) -> tuple[Trainer, RunLogger]:
    recorder = RunLogger()
    values = {"backend": "reference", "progress_every": 1} | options
    protocol = values.pop("protocol", GENERIC)
    trainer = Trainer(scene, recipe, protocol, on_event=recorder, **grouped(values))
    recorder.trainer = trainer
    trainer.run()
    return trainer, recorder


def same(a: Splats, b: Splats) -> bool:
    """Return whether all bytes are equal."""
    return all(torch.equal(x, y) for (_, x), (_, y) in zip(a.items(), b.items(), strict=True))
