"""The arguments of the CUDA kernels: structures that are read from the sources that define them."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Mapping
from functools import cache
from typing import Any

from torch import Tensor

from gs2d.kernels.cuda.compile import sources
from gs2d.kernels.cuda.graph import Work

__all__ = ["THREADS", "arguments_of", "fill", "structure", "work_of"]

THREADS = 128  # per block of most kernels
COMMENT = re.compile(r"//[^\n]*")
KERNEL = re.compile(r"__global__ void (?:__launch_bounds__\([^)]*\) )?(\w+)\((\w+)")  # its name and its structure
STRUCTURE = re.compile(r"struct (\w+) \{([^{}]*)\};")  # of data only: a method has braces
MEMBER = re.compile(r"(?:const )?(\w+)(?:<float>)?([^;]+);")
DECLARATOR = re.compile(r" *(\*?) *(\w+)(?:\[(\w+)\])?")  # pointer, name, length of an array
SCALARS: dict[str, Any] = {"float": ctypes.c_float, "int": ctypes.c_int32, "int64": ctypes.c_int64}
SCALARS |= {"double": ctypes.c_double, "S": ctypes.c_float, "R": ctypes.c_float}  # S and R: parameters of templates


@cache
def _source() -> str:
    """Return all sources as one text, without comments."""
    text = COMMENT.sub("", "\n".join(sources().values()))
    return text.replace("long long", "int64").replace("unsigned char", "uchar")


@cache
def structure(name: str) -> type[ctypes.Structure]:
    """Return a C++ structure of ``core/`` or ``cuda/`` by its name; setting a field that it lacks is an error."""
    (members,) = (members for known, members in STRUCTURE.findall(_source()) if known == name)
    fields: list[tuple[str, Any]] = []
    for kind, declarators in MEMBER.findall(members):
        for declarator in declarators.split(","):
            found = DECLARATOR.fullmatch(declarator)
            assert found is not None, declarator
            pointer, field, length = found.groups()
            member = ctypes.c_void_p if pointer else SCALARS[kind] if kind in SCALARS else structure(kind)
            if length:  # a number or the name of a constant
                member *= int(length if length.isdigit() else re.findall(rf"\b{length} = (\d+)", _source())[0])
            fields.append((field, member))
    return type(name, (ctypes.Structure,), {"__slots__": (), "_fields_": fields})


@cache
def _structure_of(kernel: str) -> type[ctypes.Structure]:
    """Return the structure that a kernel takes."""
    return structure(dict(KERNEL.findall(_source()))[kernel])


def fill(arguments: ctypes.Structure, **fields: Any) -> None:
    """Set fields of a structure: numbers, structures, and for pointers tensors, addresses or None."""
    for name, value in fields.items():
        setattr(arguments, name, value.data_ptr() if isinstance(value, Tensor) else value)


def arguments_of(kernel: str, *named: Mapping[str, Any], **fields: Any) -> ctypes.Structure:
    """Return the arguments of a kernel with these fields; all others are 0 or null."""
    arguments = _structure_of(kernel)()
    for some in (*named, fields):
        fill(arguments, **some)
    return arguments


def work_of(kernel: str, blocks: int, *named: Mapping[str, Any], threads: int = THREADS, **fields: Any) -> Work:
    """Return a launch of a kernel with these fields in its arguments."""
    return Work(kernel, blocks, threads, arguments_of(kernel, *named, **fields))
