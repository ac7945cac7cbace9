"""What is drawn while a command works: bars of any width, sparse lines in a log, the time left."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

from gs2d.cli.console import Bar, Console
from gs2d.training.events import Notice, Phase, Step
from terminal import ESCAPES, raw_screen_of

DRAWN = textwrap.dedent(
    """
    import time
    from gs2d.cli.console import Console
    from gs2d.training.events import Notice, Phase, Step
    console = Console(quiet=False, as_json=False)
    console.on_event(Phase("training 2dgs-r", 6000))
    for done in (1000, 2000, 3000):
        time.sleep(0.3)
        console.on_event(Step(done, "surface 3,000/3,000  36,422 splats  loss 0.0712  and more than fits in a line"))
    console.on_event(Notice("a note that is much longer than one line of a narrow terminal has columns, word by word"))
    console.close()
    console.table("", ["stage", "iterations", "splats", "PSNR train", "PSNR test", "SSIM"],
                  [["surface", "3,000", "36,422", "22.36", "19.79", "0.6940"]])
    """
)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "drawn.py").write_text(DRAWN, encoding="utf-8")
    paths = [str(tmp_path), *sys.path]
    monkeypatch.setenv("PYTHONPATH", ":".join(paths))
    return "drawn"


@pytest.mark.skipif(sys.platform == "win32", reason="a pseudo-terminal")
@pytest.mark.parametrize("columns", [60, 80])
def test_bars_and_tables_fit_the_terminal(columns: int, module: str) -> None:
    raw = raw_screen_of([], columns=columns, command=module)
    assert "\x1b[" in raw
    lines = [line for part in ESCAPES.sub("", raw).split("\n") for line in part.split("\r")]
    assert max(len(line) for line in lines if not line.startswith("note")) <= columns
    assert any(line.startswith("training 2dgs-r  ") and "3,000/6,000  " in line and "left" in line for line in lines)
    assert any(line.startswith("note a note that is") for line in lines)
    assert any("22.36" in line for line in lines)


@pytest.mark.skipif(sys.platform == "win32", reason="a pseudo-terminal")
def test_a_dumb_terminal_gets_no_escape_and_no_color_no_style(module: str) -> None:
    dumb = raw_screen_of([], columns=60, command=module, env={"TERM": "dumb"})
    assert "\x1b" not in dumb
    assert "training 2dgs-r (6000)\n" in dumb
    plain = raw_screen_of([], columns=60, command=module, env={"NO_COLOR": "1"})
    assert not [code for code in ESCAPES.findall(plain) if code.endswith("m")]
    assert "3,000/6,000" in plain


def test_a_log_file_gets_one_line_per_phase_and_occasional_progress(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = Clock()
    monkeypatch.setattr("gs2d.cli.console.time.monotonic", clock)
    monkeypatch.setenv("FORCE_COLOR", "1")
    console = Console(quiet=False, as_json=False)
    console.on_event(Phase("training 2dgs", 1000))
    for done in range(10, 1001, 10):  # a minute a tenth
        clock.now += 6.0
        console.on_event(Step(done))
    err = ESCAPES.sub("", capsys.readouterr().err).splitlines()
    assert err[0] == "training 2dgs (1000)"
    assert err[1].startswith("training 2dgs: 100 of 1,000, ")
    assert len(err) == 11


def test_a_title_is_not_wrapped_to_the_width_of_its_table(capsys: pytest.CaptureFixture[str]) -> None:
    Console(quiet=False, as_json=False).table("Modules [I]: scenes of NeRF-Synthetic", ["", "MB"], [["(I)", "-"]])
    assert capsys.readouterr().out.splitlines()[0] == "Modules [I]: scenes of NeRF-Synthetic"


def test_quiet_and_json_draw_nothing_on_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    quiet, as_json = Console(quiet=True, as_json=True), Console(quiet=False, as_json=True)
    for console in (quiet, as_json):
        for event in (Phase("training", 3), Step(1), Notice("n")):
            console.on_event(event)
        console.table("", ["a"], [["b"]])
        console.say("text")
        console.result({"a": 1})
    out, err = capsys.readouterr()
    assert out == '{\n  "a": 1\n}\n' * 2
    assert err == "training (3)\nnote n\n"


# Seconds after which 10, 20, ... of 900 iterations were done: a draft of the fountain on a machine with other work,
# where each fifth line or so comes 7 s late.
RECORDED = """
    1.9 9.7 11.8 13.8 21.6 23.3 24.4 25.8 33 34.2 35.4 36.8 43.9 45.2 47 48.6 56 59.5 67.9 70.2 78.6 80.4 82.2
    90.4 93.2 101.4 104.5 113.2 116.3 124 125.2 126.5 134 135.3 136.6 145.2 146.3 147.5 148.8 150.1 157.4
    158.8 160.1 161.3 168.9 170.2 171.5 178.9 180.2 181.6 183 190.2 191.6 194.5 202.4 203.9 205.7 213.2 214.9
    216.7 223.9 226.1 227.5 229 236.6 247.5 249.2 251.2 259.1 261 262.8 272.4 280.4 282.7 285.2 292.9 294.4
    296.3 303.9 305.7 307.7 315.4 317 318.2 319.1 326.1 327.4 328.4 329.3 338.9
""".split()


def follow(seconds: list[float]) -> Iterator[str]:
    """Play a training, and yield the time left of its bar."""
    clock = Clock()
    bar = Bar(Phase("training best", 10 * len(seconds)), clock)
    for number, now in enumerate(seconds, start=1):
        clock.now = now
        bar.step(10 * number)
        yield bar.remaining()


def seconds_of(left: str) -> float:
    number, unit = left.removesuffix(" left").split()
    return float(number) * {"s": 1, "min": 60}[unit]


def test_the_time_left_of_a_recorded_run_never_rises() -> None:
    shown = [seconds_of(left) for left in follow([float(seconds) for seconds in RECORDED]) if left.endswith(" left")]
    assert len(shown) > 80
    assert shown == sorted(shown, reverse=True)
    assert shown[-1] < shown[0] / 4
    assert 200 < shown[5] < 600  # 317 s were left


def test_the_time_left_rises_where_the_work_grows() -> None:
    grown = [float(i) for i in range(1, 31)] + [30.0 + 20.0 * i for i in range(1, 61)]  # twenty times as slow
    lefts = [seconds_of(left) for left in follow(grown) if left.endswith(" left")]
    assert max(lefts[40:60]) > 2 * min(lefts[20:30])
