"""Structures of the C++ and CUDA sources as ctypes types, read from the sources, which are part of the package."""

from __future__ import annotations

import ctypes
import math
import re
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from torch import Tensor

COMMENT = re.compile(r"//[^\n]*")
STRUCTURE = re.compile(r"struct (\w+) \{([^{}]*)\};")  # of data only: a method has braces
EXPORT = re.compile(r"GS2D_EXPORT (\w+) (\w+)\(([^)]*)\)")  # result, name, parameters
MEMBER = re.compile(r"(?:const )?(\w+)(?:<float>)?([^;]+);")  # type and declarators
LENGTH = re.compile(r"\[(\w+)\]")
SCALARS: dict[str, Any] = {"float": ctypes.c_float, "double": ctypes.c_double, "int": ctypes.c_int32}
SCALARS |= {
    "void": None,
    "uint32_t": ctypes.c_uint32,
    "int32_t": ctypes.c_int32,
    "int64": ctypes.c_int64,
    "int64_t": ctypes.c_int64,
}
SCALARS |= dict.fromkeys(("real", "R", "S"), ctypes.c_float)  # not in float64 libraries; parameters of templates


@cache
def source_of(where: str) -> str:
    """Return a source file of ``kernels/``, or all of a folder and of ``core/``, without comments."""
    root = resources.files("gs2d.kernels")
    files = [root.joinpath(where)]
    if files[0].is_dir():
        files = [file for folder in ("core", where) for file in root.joinpath(folder).iterdir()]
    texts = [file.read_text(encoding="utf-8") for file in files if file.name.endswith((".h", ".cu", ".cpp"))]
    return COMMENT.sub("", "\n".join(texts)).replace("long long", "int64").replace("unsigned char", "uchar")


@cache
def _exports() -> dict[str, tuple[str, list[str]]]:
    """Return the type of the result and the parameters of each function that the CPU library exports."""
    exports = EXPORT.findall(source_of("cpu"))
    return {name: (result, [p for p in parameters.split(",") if p.strip()]) for result, name, parameters in exports}


def signature_of(function: str, real: Any) -> tuple[Any, list[Any]]:
    """Return the types of the result and the parameters of an exported function; ``real`` is the library's number."""
    result, parameters = _exports()[function]
    scalars = SCALARS | {"real": real}
    return scalars[result], [ctypes.c_void_p if re.search(r"[*\[]", p) else scalars[p.split()[0]] for p in parameters]


def arguments_of(function: str, /, **fields: Any) -> ctypes.Structure:
    """Return the structure that an exported function takes as its first parameter; other fields are 0 or null."""
    first = _exports()[function][1][0].removeprefix("const ")
    return filled(structure(re.findall(r"\w+", first)[0], "cpu"), **fields)


@cache
def structure(name: str, where: str) -> type[ctypes.Structure]:
    """Return a C++ structure by its name; setting a field that it lacks is an error.

    ``where`` is the folder "cpu" or "cuda", or a source file in ``kernels/`` if the name is not unique.
    """
    text = source_of(where)
    (members,) = (members for own_name, members in STRUCTURE.findall(text) if own_name == name)
    fields: list[tuple[str, Any]] = []
    for kind, declarators in MEMBER.findall(members):
        for declarator in declarators.split(","):
            plain = LENGTH.sub("", declarator)
            member = ctypes.c_void_p if "*" in plain else SCALARS[kind] if kind in SCALARS else structure(kind, where)
            sizes = LENGTH.findall(declarator)  # numbers or names of constants
            if sizes:
                lengths = (x if x.isdigit() else re.findall(rf"\b{x} = (\d+)", text)[0] for x in sizes)
                member *= math.prod(map(int, lengths))
            fields.append((re.findall(r"\w+", plain)[-1], member))
    return type(name, (ctypes.Structure,), {"__slots__": (), "_fields_": fields})


def fill(target: ctypes.Structure, /, **fields: Any) -> None:
    """Set fields of a structure: numbers and structures, and for pointers tensors, arrays, addresses or None."""
    for name, value in fields.items():
        if isinstance(value, Tensor):
            value = value.data_ptr()
        setattr(target, name, value.ctypes.data if isinstance(value, np.ndarray) else value)


def filled(kind: type[ctypes.Structure], /, **fields: Any) -> ctypes.Structure:
    """Return a structure with these fields; all others are 0 or null."""
    target = kind()
    fill(target, **fields)
    return target
