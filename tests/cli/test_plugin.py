"""A package that adds one of each, installed by pip into a folder of its own, used from the command line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from cli_process import CliProcess
from gs2d import errors
from gs2d.kernels.library import available_variants
from tiny import write_capture

PLUGIN = Path(__file__).parents[1] / "plugin"
SOURCE = Path(errors.__file__).parents[1]  # the source tree, or where the wheel was installed


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which pip installed the package."""
    pytest.importorskip("setuptools", minversion="70")
    if not available_variants():
        pytest.skip("its backend needs the native library, which is not built")
    folder = tmp_path_factory.mktemp("site")
    copy = tmp_path_factory.mktemp("plugin")  # setuptools builds beside what it reads
    for file in PLUGIN.iterdir():
        if file.is_file():
            (copy / file.name).write_text(file.read_text())
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    done = subprocess.run([*pip, "--target", str(folder), str(copy)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def gs2d(site: Path) -> Iterator[CliProcess]:
    """Commands in a process that imports the package."""
    process = CliProcess(site, SOURCE)
    yield process
    process.close()


@pytest.fixture(scope="module")
def trained(gs2d: CliProcess, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on a capture that the package reads, by its recipe, loss and densifier, on its backend."""
    folder = tmp_path_factory.mktemp("work")
    capture = write_capture(folder / "ball")
    (folder / "link").mkdir()
    (folder / "link" / "capture.txt").write_text(str(capture))
    few = ("--set", "init_points=60", "--schedule-scale", "0.0003", "--set", "page=false")
    chosen = ("--recipe", "example-2dgs", "--backend", "example-checked")
    done = gs2d("train", folder / "link", "--out", folder / "run", *chosen, *few)
    assert "example-tint: Numbers of 6 photographs, from -0." in done.stdout + done.stderr
    return folder / "run"


def test_a_run_uses_all_of_them_and_says_so(trained: Path) -> None:
    said = json.loads((trained / "run.json").read_text())
    assert said["backend"]["name"] == "example-checked"
    assert said["recipe"]["name"] == "example-2dgs"
    assert said["protocol"]["name"] == "nerf-synthetic"
    assert said["recipe"]["stages"][0]["densify"] == {"name": "example-prune", "options": {"at": 3, "count": 2}}
    events = [json.loads(line) for line in (trained / "events.jsonl").read_text().splitlines()]
    losses = next(event["losses"] for event in events if "losses" in event)
    assert losses["example-contrast"] > 0
    assert losses["example-outside"] > 0  # the photographs have an alpha channel
    assert losses["example-tint"] > 0
    assert losses["example-brightness"] > 0
    state = torch.load(sorted((trained / "checkpoints").glob("*.pt"))[-1], weights_only=True)["state"]
    assert state["learned"]["example-tint"]["values"].abs().max() > 0.005
    assert 0 < state["groups"]["near"].sum() < 58
    views = json.loads((trained / "learned.json").read_text())["views"]
    assert len(views) == 6
    assert all(len(view["example-tint"]) == 3 for view in views.values())
    pruned = [event for event in events if event["kind"] == "densified"]
    assert [(event["iteration"], event["splats"]) for event in pruned] == [(3, 58)]


def test_its_quantity_and_section_are_in_the_report(trained: Path) -> None:
    report = (trained / "report.html").read_text()
    assert "<h3>Tint of the photographs</h3>" in report
    assert "<p>Numbers of 6 photographs, from -0." in report
    assert "Tint of the photographs, by photograph" in report
    assert "<summary>Seed of the run</summary>" in report
    assert "<p>Seed 0, " in report


def test_the_lists_name_what_the_package_adds(gs2d: CliProcess) -> None:
    listed = gs2d("recipes").stdout
    assert "example-2dgs" in listed
    assert "Like 2dgs, with losses and a densifier of this package." in listed
    assert "example-checked: " in gs2d("doctor").stdout


def test_another_process_finds_the_package_and_exports_its_format(
    site: Path, gs2d: CliProcess, trained: Path, tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "gs2d", "export", str(trained), "--out", str(tmp_path / "a.xyz")]
    environment = os.environ | {"PYTHONPATH": f"{site}{os.pathsep}{SOURCE}"}
    said = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert "centres" in said.stdout + said.stderr
    assert len((tmp_path / "a.xyz").read_text().splitlines()) == 58
    gs2d("export", tmp_path / "a.xyz", "--out", tmp_path / "a.ply")
    assert "splats: 58" in gs2d("info", tmp_path / "a.ply").stdout


def test_its_method_makes_a_mesh(gs2d: CliProcess, trained: Path, tmp_path: Path) -> None:
    made = json.loads(gs2d("mesh", trained, "--method", "example-coarse", "--out", tmp_path / "a.ply", "--json").stdout)
    assert made["method"] == "example-coarse"
    refused = gs2d("mesh", trained, "--method", "example-coarse", "--watertight", code=2).stderr
    assert "--watertight needs a method that closes (delaunay), got example-coarse; leave one of them out" in refused


def test_its_evaluator_scores_the_surface(gs2d: CliProcess, trained: Path) -> None:
    (trained.parent / "ball" / "vertices.txt").write_text("7")
    (trained.parent / "link" / "vertices.txt").write_text("7")
    surface = json.loads(gs2d("evaluate", trained, "--json").stdout)["surface"]
    assert surface["evaluator"] == "example-vertices"


def test_its_camera_model_is_read_and_cut_into_faces(gs2d: CliProcess, tmp_path: Path) -> None:
    frames = []
    for index in range(3):
        pose = np.eye(4)
        pose[0, 3] = index
        frames.append({"file_path": f"{index}.png", "transform_matrix": pose.tolist()})
        Image.fromarray(np.full((40, 40, 3), 90, np.uint8)).save(tmp_path / f"{index}.png")
    meta = {"camera_model": "example-equisolid", "k1": 1.0, "fl_x": 15.0, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    assert "3 example-equisolid photographs are cut into" in gs2d("info", tmp_path).stdout


def test_its_command_is_listed_parsed_and_run(gs2d: CliProcess, trained: Path) -> None:
    listed = gs2d("--help").stdout
    assert "Examples:" in listed
    assert "Count the splats of a file." in listed
    assert "Count each splat twice." in gs2d("example-count", "--help").stdout
    assert json.loads(gs2d("example-count", trained / "splats.ply", "--double", "--json").stdout) == {"splats": 116}
    assert "no option --triple" in gs2d("example-count", trained / "splats.ply", "--triple", code=2).stderr


def test_a_run_goes_on_with_the_recipe_from_a_file(gs2d: CliProcess, trained: Path) -> None:
    """What `gs2d recipes --json` prints, and what trained the run, are one recipe."""
    file = trained.parent / "mine.json"
    file.write_text(gs2d("recipes", "example-2dgs", "--json").stdout)
    few = ("--set", "init_points=60", "--schedule-scale", "0.0003", "--set", "page=false")
    chosen = ("--recipe", file, "--backend", "example-checked")
    said = gs2d("train", trained.parent / "link", "--out", trained, *chosen, *few, "--resume")
    assert "resuming after" in said.stdout + said.stderr


@pytest.mark.parametrize(
    ("field", "guest"),
    [
        ("surface.densify", "densifier 'example-prune'"),
        ("surface.on_enter.example-near", "action 'example-near'"),
        ("learned.example-tint", "quantity 'example-tint'"),
    ],
)
def test_a_wrong_option_of_a_guest_is_one_line(gs2d: CliProcess, trained: Path, field: str, guest: str) -> None:
    wrong = ("--recipe", "example-2dgs", "--set", f'{field}.options={{"when": 3}}')
    out = trained.parent / "none"
    said = gs2d("train", trained.parent / "ball", "--out", out, *wrong, "--quiet", code=2).stderr
    assert f"{guest} does not take the options {{'when': 3}}" in said
    assert said.count("\n") == 1
