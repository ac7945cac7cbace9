"""A backend of a package on a device that gs2d has no backend for."""

from __future__ import annotations

from pathlib import Path

import pytest

from cli_runs import TINY
from gs2d.cli import run
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.prepare.open_capture import QUALITIES, quality_level
from gs2d.render.backends import BACKENDS, get_backend
from gs2d.render.reference_backend import ReferenceBackend


class OnNamedDevice(ReferenceBackend):
    """The reference on a device whose name appears nowhere in gs2d; torch keeps its tensors on the CPU."""

    name = "guest"
    device = "cpu:0"


class OnMetal(ReferenceBackend):
    """A backend whose device is not in this machine."""

    name = "guest"
    device = "mps"


def test_a_third_party_device_trains_meshes_and_scores(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(BACKENDS._objects, "guest", OnNamedDevice)
    out = tmp_path / "run"
    assert run(["train", str(capture), "--out", str(out), "--backend", "guest", "--quiet", *TINY]) == 0
    assert RunFolder(out).definition()["backend"]["name"] == "guest"
    assert run(["mesh", str(out), "--quiet"]) == 0
    assert run(["evaluate", str(out), "--quiet"]) == 0


def test_qualities_of_another_device_are_those_of_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    def normal() -> object:
        return quality_level("normal", is_data_set=False, on_host=get_backend("guest").on_host)

    monkeypatch.setitem(BACKENDS._objects, "guest", OnMetal)
    assert normal() == QUALITIES["normal"]["gpu"]
    monkeypatch.setitem(BACKENDS._objects, "guest", OnNamedDevice)
    assert normal() == QUALITIES["normal"]["cpu"]
