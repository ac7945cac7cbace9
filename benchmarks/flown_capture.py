"""Make a synthetic drone capture with any number of photographs over land with houses and a known surface.

::

    python -m benchmarks.flown_capture FOLDER --photographs 6400 [--size 96] [--points 20000] [--gps-noise 1.5]

The capture has COLMAP's layout with ground-truth cameras, so training needs no structure from motion. The photographs'
EXIF data has GPS positions, and the true surface is ``mesh_gt.ply``. The land grows with the number of photographs,
with 80 % forward and 70 % side overlap. On two cores, 6,400 photographs of 96x72 or 100 of 1600x1200 take two minutes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.flight import Flight, write_flight
from gs2d.errors import Gs2dError


def main(arguments: list[str] | None = None) -> int:
    """Write the capture; return 2 for user errors."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.flown_capture", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--photographs", type=int, default=400)
    parser.add_argument("--size", type=int, default=320, help="width, px; the height is three quarters of it")
    parser.add_argument("--points", type=int, help="approximate number of sparse points (default: 40 per photograph)")
    parser.add_argument(
        "--side", type=float, help="approximate side of the area flown over, m (default: grows with the photographs)"
    )
    parser.add_argument("--land", type=float, help="side of the land, m (default: extends beyond all images)")
    parser.add_argument(
        "--gps-noise", type=float, default=1.5, help="standard deviation of GPS positions along each axis, m"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int)
    args = parser.parse_args(arguments)
    flight = Flight(
        args.photographs,
        width=args.size,
        height=args.size * 3 // 4,
        points=args.points,
        side=args.side,
        land=args.land,
        seed=args.seed,
        gps_noise=args.gps_noise,
    )
    try:
        write_flight(args.folder, flight, threads=args.threads)
    except (Gs2dError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
