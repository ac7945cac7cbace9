"""The subject of a tiny run: written beside its results, taken by the mesh where it should be, and overridden."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gs2d.config.protocols import PROTOCOLS
from gs2d.data import View
from gs2d.data.subject import OBJECT, given_subject, read_subject
from gs2d.errors import DataError, ProtocolError, RunError
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import PAGE, RunFolder
from gs2d.io.splat_ply import read_splats
from gs2d.pipeline.events import Notice
from gs2d.pipeline.export import export_run
from gs2d.pipeline.finished import finished_splats
from gs2d.pipeline.job import protocol_from_json, reload_job
from gs2d.pipeline.mesh import bare_of, extract_mesh, mesh_run
from gs2d.pipeline.options import MeshOptions
from gs2d.pipeline.subject import meshed_subject, subject_line, within
from gs2d.report.sections.subject import subject_section
from wall_scene import wall

BOX = (-0.5, -0.6, -0.7, 0.5, 0.6, 0.7)


def test_training_writes_the_subject_and_only_the_generic_protocol_meshes_it(undisturbed: RunFolder) -> None:
    subject = read_subject(undisturbed.path)
    assert subject is not None
    shown = subject_section(undisturbed.path)  # in the report: words, the box and the picture
    assert subject.why in shown
    assert subject_line(subject, meshed=True).endswith("--scene takes everything")
    assert "the mesh is of everything" in subject_line(subject, meshed=False)
    assert "data:image/jpeg;base64," in shown
    job, splats = reload_job(undisturbed, lambda _: None), finished_splats(undisturbed)
    assert job.protocol.name == "nerf-synthetic"
    assert meshed_subject(undisturbed, job, splats, MeshOptions(), lambda _: None) is None
    assert [name for name, protocol in PROTOCOLS.items() if protocol.fusion.subject] == ["generic"]


def test_a_box_of_the_user_becomes_the_subject_and_limits_the_mesh(undisturbed: RunFolder, tmp_path: Path) -> None:
    run = RunFolder(Path(shutil.copytree(undisturbed.path, tmp_path / "run")))
    job, splats, said = reload_job(run, lambda _: None), finished_splats(run), []
    subject = meshed_subject(run, job, splats, MeshOptions(subject_box=BOX), said.append)
    assert subject is not None
    assert (subject.kind, subject.box.ravel().tolist()) == (OBJECT, list(BOX))
    assert json.loads((run.path / "subject.json").read_text())["min"] == list(BOX[:3])
    assert said == [
        Notice(
            "subject: 1 x 1.2 x 1.4 world units, box -0.5 -0.6 -0.7 0.5 0.6 0.7 (the box was given); "
            "--scene takes everything"
        )
    ]
    out = tmp_path / "part.ply"
    generic = replace(job, protocol=replace(job.protocol, fusion=PROTOCOLS["generic"].fusion))
    result = extract_mesh(generic, splats, MeshOptions(voxel=0.05), out, lambda _: None, subject=subject)
    vertices = read_mesh(out).vertices
    assert (np.abs(vertices) <= np.array(BOX[3:]) + 0.05 * 8).all()
    assert {"pixels", "faces_per_pixel"} <= result.keys()
    for options in (MeshOptions(whole_scene=True), MeshOptions(bbox=BOX), MeshOptions(unbounded=True)):
        assert meshed_subject(run, generic, splats, options, said.append) is None
        with pytest.raises(ProtocolError, match="exclude each other"):
            meshed_subject(run, generic, splats, replace(options, subject_box=BOX), said.append)


def test_what_shows_nothing_is_left_out_of_a_subject_and_kept_in_a_scene(
    undisturbed: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job, splats = reload_job(undisturbed, lambda _: None), finished_splats(undisturbed)
    generic = replace(job, protocol=replace(job.protocol, fusion=PROTOCOLS["generic"].fusion))
    asked: list[bool] = []

    def extract(frames: Any, *, with_bare: bool, **rest: Any) -> Any:
        asked.append(with_bare)
        raise ProtocolError("enough")

    monkeypatch.setattr("gs2d.pipeline.mesh.extract", extract)
    box = given_subject(BOX, [view.camera for view in job.scene.train])
    for one, options, subject in (
        (generic, MeshOptions(), box),
        (generic, MeshOptions(bbox=BOX), None),
        (generic, MeshOptions(), None),
        (generic, MeshOptions(bbox=BOX, whole_scene=True), None),
        (job, MeshOptions(), box),
    ):
        with pytest.raises(ProtocolError, match="enough"):
            extract_mesh(one, splats, options, tmp_path / "mesh.ply", lambda _: None, subject=subject)
    assert asked == [False, False, True, True, True]


def test_bare_walls_are_found_in_photographs_that_say_where_their_points_are(undisturbed: RunFolder) -> None:
    job = replace(reload_job(undisturbed, lambda _: None), scene=wall())
    generic = replace(job, protocol=PROTOCOLS["generic"])
    view = generic.scene.train[0]
    found = bare_of(generic, view)
    assert found is not None
    gray = (np.abs(view.image().astype(int) - 128) <= 1).all(axis=2)  # the left third
    assert found[gray].mean() > 0.8
    assert found[~gray].mean() < 0.1
    assert bare_of(job, view) is None  # official protocols are as they were
    assert bare_of(replace(generic, scene=replace(wall(), observe=None)), view) is None
    opaque = np.concatenate([view.image(), np.full((*view.image().shape[:2], 1), 255, np.uint8)], axis=2)
    assert bare_of(generic, View.from_arrays(view.name, view.camera, opaque)) is None


def test_a_new_subject_is_in_the_page_and_what_is_said_of_the_mesh_in_the_metrics(
    undisturbed: RunFolder, tmp_path: Path
) -> None:
    run = RunFolder(Path(shutil.copytree(undisturbed.path, tmp_path / "run")))
    for options, rewritten in ((MeshOptions(voxel=0.05), False), (MeshOptions(voxel=0.05, subject_box=BOX), True)):
        run.file(PAGE).write_text("of before")
        result = mesh_run(run.path, options)
        assert (run.file(PAGE).read_text() != "of before") == rewritten
        said = run.metrics()["mesh"]
        assert (said["faces"], said["voxel"]) == (result["faces"], 0.05)
        assert "file" not in said
    assert run.metrics()["stages"]
    run.file(PAGE).unlink()
    mesh_run(run.path, MeshOptions(voxel=0.05, subject_box=BOX))
    assert not run.file(PAGE).exists()  # whoever wanted none gets none


def test_runs_of_before_there_was_a_subject_still_open() -> None:
    from dataclasses import asdict

    for protocol in PROTOCOLS.values():
        data = asdict(protocol)
        del data["fusion"]["subject"]
        assert protocol_from_json(data) == protocol


def test_splats_are_exported_within_a_box(undisturbed: RunFolder, tmp_path: Path) -> None:
    splats = finished_splats(undisturbed)
    means = splats.means.sort(dim=0).values
    low, high = means[len(means) // 4].tolist(), means[-1].add(1).tolist()
    result = export_run(undisturbed.path, tmp_path / "part.ply", "2dgs", bbox=(*low, *high))
    part = read_splats(tmp_path / "part.ply")
    expected = (splats.means >= torch.tensor(low)).all(dim=1)
    assert 0 < result["splats"] == int(expected.sum()) < len(splats)
    assert torch.equal(part.means, splats.means[expected])
    with pytest.raises(RunError, match="got none of"):
        within(splats, (100, 100, 100, 101, 101, 101))
    with pytest.raises(DataError, match="--bbox must be a lower corner and a higher one"):
        within(splats, (1, 0, 0, 0, 1, 1))
