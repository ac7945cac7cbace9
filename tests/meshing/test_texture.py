"""Texture baking: which images colour a texel and with what weight, filling of unseen texels, and files."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest
import trimesh
from benchmarks.texture import image, psnr

from gs2d.core.mesh import Mesh, TexturedMesh
from gs2d.errors import DiskError, ProtocolError
from gs2d.io.meshes import write_mesh
from gs2d.meshing import texture as atlas_module
from gs2d.meshing.texture import (
    FEATHER,
    MIN_FEATHER,
    ColorSource,
    bake,
    feather,
    fill_unseen,
    simplified,
    spread,
    texels_of,
    unwrap,
    vertex_normals,
)
from texture_shapes import above, box, checkers, flat_atlas, grid_plane, join, listed, photograph, ring

RED, GREEN, BLUE = (np.array(c, float) for c in ((1, 0, 0), (0, 1, 0), (0, 0, 1)))


def plain(camera_height: float, color: np.ndarray, size: int = 64) -> ColorSource:
    """Return an image of one colour, from above."""
    image = np.broadcast_to(np.rint(255 * color).astype(np.uint8), (size, size, 3))
    return ColorSource(above(camera_height, size), np.ascontiguousarray(image))


@pytest.fixture
def uncorrected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable exposure correction, so that differences between images remain."""
    monkeypatch.setattr(atlas_module, "corrected", lambda image, *_: (image, np.ones(image.shape[:2], np.float32)))


