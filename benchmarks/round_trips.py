"""Measure the loss of each export format: bytes per splat, and renderings of the file that was read back.

::

    python -m benchmarks.round_trips RUN [--layouts 3dgs spz] [--split test] [--every 1]

Writes the splats of a finished run in every layout to a temporary folder, reads them back, and renders every N-th view
of a split (of the training views if the split is empty). Prints a Markdown row per layout: bytes per splat, PSNR
against the run's own renderings and against the photographs (mean over views, colours in [0, 1] without rounding),
seconds to write and to read. "the same" means that no pixel differs by more than 1e-4. For a stream with levels of
detail, a second table compares each level with the original splats, at full, half, quarter and eighth image size (means
of pixels), the sizes at which coarse levels are displayed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from gs2d.contrib.formats.sog import read_level
from gs2d.core.splats import Splats
from gs2d.data import View
from gs2d.errors import BackendError
from gs2d.io.formats.splat_formats import LAYOUTS, read_splats, write_layout, written_bytes
from gs2d.io.run_dir import open_run
from gs2d.pipeline.prepare.loaded import LoadedRun, finished_splats, reload_run
from gs2d.render.api import rasterize

Draw = Callable[[Splats], list[np.ndarray]]
SAME = 1e-4  # difference of a colour in [0, 1]


def pictures(splats: Splats, job: LoadedRun, views: Sequence[View]) -> list[np.ndarray]:
    """Render views, [H, W, 3] each, in [0, 1]."""
    placed = splats.to(job.backend.device)
    with torch.no_grad():
        drawn = [rasterize(placed, view.camera, job.settings, backend=job.backend).color for view in views]
    return [image.clamp(0, 1).cpu().numpy().astype(np.float64) for image in drawn]


def photographs(job: LoadedRun, views: Sequence[View]) -> list[np.ndarray]:
    """Return the photographs of views, over the run's background."""
    found = []
    for view in views:
        image = view.image().astype(np.float64) / 255
        if image.shape[2] == 4:
            image = image[..., :3] * image[..., 3:] + np.array(job.settings.background) * (1 - image[..., 3:])
        found.append(image)
    return found


def psnr(a: Sequence[np.ndarray], b: Sequence[np.ndarray]) -> float:
    """Return the mean PSNR of the images, dB."""
    errors = [max(float(np.square(x - y).mean()), 1e-20) for x, y in zip(a, b, strict=True)]
    return float(np.mean([-10 * np.log10(error) for error in errors]))


def row(layout: str, splats: Splats, draw: Draw, own: list[np.ndarray], real: list[np.ndarray], home: Path) -> str:
    """Write, read and render; return a table row. ``own`` is the rendering of the original splats."""
    path = home / f"a{LAYOUTS.get(layout).ending}"
    start = time.perf_counter()
    write_layout(path, splats, layout)
    written = time.perf_counter() - start
    start = time.perf_counter()
    back = read_splats(path)
    read = time.perf_counter() - start
    drawn = draw(back)
    furthest = max(float(np.abs(a - b).max()) for a, b in zip(drawn, own, strict=True))
    against = "the same" if furthest <= SAME else f"{psnr(drawn, own):.1f}"
    size = written_bytes(path, layout) / max(len(splats), 1)
    return f"| `{layout}` | {size:.1f} | {against} | {psnr(drawn, real):.2f} | {written:.1f} | {read:.1f} |"


def smaller(image: np.ndarray) -> np.ndarray:
    """Halve the image size by averaging 2 x 2 pixels; an odd last row or column is dropped."""
    h, w = (side // 2 * 2 for side in image.shape[:2])
    return image[:h, :w].reshape(h // 2, 2, w // 2, 2, -1).mean(axis=(1, 3))


def levels(draw: Draw, own: list[np.ndarray], path: Path) -> Iterator[str]:
    """Return the rows of a stream's level table."""
    index = json.loads(path.read_text(encoding="utf-8"))
    for level, count in enumerate(index["counts"]):
        found, theirs = draw(read_level(path, level).to_surfels(path)), own
        cells = []
        for _ in range(4):
            cells.append(f"{psnr(found, theirs):.1f}")
            found, theirs = [smaller(image) for image in found], [smaller(image) for image in theirs]
        size = sum(
            file.stat().st_size
            for name in index["filenames"]
            if name.startswith(f"{level}_")
            for file in (path.parent / name).parent.iterdir()
        )
        yield f"| {level} | {count:,} | {size / 1e6:.2f} | {' | '.join(cells)} |"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the comparison and print the table of a run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--layouts", nargs="+", default=list(LAYOUTS.builtin))
    parser.add_argument("--split", choices=("train", "test"), default="test")
    parser.add_argument("--every", type=int, default=1)
    options = parser.parse_args(argv)
    run = open_run(options.run)
    splats, job = finished_splats(run), reload_run(run, lambda event: None)
    views = job.scene.test if options.split == "test" and job.scene.test else job.scene.train
    views = views[:: options.every]

    def draw(some: Splats) -> list[np.ndarray]:
        return pictures(some, job, views)

    own, real = draw(splats), photographs(job, views)
    print(f"{len(splats):,} splats, SH degree {splats.sh_degree}, {len(views)} views: {psnr(own, real):.2f} dB\n")
    print("| layout | bytes a splat | renderings, dB | photographs, dB | written, s | read, s |")
    print("|---|---|---|---|---|---|")
    with TemporaryDirectory(prefix="gs2d-round-trips-") as home:
        for layout in options.layouts:
            try:
                print(row(layout, splats, draw, own, real, Path(home)), flush=True)
            except BackendError as error:
                print(f"| `{layout}` | {error} | | | | |")
        stream = Path(home) / f"a{LAYOUTS.get('streamed').ending}"
        if stream.exists():
            print("\n| level | splats | MB | full size, dB | 1/2 | 1/4 | 1/8 |\n|---|---|---|---|---|---|---|")
            for line in levels(draw, own, stream):
                print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
