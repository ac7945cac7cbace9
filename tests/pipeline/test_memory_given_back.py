"""Memory that was freed goes back to the system, and what can be had again goes when a run says so."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gs2d.core.camera import look_at
from gs2d.data import Scene, View
from gs2d.data.cache import DecodedImage, ImageCache
from gs2d.pipeline.prepare.memory_budget import release

KEPT = """
import resource, sys
from gs2d.core.memory import hold, trim

def faults_of_a_round():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    blocks = [bytearray(10_000_000) for _ in range(8)]  # as gradients and images of an iteration
    del blocks
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

held = hold() if sys.argv[1] == "hold" else None
faults = [faults_of_a_round() for _ in range(5)]
trim()
print(held, faults[-1], faults_of_a_round())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="page faults are counted by getrusage")
def test_what_an_iteration_frees_serves_the_next_one_until_it_is_given_back() -> None:
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MALLOC_", "GLIBC_TUNABLES"))}
    rounds = {}
    for how in ("hold", "not"):
        command = [sys.executable, "-c", KEPT, how]
        found = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
        held, *rounds[how] = found.stdout.split()
        if how == "hold" and held == "False":
            pytest.skip("this C library cannot be told")
    assert int(rounds["hold"][0]) < 100
    assert int(rounds["hold"][1]) > 10_000  # 80 MB of new pages
    assert int(rounds["not"][0]) > 10_000  # what it is for


def test_a_scene_that_forgets_its_pictures_decodes_them_again(tmp_path: Path) -> None:
    cache, decoded = ImageCache(1 << 20), []
    camera = look_at(np.array([0.0, 0.0, -3.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]), width=4, height=4, fx=5.0)

    def view(name: str) -> View:
        def decode() -> DecodedImage:
            decoded.append(name)
            return DecodedImage(np.full((4, 4, 3), len(name), np.uint8))

        return View(name, camera, decode, cache)

    scene = Scene("s", "colmap", (view("a"),), (view("bb"),), None, 1.0, np.zeros((2, 3)))
    assert [v.name for v in scene.preload(2)] == ["a", "bb"]
    assert cache.nbytes == 2 * 48
    scene.views[0].image()
    assert sorted(decoded) == ["a", "bb"]
    release(scene)
    assert (cache.nbytes, len(cache)) == (0, 0)
    assert scene.views[1].image()[0, 0, 0] == 2
    assert len(decoded) == 3