def middle(texture: np.ndarray) -> list[int]:
    return [int(v) for v in texture[len(texture) // 2, len(texture) // 2]]


def test_a_textured_checkered_box_looks_like_its_images() -> None:
    pytest.importorskip("xatlas")
    mesh = box()
    images = [photograph(mesh, camera, checkers) for camera in ring(14)]
    baked = bake(unwrap(mesh, 256), listed(images), 256, threads=1)
    assert baked.unseen < 10  # of 60 000: at the corners
    colors = np.rint(255 * np.clip(checkers(mesh.vertices), 0, 1)).astype(np.uint8)
    by_vertex, by_texture = [], []
    for camera in ring(3, turn=0.4):  # cameras that were not used for baking
        truth = photograph(mesh, camera, checkers)
        target = np.where(truth.image[..., 3:] > 0, truth.image[..., :3] / 255, 1.0)
        inside = truth.image[..., 3] == 255
        by_texture.append(psnr(image(baked.mesh, camera)[0][inside], target[inside]))
        by_vertex.append(psnr(image(Mesh(mesh.vertices, mesh.faces, colors), camera)[0][inside], target[inside]))
    assert min(by_texture) > 31
    assert max(by_vertex) < 20  # vertex colours: six squares for three of the checkerboard


@pytest.mark.usefixtures("uncorrected")
def test_a_texel_is_weighted_by_pixels_per_area() -> None:
    # f = 64; straight above a plane q = f^2 / z^2: 4096, 1024, 256 and 64 at z = 1, 2, 4, 8. The best two, minus
    # the third: 3840 and 768, a ratio of 5 to 1.
    heights = ((4, GREEN), (1, RED), (8, GREEN), (2, BLUE))
    baked = bake(flat_atlas(grid_plane()), listed([plain(z, c, 256) for z, c in heights]), 64, best=2, threads=1)
    assert middle(baked.mesh.texture) == pytest.approx([255 * 5 / 6, 0, 255 / 6], abs=1)


@pytest.mark.usefixtures("uncorrected")
def test_occluders_do_not_colour_the_surface() -> None:
    # A plate of half the side length hides the middle of the floor from the near camera; the far one looks obliquely.
    floor, plate = grid_plane(16, side=2.0), grid_plane(4, side=1.0, z=0.5)
    both = join([floor, plate])
    uv = np.concatenate([0.25 + 0.25 * floor.vertices[:, :2], 0.75 + 0.2 * plate.vertices[:, :2]]).astype(np.float32)
    sheet = atlas_module.Atlas(both, np.arange(len(both.vertices)), both.faces, uv, charts=2)
    image = np.zeros((200, 200, 3), np.uint8)
    images = [ColorSource(above(4.0, 200, 300.0), image + np.uint8([255, 0, 0]))]
    baked = bake(sheet, listed(images), 128, best=1, threads=1)
    # seen from height 4, a plate of half the side at height 0.5 hides (0.5 * 4 / 3.5)^2 of the floor (world units)
    floor_texels = (128 * 0.5) ** 2
    assert baked.unseen == pytest.approx(floor_texels * (4 / 3.5) ** 2 / 4, rel=0.15)
    aside = [ColorSource(camera, image + np.uint8([0, 0, 255])) for camera in ring(8, 4.0, 200)[::2]]
    texture = bake(sheet, listed(images + aside), 128, best=1, threads=1).mesh.texture
    assert texture[32, 32].tolist() == [0, 0, 255]  # the middle of the floor
    assert texture[96, 96].tolist() == [255, 0, 0]  # the plate


def test_pixels_that_are_masked_or_transparent_are_not_used() -> None:
    masked = ColorSource(above(1, 256), plain(1, RED, 256).image, np.zeros((256, 256), bool))
    clear = np.concatenate([plain(1, GREEN, 256).image, np.zeros((256, 256, 1), np.uint8)], axis=2)
    images = [masked, ColorSource(above(1, 256), clear), plain(2, BLUE, 256)]
    assert middle(bake(flat_atlas(grid_plane()), listed(images), 64, threads=1).mesh.texture) == [0, 0, 255]
    with pytest.raises(ProtocolError, match="none of 1 photographs"):
        bake(flat_atlas(grid_plane()), listed([masked]), 64, threads=1)


def test_a_gain_between_images_leaves_no_step() -> None:
    # One of two images is a fifth brighter and ends in the middle of the plane.
    mesh = grid_plane(16)
    one = photograph(mesh, above(2.0, 128, 128.0), lambda p: np.full_like(p, 0.5))
    image = one.image.copy()
    image[..., :3] = 153  # 0.6
    valid = np.zeros((128, 128), bool)
    valid[:, :64] = True
    images = listed([one, ColorSource(one.camera, image, valid)])
    row = bake(flat_atlas(mesh), images, 128, best=2, threads=1).mesh.texture[64, :, 0].astype(int)
    assert np.ptp(row) <= 2  # without blending: 12, half of the difference
    assert row[16] == pytest.approx(np.sqrt(128 * 153), abs=2)  # the mean exposure


def test_feathering_decreases_towards_outlines_only() -> None:
    focal, columns = 100.0, np.arange(40)
    plane = np.broadcast_to(1 / (0.5 + 0.01 * columns), (30, 40))  # 1 / depth is linear in the image
    shown = np.ones((30, 40), bool)
    inside = feather(plane, focal, shown)[10:20, 10:30]
    assert (inside == 1).all()
    step = plane.copy()
    step[:, 20:] *= 0.7
    values = feather(step, focal, shown)[15]
    assert values[19] == values[20] == np.float32(MIN_FEATHER)
    np.testing.assert_allclose(values[21:25], np.array([1, 2, 3, 4]) / FEATHER)
    assert feather(np.where(step > 0, 0, step), focal, shown).max() == 0
    border = feather(plane, focal, shown)[15]
    np.testing.assert_allclose(border[:4], np.array([1, 2, 3, 4]) / FEATHER)


def test_unseen_texels_get_the_colour_of_adjacent_surface() -> None:
    # The left half of a plane is visible, green above and red below; another plane lies far behind it.
    mesh = join([grid_plane(8), grid_plane(2, z=5.0)])
    texels = texels_of(flat_atlas(grid_plane(8)), 64)
    colors, seen = np.zeros((len(texels.index), 3), np.uint8), texels.index % 64 < 32
    colors[seen] = (200, 10, 10)
    colors[seen & (texels.index // 64 < 32)] = (10, 200, 10)
    fill_unseen(flat_atlas(mesh), texels, colors, seen)
    picture_ = np.zeros((64 * 64, 3), np.uint8)
    picture_[texels.index] = colors
    picture_ = picture_.reshape(64, 64, 3)
    assert picture_[60, 60, 0] > 160  # filled texels between both colours mix them
    assert picture_[4, 60, 1] > 160
    assert picture_[:, :32].reshape(-1, 3).tolist() == [[10, 200, 10]] * 1024 + [[200, 10, 10]] * 1024  # unchanged


def test_texels_outside_charts_get_the_nearest_colour() -> None:
    mesh = Mesh(grid_plane(2).vertices * np.float32(0.5), grid_plane(2).faces)  # the middle half of the texture
    texels = texels_of(flat_atlas(mesh), 64)
    assert len(texels.index) == 32 * 32
    texture = spread(texels, np.where((texels.index % 64 < 32)[:, None], (9, 8, 7), (1, 2, 3)).astype(np.uint8))
    assert (texture[:, :32] == (9, 8, 7)).all()
    assert (texture[:, 32:] == (1, 2, 3)).all()


def test_simplification_keeps_the_shape() -> None:
    mesh = box(20)
    assert simplified(mesh, len(mesh.faces)) is mesh
    far = Mesh((mesh.vertices.astype(np.float64) + 1e6), mesh.faces)  # float32 has a resolution of only 1/16 here
    small = simplified(far, 400)
    assert 300 <= len(small.faces) <= 400
    np.testing.assert_allclose(np.abs(small.vertices - 1e6).max(axis=1), 1, atol=1e-3)


# -- files -------------------------------------------------------------------------------------------------------------
def textured() -> TexturedMesh:
    """Return the unit square as four triangles around its centre, red above and blue below."""
    mesh = grid_plane(2)
    texture = np.zeros((16, 16, 3), np.uint8)
    texture[:8], texture[8:] = (250, 0, 0), (0, 0, 250)
    return TexturedMesh(mesh.vertices, vertex_normals(mesh), mesh.faces, flat_atlas(mesh).uv, texture)


@pytest.mark.parametrize("name", ["mesh.glb", "mesh.obj"])
def test_other_programs_open_the_files_with_their_texture(tmp_path: Path, name: str) -> None:
    mesh = textured()
    mesh.save(tmp_path / name)
    loaded = trimesh.load(tmp_path / name, force="mesh", process=False)
    assert len(loaded.faces) == len(mesh.faces)
    np.testing.assert_allclose(
        np.sort(loaded.triangles.reshape(-1, 3), 0), np.sort(mesh.vertices[mesh.faces].reshape(-1, 3), 0)
    )
    np.testing.assert_allclose(loaded.face_normals, np.tile([0, 0, 1], (8, 1)), atol=1e-6)
    material = loaded.visual.material
    image = material.baseColorTexture if name.endswith("glb") else material.image
    np.testing.assert_array_equal(np.asarray(image.convert("RGB")), mesh.texture)
    colors = np.asarray(loaded.visual.to_color().vertex_colors)[:, :3].astype(int)  # y is up: red above, blue below
    top, bottom = loaded.vertices[:, 1] > 0.5, loaded.vertices[:, 1] < -0.5
    assert (colors[top] == (250, 0, 0)).all()
    assert (colors[bottom] == (0, 0, 250)).all()


def test_an_obj_file_is_replaced_with_its_material_and_texture_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("gs2d.io.meshes.np.savetxt", full)
    with pytest.raises(DiskError, match="No space left"):
        write_mesh(tmp_path / "a.obj", textured())
    assert list(tmp_path.iterdir()) == []
    for name in ("a.obj", "a.mtl", "a.png"):
        (tmp_path / name).write_text("mine")
    with pytest.raises(DiskError, match="No space left"):
        write_mesh(tmp_path / "a.obj", textured())
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"] * 3
