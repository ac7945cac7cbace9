"""A viewer under a light load for an hour: ``python tests/helpers/soak.py --minutes 60``.

Each second a browser comes, looks from three places and goes; some ask for exact pictures, and every tenth visit is a
hostile connection. What the server has in memory is printed each minute; the last line is a JSON object with the
memory after the first minutes (what is loaded once), at the end, the growth a visit, and whether it still serves.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from websockets.exceptions import ConnectionClosed, InvalidStatus

import hostile_clients
from gs2d.io.formats.registry import write_layout
from served_viewer import Served, random_splats
from viser_client import Client

LOADING = 5  # minutes: what is loaded or kept once


def visit(url: str, chance: random.Random) -> None:
    """A browser that waits for the scene, moves three times and leaves; one in four asks for exact pictures."""
    browser = Client(url)
    try:
        browser.wait(lambda: browser.counts["GaussianSplatsMessage"] > 0)
        exact = chance.random() < 0.25
        if exact:
            browser.choose("splats", "exact")
        for _ in range(3):
            browser.look_from((chance.uniform(-1, 1), -3.0, chance.uniform(0, 2)))
            time.sleep(0.05)
        if exact:
            browser.wait(lambda: browser.counts["BackgroundImageMessage"] > 0)
    finally:
        browser.close()


def soak(served: Served, seconds: float, pause: float) -> dict[str, object]:
    """Visit for so long; returns what came of it."""
    chance, began, minutes = random.Random(0), time.monotonic(), 0
    visits, hostile, settled, peak = 0, 0, None, 0.0
    while (passed := time.monotonic() - began) < seconds:
        if passed >= 60 * minutes:
            memory = served.memory()
            print(f"{minutes} min: {memory:.1f} MB, {visits} visits, {hostile} hostile", flush=True)
            if minutes == LOADING:
                settled = (memory, visits + hostile)
            peak, minutes = max(peak, memory), minutes + 1
        if (visits + hostile) % 10 == 9:
            attacks = hostile_clients.attacks(served.url)
            with contextlib.suppress(OSError, ConnectionClosed, EOFError, InvalidStatus, TimeoutError):
                attacks[hostile % len(attacks)]()
            hostile += 1
        else:
            visit(served.url, chance)
            visits += 1
        time.sleep(pause)
    memory, alive = served.memory(), served.is_alive()
    first, before = settled or (memory, 0)
    growth = 1e3 * (memory - first) / max(visits + hostile - before, 1)
    return {
        "minutes": round(seconds / 60, 1),
        "visits": visits,
        "hostile": hostile,
        "MB after loading": round(first, 1),
        "MB at the end": round(memory, 1),
        "MB at most": round(max(peak, memory), 1),
        "kB a visit": round(growth, 2),
        "alive": alive,
    }


def main() -> int:
    """Soak as the options say."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--splats", type=int, default=2000)
    parser.add_argument("--pause", type=float, default=1.0, help="seconds between visits")
    given = parser.parse_args()
    with TemporaryDirectory(prefix="gs2d-soak-") as home:
        write_layout(Path(home, "a.ply"), random_splats(given.splats), "2dgs")
        served = Served(Path(home, "a.ply"))
        try:
            found = soak(served, 60 * given.minutes, given.pause)
        finally:
            said = served.end()
    found["tracebacks"] = said.count("Traceback")
    print(json.dumps(found), flush=True)
    return 0 if found["alive"] and not found["tracebacks"] else 1


if __name__ == "__main__":
    sys.exit(main())
