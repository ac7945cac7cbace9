"""The profile of a run and the growth of its steps: whose time a stack is, and what counts as too steep."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from benchmarks import growth, profile_run
from benchmarks.sampler import Rule, Sampler, Seconds, classify

from gs2d.core.splats import Splats
from gs2d.kernels.library import available_variants

needs_native = pytest.mark.skipif(not available_variants(), reason="the native library was not built")


def test_the_innermost_place_decides_whose_time_a_stack_is() -> None:
    # the PSNR curve is drawn from inside a training iteration, and renders: curve, not iteration; rasterizer, not score
    stack = [
        ("/x/gs2d/render/cpu.py", "forward"),
        ("/x/gs2d/evaluation/images.py", "image_metrics"),
        ("/x/gs2d/pipeline/run_logger.py", "_probe_psnr"),
        ("/x/gs2d/training/trainer.py", "step"),
    ]
    assert classify(stack, profile_run.PHASES) == "PSNR curve"
    assert classify(stack, profile_run.PARTS) == "rasterizer"
    assert classify(stack[3:], profile_run.PHASES) == "training iterations"
    assert classify([("/x/other.py", "f")], profile_run.PHASES) is None


def test_every_place_of_the_tables_exists() -> None:
    package = Path(__file__).resolve().parents[2] / "src" / "gs2d"
    files = {str(path): path.read_text() for path in package.rglob("*.py")}
    for rule in (*profile_run.PHASES, *profile_run.PARTS):
        for end, function in rule.places:
            if "importlib" in end:
                continue
            held = [text for path, text in files.items() if path.endswith(end)]
            assert held, f"{rule.name}: no file ends in {end}"
            assert not function or any(f"def {function}(" in text for text in held), f"{rule.name}: no {function}"


def test_samples_add_up_to_phases_parts_and_the_share_of_the_rasterizer() -> None:
    sampler = Sampler(profile_run.PHASES, profile_run.PARTS)
    step = ("/x/training/trainer.py", "step")
    sampler.add([("/x/render/cpu.py", "backward"), step], 3.0)
    sampler.add([("/x/training/adam.py", "adam_step"), step], 0.5)
    sampler.add([("/x/unknown.py", "work")], 0.5)
    result = profile_run.table(sampler.seconds)
    assert result["seconds"] == 4.0
    assert result["rasterizer_share"] == 0.75
    assert result["phases"]["training iterations"] == {"seconds": 3.5, "parts": {"rasterizer": 3.0, "Adam": 0.5}}
    assert list(result["phases"]) == ["training iterations", "other"]
    assert result["elsewhere"] == {"unknown.py:work": 0.5}


def test_a_thread_is_watched_only_while_it_is_inside() -> None:
    def slow() -> None:
        time.sleep(0.2)

    before = sys.getswitchinterval()
    with Sampler((Rule("here", ((__file__.rsplit("/", 1)[-1], "slow"),)),), ()) as seconds:
        slow()
    assert isinstance(seconds, Seconds)
    assert sum(seconds.phases["here"].values()) > 0.05
    assert sys.getswitchinterval() == before


def test_the_exponent_is_the_slope_between_the_two_largest_sizes() -> None:
    assert growth.exponent([1, 10, 20], [5, 1, 8]) == pytest.approx(3)
    assert growth.exponent([10, 30], [2, 6]) == pytest.approx(1)


@needs_native
@pytest.mark.parametrize("quadratic", [False, True])
def test_growth_fails_on_a_quadratic_step(quadratic: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = [0.0]  # a clock that only the step moves: no neighbour can make the slope another

    def loops(splats: Splats) -> Callable[[], object]:
        n = len(splats)

        def step() -> None:
            seconds[0] += 1e-6 * (n * n if quadratic else 400 * n)

        return step

    monkeypatch.setattr(growth.time, "process_time", lambda: seconds[0])
    monkeypatch.setattr(growth, "BY_SPLATS", {"loops": loops})
    file = tmp_path / "growth.json"
    words = ["--only", "loops", "--splats", "200", "400", "--repeats", "5", "--out", str(file)]
    assert growth.main(words) == int(quadratic)
    row = json.loads(file.read_text())["steps"]["loops"]
    assert row["sizes"] == [200, 400]
    assert row["exponent"] == pytest.approx(2 if quadratic else 1, abs=1e-3)


@needs_native
def test_the_short_form_of_growth_measures_every_step(capsys: pytest.CaptureFixture[str]) -> None:
    assert growth.main(["--quick"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" {")[0] for line in lines] == [*growth.BY_SPLATS, *growth.BY_PIXELS]
