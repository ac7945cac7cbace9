"""Every command with every wrong kind of input: exit code 2, one line, and a remedy that works."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import gs2d
from capture_writers import small_blender, small_colmap, small_dtu, small_nerfstudio, write_image_of
from cli_runs import one_line
from foreign_writers import small_alicevision, small_metashape, small_opensfm
from gs2d.cli import run
from gs2d.core.missing import has_photographs, suggestion
from gs2d.data import detect_format

NEEDS = {  # what each command reads
    **dict.fromkeys(("mesh", "render", "evaluate", "survey"), "run"),
    **dict.fromkeys(("view", "export"), "run or splats"),
    **dict.fromkeys(("train", "blocks"), "capture"),
    **dict.fromkeys(("poses", "reconstruct"), "photographs"),
    "info": "anything",
}
INPUTS = {  # relative path -> what it is, and what the remedy names in place of it (None: nothing here can help)
    "photos": ("photographs", "photos"),
    "photos.zip": ("archive", "photos.zip"),
    "capture.zip": ("archive", "capture.zip"),
    "capture": ("capture", "capture"),
    "capture/images": ("photographs", "capture"),
    "run": ("run", "run"),
    "run/mesh.ply": ("mesh", "run"),
    "run/renders": ("folder", "run"),
    "runs": ("folder", "runs/run"),
    "mesh.ply": ("mesh", None),
    "empty": ("folder", None),
    "notes.txt": ("file", None),
}
TAKEN = {  # what a command reads although its name for it is another one
    *(("poses", path) for path in ("capture", "capture/images")),
    ("reconstruct", "capture/images"),
    *(("info", path) for path in ("mesh.ply", "run/mesh.ply", "capture", "run")),
}
OUT = {"train": "new", "blocks": "new", "poses": "new", "reconstruct": "new", "export": "new.ply"}


def packed(folder: Path) -> None:
    with zipfile.ZipFile(folder.with_suffix(".zip"), "w") as file:
        for path in sorted(folder.rglob("*")):
            file.write(path, path.relative_to(folder))


@pytest.fixture(scope="module")
def inputs(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("inputs")
    for i in range(3):
        write_image_of(home / "photos" / f"{i}.jpg", seed=i)
    small_colmap(home / "capture", count=3)
    shutil.copytree(trained, home / "run")
    shutil.copytree(trained, home / "runs" / "run")
    for name in ("photos", "capture"):
        packed(home / name)
    shutil.copy(trained / "mesh.ply", home)
    (home / "empty").mkdir()
    (home / "notes.txt").write_text("hello")
    return home


@pytest.fixture
def there(inputs: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(inputs)
    return inputs


def named(line: str) -> list[str]:
    """The paths that a line names after its first semicolon, without those that a command makes."""
    remedy = line.partition("; ")[2]
    made = {words[-1] for words in re.findall(r"python -m zipfile -e (\S+) ([^`\s]+)", remedy)}
    words = [word.strip("`,") for word in remedy.split()]
    return [word for word in words if word not in made and ("/" in word or "." in word or Path(word).exists())]


@pytest.mark.parametrize("path", INPUTS)
@pytest.mark.parametrize("command", NEEDS)
def test_a_wrong_input_is_one_line_with_a_remedy_for_what_the_path_is(
    there: Path, capsys: pytest.CaptureFixture[str], command: str, path: str
) -> None:
    kind, better = INPUTS[path]
    if kind == NEEDS[command] or (command, path) in TAKEN or (kind == "run" and "run" in NEEDS[command]):
        pytest.skip("this is what the command reads")
    before = sorted(there.rglob("*"))
    words = [command, path, *(["--out", OUT[command]] if command in OUT else []), "--quiet"]
    assert run(words) == 2
    line = one_line(capsys.readouterr().err)
    assert sorted(there.rglob("*")) == before
    assert path in line
    for name in named(line):
        assert Path(name).exists() or (there / path / name).exists(), f"{name} of: {line}"
    assert f"--out {path}" not in line, "never trains into what the user has"
    if NEEDS[command] == "run" and better is not None:
        assert better in named(line), line
    if NEEDS[command] == "capture" and path in ("capture/images", "photos", "photos.zip", "capture.zip"):
        assert better in named(line), line


@pytest.mark.parametrize("command", ["reconstruct", "train", "view", "info"])
def test_photographs_in_an_archive_are_unpacked_as_the_message_says(
    there: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    assert run([command, "photos.zip", *(["--out", "new"] if command in OUT else []), "--quiet"]) == 2
    line = one_line(capsys.readouterr().err)
    (unpacking,) = re.findall(r"`python (-m zipfile -e [^`]+)`", line)
    folder = unpacking.split()[-1]
    assert not Path(folder).exists()
    subprocess.run([sys.executable, *shlex.split(unpacking)], check=True)
    assert sorted(path.name for path in Path(folder).iterdir()) == ["0.jpg", "1.jpg", "2.jpg"]
    shutil.rmtree(folder)


def test_a_run_without_scale_gets_one_and_then_an_orthophoto(there: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["survey", "run", "--orthophoto"]) == 2
    line = one_line(capsys.readouterr().err)
    assert "run has no georeference" in line
    (command,) = re.findall(r"`gs2d (survey run --known-distance) X0 Y0 Z0 X1 Y1 Z1 METRES`", line)
    assert run([*command.split(), *"0 0 0 1 0 0 2".split()]) == 0
    capsys.readouterr()
    assert run(["survey", "run", "--orthophoto", "--out", "above.png"]) == 2
    assert "--out must end in .tif" in one_line(capsys.readouterr().err)  # that is all that is left to say
    Path("run/georeference.json").unlink()


@pytest.mark.parametrize(
    "write",
    [small_colmap, small_nerfstudio, small_blender, small_dtu, small_opensfm, small_metashape, small_alicevision],
)
def test_captures_of_every_format_are_distinguished_from_photographs_by_name(tmp_path: Path, write: object) -> None:
    write(tmp_path / "some")  # type: ignore[operator]
    assert detect_format(tmp_path / "some")
    assert not has_photographs(tmp_path / "some")
    assert suggestion(tmp_path / "some", "run").startswith("; `gs2d train ")


def test_a_folder_of_sog_splats_is_no_folder_of_photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("means_l.webp", "means_u.webp", "meta.json"):
        (tmp_path / name).touch()
    for words in (["view", tmp_path], ["info", tmp_path], ["train", tmp_path, "--out", tmp_path / "run"]):
        assert run(list(map(str, words))) == 2
        assert f"; it holds splats: `gs2d view {tmp_path / 'meta.json'}` shows them" in one_line(
            capsys.readouterr().err
        )


MISSPELT = (
    *([command, "photoz"] for command in ("info", "view", "mesh", "render", "evaluate", "survey")),
    *([command, "photoz", "--out", "new"] for command in ("train", "blocks", "poses", "reconstruct")),
    ["export", "photoz", "--out", "new.ply"],
    *(["train", "capture", "--out", "new", option, "photoz"] for option in ("--masks", "--init")),
    ["mesh", "--splats", "photoz", "--out", "new.ply"],
    ["evaluate", "run", "--ground-truth", "photoz"],
    ["survey", "run", "--positions", "photoz"],
    ["sweep", "best", "--data", "photoz", "--out", "new"],
)


def test_a_misspelt_path_is_found_before_anything_heavy_is_imported(there: Path) -> None:
    """In one process that has imported nothing: torch and numpy are not loaded when the last error is printed."""
    code = (
        "import sys; from gs2d.cli import run\n"
        "heavy = {'torch', 'numpy', 'PIL', 'scipy'}\n"
        f"for words in {list(map(list, MISSPELT))!r}:\n"
        "    print(run(words), file=sys.stderr)\n"
        "    if heavy & set(sys.modules): sys.exit(f'{words} imports {heavy & set(sys.modules)}')"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(gs2d.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    assert lines[1::2] == ["2"] * len(MISSPELT)
    for line in lines[::2]:
        assert re.match(r"error: expected .* at photoz, found nothing; did you mean photos(\.zip)?\?", line), line


def test_a_continued_search_does_not_need_the_photographs(there: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["reconstruct", "gone", "--out", "run", "--resume"]) == 2
    assert "found nothing" not in capsys.readouterr().err
