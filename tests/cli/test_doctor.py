"""``gs2d doctor``: what is here, what is missing, and the words that bring it."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from gs2d.cli import run
from gs2d.core.extras import EXTRAS, install
from gs2d.render.backends import BackendStatus

ROOT = Path(__file__).parents[2]


def test_an_extra_is_what_pyproject_says_and_is_installed_by_the_names_of_its_packages() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    for extra, requirements in EXTRAS.items():
        assert tuple(declared[extra]) == requirements
        assert install(extra) == "pip install " + " ".join(f"'{requirement}'" for requirement in requirements)


def test_doctor_checks_the_requirements_of_every_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr("gs2d.cli.handlers._version", lambda name: None if name in ("xatlas", "pi-heif") else "1.2.3")
    assert run(["doctor", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    missing = {name for name, entry in report["optional"].items() if not entry["available"]}
    assert missing == {"ffmpeg", "texture"}
    assert report["optional"]["sfm"]["details"].startswith("pycolmap 1.2.3; features on the ")
    assert report["optional"]["heic"]["details"] == "pillow-heif 1.2.3"
    assert run(["doctor"]) == 0
    text = capsys.readouterr().out
    assert "no   textured meshes (--texture): xatlas missing\n       to get it: pip install 'xatlas" in text
    ffmpeg = "no   videos, read and written (gs2d render --video x.mp4): ffmpeg, ffprobe missing"
    assert f"{ffmpeg}\n       to get it: apt" in text


def test_doctor_ends_with_whether_the_machine_can_train_and_the_next_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cuda = BackendStatus("cuda", False, "no GPU", "install one", "")
    cpu, slow = BackendStatus("cpu", True, "", "", "2 threads"), BackendStatus("reference", True, "", "", "slow")
    monkeypatch.setattr("gs2d.render.backends.backend_report", lambda: (cuda, cpu, slow))
    assert run(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    shown = [line.split()[1] for line in lines if line.startswith(("  yes", "  no"))]
    assert shown[:3] == ["cpu:", "reference:", "cuda:"]
    assert lines[-1] == "Ready for gs2d train (cpu). Try it: gs2d demo"
    broken = BackendStatus("cpu", False, "no library", "install a compiler", "")
    monkeypatch.setattr("gs2d.render.backends.backend_report", lambda: (cuda, broken, slow))
    assert run(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-2].startswith("Not ready for gs2d train: ")
    assert lines[-1] == "First: install a compiler"
