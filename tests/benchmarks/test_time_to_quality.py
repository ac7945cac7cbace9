"""The curves of quality against seconds: what is trained and counted, that it goes on, and what is drawn."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benchmarks import quality_plot, quality_run, time_to_quality
from benchmarks.quality_run import Clocks, Spent, marks
from benchmarks.street_runs import Process
from PIL import Image

from fake_peer import calls, fake_peer
from gs2d.data import load_scene
from gs2d.synthetic.capture import write_demo_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("captures") / "still"
    write_demo_capture(folder, train_views=5, test_views=2, size=24, threads=1)
    return folder


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Trainings run here, not in a process each; the list gets the folder of each."""
    started: list[str] = []

    def watch(command: list[str], console: Path, **_: Any) -> Process:
        file = Path(command[3])
        started.append(file.parent.name)
        code = quality_run.main(command[3:])
        console.write_text("")
        return Process(command, code, 0.0, 0.0, None, 0)

    monkeypatch.setattr(time_to_quality, "watch_process", watch)
    return started


def words(capture: Path, out: Path, *more: str) -> list[str]:
    return [str(capture), "--out", str(out), "--recipes", "2dgs", "2dgs-60k", "--threads", "1", "--points", "2", *more]


# -- the clocks ----------------------------------------------------------------------------------------------------
def test_what_is_done_while_the_clocks_stand_still_is_not_counted() -> None:
    clocks = Clocks(time.time())
    clocks.set(Spent(100.0, 50.0, 5.0))  # of a training that was cut off
    with clocks.stopped():
        until = time.process_time() + 0.3
        while time.process_time() < until:
            pass
    spent = clocks.spent()
    assert 100.0 <= spent.seconds < 100.2
    assert 55.0 <= spent.user_seconds + spent.system_seconds < 55.2
    until = time.process_time() + 0.2
    while time.process_time() < until:
        pass
    more = clocks.spent() - spent
    assert more.user_seconds + more.system_seconds >= 0.19
    assert Clocks(time.time() - 7.0).spent().seconds >= 7.0  # the process's start counts


def test_the_course_of_a_training_has_points_before_its_end() -> None:
    assert marks(3000, 4) == [750, 1500, 2250]
    assert marks(3, 8) == [1, 2]
    assert marks(100, 1) == []


