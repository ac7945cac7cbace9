"""NumPy files from other programs."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from gs2d.data.arrays import read_npy, read_npz
from gs2d.errors import DataError


def header(text: str, version: int = 1) -> bytes:
    """The head of a .npy file with any text where numpy writes a dictionary."""
    layout = "<H" if version == 1 else "<I"
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack(layout, len(text)) + text.encode("latin-1")


def plain(shape: str = "(2,)", descr: str = "'<f4'") -> str:
    return f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}"


@pytest.mark.parametrize("dtype", ["bool", "u1", ">u2", "<i8", "f2", ">f4", "f8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_numpy_files_are_read(tmp_path: Path, dtype: str, order: str) -> None:
    array = np.asarray(np.random.default_rng(0).uniform(0, 200, (3, 4, 5)).astype(dtype), order=order)  # type: ignore[call-overload]
    np.save(tmp_path / "a.npy", array)
    got = read_npy(tmp_path / "a.npy", "map")
    np.testing.assert_array_equal(got, array)
    assert got.dtype == array.dtype.newbyteorder("=")
    assert got.flags.writeable
    np.savez_compressed(tmp_path / "a.npz", one=array, two=np.float64(3))
    both = read_npz(tmp_path / "a.npz", "archive", lambda name: True)
    np.testing.assert_array_equal(both["one"], array)
    assert both["two"].shape == ()
    assert list(read_npz(tmp_path / "a.npz", "archive", lambda name: name == "two")) == ["two"]


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"PK\3\4 and more",
        header(plain())[:-5],
        b"\x93NUMPY\3\0" + b"\xff" * 4,
        header("(" * 5000),
        header("[1, 2]"),
        header("\0"),
        header(plain("'ab'")),
        header(plain("(-1,)")),
        header(plain("(9" + "9" * 40 + ",)")),
        header(plain("(10000000000000,)")),
        header(plain("(2,)")) + b"1234",
        header(plain("(1,)", "'|O'")) + bytes(8),
        header(plain("(1,)", "[('a', '<f4')]")) + bytes(8),
        header(plain("(1,)", "'<f3'")) + bytes(8),
        header(plain("(1,)", "'<c16'")) + bytes(16),
    ],
)
@pytest.mark.filterwarnings("ignore:Reading")
def test_anything_but_numbers_is_one_line(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(DataError, match="numbers") as caught:
        read_npy(tmp_path / "a.npy", "depth map")
    assert str(tmp_path / "a.npy") in str(caught.value)
    assert "\n" not in str(caught.value)


def zeros(megabytes: int) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(megabytes << 20, np.uint8))
    return buffer.getvalue()


def test_a_zip_bomb_is_not_unpacked(tmp_path: Path) -> None:
    data = zeros(200)
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        archive.writestr("a.npy", data)
    assert (tmp_path / "bomb.npz").stat().st_size < 400_000
    with pytest.raises(DataError, match="more than 400 times"):
        read_npz(tmp_path / "bomb.npz", "archive", lambda name: True)
    assert read_npz(tmp_path / "bomb.npz", "archive", lambda name: name == "b") == {}
