"""The subject of a tiny run: written, meshed and overridden."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gs2d.config.protocols import PROTOCOLS
from gs2d.data.subject_box import OBJECT, read_subject
from gs2d.errors import ProtocolError
from gs2d.io.meshes import read_mesh
from gs2d.io.run_dir import RunFolder
from gs2d.pipeline.finish.run_mesh import extract_mesh
from gs2d.pipeline.finish.run_subject import meshed_subject, subject_line
from gs2d.pipeline.prepare.loaded import finished_splats, reload_run
from gs2d.pipeline.prepare.options import MeshOptions
from gs2d.report.run_record import read_record
from gs2d.report.sections.settings_section import settings_section
from gs2d.training.events import Notice

BOX = (-0.5, -0.6, -0.7, 0.5, 0.6, 0.7)


def test_training_writes_the_subject_and_the_generic_protocol_meshes_it(undisturbed: RunFolder) -> None:
    subject = read_subject(undisturbed.path)
    assert subject is not None
    assert subject.why in str(settings_section(read_record(undisturbed.path)))
    assert subject_line(subject, meshed=True).endswith("--scene meshes everything")
    assert "everything is meshed" in subject_line(subject, meshed=False)
    job = reload_run(undisturbed, lambda _: None).trained(finished_splats(undisturbed))
    assert job.protocol.name == "nerf-synthetic"
    assert meshed_subject(undisturbed, job, MeshOptions(), lambda _: None) is None
    assert [name for name, protocol in PROTOCOLS.working() if protocol.fusion.subject] == ["generic"]


def test_a_subject_box_becomes_the_subject_and_limits_the_mesh(undisturbed: RunFolder, tmp_path: Path) -> None:
    run = RunFolder(Path(shutil.copytree(undisturbed.path, tmp_path / "run")))
    job, said = reload_run(run, lambda _: None).trained(finished_splats(run)), []
    subject = meshed_subject(run, job, MeshOptions(subject_box=BOX), said.append)
    assert subject is not None
    assert (subject.kind, subject.box.ravel().tolist()) == (OBJECT, list(BOX))
    assert json.loads((run.path / "subject.json").read_text())["min"] == list(BOX[:3])
    assert said == [
        Notice(
            "subject: 1 x 1.2 x 1.4 world units, box -0.5 -0.6 -0.7 0.5 0.6 0.7 (set with --subject-box); "
            "--scene meshes everything"
        )
    ]
    out = tmp_path / "part.ply"
    protocol = replace(job.protocol, fusion=PROTOCOLS["generic"].fusion)
    generic = replace(job, protocol=protocol)
    result = extract_mesh(generic, MeshOptions(voxel=0.05), out, lambda _: None, subject=subject)
    vertices = read_mesh(out).vertices
    assert (np.abs(vertices) <= np.array(BOX[3:]) + 0.05 * 8).all()
    assert {"pixels", "faces_per_pixel"} <= result.keys()
    for options in (MeshOptions(whole_scene=True), MeshOptions(bbox=BOX), MeshOptions(method="unbounded")):
        assert meshed_subject(run, generic, options, said.append) is None
        with pytest.raises(ProtocolError, match="exclude each other"):
            meshed_subject(run, generic, replace(options, subject_box=BOX), said.append)
