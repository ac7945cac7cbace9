"""The table of the evidence: what is finished is not done again, a capture without a true surface has empty cells."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from benchmarks import evidence

IMAGES = {"psnr": 30.123, "worst_psnr": 25.0}


def row(capture: str, recipe: str) -> dict[str, Any]:
    known = capture == "bottle"
    return {
        "capture": capture,
        "recipe": recipe,
        "seed": 0,
        "scale": 1.0,
        "iterations": 30_000,
        "seconds": 1000.4,
        "train_psnr": 31.0,
        "images": IMAGES,
        "splats": 1234,
        "longest_splat": 0.051,
        "f_scores": [0.95, 0.99] if known else [],
        "chamfer": 0.0031 if known else None,
    }


def test_rows_that_are_there_are_shown_and_others_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made: list[tuple[str, str]] = []

    def make(case: evidence.Case, recipe: str, _: object) -> dict[str, Any]:
        made.append((case.name, recipe))
        return row(case.name, recipe)

    monkeypatch.setattr(evidence, "row_of", make)
    (tmp_path / "evidence.json").write_text(json.dumps([row("lego", "2dgs")]))
    words = ["data", str(tmp_path), "--captures", "lego", "bottle", "--recipes", "2dgs"]
    evidence.main(words)
    evidence.main(words)
    assert made == [("bottle", "2dgs")]
    lines = capsys.readouterr().out.splitlines()
    assert "| lego | `2dgs` | 30,000 | 30.12 | 25.00 | 31.00 |  |  | 1,234 | 0.05 | 1000 |" in lines
    assert "| bottle | `2dgs` | 30,000 | 30.12 | 25.00 | 31.00 | 0.950 | 0.00310 | 1,234 | 0.05 | 1000 |" in lines
    assert all(line.count("|") == 12 for line in lines)
    evidence.main([*words, "--seed", "1", "--captures", "lego"])
    assert made[-1] == ("lego", "2dgs")
