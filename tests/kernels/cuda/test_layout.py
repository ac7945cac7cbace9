"""The structures of ``kernel_arguments.py`` have the memory layout that NVRTC gives to those of the kernels.

The emulator uses another compiler. Agreement between it and Python does not guarantee the same layout in NVRTC, where a
mismatch would make a kernel read pointers from wrong offsets.
"""

from __future__ import annotations

import ctypes
import re

import pytest

from gs2d.errors import BackendError
from gs2d.kernels import tsdf as fusion
from gs2d.kernels.cuda import compile
from gs2d.kernels.cuda import kernel_arguments as arguments

KERNEL = re.compile(r'extern "C" __global__ void (?:__launch_bounds__\([^)]*\) )?(\w+)\((\w+)(<float>)? ')
NAMES = {  # C++ names that differ
    "KernelView": "View",
    "FeatureBuffers": "Features",
    "GatheredSignal": "Gathered",
    "DecodedTarget": "Photograph",
    "PieceBuffers": "Pieces",
}
CAMERA = {name: f"camera.{name}" for name in ("R", "t", "center", "fx", "fy", "cx", "cy")}  # members of View


def structures() -> dict[str, type[ctypes.Structure]]:
    """Return the argument structures by name."""
    found = {}
    for module in (arguments, fusion):
        for name, value in vars(module).items():
            if isinstance(value, type) and issubclass(value, ctypes.Structure):
                found[name.lstrip("_")] = value
    return found


def assertions(name: str, structure: type[ctypes.Structure]) -> list[str]:
    """Return C++ assertions for a structure and its members."""
    bare = name.partition("<")[0]
    lines = [f'static_assert(sizeof(gs2d::{name}) == {ctypes.sizeof(structure)}, "{bare}");']
    for field, kind in structure._fields_:  # type: ignore[misc]
        place, there = getattr(structure, field).offset, CAMERA.get(field, field) if bare == "View" else field
        offset = f"__INTADDR__(&static_cast<gs2d::{name}*>(nullptr)->{there})"  # NVRTC's definition of offsetof
        lines.append(f'static_assert({offset} == {place}, "{bare}.{field}");')
        inner = getattr(kind, "_type_", kind)
        if isinstance(inner, type) and issubclass(inner, ctypes.Structure):
            own = inner.__name__.lstrip("_")
            lines += assertions(NAMES.get(own, own), inner)
    return lines


@pytest.mark.parametrize("name", compile.source_names())
def test_kernels_and_python_agree_where_every_field_lies(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    try:
        compile.nvrtc_version()
    except BackendError as error:
        pytest.skip(str(error))
    text = compile.sources()[name]
    kinds = {kind + arguments for _, kind, arguments in KERNEL.findall(text)}
    assert len(KERNEL.findall(text)) == len(compile.KERNEL.findall(text))
    known = structures()
    lines = [line for kind in sorted(kinds) for line in assertions(kind, known[kind.partition("<")[0]])]
    assert len(lines) > 3
    headers = {key: value for key, value in compile.sources().items() if key.endswith(".h")}
    # only the structures: no need to recompile the kernels
    compile.compile_text(text + "\n" + "\n".join(lines), name, "compute_75", headers=headers)
