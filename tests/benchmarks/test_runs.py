"""The profile of a run and the growth of its steps: whose time a stack is, and what counts as too steep."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from benchmarks import growth, profile_run

from gs2d.core.splats import Splats
from gs2d.kernels.library import available_variants

needs_native = pytest.mark.skipif(not available_variants(), reason="the native library was not built")


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
