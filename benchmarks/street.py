"""Run ``gs2d reconstruct`` on real captures with default settings, optionally next to OpenSplat on the same images.

::

    python -m benchmarks.street --data ../shared/data --out runs/street [--quality draft] [--captures fox bust]
                                [--opensplat BINARY] [--gallery FOLDER] [--results benchmarks/results/street.json]
                                [--options=--learn=exposure]

``--data`` holds the captures in the folders that ``CAPTURES`` names; only their photographs are used. Each capture runs
once in its own process and is scored. Finished runs are not repeated, so an interrupted command can be restarted;
scores are recomputed because they are fast. Captures with fewer than 24 photographs get ``--test-every 8``, because
``reconstruct`` would hold out no test views.

With ``--opensplat``, OpenSplat trains on our cameras and the same images. Its CPU budget is the time our run took
*after* camera estimation: training, scoring, mesh, report and page (``benchmarks/street_peer.py``).

``--gallery`` writes an image of each finished capture: photograph, rendering of a test view, normals, mesh. Most of
these photographs and their renderings may not be redistributed; ``gallery.md`` next to the images lists which may.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.street_peer import measure_peer
from benchmarks.street_runs import PEER, measure_run
from benchmarks.timing import machine
from gs2d.core.json_files import write_json
from gs2d.errors import Gs2dError


@dataclass(frozen=True)
class Capture:
    """Capture by a third party.

    Attributes
    ----------
    name, folder : str
        Name in the table, and the folder of the photographs below ``--data``.
    licence : str
        Licence of the photographs, as stated by their source.
    may_be_shown : bool
        Whether images of the capture may be published.
    """

    name: str
    folder: str
    licence: str
    may_be_shown: bool = False


TUNED = (  # bust, monster tree and temple; settings were tuned on all of these
    Capture("fox", "fox_instant_ngp/images", "NVIDIA Source Code License (non-commercial)"),
    Capture("castle", "sceaux_castle/images", "none stated, copyright Pierre Moulon"),
    Capture("fountain", "strecha_fountain_P11/images", "none stated"),
    Capture("mouse", "colmap_mouse/images", "none stated"),
    Capture("temple", "temple_sparse_ring", "none stated"),
    Capture("monstree", "monstree/images", "none stated"),
    Capture("bust", "alexander_bust/images", "CC BY-NC-SA"),
    Capture("bottle", "rendered_bottle/train", "CC BY 4.0 (YCB) and public domain, rendered", may_be_shown=True),
)
UNTUNED = (  # not used for tuning: examples in public repositories, OWNER+NAME/FOLDER below --data
    Capture("frog", "snavely+bundler_sfm/examples/kermit", "none stated"),
    Capture("doll", "snavely+bundler_sfm/examples/ET", "none stated"),
    Capture("lane", "mapillary+OpenSfM/data/lund/images", "none stated"),
    Capture("lounge", "InternRobotics+AnySplat/examples/vrnerf/riverview", "of VR-NeRF, CC BY-NC 4.0"),
    Capture("kitchen", "facebookresearch+vggsfm/examples/kitchen/images", "of Mip-NeRF 360, none stated"),
    Capture("museum", "facebookresearch+vggsfm/examples/british_museum/images", "of Flickr's users"),
    Capture("statue", "facebookresearch+vggsfm/examples/statue/images", "CC BY-NC repository"),
    Capture("cake", "facebookresearch+vggsfm/examples/cake/images", "of CO3D, CC BY-NC 4.0"),
    Capture("flat", "CUT3R+CUT3R/examples/001", "CC BY-NC-SA repository"),
    Capture("kitchenette", "CUT3R+CUT3R/examples/002", "CC BY-NC-SA repository"),
    Capture("hall", "CUT3R+CUT3R/examples/004", "CC BY-NC-SA repository"),
    Capture("buddha", "alicevision+dataset_buddha/buddha", "CC BY 4.0"),
)
CAPTURES = (*TUNED, *UNTUNED)
STREET = tuple(capture.name for capture in TUNED if not capture.may_be_shown)  # the bottle is for the gallery
COLUMNS = {
    "capture": lambda row: row["capture"],
    "exit": lambda row: str(row["exit_code"]),
    "placed": lambda row: of("{0[placed]} of {0[photographs]}", row["poses"]),
    "minutes": lambda row: f"{row['seconds'] / 60:.1f}",
    "CPU min": lambda row: f"{row['cpu_seconds'] / 60:.1f}",
    "training: told, took": lambda row: told(row),
    "test PSNR / SSIM": lambda row: image_scores(row["scores"]),
    "worst view": lambda row: of("{0[worst_psnr]:.2f}", test_of(row["scores"])),
    "training views": lambda row: of("{0[psnr]:.2f}", (row["scores"] or {}).get("train")),
    "peer": lambda row: image_scores(scores_of(row.get("peer"))),
    "peer's worst": lambda row: of("{0[worst_psnr]:.2f}", test_of(scores_of(row.get("peer")))),
    "hidden points": lambda row: of("{0:.2%}", ((row["scores"] or {}).get("hidden") or {}).get("share")),
    "faces": lambda row: of("{0[faces]:,}", row["mesh"]),
    "in subject": lambda row: of("{0:.1%}", (row["mesh"] or {}).get("share_in_subject")),
    "faces / pixel": lambda row: of("{0:.2f}", (row["mesh"] or {}).get("faces_per_pixel")),
    "peak GB": lambda row: f"{row['peak_rss_bytes'] / 1e9:.2f}",
}


# -- the table -----------------------------------------------------------------------------------------------------
def of(template: str, value: Any) -> str:
    """Format a value; a dash if it is missing."""
    return "-" if value is None else template.format(value)


def scores_of(peer: dict[str, Any] | None) -> dict[str, Any] | None:
    """Return OpenSplat's scores, if any."""
    return (peer or {}).get("scores")


