"""Protocols: the data sets' facts, and how they fill what a recipe leaves open."""

from __future__ import annotations

import pytest

from gs2d.config.datasets import (
    DATASETS,
    DTU_SCENES,
    MIP_NERF_360_SCENES,
    NERF_SYNTHETIC_SCENES,
    TNT_SCENES,
    get_dataset,
)
from gs2d.config.protocols import DTU, GENERIC, PROTOCOLS, TNT_LARGE, get_protocol, protocol_for
from gs2d.config.recipe import LossTerm
from gs2d.errors import ProtocolError


def test_the_depth_that_is_fused_is_that_of_the_losses_unless_the_protocol_names_another() -> None:
    """NeRF-Synthetic trains on mean depth, as the official script does, and fuses median depth."""
    assert {name: p.fused_depth for name, p in PROTOCOLS.items() if p.fused_depth != p.depth} == {
        "nerf-synthetic": "median"
    }
    assert DTU.fused_depth == "median"
    assert GENERIC.fused_depth == "mean"


def test_depth_is_median_on_dtu_and_tnt_and_mean_elsewhere() -> None:
    assert {name: p.depth for name, p in PROTOCOLS.items()} == {
        "dtu": "median",
        "tnt": "median",
        "tnt-large": "median",
        "nerf-synthetic": "mean",
        "mip-nerf-360": "mean",
        "generic": "mean",
    }


def test_terms_take_what_they_leave_open_from_the_protocol() -> None:
    terms = (LossTerm("l1", 0.8), LossTerm("distortion", None, 3000), LossTerm("ssim", 0.2, depth="mean"))
    assert TNT_LARGE.resolve(terms) == (
        LossTerm("l1", 0.8, depth="median"),
        LossTerm("distortion", 10.0, 3000, "median"),
        LossTerm("ssim", 0.2, depth="mean"),
    )


def test_dtu_is_trained_with_its_background_and_measured_on_training_views() -> None:
    assert not DTU.use_mask_in_training
    assert DTU.use_mask_in_fusion
    assert (DTU.test_on, DTU.test_every) == ("train", 0)
    assert (DTU.fusion.voxel, DTU.fusion.truncation, DTU.fusion.depth_limit, DTU.fusion.clusters) == (
        0.004,
        0.016,
        3.0,
        1,
    )


@pytest.mark.parametrize(
    ("scene_format", "name"),
    [("blender", "nerf-synthetic"), ("dtu", "dtu"), ("colmap", "generic"), ("nerfstudio", "generic")],
)
def test_auto_follows_the_format(scene_format: str, name: str) -> None:
    assert protocol_for(scene_format).name == name
    assert get_protocol(name) is protocol_for(scene_format)


def test_unknown_names_say_what_exists() -> None:
    with pytest.raises(ProtocolError, match="nerf-synthetic"):
        get_protocol("nerf")


def test_a_format_of_a_reader_from_elsewhere_has_the_generic_protocol() -> None:
    assert protocol_for("of-a-guest") is GENERIC


# data sets


def test_dtu_is_the_fifteen_scans_at_half_size() -> None:
    assert [s.scan for s in DTU_SCENES.scenes] == [24, 37, 40, 55, 63, 65, 69, 83, 97, 105, 106, 110, 114, 118, 122]
    assert {(s.name[:4], s.protocol, s.downscale) for s in DTU_SCENES.scenes} == {("scan", "dtu", 2)}
    assert DTU_SCENES.evaluator == "dtu"


def test_tanks_and_temples_is_six_scenes_with_their_tau_and_fusion() -> None:
    """tau in m, voxel in units of the capture: the two large scenes are fused coarser and farther."""
    got = {s.name: (s.tau, get_protocol(s.protocol).fusion.voxel, s.downscale) for s in TNT_SCENES.scenes}
    assert got == {
        "Barn": (0.01, 0.004, 2),
        "Caterpillar": (0.005, 0.004, 2),
        "Ignatius": (0.003, 0.004, 2),
        "Truck": (0.005, 0.004, 2),
        "Meetingroom": (0.01, 0.006, 2),
        "Courthouse": (0.025, 0.006, 2),
    }
    assert get_protocol(TNT_SCENES.scene("courthouse").protocol).fusion.depth_limit == 4.5


def test_nerf_synthetic_is_eight_scenes_at_full_size_and_360_has_its_image_folders() -> None:
    assert len(NERF_SYNTHETIC_SCENES.scenes) == 8
    assert {s.downscale for s in NERF_SYNTHETIC_SCENES.scenes} == {1}
    folders = {s.name: (s.images, s.downscale) for s in MIP_NERF_360_SCENES.scenes}
    assert folders["garden"] == folders["bicycle"] == ("images_4", 4)
    assert folders["kitchen"] == folders["room"] == ("images_2", 2)
    assert len(folders) == 9


def test_every_scene_names_a_protocol_that_exists() -> None:
    for dataset in DATASETS.values():
        assert get_dataset(dataset.name) is dataset
        for scene in dataset.scenes:
            assert scene.protocol in PROTOCOLS
            assert (scene.tau is not None) == (dataset is TNT_SCENES)
