"""The report section on world coordinates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gs2d.contrib.survey.georeference import Georeference, Residual, write_georeference
from gs2d.contrib.survey.report_section import SHOWN, georeference_section
from gs2d.errors import DataError
from gs2d.report.run_record import RunRecord


def test_a_run_without_georeference_has_no_section(tmp_path: Path) -> None:
    assert georeference_section(RunRecord(tmp_path, {})) is None


def test_check_points_come_first_then_outliers_then_the_largest_errors(tmp_path: Path) -> None:
    fitted = tuple(Residual(f"{k}.jpg", np.array([0.01 * k, 0, 0]), "fitted") for k in range(SHOWN + 3))
    others = (
        Residual("<gate>", np.array([0, -0.3, 0.4]), "check"),
        Residual("wild.jpg", np.array([0, 0, 9.0]), "left out"),
    )
    origin = np.array([500_000.0, 5_200_000, 400])
    write_georeference(
        tmp_path,
        Georeference(
            1.25,
            np.eye(3),
            np.zeros(3),
            origin,
            "a test",
            epsg=32632,
            residuals=(*fitted, *others),
            doubts=("the scale is known to 3.0% only",),
        ),
    )
    html = str(georeference_section(RunRecord(tmp_path, {})))
    assert "EPSG:32632" in html
    assert "1.25 m per unit" in html
    assert "doubtful: the scale is known to 3.0% only" in html
    places = [html.index(f">{name}</td>") for name in ("&lt;gate&gt;", "wild.jpg", "14.jpg", "13.jpg")]
    assert places == sorted(places)
    assert "<td>0.500</td><td>+0.000</td><td>-0.300</td><td>+0.400</td>" in html
    assert "5 more have smaller errors" in html


def test_a_damaged_file_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "georeference.json").write_text("{}", encoding="utf-8")
    with pytest.raises(DataError, match="is damaged"):
        georeference_section(RunRecord(tmp_path, {}))
