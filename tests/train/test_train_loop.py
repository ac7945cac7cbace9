"""The trainer: order of an iteration, frozen rows, determinism, exact resume, divergence."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from train_toys import random_splats

from gs2d.camera import Camera
from gs2d.data.scene import Scene, View
from gs2d.errors import BackendError, DataError, DivergedError, RecipeError, RunError
from gs2d.protocols import GENERIC, NERF_SYNTHETIC
from gs2d.recipe import ALL, GradDensify, LossTerm, Rates, Recipe, Stage
from gs2d.recipes import PHOTOMETRIC, appearance, get_recipe, proceed, refine, surface
from gs2d.render import reference, reference_errors
from gs2d.render.backend import Backend, get_backend
from gs2d.render.types import RasterSettings, RenderOutput
from gs2d.splats import Splats
from gs2d.train import events
from gs2d.train.loop import Trainer, raster_settings
from gs2d.train.state import TrainState


def short(absgs: bool = False) -> Recipe:
    """2DGS-R in 10 + 4 + 5 iterations: densified at 3, 6 and 9, reset after 5, normal consistency after 4."""
    densify = GradDensify(
        every=3, start=1, stop=10, reset_every=0, reset_at=(5,), opacity_cull=0.005, max_splats=75, absolute=absgs
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
                rates=Rates(means_horizon=10),
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


@pytest.fixture(params=["reference", "cpu"])
def backend(request: pytest.FixtureRequest) -> str:
    if request.param not in backends():
        pytest.skip("the native library is not built")
    return str(request.param)


class Recorder:
    """Keeps the events, and a copy of the splats at each."""

    def __init__(self) -> None:
        self.events: list[events.Event] = []
        self.splats: list[Splats] = []
        self.trainer: Trainer | None = None

    def __call__(self, event: events.Event) -> None:
        self.events.append(event)
        assert self.trainer is not None
        self.splats.append(self.trainer.splats.clone())

    def at(self, kind: type, stage: str) -> Splats:
        """The splats at the first event of a kind in a stage."""
        for event, splats in zip(self.events, self.splats, strict=True):
            if isinstance(event, kind) and event.stage == stage:  # type: ignore[attr-defined]
                return splats
        raise AssertionError(f"no {kind.__name__} in {stage}")


def train(scene: Scene, recipe: Recipe, **options: object) -> tuple[Trainer, Recorder]:
    recorder = Recorder()
    trainer = Trainer(
        scene,
        recipe,
        options.pop("protocol", GENERIC),
        on_event=recorder,
        progress_every=1,
        **({"backend": "reference"} | options),  # type: ignore[arg-type]
    )
    recorder.trainer = trainer
    trainer.run()
    return trainer, recorder


def same(a: Splats, b: Splats) -> bool:
    """Whether all bytes are the same."""
    return all(torch.equal(x, y) for (_, x), (_, y) in zip(a.items(), b.items(), strict=True))


def test_the_stages_run_in_order_and_tell_what_they_do(scene: Scene) -> None:
    trainer, recorder = train(scene, short())
    kinds = [type(event).__name__ for event in recorder.events if not isinstance(event, events.Progress)]
    assert kinds == [
        "Initialised",
        *("StageEntering", "StageStarted", "Densified", "OpacityLimited", "Densified", "Densified", "StageFinished"),
        *("StageEntering", "Ranked", "StageStarted", "StageFinished"),
        *("StageEntering", "Cloned", "StageStarted", "StageFinished"),
    ]
    progress = [event for event in recorder.events if isinstance(event, events.Progress)]
    assert [(e.stage, e.iteration) for e in progress] == [
        *(("surface", i) for i in range(1, 11)),
        *(("appearance", i) for i in range(1, 5)),
        *(("refine", i) for i in range(1, 6)),
    ]
    assert [set(e.losses) for e in progress[:10]] == [{"l1", "ssim"}] * 4 + [{"l1", "ssim", "normal_consistency"}] * 6
    assert [set(e.losses) for e in progress[10:14]] == [{"l1", "ssim"}] * 4
    assert [set(e.losses) for e in progress[14:]] == [{"l1", "ssim", "normal_consistency"}] * 5
    assert [e.sh_degree for e in progress] == [0, 0, 1, 1, 1, 2, 2, 2, 3, 3] + [3] * 9
    assert progress[0].loss == pytest.approx(sum(progress[0].losses.values()))
    assert progress[9].rates["means"] == pytest.approx(1.6e-6 * scene.extent)
    assert trainer.done
    (ranked,) = [e for e in recorder.events if isinstance(e, events.Ranked)]
    (cloned,) = [e for e in recorder.events if isinstance(e, events.Cloned)]
    at_rank = len(recorder.at(events.Ranked, "appearance"))
    assert ranked.count == cloned.count == -(-at_rank * 20 // 100)
    assert len(trainer.splats) == at_rank + cloned.count


def test_training_lowers_the_loss(scene: Scene) -> None:
    _, recorder = train(scene, Recipe("r", (replace(surface(), iterations=60, densify=None),)))
    losses = [event.loss for event in recorder.events if isinstance(event, events.Progress)]
    assert np.mean(losses[-6:]) < 0.7 * np.mean(losses[:6])  # six views: means over epochs


def test_frozen_rows_and_attributes_are_bit_identical_through_a_stage(scene: Scene, backend: str) -> None:
    trainer, recorder = train(scene, short(), backend=backend)
    start, end = (recorder.at(kind, "appearance") for kind in (events.StageStarted, events.StageFinished))
    high_error = trainer.state.groups["high_error"][: len(start)]
    assert 0 < int(high_error.sum()) < len(start)
    for name, tensor in start.items():
        after = dict(end.items())[name]
        if name in ("sh0", "shN"):
            assert torch.equal(after[~high_error], tensor[~high_error])
            assert not torch.equal(after[high_error], tensor[high_error])
        else:
            assert torch.equal(after, tensor), name
    start, end = (recorder.at(kind, "refine") for kind in (events.StageStarted, events.StageFinished))
    assert torch.equal(start.opacity_logits, end.opacity_logits)
    clones = trainer.state.groups["clones"]
    originals = high_error.nonzero().squeeze(1)
    for name, tensor in start.items():
        assert torch.equal(tensor[clones], tensor[originals]), name
        assert torch.equal(dict(end.items())[name], tensor) == (name == "opacity_logits"), name


def test_clones_only_leaves_the_others_alone(scene: Scene) -> None:
    recipe = short()
    only = replace(refine(rows="clones"), iterations=3)
    trainer, recorder = train(scene, replace(recipe, stages=(*recipe.stages[:2], only)))
    start, clones = recorder.at(events.StageStarted, "refine"), trainer.state.groups["clones"]
    for name, tensor in trainer.splats.items():
        assert torch.equal(tensor[~clones], dict(start.items())[name][~clones]), name
    assert not torch.equal(trainer.splats.means[clones], start.means[clones])


def test_a_densification_updates_nothing_and_a_reset_everything_but_opacity(scene: Scene) -> None:
    # thresholds that nothing reaches: densification at 3 and 6 changes no row
    densify = GradDensify(
        grad_threshold=1e9,
        opacity_cull=0.0,
        scale_cull=1e9,
        every=3,
        start=1,
        stop=8,
        reset_every=0,
        reset_at=(5,),
        reset_opacity=0.05,
    )
    stage = replace(surface(), iterations=8, densify=densify, sh_interval=0)
    _, recorder = train(scene, Recipe("r", (stage,)))
    by_iteration = {
        event.iteration: splats
        for event, splats in zip(recorder.events, recorder.splats, strict=True)
        if isinstance(event, events.Progress)
    }
    for iteration in range(2, 9):
        before, after = by_iteration[iteration - 1], by_iteration[iteration]
        if iteration in (3, 6):
            assert same(before, after), iteration
            continue
        for name, tensor in after.items():
            if iteration == 5 and name == "opacity_logits":
                limit = torch.tensor(0.05).logit()
                assert torch.equal(tensor, before.opacity_logits.clamp(max=limit.item()))
            else:
                assert not torch.equal(tensor, dict(before.items())[name]), (iteration, name)


def test_white_backgrounds_reset_opacity_when_densification_starts(scene: Scene) -> None:
    densify = GradDensify(start=2, stop=6, every=10)
    recipe = Recipe("r", (replace(surface(), iterations=4, densify=densify),))

    def resets(white: bool) -> list[int]:
        protocol = replace(GENERIC, background=NERF_SYNTHETIC.background) if white else GENERIC
        _, recorder = train(scene, recipe, protocol=protocol)
        return [event.iteration for event in recorder.events if isinstance(event, events.OpacityLimited)]

    assert resets(white=True) == [2]
    assert resets(white=False) == []


def test_absgs_caps_opacity_and_gathers_absolute_gradients(scene: Scene) -> None:
    densify = GradDensify(
        absolute=True, abs_threshold=1e-9, start=1, stop=6, every=4, reset_every=0, cap_every=2, opacity_cap=0.09
    )
    _, recorder = train(scene, Recipe("r", (replace(surface(), iterations=5, densify=densify),)))
    caps = [event for event in recorder.events if isinstance(event, events.OpacityLimited)]
    assert [(cap.iteration, cap.ceiling, cap.reset) for cap in caps] == [(2, 0.09, False), (4, 0.09, False)]
    (densified,) = [event for event in recorder.events if isinstance(event, events.Densified)]
    assert densified.split > 0


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(scene: Scene, backend: str) -> None:
    one, two = (train(scene, short(), backend=backend)[0].splats for _ in range(2))
    assert same(one, two)
    other = train(scene, replace(short(), seed=1), backend=backend)[0].splats
    assert len(other) != len(one) or not same(one, other)


def reload(data: bytes) -> TrainState:
    return TrainState.from_state_dict(torch.load(io.BytesIO(data), weights_only=True))


def saved(trainer: Trainer) -> bytes:
    file = io.BytesIO()
    torch.save(trainer.state.state_dict(), file)
    return file.getvalue()


@pytest.mark.parametrize("absgs", [False, True])
def test_resuming_from_any_event_gives_the_same_bytes(scene: Scene, absgs: bool) -> None:
    kept: list[tuple[events.Event, bytes]] = []
    backend = backends()[-1]
    trainer = Trainer(
        scene,
        short(absgs),
        GENERIC,
        backend=backend,
        progress_every=1,
        on_event=lambda event: kept.append((event, saved(trainer))),
    )
    end = trainer.run()
    assert {type(event) for event, _ in kept} == set(events.Event.__args__)  # type: ignore[attr-defined]
    for event, data in kept[:: 1 if backend == "cpu" else 5]:
        resumed = Trainer(scene, short(absgs), GENERIC, backend=backend, state=reload(data))
        assert same(resumed.run(), end), event


class Killed(Exception):
    pass


@pytest.mark.parametrize("when", [1, 9, 20, 26])
def test_a_run_that_is_killed_in_an_event_resumes_from_its_last_save_to_the_same_bytes(
    scene: Scene, backend: str, when: int
) -> None:
    end = Trainer(scene, short(), GENERIC, backend=backend, progress_every=1).run()
    saves: list[bytes] = []

    def on_event(event: events.Event) -> None:
        if isinstance(event, events.Progress) and event.iteration % 3 == 0:
            saves.append(saved(trainer))
        seen.append(event)
        if len(seen) == when:
            raise Killed

    seen: list[events.Event] = []
    trainer = Trainer(scene, short(), GENERIC, backend=backend, on_event=on_event, progress_every=1)
    with pytest.raises(Killed):
        trainer.run()
    state = reload(saves[-1]) if saves else None
    assert same(Trainer(scene, short(), GENERIC, backend=backend, state=state).run(), end)


def test_a_finished_stage_can_be_shared_with_a_recipe_of_the_same_first_stage(scene: Scene) -> None:
    first = short().stages[0]
    longer = Recipe("longer", (first, replace(proceed(), iterations=4)))
    at_finish: list[bytes] = []

    def on_event(event: events.Event) -> None:
        if isinstance(event, events.StageFinished) and event.index == 0:
            at_finish.append(saved(trainer))

    trainer = Trainer(scene, short(), GENERIC, backend="reference", on_event=on_event)
    trainer.run()
    shared = Trainer(scene, longer, GENERIC, backend="reference", state=reload(at_finish[0]))
    assert same(shared.run(), Trainer(scene, longer, GENERIC, backend="reference").run())
    assert shared.state.moments["means"].steps > 4  # kept


def test_a_finished_run_has_nothing_left_to_do(scene: Scene) -> None:
    trainer, _ = train(scene, short())
    again = Trainer(scene, short(), GENERIC, backend="reference", state=reload(saved(trainer)))
    assert again.done
    assert same(again.run(), trainer.splats)


def test_a_stage_of_no_iterations_runs_its_actions(scene: Scene) -> None:
    recipe = short()
    stages = (replace(recipe.stages[0], iterations=2), *(replace(s, iterations=0) for s in recipe.stages[1:]))
    trainer, _ = train(scene, replace(recipe, stages=stages))
    assert int(trainer.state.groups["clones"].sum()) > 0


def test_states_of_another_recipe_or_scene_are_refused(scene: Scene) -> None:
    state = TrainState(random_splats(5, degree=2), torch.Generator())
    with pytest.raises(RunError, match="SH degree 2"):
        Trainer(scene, short(), GENERIC, backend="reference", state=state)
    for stage, step in ((0, 11), (3, 1), (4, 0)):
        state = TrainState(random_splats(5), torch.Generator(), stage=stage, step=step)
        with pytest.raises(RunError, match=f"stage {stage}, iteration {step}"):
            Trainer(scene, short(), GENERIC, backend="reference", state=state)
    state = TrainState(random_splats(5), torch.Generator(), queue=[6])
    with pytest.raises(RunError, match="view 6"):
        Trainer(scene, short(), GENERIC, backend="reference", state=state)


def test_bad_recipes_and_empty_scenes_stop_before_anything_is_trained(scene: Scene) -> None:
    with pytest.raises(RecipeError, match="at least one stage"):
        Trainer(scene, Recipe("r", ()), GENERIC, backend="reference")
    with pytest.raises(DataError, match="no training views"):
        Trainer(replace(scene, train=()), short(), GENERIC, backend="reference")


def spoiled(spoil: Callable[[Splats, RenderOutput], RenderOutput], calls: int) -> Backend:
    """The reference, whose render number ``calls`` is spoiled."""
    count = [0]

    def rasterize(
        splats: Splats, camera: Camera, settings: RasterSettings, probe: torch.Tensor | None = None
    ) -> RenderOutput:
        count[0] += 1
        output = reference.rasterize(splats, camera, settings, probe)
        return spoil(splats, output) if count[0] == calls else output

    return Backend("reference", rasterize, reference_errors.splat_errors)


def test_nan_in_the_loss_stops_with_stage_and_iteration(scene: Scene) -> None:
    bad = spoiled(lambda _, out: replace(out, color=out.color * float("nan")), 4)
    with pytest.raises(DivergedError, match=r"iteration 4 of stage 'surface': the loss .* is NaN or infinite"):
        train(scene, short(), backend=bad)


@pytest.mark.parametrize("name", ALL)
def test_nan_in_a_gradient_names_the_attribute(scene: Scene, name: str) -> None:
    def spoil(splats: Splats, output: RenderOutput) -> RenderOutput:
        def hook(gradient: torch.Tensor) -> torch.Tensor:
            spoiled_gradient = gradient.clone()
            spoiled_gradient.view(-1)[-1] = float("inf")
            return spoiled_gradient

        getattr(splats, name).register_hook(hook)
        return output

    with pytest.raises(DivergedError, match=f"iteration 2 of stage 'surface': the gradient of {name} is NaN"):
        train(scene, short(), backend=spoiled(spoil, 2))


def test_nan_in_a_parameter_stops_at_the_door_though_the_rasterizer_would_skip_it(scene: Scene) -> None:
    splats = random_splats(5)
    splats.log_scales[3, 1] = float("nan")
    state = TrainState(splats, torch.Generator())
    with pytest.raises(DivergedError, match="log_scales is NaN"):
        Trainer(scene, short(), GENERIC, backend="reference", state=state).run()


def test_an_update_that_leaves_the_finite_numbers_stops(scene: Scene) -> None:
    wild = replace(surface(), iterations=3, densify=None, rates=Rates(sh0=1e39))
    with pytest.raises(DivergedError, match="iteration 1 of stage 'surface': sh0 is NaN"):
        train(scene, Recipe("r", (wild,)))


def test_a_view_in_which_nothing_is_visible_is_survived(scene: Scene) -> None:
    """The picture is background, no gradient flows, and training goes on."""
    away = replace(scene.train[0].camera, T_cam_world=np.diag([1.0, 1.0, 1.0, 1.0]) + np.eye(4, k=3) * 1e3)
    view = View.from_arrays("away.png", away, scene.train[0].image())
    trainer, _ = train(replace(scene, train=(*scene.train, view)), short())
    assert trainer.done


def test_masks_count_only_where_the_protocol_says_so(scene: Scene) -> None:
    masked = tuple(
        View.from_arrays(v.name, v.camera, v.image(), mask=np.indices((24, 24))[1] < 12) for v in scene.train
    )
    halved = replace(scene, train=masked)
    stage = Stage("s", 2, losses=PHOTOMETRIC)
    ignoring, using = (replace(GENERIC, use_mask_in_training=use) for use in (False, True))
    plain = train(scene, Recipe("r", (stage,)), protocol=using)[0].splats
    assert same(train(halved, Recipe("r", (stage,)), protocol=ignoring)[0].splats, plain)
    assert not same(train(halved, Recipe("r", (stage,)), protocol=using)[0].splats, plain)


def test_targets_that_do_not_fit_in_memory_are_made_anew_with_the_same_result(scene: Scene, backend: str) -> None:
    stage = Stage("s", 8, losses=PHOTOMETRIC)
    kept = train(scene, Recipe("r", (stage,)), backend=backend)[0].splats
    for limit in (0, 2 * 2 * 24 * 24 * 3 * 4):
        assert same(train(scene, Recipe("r", (stage,)), backend=backend, target_bytes=limit)[0].splats, kept)


def test_the_protocol_sets_near_background_and_open_losses(scene: Scene) -> None:
    settings = raster_settings(NERF_SYNTHETIC, 5.0, 2)
    assert (settings.near, settings.background, settings.sh_degree) == (0.2, (1.0, 1.0, 1.0), 2)
    assert raster_settings(GENERIC, 5.0, 3).near == pytest.approx(0.05)
    stage = Stage("s", 1, losses=(*PHOTOMETRIC, LossTerm("distortion", None)))
    small, large = (replace(GENERIC, distortion_weight=w) for w in (1.0, 10.0))
    values = [
        event.losses["distortion"]
        for protocol in (small, large)
        for event in train(scene, Recipe("r", (stage,)), protocol=protocol)[1].events
        if isinstance(event, events.Progress)
    ]
    assert values[0] > 0
    assert values[1] == pytest.approx(10 * values[0])


def test_every_named_recipe_trains_a_few_iterations_of_each_stage(scene: Scene) -> None:
    for name in ("2dgs-r-absgs-d", "2dgs-r-rerank", "2dgs-r-occlusion", "2dgs-r-sh-of-all", "2dgs-distortion"):
        recipe = get_recipe(name)
        stages = tuple(replace(stage, iterations=2) for stage in recipe.stages)
        assert train(scene, replace(recipe, stages=stages))[0].done
