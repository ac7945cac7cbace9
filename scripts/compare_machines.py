"""Compare the results of two processors: images and gradients of random splats, and a short training.

    python scripts/compare_machines.py make OUT.npz --capture FOLDER     # on each machine; creates FOLDER
    python scripts/compare_machines.py compare A.npz B.npz               # fails if they differ by more than rounding

`scripts/check_aarch64.sh` runs it on this machine and under QEMU.
"""

from __future__ import annotations

import argparse
import platform
import sys
import time
from pathlib import Path

import numpy as np
import torch

import gs2d
from gs2d.contrib.demo.demo_capture import write_demo_capture
from gs2d.core.splats import ATTRIBUTES

SPLATS, WIDTH, HEIGHT = 30_000, 240, 180
VIEWS, SIZE, SCHEDULE = 10, 64, 0.005
IMAGES = ("color", "alpha", "normal", "depth_mean", "distortion")


def make(out: Path, capture: Path) -> None:
    """Write the results of this processor."""
    print(
        f"{platform.machine()}: python {platform.python_version()}, torch {torch.__version__}, gs2d {gs2d.__version__}"
    )
    found = {**_drawn(), **_trained(capture)}
    np.savez(out, **found)


def _drawn() -> dict[str, np.ndarray]:
    """Return images of random splats, and the gradients of a weighted sum of all images."""
    rng = np.random.default_rng(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.from_numpy(rng.standard_normal(shape).astype(np.float32))

    splats = gs2d.Splats(
        means=normal(SPLATS, 3),
        quats=normal(SPLATS, 4),
        log_scales=normal(SPLATS, 2) * 0.5 - 4.0,
        opacity_logits=normal(SPLATS),
        sh0=normal(SPLATS, 1, 3),
        shN=normal(SPLATS, 8, 3) * 0.2,
    )
    for _, tensor in splats.items():
        tensor.requires_grad_()
    camera = gs2d.look_at(
        np.array([0.5, -1.0, 4.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]), width=WIDTH, height=HEIGHT, fx=200.0
    )
    started = time.process_time()
    seen = gs2d.rasterize(splats, camera, backend="cpu")
    loss = torch.zeros(())
    for name in IMAGES:
        image = getattr(seen, name)
        loss = loss + (image * normal(*image.shape)).sum()
    loss.backward()  # type: ignore[no-untyped-call]
    drawn = int((seen.radii > 0).sum())
    print(f"  {drawn} of {SPLATS} splats drawn, and their gradients, in {time.process_time() - started:.1f} s")
    images = {f"image {name}": getattr(seen, name).detach().numpy() for name in IMAGES}
    return images | {f"gradient {name}": getattr(splats, name).grad.numpy() for name in ATTRIBUTES}


def _trained(capture: Path) -> dict[str, np.ndarray]:
    """Return test PSNR and the number of splats after a short training."""
    if not capture.exists():
        write_demo_capture(capture, seed=0, train_views=VIEWS, test_views=2, size=SIZE)
    started = time.process_time()
    trained = gs2d.train(gs2d.load_scene(capture), schedule_scale=SCHEDULE, backend="cpu")
    psnr = gs2d.evaluate(trained).psnr.value
    print(f"  trained to {len(trained.splats)} splats, {psnr:.3f} dB, in {time.process_time() - started:.0f} s")
    return {"training psnr": np.array(psnr), "training splats": np.array(len(trained.splats))}


def compare(first: Path, second: Path) -> int:
    """Print the differences; return the number of differences beyond rounding."""
    a, b = np.load(first), np.load(second)
    faults = 0
    for name in a.files:
        x, y = a[name].astype(np.float64), b[name].astype(np.float64)
        apart = np.abs(x - y)
        if name.startswith("image"):  # a pair at a threshold may be drawn on one processor only
            value, limit = float(np.quantile(apart, 0.999)) / float(np.abs(x).max()), 1e-4
            told = f"99.9 % of pixels within {value:.1e} of the largest value, the rest within {apart.max():.1e}"
        elif name.startswith("gradient"):
            value, limit = float(np.linalg.norm(x - y) / np.linalg.norm(x)), 2e-3
            told = f"relative difference {value:.1e}"
        elif name == "training psnr":
            value, limit = float(apart), 0.3
            told = f"{float(x):.3f} and {float(y):.3f} dB"
        else:
            value, limit = float(apart / x), 0.1
            told = f"{int(x)} and {int(y)}"
        faults += not value <= limit  # NaN counts as a difference
        print(f"{'ok   ' if value <= limit else 'FAULT'} {name}: {told}")
    return faults


def main() -> int:
    """Run the requested command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    maker = commands.add_parser("make")
    maker.add_argument("out", type=Path)
    maker.add_argument("--capture", type=Path, required=True)
    comparer = commands.add_parser("compare")
    comparer.add_argument("first", type=Path)
    comparer.add_argument("second", type=Path)
    given = parser.parse_args()
    if given.command == "compare":
        return min(compare(given.first, given.second), 1)
    make(given.out, given.capture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
