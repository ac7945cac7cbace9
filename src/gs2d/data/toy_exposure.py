"""Photographs as by a camera on automatic: each training picture of a capture gets a gain and a white balance."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gs2d.errors import DataError
from gs2d.images import read_image, write_image
from gs2d.io.files import read_json, write_json

GAINS = "exposure_gt.json"
GAIN, BALANCE = 1.35, 1.08  # largest gain (and its inverse the smallest), and what a channel has more or less than it


def random_gains(count: int, seed: int, *, gain: float = GAIN, balance: float = BALANCE) -> np.ndarray:
    """Gains of the three channels of ``count`` photographs [count, 3]; the mean of each channel is 1.

    log gain is uniform within ``gain``, log balance within ``balance``. A photograph's values are sRGB: where the curve
    of a camera is a power of the light, a longer exposure is a gain there too.
    """
    rng = np.random.default_rng([seed, 2])
    logs = np.log(gain) * rng.uniform(-1, 1, (count, 1)) + np.log(balance) * rng.uniform(-1, 1, (count, 3))
    gains = np.exp(logs)
    return np.asarray(gains / gains.mean(axis=0))


def vary_exposure(
    folder: Path, *, seed: int = 0, gain: float = GAIN, balance: float = BALANCE
) -> dict[str, list[float]]:
    """Multiply the training pictures of a Blender capture by random gains, in place; clipped at 255, alpha stays.

    Test pictures keep the gain 1, which is the mean of the others. The gains go to ``exposure_gt.json`` first, which
    marks the capture: it is never done twice.

    Returns
    -------
    dict of view name to three floats

    Raises
    ------
    DataError
        It was done before, or a picture is missing.
    DiskError
    """
    if (folder / GAINS).exists():
        raise DataError(f"the pictures of {folder} have gains already ({GAINS}); make the capture anew")
    frames = read_json(folder / "transforms_train.json")["frames"]
    files = [(folder / frame["file_path"]).with_suffix(".png") for frame in frames]
    gains = random_gains(len(files), seed, gain=gain, balance=balance)
    truth = {str(file.relative_to(folder)): list(map(float, row)) for file, row in zip(files, gains, strict=True)}
    write_json(folder / GAINS, truth)
    for file, row in zip(files, gains, strict=True):
        image = read_image(file)
        changed = image.copy()
        changed[..., :3] = np.rint(np.minimum(image[..., :3] * row, 255))
        write_image(file, changed)
    return truth
