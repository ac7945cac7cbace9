"""The section about learned quantities: every quantity of the recipe, built in or not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gs2d.config.quantities import QUANTITIES
from gs2d.core.json_files import write_json
from gs2d.errors import DataError
from gs2d.report.run_record import RunRecord
from gs2d.report.sections.learned_section import learned_section
from gs2d.training.learned.quantity import LearnedQuantity

FRAMES = [
    {"name": "a.jpg", "split": "train", "moved": {"pixels": 1.5, "degrees": 0.1}, "zoom": [1.01, 0, 0]},
    {"name": "b.jpg", "split": "train", "moved": {"pixels": 0.5, "degrees": 0.3}, "zoom": [1.01, 0, 0]},
    {"name": "c.jpg", "split": "test"},
]


def written(folder: Path, views: dict[str, Any], *names: str) -> RunRecord:
    write_json(folder / "learned.json", {"views": views})
    write_json(folder / "poses.json", {"frames": FRAMES})
    return RunRecord(folder, {"recipe": {"learned": [{"name": name} for name in names]}})


def test_each_built_in_quantity_has_a_paragraph(tmp_path: Path) -> None:
    gains = {"a.jpg": 0.8, "b.jpg": 1.2}
    transforms = {name: {"exposure": (gain * np.eye(3, 4)).tolist()} for name, gain in gains.items()}
    html = str(learned_section(written(tmp_path, transforms, *QUANTITIES.builtin)))
    titles = [html.index(f"<h3>{QUANTITIES.get(name).title}</h3>") for name in QUANTITIES.builtin]
    assert len(set(titles)) == len(QUANTITIES.builtin)
    for words in (
        "a.jpg is the darkest photograph (0.80 times the mean brightness), b.jpg the brightest (1.20 times)",
        "Training cameras moved by 1.00 px on average (0.200 degrees); a.jpg moved most (1.50 px)",
        "Focal lengths changed by a factor of 1.0100.",
    ):
        assert words in html
    assert html.count("data:image/svg+xml") == 2  # exposure and poses are plotted by photograph


def test_a_quantity_of_another_package_is_plotted_by_its_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(QUANTITIES._objects, "haze", type("Haze", (LearnedQuantity,), {"title": "Haze <of> a lens"}))
    monkeypatch.setitem(QUANTITIES._objects, "many", type("Many", (LearnedQuantity,), {}))
    views = {"a.jpg": {"haze": [0.1, 0.2], "many": [3.0] * 16}, "b.jpg": {"haze": [-0.3, 0.4], "many": [1.0] * 16}}
    html = str(learned_section(written(tmp_path, views, "haze", "many")))
    assert "<h3>Haze &lt;of&gt; a lens</h3>" in html
    assert "Numbers of 2 photographs, from -0.3 to 0.4." in html
    assert "<h3>many</h3>" in html
    assert LearnedQuantity.report("many", {"views": views}).curves == {"root mean square": [3.0, 1.0]}  # type: ignore[union-attr]
    assert html.count("data:image/svg+xml") == 2


def test_a_quantity_whose_package_is_not_installed_is_named(tmp_path: Path) -> None:
    html = str(learned_section(written(tmp_path, {"a.jpg": {"glow": [1.0]}}, "glow")))
    assert "<h3>glow</h3>" in html
    assert "is not installed; learned.json has its numbers" in html


def test_without_learned_quantities_there_is_no_section_and_a_damaged_file_is_an_error(tmp_path: Path) -> None:
    assert learned_section(RunRecord(tmp_path, {"recipe": {"learned": []}})) is None
    record = written(tmp_path, {"a.jpg": {"exposure": [1.0]}}, "exposure")
    with pytest.raises(DataError, match=r"learned\.json is damaged"):
        learned_section(record)