def test_of(scores: dict[str, Any] | None) -> dict[str, Any] | None:
    """Return the scores of test views, if any."""
    return (scores or {}).get("test")


def image_scores(scores: dict[str, Any] | None) -> str:
    """Format mean PSNR and SSIM of test views."""
    return of("{0[psnr]:.2f} / {0[ssim]:.3f}", test_of(scores))


def told(row: dict[str, Any]) -> str:
    """Format the bounds of the time estimate and the actual training time, minutes."""
    estimate = row["estimate"]
    bounds = of("{0[0]:.1f} to {0[1]:.1f}", estimate and (estimate["least"] / 60, estimate["most"] / 60))
    return f"{bounds}, {of('{0:.1f}', row['training_seconds'] and row['training_seconds'] / 60)}"


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of finished captures."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
    lines += ["| " + " | ".join(column(row) for column in COLUMNS.values()) + " |" for row in rows]
    return "\n".join(lines) + "\n"


# -- the captures --------------------------------------------------------------------------------------------------
def measure(capture: Capture, args: argparse.Namespace) -> dict[str, Any]:
    """Return one row: our run, and OpenSplat's if available."""
    folder = args.out / args.quality / capture.name
    row = {"capture": capture.name, "quality": args.quality}
    row |= measure_run(args.data / capture.folder, folder, args.quality, shlex.split(args.options))
    if args.opensplat is None or row["scores"] is None:
        return row
    budget = row["cpu_seconds"] - (row["cpu_seconds_before"] or 0.0)
    try:
        row["peer"] = measure_peer(args.opensplat, folder / "run", folder / PEER, budget)
    except Gs2dError as error:
        row["peer"] = {"error": str(error)}
        print(f"  peer: {error}", flush=True)
    return row


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse and check the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.street", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--out", type=Path, default=Path("runs/street"), help="folder of runs and results")
    parser.add_argument("--captures", nargs="+", choices=[c.name for c in CAPTURES], default=list(STREET))
    parser.add_argument("--quality", choices=("draft", "normal", "full"), default="draft")
    parser.add_argument(
        "--options",
        default="",
        help="options for `gs2d reconstruct` as one argument: --options='--learn exposure --seed 1'",
    )
    parser.add_argument("--opensplat", type=Path, metavar="BINARY", help="OpenSplat binary (default: no comparison)")
    parser.add_argument("--gallery", type=Path, metavar="FOLDER", help="write images of finished captures")
    parser.add_argument("--results", type=Path, help="also write the rows here")
    args = parser.parse_args(arguments)
    for capture in CAPTURES:
        if capture.name in args.captures and not (args.data / capture.folder).is_dir():
            parser.error(f"{capture.name}: there is no folder {args.data / capture.folder}; see --data and --captures")
    if args.opensplat is not None and not args.opensplat.is_file():
        parser.error(f"--opensplat must be a binary, got {args.opensplat}")
    return args


def main(arguments: Sequence[str] | None = None) -> int:
    """Run missing captures, write rows as they finish and print the table; return 1 if a run failed."""
    args = parse(arguments)
    rows: list[dict[str, Any]] = []
    document = {"format": 1, "date": time.strftime("%Y-%m-%d"), "machine": machine(), "rows": rows}
    chosen = [capture for capture in CAPTURES if capture.name in args.captures]
    args.out.mkdir(parents=True, exist_ok=True)
    for capture in chosen:
        try:
            rows.append(measure(capture, args))
        except Gs2dError as error:
            print(f"error: {capture.name}: {error}", file=sys.stderr)
            return 2
        print(json.dumps(rows[-1]), flush=True)
        for file in (args.out / f"{args.quality}.json", *([args.results] if args.results else [])):
            file.parent.mkdir(parents=True, exist_ok=True)
            write_json(file, document)
    print(markdown(rows))
    (args.out / f"{args.quality}.md").write_text(markdown(rows))
    if args.gallery is not None:
        from benchmarks.street_gallery import write_gallery

        write_gallery(args.gallery, chosen, args.out / args.quality, args.quality)
    return int(any(row["exit_code"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
