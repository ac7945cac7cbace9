"""One second of mutated inputs of every family, always from the same first one, and every input that was a finding.

``GS2D_FUZZ_SECONDS=0`` throws a dozen inputs a family. ``make fuzz`` throws new ones for an hour a family; what it
finds goes into ``findings/FAMILY/`` as the changed file alone (``drive.py --keep`` writes it; "__" stands for "/" in
its name, behind a number and "--").
"""

from __future__ import annotations

import itertools
import os
import sys
import time
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

from drive import try_case  # noqa: E402
from families import FAMILIES  # noqa: E402
from guard import outcome  # noqa: E402

from gs2d.errors import DataError  # noqa: E402

LEAST = 12  # inputs a family, whatever the time
SLOW = {"run-files": 6, "usd": 3}
SECONDS = float(os.environ.get("GS2D_FUZZ_SECONDS", "1"))  # a family, at least
FINDINGS = sorted(path for path in (HERE / "findings").rglob("*") if path.is_file())


@pytest.mark.usefixtures("native")
@pytest.mark.parametrize("name", FAMILIES)
def test_mutated_inputs_are_read_or_refused_in_one_line(tmp_path: Path, name: str) -> None:
    family = FAMILIES[name]
    end = time.monotonic() + SECONDS
    for seed in itertools.count():
        if seed >= SLOW.get(name, LEAST) and time.monotonic() >= end:
            break
        files, victim = family.case(seed)
        finding, _, _ = try_case(family, files, tmp_path)
        assert finding is None or finding.startswith("memory"), f"{name} {seed} ({victim}): {finding}"


@pytest.mark.usefixtures("native")
@pytest.mark.parametrize("path", FINDINGS, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_what_was_a_finding_stays_mended(tmp_path: Path, path: Path) -> None:
    family, victim = FAMILIES[path.parent.name], path.name.partition("--")[2].replace("__", "/")
    seeds = [seed for seed in family.seeds_made() if victim in seed]
    assert seeds
    for seed in seeds:
        finding, _, _ = try_case(family, {**seed, victim: path.read_bytes()}, tmp_path)
        assert finding is None or finding.startswith("memory"), finding


def test_an_input_is_the_same_whenever_it_is_made() -> None:
    for name in ("colmap-bin", "recipe", "images"):
        assert FAMILIES[name].case(3) == FAMILIES[name].case(3)
        assert len({str(FAMILIES[name].case(seed)) for seed in range(20)}) > 15


def test_the_guard_sees_what_is_not_allowed(tmp_path: Path) -> None:
    """A fuzzer that sees nothing would pass for ever."""
    (tmp_path / "inside").mkdir()

    def fault(_: Path) -> None:
        raise KeyError("a")

    def warned(_: Path) -> None:
        import numpy as np

        np.float32(1e30) * np.float32(1e30)

    def outside(_: Path) -> None:
        (tmp_path / "b").write_text("x")

    def lines(_: Path) -> None:
        error = DataError("one")
        error.args = ("one\ntwo",)  # its own constructor makes one line of it
        raise error

    def process(_: Path) -> None:
        import subprocess

        subprocess.run(["true"], check=True)

    def refused(_: Path) -> None:
        raise DataError("no")

    def inside(folder: Path) -> None:
        (folder / "c").write_text("x")

    seen = [
        outcome(read, tmp_path / "inside", 10)[0]
        for read in (
            *(fault, warned, outside, lines, process),
            *(lambda _: print("x", file=sys.__stderr__), lambda _: print("x", file=sys.__stdout__)),
        )
    ]
    words = (
        "traceback: KeyError",
        "warning: Runt",
        "outside: open",
        "a message of sev",
        "outside: sub",
        *("printed",) * 2,
    )
    assert [str(found)[: len(word)] for found, word in zip(seen, words, strict=True)] == list(words)
    assert outcome(refused, tmp_path / "inside", 10)[:2] == (None, "refused")
    assert outcome(inside, tmp_path / "inside", 10)[:2] == (None, "read")
