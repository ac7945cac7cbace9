"""OpenUSD, read by OpenUSD itself: what the schema says of our splats, and what comes back of others' files."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gs2d.contrib.formats import usd
from gs2d.contrib.formats.usd import read_usd, write_usd
from gs2d.errors import BackendError, DataError
from gs2d.io.formats.splat_formats import read_splat_file, read_surfels
from gs2d.io.gaussians import Gaussians
from splat_scenes import a_scene

pytest.importorskip("pxr", reason="the extra usd is not installed")
from pxr import Gf, Usd, UsdGeom, UsdValidation, UsdVol, Vt

FIELD = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "World"
{
    float3 xformOp:rotateXYZ = (90, 0, 0)
    double3 xformOp:translate = (1, -2, 3.5)
    float3 xformOp:scale = (2, 2, 2)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"]

    def ParticleField3DGaussianSplat "Balls"
    {
        float[] opacities = [0.5, 1]
        quath[] orientationsh = [(1, 0, 0, 0), (0.5, 0.5, 0.5, 0.5)]
        point3f[] positions = [(0, 1, 2), (-1.5, 2, 1e-3)]
        float3[] radiance:sphericalHarmonicsCoefficients = [
            (0, 0.5, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1), (-1, 2, 0.25), (0, 0, 0), (0, 0, 0), (0, 0, 0)]
        uniform int radiance:sphericalHarmonicsDegree = 1
        float3[] scales = [(0.1, 0.2, 0.3), (0.2, 0.1, 0.3)]
    }
}
"""


def changed(path: Path, *pairs: tuple[str, str]) -> Path:
    """The scene above with other words."""
    text = FIELD
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path


def field_of(path: Path) -> Any:
    stage = Usd.Stage.Open(str(path))
    return stage, stage.GetDefaultPrim()


@pytest.mark.parametrize("degree", [0, 3])
def test_splats_survive_a_round_trip_exactly(tmp_path: Path, degree: int) -> None:
    splats = a_scene(400, degree)
    splats.opacity_logits[:3] = torch.tensor([40.0, -60.0, 17.4])  # a linear opacity is 1 here, 0 there
    splats.log_scales[0] = torch.tensor([0.01, -0.02])  # where logarithms are finer than their scales
    splats.quats[0] *= 1e-3
    write_usd(tmp_path / "a.usd", Gaussians.of(splats))
    file = read_splat_file(tmp_path / "a.usd")
    assert file.kind == "OpenUSD, surflets"
    assert file.surfels is not None
    for name, tensor in splats.items():
        assert torch.equal(getattr(file.surfels, name), tensor), name
    again = (tmp_path / "a.usd").read_bytes()
    write_usd(tmp_path / "b.usd", Gaussians.of(splats))
    assert (tmp_path / "b.usd").read_bytes() == again  # no time of writing in it


def test_openusd_reads_a_field_of_gaussian_surflets(tmp_path: Path) -> None:
    splats = a_scene(50, 2)
    write_usd(tmp_path / "a.usd", Gaussians.of(splats))
    stage, prim = field_of(tmp_path / "a.usd")
    assert prim.IsA(UsdVol.ParticleField)
    assert prim.HasAPI(UsdVol.ParticleFieldKernelGaussianSurfletAPI)
    assert not prim.HasAPI(UsdVol.ParticleFieldKernelGaussianEllipsoidAPI)
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Z", 1.0)
    values = {
        "positions": UsdVol.ParticleFieldPositionAttributeAPI(prim).GetPositionsAttr(),
        "orientations": UsdVol.ParticleFieldOrientationAttributeAPI(prim).GetOrientationsAttr(),
        "scales": UsdVol.ParticleFieldScaleAttributeAPI(prim).GetScalesAttr(),
        "opacities": UsdVol.ParticleFieldOpacityAttributeAPI(prim).GetOpacitiesAttr(),
        "harmonics": UsdVol.ParticleFieldSphericalHarmonicsAttributeAPI(
            prim
        ).GetRadianceSphericalHarmonicsCoefficientsAttr(),
    }
    got = {name: attribute.Get() for name, attribute in values.items()}
    np.testing.assert_array_equal(np.array(got["positions"]), splats.means.numpy())
    np.testing.assert_allclose(np.array(got["scales"])[:, :2], splats.scales.numpy(), rtol=1e-6)
    np.testing.assert_allclose(np.array(got["opacities"]), splats.opacities.numpy(), atol=1e-7)
    expected = torch.cat([splats.sh0, splats.shN], dim=1).reshape(-1, 3)  # by splat, then degree, then order
    np.testing.assert_array_equal(np.array(got["harmonics"]), expected.numpy())
    unit = torch.nn.functional.normalize(splats.quats, dim=1)
    for quat, ours in zip(got["orientations"], unit.tolist(), strict=True):
        assert [quat.GetReal(), *quat.GetImaginary()] == pytest.approx(ours, abs=1e-6)
    low, high = np.array(UsdGeom.Boundable(prim).GetExtentAttr().Get())
    assert (splats.means.numpy() > low).all()
    assert (splats.means.numpy() < high).all()


@pytest.mark.parametrize("n", [0, 30])
def test_all_validators_of_openusd_pass(tmp_path: Path, n: int) -> None:
    write_usd(tmp_path / "a.usd", Gaussians.of(a_scene(n)))
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())

    def complaints(stage: Any) -> list[str]:
        return [f"{error.GetName()}: {error.GetMessage()}" for error in context.Validate(stage)]

    assert complaints(Usd.Stage.Open(str(tmp_path / "a.usd"))) == []
    assert complaints(Usd.Stage.CreateInMemory()) != []  # they do look


