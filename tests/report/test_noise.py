"""Pictures of noise, which compress worst: error maps of a draft look like it."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gs2d.contrib.pictures.video import write_video
from gs2d.data.image_files import write_image
from gs2d.errors import BackendError
from gs2d.report.html_parts import image_tag

SIDES = (1, 7, 64, 256, 257, 300, 360, 361, 520, 700)


def noise(height: int, width: int, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(height * width).integers(0, 256, (height, width, channels), dtype=np.uint8)


def decoded(html: str) -> np.ndarray:
    data = html.partition("base64,")[2].partition('"')[0]
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("width", [360, 960])
def test_noise_of_any_size_becomes_an_image_of_the_report(side: int, width: int) -> None:
    image = noise(max(side * 3 // 4, 1), side)
    shown = decoded(image_tag(image, alt="noise", width=width))
    assert shown.shape[1] == min(side, width)
    if side <= width:  # not shrunk: the noise itself, but for the loss of the compression
        assert np.abs(shown.astype(float) - image).mean() < 12


@pytest.mark.parametrize("ending", [".webp", ".mp4"])
def test_noise_makes_a_video(ending: str, tmp_path: Path) -> None:
    frames = [tmp_path / f"{i}.png" for i in range(3)]
    for i, frame in enumerate(frames):
        write_image(frame, np.roll(noise(120, 180), i, axis=0))
    try:
        write_video(tmp_path / f"film{ending}", frames, fps=10)
    except BackendError as error:
        pytest.skip(str(error))
    assert (tmp_path / f"film{ending}").stat().st_size > 0
