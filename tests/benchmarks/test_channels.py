"""benchmarks/channels.py runs, and says what it compares."""

from __future__ import annotations

import pytest
import torch
from benchmarks import channels


@pytest.mark.usefixtures("native")
def test_every_way_has_a_ratio_to_one_view_of_three_channels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(channels, "CHANNELS", (3, 12))
    threads = torch.get_num_threads()
    try:
        rows = {name: median for name, median, _, _ in channels.measure(4000, 160, 5)}  # less, and the calls are timed
    finally:
        torch.set_num_threads(threads)
    assert rows.pop("rasterize, 3 channels") == 1.0
    assert list(rows)[:2] == ["3 channels", "12 channels"]
    assert rows["12 channels"] > rows["3 channels"]
    assert all(median > 0 for median in rows.values())
