"""Captures in ZIP files."""

from __future__ import annotations

import errno
import json
import os
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from capture_writers import small_colmap, small_nerfstudio
from gs2d.core import growth
from gs2d.data import archive as module
from gs2d.data import load_scene
from gs2d.data.archive import is_archive, unpack
from gs2d.errors import DataError, DiskError


def pack(folder: Path, path: Path, prefix: str = "", separator: str = "/") -> Path:
    """A ZIP file of a folder, its names behind ``prefix``."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for source in sorted(folder.rglob("*")):
            if source.is_file():
                file.writestr(
                    prefix + source.relative_to(folder).as_posix().replace("/", separator), source.read_bytes()
                )
    return path


def unpacked(path: Path, target: Path) -> Path:
    target.mkdir()
    return unpack(path, target)


@pytest.mark.parametrize("write", [small_colmap, small_nerfstudio])
@pytest.mark.parametrize("prefix", ["", "garden/", "garden/garden/"])
def test_an_unpacked_capture_equals_the_original(tmp_path: Path, write: Callable[[Path], object], prefix: str) -> None:
    write(tmp_path / "capture")
    path = pack(tmp_path / "capture", tmp_path / "garden.zip", prefix)
    assert is_archive(path)
    root = unpacked(path, tmp_path / "out")
    assert root.name == "garden"
    before = load_scene(tmp_path / "capture")
    after = load_scene(root)
    assert [v.name for v in after.views] == [v.name for v in before.views]
    for a, b in zip(after.views, before.views, strict=True):
        assert (a.image() == b.image()).all()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["capture", "garden.zip", "out"]


NAMES = {
    "gb18030": "\u7167\u7247",
    "cp932": "\u5199\u771f\u30bd",  # the last character ends with the byte of a backslash
    "cp949": "\uc0ac\uc9c4",
    "cp1251": "\u0441\u043d\u0438\u043c\u043e\u043a",
    "cp850": "Gr\u00fcn",
}


def write_zip_in(encoding: str, folder: Path, path: Path) -> None:
    """A ZIP file with stored entries whose names are bytes of an encoding, without the flag of UTF-8."""
    entries, directory = b"", b""
    files = [source for source in sorted(folder.rglob("*")) if source.is_file()]
    for source in files:
        name, data = source.relative_to(folder).as_posix().encode(encoding), source.read_bytes()
        facts = struct.pack("<HHHHIIIHH", 0, 0, 0, 0, zlib.crc32(data), len(data), len(data), len(name), 0)
        directory += b"PK\x01\x02" + struct.pack("<HH", 20, 20) + facts
        directory += struct.pack("<HHHII", 0, 0, 0, 0, len(entries)) + name
        entries += b"PK\x03\x04" + struct.pack("<H", 20) + facts + name + data
    count, size = len(files), len(directory)
    end = b"PK\x05\x06" + struct.pack("<HHHHIIH", 0, 0, count, count, size, len(entries), 0)
    path.write_bytes(entries + directory + end)


def rename_photographs(root: Path, word: str) -> None:
    path = root / "transforms.json"
    path.write_text(path.read_text().replace("/f_", f"/{word}_"), encoding="utf-8")
    for image in sorted((root / "images").iterdir()):
        image.rename(image.with_name(image.name.replace("f_", f"{word}_")))


@pytest.mark.parametrize("escaped", [False, True])
@pytest.mark.parametrize("encoding", NAMES)
def test_names_in_an_unstated_encoding_are_those_of_the_camera_file(
    tmp_path: Path, encoding: str, escaped: bool
) -> None:
    small_nerfstudio(tmp_path / "capture")
    rename_photographs(tmp_path / "capture", NAMES[encoding])
    if escaped:
        path = tmp_path / "capture" / "transforms.json"
        path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8"))))
    write_zip_in(encoding, tmp_path / "capture", tmp_path / "a.zip")
    scene = load_scene(unpacked(tmp_path / "a.zip", tmp_path / "out"))
    assert (len(scene.views), scene.skipped) == (9, ())
    assert f"images/{NAMES[encoding]}_00.png" in {view.name for view in scene.views}


def test_the_same_content_is_unpacked_only_once(tmp_path: Path) -> None:
    small_nerfstudio(tmp_path / "capture")
    first = unpacked(pack(tmp_path / "capture", tmp_path / "a.zip"), tmp_path / "out")
    (first / "mark").write_text("x")
    os.utime(tmp_path / "capture" / "transforms.json", (1, 1))
    assert unpack(pack(tmp_path / "capture", tmp_path / "b.zip"), tmp_path / "out") == first
    (tmp_path / "capture" / "transforms.json").write_text("{}")
    assert first not in (other := unpack(pack(tmp_path / "capture", tmp_path / "a.zip"), tmp_path / "out")).parents
    assert not (other / "mark").exists()


@pytest.mark.parametrize(
    "name", ["../evil.txt", "a/../../evil.txt", "/etc/evil.txt", "C:\\evil.txt", "..\\evil.txt", "\\evil.txt"]
)
def test_paths_in_an_archive_cannot_leave_its_folder(tmp_path: Path, name: str) -> None:
    small_nerfstudio(tmp_path / "capture")
    path = pack(tmp_path / "capture", tmp_path / "a.zip")
    with zipfile.ZipFile(path, "a") as file:
        file.writestr(zipfile.ZipInfo(name), b"evil")
    root = unpacked(path, tmp_path / "out")
    assert len(list(root.rglob("*evil.txt"))) == len(list(tmp_path.rglob("*evil.txt"))) == 1


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    small_nerfstudio(tmp_path / "capture")
    path = pack(tmp_path / "capture", tmp_path / "a.zip")
    with zipfile.ZipFile(path, "a") as file:
        info = zipfile.ZipInfo("secrets")
        info.external_attr = (stat.S_IFLNK | 0o777) << 16
        file.writestr(info, "/etc")
    assert (unpacked(path, tmp_path / "out") / "secrets").read_text() == "/etc"


def test_a_zip_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("transforms.json", b"\0" * 10_000_000)
    assert unpacked(tmp_path / "a.zip", tmp_path / "out").name == "a"
    monkeypatch.setattr(growth, "SMALL", 1_000_000)
    with pytest.raises(DataError, match="a capture would take"):
        unpack(tmp_path / "a.zip", tmp_path)


def test_a_full_disk_is_named_and_nothing_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    small_nerfstudio(tmp_path / "capture")
    path = pack(tmp_path / "capture", tmp_path / "a.zip")
    monkeypatch.setattr(module.os, "replace", full)
    with pytest.raises(DiskError, match="device"):
        unpacked(path, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_a_file_that_is_damaged_is_named_and_nothing_is_left(tmp_path: Path) -> None:
    small_nerfstudio(tmp_path / "capture")
    path = pack(tmp_path / "capture", tmp_path / "a.zip")
    with zipfile.ZipFile(path) as file:
        info = file.getinfo("images/f_03.png")
    data = bytearray(path.read_bytes())
    names, extra = struct.unpack("<HH", data[info.header_offset + 26 : info.header_offset + 30])
    data[info.header_offset + 30 + names + extra + 40] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"a\.zip"):
        unpacked(path, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def encrypted(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("transforms.json", b"{}")
    data = bytearray(path.read_bytes())
    for signature, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        data[data.index(signature) + at] |= 1
    path.write_bytes(data)


def cut(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("a", bytes(1000))
    path.write_bytes(path.read_bytes()[:500])


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda path: path.write_text("no archive"), "again"),
        (cut, "again"),
        (lambda path: zipfile.ZipFile(path, "w").close(), "capture"),
        (encrypted, "transforms"),
    ],
)
def test_an_invalid_archive_is_one_line(tmp_path: Path, write: Callable[[Path], object], words: str) -> None:
    write(tmp_path / "a.zip")
    with pytest.raises(DataError, match=words) as caught:
        unpacked(tmp_path / "a.zip", tmp_path / "out")
    assert "\n" not in str(caught.value)
