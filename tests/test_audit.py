"""The audit never reports "no vulnerabilities" if it could not check."""

from __future__ import annotations

import importlib.util
import subprocess
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest


@pytest.fixture
def audit() -> ModuleType:
    path = Path(__file__).parents[1] / "scripts" / "audit.py"
    spec = importlib.util.spec_from_file_location("audit", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("answer", "code", "words"),
    [
        ("", 3, "not checked, the database could not be asked: connection refused"),
        ('{"dependencies": [{"name": "a", "version": "1", "vulns": []}]}', 0, "0 known in 1 packages"),
        (
            '{"dependencies": [{"name": "a", "version": "1", "vulns": [{"id": "X-1", "fix_versions": ["2"]}]}]}',
            1,
            "vulnerability: a 1: X-1; fixed in 2",
        ),
        ('{"dependencies": [{"name": "a", "skip_reason": "not on PyPI"}]}', 3, "not checked: a"),
    ],
)
def test_a_failed_check_is_reported(
    audit: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    answer: str,
    code: int,
    words: str,
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    done = SimpleNamespace(stdout=answer, stderr="x\nconnection refused", returncode=1)
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: done)
    assert audit.vulnerabilities(Path("constraints.txt")) == code
    assert words in capsys.readouterr().out


def test_without_pip_audit_no_result_is_claimed(
    audit: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert audit.vulnerabilities(Path("constraints.txt")) == 3
    assert "not checked, pip-audit is not installed" in capsys.readouterr().out
