"""Stage 2 from cached views: equals normal training up to rounding, independently of thread count and resuming."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from fake_backends import altered
from gs2d.config.presets import appearance, refine
from gs2d.config.protocols import GENERIC
from gs2d.config.recipe import Recipe, Stage
from gs2d.data.scene import Scene, View
from gs2d.render.backends import Backend
from gs2d.render.reference_backend import PLAIN
from gs2d.training import events
from gs2d.training.cached_objective import CachedViews, is_cacheable
from gs2d.training.state import TrainState
from gs2d.training.trainer import Trainer
from train_toys import SIZE, VIEWS, backends, grouped, random_splats, same

needs_cpu = pytest.mark.skipif("cpu" not in backends(), reason="the native library is not built")
ROOM = 1 << 30


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def masked(scene: Scene) -> Scene:
    """Return the toy scene; every other view masks out a corner."""
    views = []
    for i, view in enumerate(scene.train):
        mask = np.ones((SIZE, SIZE), bool)
        mask[: SIZE // 2, : SIZE // 3] = False
        views.append(View.from_arrays(view.name, view.camera, view.image(), mask=mask if i % 2 else None))
    return replace(scene, train=tuple(views))


def recipe(iterations: int = 3 * VIEWS, k: float = 20.0) -> Recipe:
    """Return a recipe with mainly stage 2, and a short stage 3."""
    return Recipe("colors", (replace(appearance(k=k), iterations=iterations), replace(refine(), iterations=2)))


def trainer(
    scene: Scene, room: int, *, iterations: int = 3 * VIEWS, state: TrainState | None = None, **options: object
) -> Trainer:
    if state is None:
        state = TrainState(random_splats(90, seed=5), torch.Generator().manual_seed(0))
    given = {"backend": "cpu", "state": state, "stage2_cache_bytes": room} | options
    return Trainer(scene, recipe(iterations), GENERIC, **grouped(given))


def entered(scene: Scene, room: int = ROOM, **options: object) -> Trainer:
    made = trainer(scene, room, **options)  # type: ignore[arg-type]
    made.enter(0)
    return made


def views_of(made: Trainer, room: int = ROOM) -> CachedViews:
    return CachedViews(made._whole, made.state, made.recipe.stages[0], room)


@needs_cpu
def test_cached_views_have_the_losses_and_gradients_of_full_renderings(masked: Scene) -> None:
    made = entered(masked)
    stage, cached = made.recipe.stages[0], views_of(made)
    assert len(cached.views) == VIEWS
    assert len(cached.rows) == 18
    for index in range(VIEWS):
        a, b = (e.evaluate(made.state, stage, 1, index) for e in (cached, made._whole))
        assert a.losses == pytest.approx(b.losses, rel=1e-6)
        for name in ("sh0", "shN"):
            plain = b.gradients[name][cached.rows]
            assert a.gradients[name].shape == plain.shape
            error = (a.gradients[name] - plain).abs().max() / plain.abs().max()
            assert error <= 3e-6, (index, name)  # SSIM amplifies rounding errors of the image
            assert plain.abs().max() > 0


@needs_cpu
def test_the_first_views_that_fit_are_cached(masked: Scene) -> None:
    made = entered(masked)
    sizes = [view.nbytes for view in views_of(made).views]
    two = sizes[0] + sizes[1]
    assert len(views_of(made, two).views) == 2
    assert len(views_of(made, two - 1).views) == 1
    assert len(views_of(made, sizes[0] - 1).views) == 0
    cached = views_of(made, two)
    stage = made.recipe.stages[0]
    assert cached.evaluate(made.state, stage, 1, 1).rows is not None
    a, b = (e.evaluate(made.state, stage, 1, 2) for e in (cached, made._whole))
    assert a.rows is None
    assert torch.equal(a.gradients["sh0"], b.gradients["sh0"])


@needs_cpu
@pytest.mark.parametrize("part", [False, True])
def test_bytes_do_not_depend_on_threads_or_on_resuming(masked: Scene, part: bool) -> None:
    room = views_of(entered(masked)).views[0].nbytes * (2 * VIEWS - 3) // 2 if part else ROOM
    kept: list[tuple[events.TrainingEvent, bytes]] = []

    def keep(event: events.TrainingEvent) -> None:
        file = io.BytesIO()
        torch.save(made.state.state_dict(), file)
        kept.append((event, file.getvalue()))

    torch.set_num_threads(1)
    made = trainer(masked, room, on_event=keep, progress_every=1)
    end = made.run()
    assert any(isinstance(event, events.Progress) for event, _ in kept)
    torch.set_num_threads(2)
    assert same(trainer(masked, room).run(), end)
    torch.set_num_threads(3)
    for event, data in kept[::3]:
        state = TrainState.from_state_dict(torch.load(io.BytesIO(data), weights_only=True))
        assert same(trainer(masked, room, state=state).run(), end), event


def test_which_stages_use_cached_views() -> None:
    plain, caching = replace(appearance(), iterations=100), altered(PLAIN, caches_views=True)

    def cacheable(stage: Stage, backend: Backend = caching, views: int = 50) -> bool:
        return is_cacheable(Recipe("x", (stage,)), stage, backend=backend, views=views)

    assert cacheable(plain)
    assert cacheable(replace(plain, train={"sh0": "high_error"}))
    assert not cacheable(plain, PLAIN)
    assert not cacheable(plain, views=51)  # caching pays off from two visits per view
    assert not cacheable(replace(plain, train=dict.fromkeys(("sh0", "shN"), "all")))
    assert not cacheable(replace(plain, train={"sh0": "high_error", "shN": "clones"}))
    assert not cacheable(replace(plain, train={**plain.train, "opacity_logits": "high_error"}))
    assert not cacheable(replace(plain, losses=refine().losses))
    assert not cacheable(replace(plain, sh_interval=40))
    assert not cacheable(replace(refine(), iterations=100))
