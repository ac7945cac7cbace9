"""What a capture will take, before anything is trained: counted, bounded, and refused where it cannot fit."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gs2d.cli.app import run as main
from gs2d.config.densify import Densify
from gs2d.config.presets import get_recipe
from gs2d.config.recipe import Stage
from gs2d.config.robust import Removal
from gs2d.config.schedule import scale_schedule
from gs2d.config.serialize import apply_overrides
from gs2d.core import memory_limit
from gs2d.core.splats import Splats
from gs2d.data import load_scene
from gs2d.errors import DataError, RecipeError
from gs2d.pipeline import capture_plan
from gs2d.pipeline.capture_plan import (
    FUSION_BYTES,
    PLACE_BYTES,
    PROGRAM_BYTES,
    SPLAT_BYTES,
    budget_overrides,
    expected_splats,
    fitting_downscale,
    looks_of,
    meshing_bytes,
    rounded,
)
from gs2d.pipeline.events import Event, Notice
from gs2d.pipeline.options import PlanOptions, TrainOptions
from gs2d.pipeline.planned import command_of, plan
from gs2d.pipeline.probe import Cost, Probe, cost_of, crowded
from gs2d.pipeline.train import train
from gs2d.synthetic.flight import Flight, write_flight
from train_toys import random_splats

MEGA = 1_000_000


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
    assert found.start < found.splats.expected < found.splats.most
    assert 0 < found.seconds.least < found.seconds.expected < found.seconds.most
    assert PROGRAM_BYTES < found.memory.least <= found.memory.expected <= found.memory.most
    assert found.temporary == 8 * found.trained_pixels
    lines = found.lines()
    assert [line.partition(":")[0] for line in lines] == ["photographs", "splats", "memory", "disk", "time"]
    assert lines[0] == "photographs: 12 with 0.0369 megapixels together, in memory"
    assert sorted(path.name for path in capture.rglob("*")) == before


def test_the_command_line_tells_it_as_json_with_the_command_that_trains(
    capture: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["plan", str(capture), "--recipe", "2dgs", "--schedule-scale", "0.01", "--prepare", "always", "--json"]
    assert main(words) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["prepared"] is True
    assert told["disk"] > 12 * 64 * 48
    assert told["command"] == f"gs2d train {capture} --out RUN --recipe 2dgs --schedule-scale 0.01"


def test_splats_at_the_end_are_those_at_the_start_times_growth_but_for_a_budget() -> None:
    recipe = get_recipe("2dgs")
    found = expected_splats(recipe, 1000)
    assert (found.least, found.expected, found.most) == (1000, 4000, 9000)
    limited = expected_splats(apply_overrides(recipe, ("surface.densify.max_splats=2500",)), 1000)
    assert (limited.least, limited.expected, limited.most) == (1000, 2500, 2500)
    frozen = expected_splats(apply_overrides(recipe, ("surface.densify=null",)), 1000)
    assert (frozen.least, frozen.most) == (1000, 1000)


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


def test_the_downscale_is_the_first_at_which_an_iteration_fits() -> None:
    allowed = PROGRAM_BYTES + 24 * MEGA * (216 // 4 + 12)  # of 24 megapixels at half their size
    assert fitting_downscale(24 * MEGA, 1, allowed, on_host=True) == 2
    assert fitting_downscale(24 * MEGA, 1, allowed - 1, on_host=True) == 3
    assert fitting_downscale(24 * MEGA, 4, allowed, on_host=True) == 4
    assert fitting_downscale(24 * MEGA, 1, allowed, on_host=False) == 1  # what a GPU has is its own
    with pytest.raises(DataError, match="24 megapixels need 0.27 GiB to be read, got 0.38 GiB to keep to"):
        fitting_downscale(24 * MEGA, 1, PROGRAM_BYTES + 10 * MEGA, on_host=True)


def test_a_budget_of_splats_is_named_where_as_many_as_may_come_do_not_fit(
    capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capture_plan, "SPLAT_BYTES", 1 << 20)  # a thousand are a gigabyte
    options = planned(capture, memory=2.0)
    found = plan(options)
    assert found.max_splats is not None
    assert found.start < found.max_splats < 1700
    assert found.memory.most <= 2 << 30
    assert f"--set surface.densify.max_splats={found.max_splats} --memory 2" in command_of(options, found)
    assert f"only with --set surface.densify.max_splats={found.max_splats}" in found.lines()[1]
    monkeypatch.setattr(capture_plan, "SPLAT_BYTES", 1 << 24)
    with pytest.raises(DataError, match=r"12 photographs start from about .* splats, which need .* got 2 GiB to keep"):
        plan(options)


def test_what_cannot_fit_is_refused_in_one_line_and_leaves_nothing(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, said in (
        (
            ["--memory", "0.5"],
            "12 photographs start from .* splats, which need 0.(59|6[0-9]) GiB, got 0.5 GiB",
        ),
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


def test_a_crowd_of_splats_covers_what_the_few_did() -> None:
    few = random_splats(20, seed=1)
    many = crowded(few)
    assert len(many) == 80
    area = few.scales.prod(dim=1).sum()
    assert many.scales.prod(dim=1).sum() == pytest.approx(float(area), rel=1e-5)
    shift = (many.means.reshape(20, 4, 3) - few.means[:, None]).norm(dim=2)
    assert bool((shift < 3 * few.scales.max(dim=1).values[:, None]).all())
    assert torch.equal(crowded(few).means, many.means)


def test_figures_for_people_have_two_digits() -> None:
    assert [rounded(value) for value in (0.3, 7, 1234, 98_765)] == [0, 7, 1200, 99_000]
    assert math.isclose(capture_plan.Range(1, 2, 3).scaled(2).most, 6)


def test_a_memory_that_is_none_is_refused(capture: Path) -> None:
    with pytest.raises(RecipeError, match=r"--memory must be 0.5 GiB or more, got 0"):
        plan(planned(capture, memory=0.0))


def test_what_a_splat_adds_is_told_apart_for_those_that_are_seen_and_those_that_are_not() -> None:
    splats = random_splats(20, seed=1)

    def seconds(some: Splats) -> float:
        far = int((some.means.norm(dim=1) > 100).sum())
        return 1.0 + 0.02 * (len(some) - far) + 0.005 * far

    found = cost_of(splats, 1.0, seconds)
    assert (found.base, found.seen, found.unseen) == pytest.approx((1.0, 0.02, 0.005))
    assert found.of(1000, 0.25) == pytest.approx(1 + 5 + 3.75)


def test_looks_of_robust_training_are_counted_as_training_makes_them() -> None:
    recipe = scale_schedule(get_recipe("best"), 0.01)
    assert looks_of(recipe) == (0, 0)
    looking = replace(recipe, removal=Removal(every=50))
    assert looks_of(looking) == (sum(stage.iterations // 50 for stage in recipe.stages), 5 * len(recipe.stages))


def test_the_plan_of_a_robust_training_takes_longer_by_its_looks(
    capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = Probe(1000, 0.0, 0.0, 1.0, Cost(0.01, 0.0, 0.0), Cost(0.5, 0.0, 0.0), Cost(1.0, 0.0, 0.0), 0.0, 1.0, None)
    monkeypatch.setattr(capture_plan, "probe", lambda *_: tried)
    seconds = {}
    for robust in ("on", "off"):
        overrides = () if robust == "on" else ("removal=null",)
        found = plan(planned(capture, recipe="best", overrides=overrides))
        seconds[robust] = found.seconds.expected
    recipe_looks = seconds["on"] - seconds["off"]
    assert recipe_looks == pytest.approx(10 * (0.5 * (200 // 50) + 1.0 * 5), rel=0.3)


def test_memory_of_the_mesh_goes_with_the_places_of_a_dense_start_up_to_a_slab(
    capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The upper bound, by which is refused, has all of it; a start from sparse points says nothing of the surface."""
    free = Cost(0.0, 0.0, 0.0)
    found = {}
    for start in (None, 2, 2_000, 1_000_000):
        tried = Probe(start, 0.0, 0.0, 1.0, Cost(0.01, 0.0, 0.0), free, free, 0.0, 1.0, None)
        monkeypatch.setattr(capture_plan, "probe", lambda *_, tried=tried: tried)
        fixed = ("surface.densify=null",)
        told = plan(planned(capture, overrides=fixed))
        found[start] = told.memory.expected - told.splats.expected * SPLAT_BYTES
        assert told.memory.most - told.splats.most * SPLAT_BYTES == pytest.approx(found[None])
    assert found[2_000] - found[2] == pytest.approx(1_998 * PLACE_BYTES)
    assert found[1_000_000] == found[None]


def test_a_place_is_as_many_pixels_as_the_photographs_have_for_one_that_was_swept(capture: Path) -> None:
    scene, recipe = load_scene(capture), get_recipe("best")
    assert recipe.dense_start is not None
    assert meshing_bytes(scene, recipe, 100) == 100 * PLACE_BYTES
    halved = replace(recipe, dense_start=replace(recipe.dense_start, side=32))  # of 64 px
    assert meshing_bytes(scene, halved, 100) == 400 * PLACE_BYTES
    assert meshing_bytes(scene, halved, 100, shrink=0.25) == 100 * PLACE_BYTES
    assert meshing_bytes(scene, get_recipe("2dgs"), 100) == meshing_bytes(scene, recipe, None) == FUSION_BYTES
