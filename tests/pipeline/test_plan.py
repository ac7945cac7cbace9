"""What a capture will take, before anything is trained: counted, bounded, and refused where it cannot fit."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gs2d.cli.app import run as main
from gs2d.cli.parser import parse
from gs2d.config.densify import Densify
from gs2d.config.presets import get_recipe
from gs2d.config.recipe import Stage
from gs2d.config.robust import Removal
from gs2d.config.serialize import apply_overrides
from gs2d.core import memory_limit
from gs2d.data import load_scene
from gs2d.errors import DataError, RecipeError
from gs2d.pipeline.events import Event, Notice
from gs2d.pipeline.prepare import estimate as module
from gs2d.pipeline.prepare import plan as plan_module
from gs2d.pipeline.prepare.estimate import (
    DOUBT,
    GROWTH,
    PROGRAM_BYTES,
    TRIAL_ITERATIONS,
    budget_overrides,
    estimate,
    expected_splats,
    rasterizer_speed,
    rounded,
    start_of,
    training_work,
)
from gs2d.pipeline.prepare.options import PlanOptions, TrainOptions
from gs2d.pipeline.prepare.plan import plan
from gs2d.pipeline.train import train_run as train_module
from gs2d.pipeline.train.train_run import train
from gs2d.render.backends import get_backend
from gs2d.synthetic.flight import Flight, write_flight
from train_toys import backends


@pytest.fixture(autouse=True)
def no_budget() -> object:
    yield
    memory_limit.set_memory_budget(None)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown") / "capture"
    write_flight(folder, Flight(12, width=64, height=48, points=6000, seed=1))
    return folder


def planned(capture: Path, **more: object) -> PlanOptions:
    given = {"schedule_scale": 0.01, "recipe": "2dgs", **more}
    return PlanOptions(scene=capture, **given)  # type: ignore[arg-type]


def test_a_plan_counts_photographs_and_pixels_and_bounds_the_rest_and_writes_nothing(capture: Path) -> None:
    before = sorted(path.name for path in capture.rglob("*"))
    found = plan(planned(capture))
    assert (found.photographs, found.pixels, found.trained_pixels) == (12, 12 * 64 * 48, 12 * 64 * 48)
    assert (found.downscale, found.prepared, found.max_splats, found.iterations) == (1, False, None, 300)
    assert found.splats.least < found.start < found.splats.expected < found.splats.most
    assert 0 < found.seconds.least < found.seconds.expected < found.seconds.most
    assert found.training.expected < found.seconds.expected
    assert PROGRAM_BYTES < found.memory.least <= found.memory.expected <= found.memory.most
    assert found.temporary == 8 * found.trained_pixels
    lines = found.lines()
    assert [line.partition(":")[0] for line in lines] == ["photographs", "splats", "memory", "disk", "time"]
    assert lines[0] == "photographs: 12 with 0.0369 megapixels together, in memory"
    assert sorted(path.name for path in capture.rglob("*")) == before


def test_the_command_line_tells_it_as_json_with_the_command_that_trains(
    capture: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(capture), "--recipe", "2dgs", "--schedule-scale", "0.01", "--prepare", "always", "--no-page"]
    words += ["--exposure", "--set", "surface.densify.every=50", "--set", "sh_degree=1", "--test-every", "4"]
    words += ["--subject-box", "-1", "-1", "-1", "1", "1", "1"]
    assert main(["plan", *words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["prepared"] is True
    assert told["disk"] > 12 * 64 * 48
    again = shlex.split(told["command"])
    assert again[:5] == ["gs2d", "train", str(capture), "--out", "RUN"]
    assert parse(again[1:]) == parse(["train", *words, "--out", "RUN"])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"downscale": 2, "test_every": 4, "exposure": True},
        {"depth_prior": "sparse", "robust": "off"},
        {"format": "colmap", "masked": "ignore", "recipe": "best", "seed": 3},
        {"quality": "draft"},
    ],
)
def test_a_plan_is_of_the_training_that_train_would_do(
    options: dict[str, Any], capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Any, ...]] = []

    class Asked(Exception):
        pass

    def listen(scene: Any, recipe: Any, backend: Any, **more: Any) -> None:
        asked.append((recipe, [view.name for view in scene.train], scene.train[0].camera.width, backend.name, more))
        raise Asked

    for place in (plan_module, train_module):
        monkeypatch.setattr(place, "estimate", listen)
    given = {"recipe": "2dgs", "schedule_scale": 0.01, **options}
    with pytest.raises(Asked):
        plan(PlanOptions(scene=capture, **given))
    with pytest.raises(Asked):
        train(TrainOptions(scene=capture, out=tmp_path / "run", estimate=True, **given))
    assert asked[0] == asked[1]


def test_a_plan_takes_a_second_at_most_for_the_speed_of_the_machine() -> None:
    for name in backends():
        backend = get_backend(name)
        rasterizer_speed(backend)  # loads the library
        begun = time.perf_counter()
        seconds = rasterizer_speed(backend)
        assert 0 < seconds < 1
        assert time.perf_counter() - begun < 10  # a busy machine is slower


def test_splats_at_the_end_are_those_at_the_start_times_growth_but_for_a_budget() -> None:
    recipe = get_recipe("2dgs")
    found = expected_splats(recipe, 1000)
    assert (found.least, found.expected, found.most) == tuple(1000 * factor for factor in GROWTH)
    limited = expected_splats(apply_overrides(recipe, ("surface.densify.max_splats=2500",)), 1000)
    assert (limited.expected, limited.most) == (2500, 2500)
    frozen = expected_splats(apply_overrides(recipe, ("surface.densify=null",)), 1000)
    assert (frozen.least, frozen.most) == (1000, 1000)
    once = expected_splats(apply_overrides(recipe, ("surface.densify.start=500", "surface.densify.stop=601")), 1000)
    assert once.most == 2000  # one densification doubles at most


def test_a_dense_start_goes_with_the_photographs_and_another_with_the_points(capture: Path) -> None:
    scene = load_scene(capture, test_every=0)
    assert scene.points is not None
    assert start_of(scene, get_recipe("2dgs")) == len(scene.points)
    assert start_of(replace(scene, points=None), get_recipe("2dgs")) == get_recipe("2dgs").init_points
    best = get_recipe("best")
    bare = replace(scene, points=None)
    assert start_of(bare, best) == round(64 * 48 / 9 * 12**0.5)
    assert start_of(replace(bare, train=scene.train[:3]), best) == round(64 * 48 / 9 * 3**0.5)
    assert start_of(scene, best) - start_of(bare, best) == pytest.approx(len(scene.points) / 2, abs=1)


def test_a_budget_is_set_in_each_stage_that_takes_one_whatever_it_is_called() -> None:
    first, *rest = get_recipe("2dgs-r-absgs-d").stages
    moving = Stage("move", 100, losses=first.losses, densify=Densify("relocation", {"max_splats": 9, "stop": 50}))
    recipe = replace(get_recipe("2dgs"), stages=(replace(first, name="coarse"), *rest, moving))
    overrides = budget_overrides(recipe, 700)
    limits = [getattr(stage.densify, "max_splats", None) for stage in apply_overrides(recipe, overrides).stages]
    assert limits[:3] == [700, None, 700]
    assert apply_overrides(recipe, overrides).stages[-1].densify == Densify(
        "relocation", {"max_splats": 700, "stop": 50}
    )
    assert budget_overrides(replace(recipe, stages=(replace(first, densify=None),)), 700) == ()


def test_a_budget_of_splats_is_named_where_as_many_as_may_come_do_not_fit(
    capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SPLAT_BYTES", 1 << 20)  # a thousand are a gigabyte
    options = planned(capture, memory=2.0)
    found = plan(options)
    assert found.max_splats is not None
    assert found.start < found.max_splats < 1700
    assert found.memory.most <= 2 << 30
    assert found.budget == (f"surface.densify.max_splats={found.max_splats}",)
    assert f"only with --set surface.densify.max_splats={found.max_splats}" in found.lines()[1]
    monkeypatch.setattr(module, "SPLAT_BYTES", 1 << 24)
    with pytest.raises(DataError, match=r"12 photographs start from about .* splats, which need .* got 2 GiB to keep"):
        plan(options)


def test_what_cannot_fit_is_refused_in_one_line_and_leaves_nothing(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, said in (
        (["--memory", "0.5"], r"need .* GiB.*\b0\.5 GiB"),  # which of both needs depends on what other tests hold
        (["--disk", "1e-6"], "12 photographs take about"),
        (["--downscale", "0"], "--downscale must be a whole number >= 1, got 0"),
    ):
        command = ["plan", str(capture), "--recipe", "2dgs", "--schedule-scale", "0.01", "--quiet", *words]
        assert main(command) == 2
        error = capsys.readouterr().err
        assert re.search(said, error)
        assert error.count("\n") == 1
    out = tmp_path / "run"
    words = ["train", capture, "--out", out, "--recipe", "2dgs", "--schedule-scale", "0.001", "--memory", "0.5"]
    # In a process of its own: what other tests hold would count.
    ran = subprocess.run([sys.executable, "-m", "gs2d", *words, "--quiet"], capture_output=True, text=True, check=False)
    assert ran.returncode == 2
    assert "12 photographs start from about" in ran.stderr
    assert ran.stderr.count("\n") == 1
    assert not out.exists()


def test_a_training_with_limits_says_its_plan_before_it_begins(capture: Path, tmp_path: Path) -> None:
    heard: list[str] = []

    def stop(event: Event) -> None:
        if isinstance(event, Notice):
            heard.append(event.text)
        if getattr(event, "name", "").startswith("training"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(TrainOptions(scene=capture, out=tmp_path / "run", recipe="2dgs", schedule_scale=0.01, memory=3.0), stop)
    assert any(text.startswith("memory: ") and "of 3 GiB allowed" in text for text in heard)
    assert any(text.startswith("time: ") for text in heard)


def test_figures_for_people_have_two_digits() -> None:
    assert [rounded(value) for value in (0.3, 7, 1234, 98_765)] == [0, 7, 1200, 99_000]


def test_a_memory_that_is_none_is_refused(capture: Path) -> None:
    with pytest.raises(RecipeError, match=r"--memory must be 0.5 GiB or more, got 0"):
        plan(planned(capture, memory=0.0))


def test_time_grows_with_pixels_iterations_and_trials_of_removal(
    capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, recipe = load_scene(capture, test_every=0), apply_overrides(get_recipe("2dgs"), ("surface.densify=null",))
    work = training_work(scene, recipe, 1000)
    longer = replace(recipe, stages=(replace(recipe.stages[0], iterations=2 * recipe.iterations),))
    assert training_work(scene, longer, 1000) == pytest.approx(2 * work)
    assert training_work(load_scene(capture, downscale=2, test_every=0), recipe, 0) == pytest.approx(
        training_work(scene, recipe, 0) / 4
    )
    removing = replace(recipe, removal=Removal(every=recipe.iterations + 1))  # five trials, at the ends of parts
    trials = 5 * TRIAL_ITERATIONS * 12 / 24  # of 12 photographs half the witnesses
    assert training_work(scene, removing, 0) == pytest.approx(training_work(scene, recipe, 0) * (1 + trials / 30_000))
    monkeypatch.setattr(module, "rasterizer_speed", lambda _: 1e-6)
    found = estimate(scene, recipe, get_backend(backends()[-1]), start=1000)
    assert found.training.expected == pytest.approx(work * 1e-6)
    assert found.training.most == pytest.approx(DOUBT * work * 1e-6)
