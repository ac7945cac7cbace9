"""Protocols: the data sets' facts, and how they fill what a recipe leaves open."""

from __future__ import annotations

import pytest

from gs2d.errors import ProtocolError
from gs2d.protocols import DTU, GENERIC, NERF_SYNTHETIC, PROTOCOLS, TNT, TNT_LARGE, get_protocol, protocol_for
from gs2d.recipe import LossTerm
from gs2d.recipes import get_recipe


def test_depth_is_median_on_dtu_and_tnt_and_mean_elsewhere() -> None:
    assert {name: p.depth for name, p in PROTOCOLS.items()} == {
        "dtu": "median",
        "tnt": "median",
        "tnt-large": "median",
        "nerf-synthetic": "mean",
        "mip-nerf-360": "mean",
        "generic": "mean",
    }


def test_table_1_writes_its_distortion_weight_100_or_10_by_scene_type() -> None:
    assert (TNT.distortion_weight, TNT_LARGE.distortion_weight) == (100.0, 10.0)


def test_near_is_absolute_in_the_papers_protocols_and_relative_elsewhere() -> None:
    assert DTU.near_for(5.0) == 0.2
    assert GENERIC.near_for(5.0) == pytest.approx(0.05)  # 1 % of the extent


def test_terms_take_what_they_leave_open_from_the_protocol() -> None:
    terms = (LossTerm("l1", 0.8), LossTerm("distortion", None, 3000), LossTerm("ssim", 0.2, depth="mean"))
    assert TNT_LARGE.resolve(terms) == (
        LossTerm("l1", 0.8, depth="median"),
        LossTerm("distortion", 10.0, 3000, "median"),
        LossTerm("ssim", 0.2, depth="mean"),
    )


def test_terms_of_weight_zero_are_dropped() -> None:
    assert GENERIC.resolve((LossTerm("l1", 1.0), LossTerm("distortion", 0.0))) == (LossTerm("l1", 1.0, depth="mean"),)


def test_the_distortion_rows_get_the_weight_of_each_scene_type() -> None:
    terms = get_recipe("2dgs-distortion").stages[0].losses
    assert [t.weight for t in DTU.resolve(terms)] == [0.8, 0.2, 0.05, 1000.0]


def test_only_nerf_synthetic_is_white() -> None:
    assert [name for name, p in PROTOCOLS.items() if p.white] == ["nerf-synthetic"]


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
    with pytest.raises(ProtocolError, match="colmap"):
        protocol_for("ply")


def test_nerf_synthetic_masks_are_in_its_alpha_not_in_the_loss() -> None:
    assert not NERF_SYNTHETIC.use_mask_in_training
