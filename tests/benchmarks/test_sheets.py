"""What benchmarks/sheets.py says of splats that are planted in a trained run."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from benchmarks import sheets

from ball_runs import options
from gs2d.core.splats import Splats
from gs2d.io.splat_ply import read_splats, write_splats
from gs2d.pipeline.train.train_run import train
from tiny import write_capture


def planted(splats: Splats, mean: tuple[float, float, float], scale: float) -> Splats:
    """The splats and a white, opaque one at ``mean``, flat in z, of ``scale`` world units in x and y."""
    one = replace(
        splats.rows(torch.zeros(1, dtype=torch.long)),
        means=torch.tensor([mean]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        log_scales=torch.full((1, 2), scale).log(),
        opacity_logits=torch.full((1,), 5.0),
        sh0=torch.full((1, 1, 3), 0.5 / 0.28209479),
        shN=torch.zeros(1, *splats.shN.shape[1:]),
    )
    return Splats(**{name: torch.cat([tensor, getattr(one, name)]) for name, tensor in splats.items()})


def figures(text: str) -> list[tuple[str, float, float]]:
    """Each row's name, mean PSNR and share of the background that is covered."""
    found = re.findall(r"^  (.*): ([\d.]+) dB, least [\d.]+ dB, empty background covered ([\d.]+) %$", text, re.M)
    return [(name, float(psnr), float(covered)) for name, psnr, covered in found]


def test_planted_sheets_are_counted_and_their_cost_is_stated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # The ball's radius is 0.8, cameras are 3 away and look at it; the scene's extent is some 3.5. One sheet of 0.9
    # lies below the ball, in sight; a small splat stands behind all cameras.
    run = tmp_path / "run"
    train(options(write_capture(tmp_path / "ball"), run))
    splats = read_splats(run / "splats.ply")
    sheets.report(run, longer=0.2)
    (_, psnr, covered), (unseen, *_), (long, *_), _ = figures(capsys.readouterr().out)
    assert (unseen, long) == ("without 0 unseen", "without 0 long")

    write_splats(run / "splats.ply", planted(planted(splats, (0, 0, -1.5), 0.9), (0, 0, 50), 0.01))
    sheets.report(run, longer=0.2)
    everything, without_unseen, without_long, without_both = figures(capsys.readouterr().out)
    assert without_unseen[0] == "without 1 unseen"
    assert without_long[0] == "without 1 long"
    assert everything[2] > covered + 5  # per cent
    assert everything[1:] == without_unseen[1:]
    assert without_long[1:] == without_both[1:] == (psnr, covered)