def test_changes_of_another_program_are_read_and_the_rest_is_exact(tmp_path: Path) -> None:
    splats = a_scene(5, 0)
    write_usd(tmp_path / "a.usd", Gaussians.of(splats))
    stage, prim = field_of(tmp_path / "a.usd")
    opacities, scales = (np.array(prim.GetAttribute(name).Get()) for name in ("opacities", "scales"))
    opacities[1], scales[2] = 0.25, 2.0 * scales[2]
    prim.GetAttribute("opacities").Set(Vt.FloatArray.FromNumpy(opacities))
    prim.GetAttribute("scales").Set(Vt.Vec3fArray.FromNumpy(scales))
    stage.GetRootLayer().Save()
    back, _ = read_surfels(tmp_path / "a.usd")
    assert float(back.opacities[1]) == pytest.approx(0.25)
    np.testing.assert_allclose(back.scales[2], 2 * splats.scales[2], rtol=1e-6)
    for name in ("opacity_logits", "log_scales"):
        same = [0, 3, 4]
        assert torch.equal(getattr(back, name)[same], getattr(splats, name)[same])


def test_ellipsoids_with_a_transform_are_read_in_the_frame_of_the_stage(tmp_path: Path) -> None:
    """By hand: twice the size, a quarter turn about x (y becomes z, z becomes -y), then the shift."""
    g, kind = read_usd(changed(tmp_path / "a.usda"))
    assert kind == "OpenUSD, ellipsoids"
    np.testing.assert_allclose(g.means, [[1, -6, 5.5], [-2, -2.002, 7.5]], atol=1e-6)
    np.testing.assert_allclose(np.exp(g.log_scales[0]), [0.2, 0.4, 0.6], rtol=1e-6)
    half = math.sqrt(0.5)
    np.testing.assert_allclose(np.abs(g.quats[0]), [half, half, 0, 0], atol=1e-6)
    np.testing.assert_allclose(g.opacity_logits[0], 0.0, atol=1e-7)
    assert 17 < g.opacity_logits[1] < 18
    np.testing.assert_allclose(g.sh0[1], [-1, 2, 0.25])
    # Degree 1 is -y, z, -x: red told by y is told by z now, green told by z by -y, blue stays with x.
    np.testing.assert_allclose(g.shN[0], [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-6)
    splats, words = read_surfels(tmp_path / "a.usda")
    assert words.startswith("3D Gaussians")
    np.testing.assert_allclose(splats.scales[0], [0.4, 0.6], rtol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("ParticleField3DGaussianSplat", "Mesh", "expected a ParticleField, but the stage has none"),
        ("[0.5, 1]", "[0.5, 1.5]", "expected opacities from 0 to 1"),
        ("[(0.1, 0.2, 0.3), ", "[(0.1, -0.2, 0.3), ", "expected scales >= 0"),
        ("(2, 2, 2)", "(2, 2, 1)", "a uniform scale; bake the transform"),
        ("(2, 2, 2)", "(2, 2, -2)", "a uniform scale; bake the transform"),
        ("Degree = 1", "Degree = 9", "expected SH degree 0 to 3, got 9"),
        ("#usda 1.0", "#usda 9.0", "its reader"),
        ("point3f[] positions", "string[] positions", "expected OpenUSD|3 numbers per splat"),
        ('"Y"\n)', '"Y"\n    subLayers = [@/etc/passwd@]\n)', "its folder, but it refers to '/etc/passwd'"),
        ('"Y"\n)', '"Y"\n    subLayers = [@../b.usda@]\n)', "its folder, but it refers to '../b.usda'"),
        (
            "scales = [(0.1, 0.2, 0.3), (0.2",
            "scales = [(nan, 1, 2), (nan",
            "expected finite numbers, but 2 of 2 splats",
        ),
    ],
)
def test_a_stage_without_splats_is_a_one_line_error(tmp_path: Path, old: str, new: str, words: str) -> None:
    (tmp_path / "home").mkdir()
    path = changed(tmp_path / "home" / "a.usda", (old, new))
    changed(tmp_path / "b.usda")
    with pytest.raises(DataError, match=words) as caught:
        read_splat_file(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_decompression_bomb_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Equal numbers are packed to next to nothing, 30 MB here to a few kB."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usdc"))
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/A")
    field.GetPrim().GetAttribute("positions").Set(Vt.Vec3fArray(1_000_000, Gf.Vec3f(1)))
    field.GetPrim().GetAttribute("opacities").Set(Vt.FloatArray(5_000_000, 1.0))
    stage.GetRootLayer().Save()
    monkeypatch.setattr(usd, "_ADDRESSES", 400 << 20)
    with pytest.raises(DataError, match="more memory than|its reader failed"):
        read_splat_file(tmp_path / "a.usdc")


def test_without_the_extra_the_error_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.import_module

    def without(name: str, package: str | None = None) -> Any:
        if name.startswith("pxr"):
            raise ModuleNotFoundError(f"No module named {name!r}", name="pxr")
        return real(name, package)

    monkeypatch.setattr(importlib, "import_module", without)
    for work in (lambda: write_usd(tmp_path / "a.usd", Gaussians.of(a_scene(1))), lambda: read_usd(tmp_path / "a.usd")):
        with pytest.raises(
            BackendError, match="OpenUSD needs pxr, which is not installed; pip install 'usd-core>=26.3'"
        ):
            work()
    assert not (tmp_path / "a.usd").exists()