# -- trainings -----------------------------------------------------------------------------------------------------
def test_the_command_trains_scores_and_draws(
    capture: Path, tmp_path: Path, in_process: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    results, figure = tmp_path / "results.json", tmp_path / "figure.png"
    more = ("--recipes", "2dgs", "--scales", "0.001", "--results", str(results), "--figure", str(figure))
    assert time_to_quality.main(words(capture, tmp_path / "out", *more)) == 0
    (entry,) = json.loads(results.read_text())["captures"]
    assert (entry["train_views"], entry["test_views"], entry["truth"]) == (5, 2, True)
    ((run,),) = (curve["runs"] for curve in entry["curves"])
    (point,) = run["course"]
    assert (point["iterations"], run["iterations"]) == (20, 30)
    assert 0 < point["user_seconds"] < run["user_seconds"]
    assert point["seconds"] < run["seconds"]
    assert 5 < run["images"]["psnr"] < 60
    assert 0 <= run["surface"]["f_scores"]["0.0025"] <= run["surface"]["f_scores"]["0.01"] <= 1
    assert "| still | 2dgs | 0.001 |" in capsys.readouterr().out
    assert np.asarray(Image.open(figure)).shape[1] > 1000


def test_each_recipe_is_trained_once_for_each_schedule_the_shortest_first(
    capture: Path, tmp_path: Path, in_process: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quality_run, "surface", lambda *_: {"surface": None})
    asked = words(capture, tmp_path, "--scales", "0.0008", "0.0004")
    assert time_to_quality.main(asked) == 0
    assert in_process == ["2dgs-0.0004-s0", "2dgs-60k-0.0004-s0", "2dgs-0.0008-s0", "2dgs-60k-0.0008-s0"]
    (entry,) = json.loads((tmp_path / "results.json").read_text())["captures"]
    lengths = {curve["name"]: [run["iterations"] for run in curve["runs"]] for curve in entry["curves"]}
    assert lengths == {"2dgs": [12, 24], "2dgs-60k": [24, 48]}
    assert time_to_quality.main(asked) == 0
    assert len(in_process) == 4, "what is finished is not repeated"
    assert time_to_quality.main([*asked, "--set", "seed=1"]) == 0
    assert len(in_process) == 8, "another specification is another training"


def test_a_training_that_was_cut_off_goes_on_to_the_same_splats_with_its_seconds(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    args = time_to_quality.parse(words(capture, tmp_path, "--points", "3"))
    spec = time_to_quality.specification(capture, 1, "2dgs", 0.001, 0, args)
    seen: dict[str, np.ndarray] = {}

    def surface(job: Any, state: Any, *_: Any) -> dict[str, Any]:
        seen[place.name] = state.splats.means.numpy().copy()
        return {"surface": None}

    monkeypatch.setattr(quality_run, "surface", surface)
    place = tmp_path / "whole"
    place.mkdir()
    whole = quality_run.train(spec, place, Clocks(time.time()))
    place = tmp_path / "cut"
    place.mkdir()
    score, count = quality_run.score, []

    def cut_off(*arguments: Any) -> dict[str, Any]:
        count.append(1)
        if len(count) == 2:
            raise KeyboardInterrupt
        return score(*arguments)

    monkeypatch.setattr(quality_run, "score", cut_off)
    with pytest.raises(KeyboardInterrupt):
        quality_run.train(spec, place, Clocks(time.time() - 1000.0))
    monkeypatch.setattr(quality_run, "score", score)
    went_on = quality_run.train(spec, place, Clocks(time.time()))
    assert (seen["cut"] == seen["whole"]).all()
    assert [point["iterations"] for point in went_on["course"]] == [10, 20]
    assert [point["images"] for point in went_on["course"]] == [point["images"] for point in whole["course"]]
    assert 1000.0 < went_on["course"][0]["seconds"] < went_on["course"][1]["seconds"] < went_on["seconds"] < 1100.0


def test_the_peer_trains_on_the_same_photographs_and_its_better_variant_counts(
    capture: Path, tmp_path: Path, in_process: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    binary = fake_peer(tmp_path / "bin", seconds=0.0)  # draws the photograph itself
    scores = iter(({"psnr": 20.0}, {"psnr": 21.0}))

    def scored(job: Any, files: Any) -> dict[str, Any]:
        images = [np.asarray(Image.open(file)) for file in files]
        truth = [np.rint(view.target(job.settings.background) * 255) for view in job.scene.test]
        assert all((a == b).all() for a, b in zip(images, truth, strict=True)), "over our background"
        return {"test": next(scores)}

    monkeypatch.setattr(time_to_quality, "score_images", scored)
    more = ("--recipes", "2dgs", "--scales", "0.001", "--opensplat", str(binary), "--opensplat-scales", "0.004")
    assert time_to_quality.main(words(capture, tmp_path / "out", *more)) == 0
    (entry,) = json.loads((tmp_path / "out" / "results.json").read_text())["captures"]
    ours, peer = entry["curves"]
    assert [run["scale"] for run in ours["runs"]] == [0.001]
    (row,) = peer["runs"]
    assert (row["scale"], row["iterations"], row["variant"], row["images"]["psnr"]) == (0.004, 64, "moving", 21.0)
    assert row["splats"] == 7
    trainings = [call for call in calls(binary) if "--resume" not in call]
    assert [call[call.index("-n") + 1] for call in trainings] == ["64", "64"]
    assert (tmp_path / "out/still/opensplat-0.004/train/sparse/0/points3D.bin").stat().st_size > 10_000 * 43


def test_a_capture_without_points_starts_the_peer_from_random_ones_in_its_bounds(capture: Path) -> None:
    scene = load_scene(capture)
    started = time_to_quality.with_start(scene, 50, 3)
    assert started.points is not None
    assert len(started.points) == 50
    assert ((started.points.points >= scene.bounds[0]) & (started.points.points <= scene.bounds[1])).all()
    assert time_to_quality.with_start(started, 9, 3).points is started.points


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--recipes", "3dgs"), "3dgs"),
        (("--scales", "0"), "--scales must be positive numbers"),
        (("--points", "0"), "--points must be at least 1"),
        (("--opensplat", "nowhere"), "--opensplat must be a binary, got nowhere"),
        (("--figure", "figure.pdf"), "--figure must end in .svg or .png, got figure.pdf"),
    ],
)
def test_a_wrong_option_is_told_before_anything_is_trained(
    more: tuple[str, ...], said: str, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        time_to_quality.main([str(capture), "--out", str(tmp_path / "out"), *more])
    assert ended.value.code == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    with pytest.raises(SystemExit):
        time_to_quality.main([str(tmp_path / "none")])


# -- the figure ----------------------------------------------------------------------------------------------------
def document() -> dict[str, Any]:
    def run(scale: float, seconds: float, psnr: float, f: float | None, seed: int = 0) -> dict[str, Any]:
        surface = None if f is None else {"f_scores": {"0.0025": f}}
        course = [{"user_seconds": seconds / 2, "seconds": seconds, "images": {"psnr": psnr - 2}}]
        times = {"user_seconds": seconds, "seconds": 2 * seconds, "course": course}
        return {"scale": scale, "seed": seed, **times, "images": {"psnr": psnr}, "surface": surface}

    def entry(name: str, f: float | None) -> dict[str, Any]:
        runs = [run(0.1, 90.0, 30.0, f), run(0.02, 10.0, 24.0, f), run(0.02, 14.0, 26.0, f, seed=1)]
        curves = [{"name": "2dgs", "runs": runs}, {"name": "best & fast", "runs": runs[:1]}]
        return {"name": name, "test_views": 2, "truth": f is not None, "curves": curves}

    return {"captures": [entry("demo", 0.7), entry("lego", None)]}


def test_a_marker_is_the_end_of_a_schedule_and_the_mean_of_its_seeds() -> None:
    curve = document()["captures"][0]["curves"][0]
    assert quality_plot.ends(curve, "user_seconds", quality_plot.psnr_of) == ([12.0, 90.0], [25.0, 30.0])
    assert quality_plot.ends(curve, "seconds", quality_plot.f_of) == ([24.0, 180.0], [0.7, 0.7])


def test_the_figure_has_a_panel_for_each_measure_that_a_capture_has(tmp_path: Path) -> None:
    figure = quality_plot.draw(document(), "user_seconds")
    titles = [axes.get_title() for axes in figure.axes if axes.axison]
    assert titles == ["demo: PSNR of test views, dB", "demo: F at 0.25 % of its size", "lego: PSNR of test views, dB"]
    panel = figure.axes[0]
    markers = [line for line in panel.get_lines() if line.get_marker() == "o"]
    assert [line.get_label() for line in markers] == ["2dgs", "best & fast"]
    assert list(markers[0].get_xdata()) == [12.0, 90.0]
    courses = [list(line.get_xdata()) for line in panel.get_lines() if line.get_marker() != "o"]
    assert [45.0, 90.0] in courses, "points of a course are joined, and have no marker"
    quality_plot.write_figure(tmp_path / "a.svg", document(), "seconds")
    quality_plot.write_figure(tmp_path / "b.svg", document(), "seconds")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert re.search(r"<svg", (tmp_path / "a.svg").read_text())
