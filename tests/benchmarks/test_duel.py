"""Two source trees in turn: a tree against itself, tiny."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmarks.duel import main

from gs2d.kernels.library import FOLDER

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.usefixtures("native")
def test_a_tree_against_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Both sides run the library that is tested: a link to the package stands for a checkout's ``src``."""
    checkout = tmp_path / "tree"
    (checkout / "src").mkdir(parents=True)
    (checkout / "src" / "gs2d").symlink_to(FOLDER.parents[1])
    (checkout / "benchmarks").symlink_to(ROOT / "benchmarks")
    out = tmp_path / "duel.json"
    small = ["--splats", "50", "--size", "16", "--threads", "1", "--rounds", "2", "--each", "2", "--stage", "1"]
    main([str(checkout), str(checkout), *small, "--json", str(out)])
    facts = json.loads(out.read_text())
    assert [row["checkout"] for row in facts["rows"]] == ["tree", "tree"]
    assert all(0 < row["best"] <= row["quarter"] <= row["median"] for row in facts["rows"])
    assert facts["after_over_before"]["best"] == pytest.approx(facts["rows"][1]["best"] / facts["rows"][0]["best"])
    assert "after / before" in capsys.readouterr().out
