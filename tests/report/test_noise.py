"""Pictures of noise, which compress worst: error maps of a draft look like it."""

from __future__ import annotations

import base64
import io

import numpy as np
import pytest
from PIL import Image

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
