"""Text with file names: conversion to bytes, and escaping for the terminal."""

from __future__ import annotations

import os

import pytest

from gs2d.core.text import name_bytes, printable
from gs2d.errors import DataError, DiskError


@pytest.mark.parametrize("name", ["plain.png", "é.png", "日本", os.fsdecode(b"caf\xe9"), os.fsdecode(b"\xff\x1b[2J")])
def test_a_file_name_is_converted_back_to_its_bytes(name: str) -> None:
    assert name_bytes(name) == os.fsencode(name)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain é 日本 [x]\\n", "plain é 日本 [x]\\n"),
        ("\x1b]0;title\x07", "\\x1b]0;title\\x07"),
        ("a\nb\tc\r", "a\\nb\\tc\\r"),
        ("\x9b31m\x7f", "\\x9b31m\\x7f"),
        (os.fsdecode(b"caf\xe9"), "caf\\xe9"),
        ("x\u202egnp.exe", "x\\u202egnp.exe"),
        ("\ud83d", "\\ud83d"),
    ],
)
def test_control_characters_are_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown
    assert printable(shown) == shown


def test_an_error_that_quotes_a_file_name_is_one_line() -> None:
    assert str(DataError("intrinsics must hold a\nb\r\nc\u2028d")) == "intrinsics must hold a b c d"
    assert str(DiskError("a\nb", 28)) == "a b"
    assert DiskError("a", 28).errno == 28
