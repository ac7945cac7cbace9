"""``gs2d export --format html``."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch

from cli_runs import one_line
from gs2d.cli import run
from gs2d.core.splats import Splats
from gs2d.io.splat_ply import write_splats


def some_splats(count: int) -> Splats:
    rows = torch.Generator().manual_seed(0)
    sizes = ((3,), (4,), (2,), (), (1, 3), (15, 3))
    return Splats(*(torch.randn(count, *size, generator=rows) for size in sizes))


def test_a_file_of_splats_becomes_a_page_beside_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_splats(tmp_path / "cloud.ply", some_splats(50))
    assert run(["export", str(tmp_path / "cloud.ply"), "--format", "html", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["file"] == str(tmp_path / "cloud.html")
    assert (result["sh_degree"], result["views"]) == (3, 1)
    assert result["bytes"] == (tmp_path / "cloud.html").stat().st_size


def test_a_run_becomes_a_page_in_it(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(trained, tmp_path / "run")
    assert run(["export", str(tmp_path / "run"), "--format", "html"]) == 0
    assert f"{tmp_path / 'run/scene.html'}: " in capsys.readouterr().out
    text = (tmp_path / "run/scene.html").read_text()
    facts = json.loads(text.split('id="facts">')[1].split("</script>")[0])
    assert [camera["name"] for camera in facts["cameras"]] == [f"train/r_{i}.png" for i in range(len(facts["cameras"]))]
    assert len(facts["cameras"]) > 1
    assert run(["export", str(tmp_path / "run"), "--out", str(tmp_path / "b.HTML"), "--quiet"]) == 0
    assert (tmp_path / "b.HTML").read_text() == text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "expected RUN"),
        (["cloud.ply", "--out", "cloud.png"], ".html file"),
    ],
)
def test_input_that_cannot_become_a_page_is_a_one_line_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write_splats(tmp_path / "cloud.ply", some_splats(5))
    assert run(["export", *words, "--format", "html"]) == 2
    assert message in one_line(capsys.readouterr().err)
    assert [path.name for path in tmp_path.iterdir()] == ["cloud.ply"]
