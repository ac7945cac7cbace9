"""The structures read from the sources have the memory layout that NVRTC gives to them.

Where they differ, a kernel would read pointers from wrong offsets.
"""

from __future__ import annotations

import ctypes
import re

import pytest

from gs2d.errors import BackendError
from gs2d.kernels.cuda import compile
from gs2d.kernels.cuda.kernel_arguments import cuda_structure

KERNEL = re.compile(r'extern "C" __global__ void (?:__launch_bounds__\([^)]*\) )?(\w+)\((\w+)(<float>)? ')
TEMPLATES = {"PinholeCamera": "PinholeCamera<float>"}


def assertions(name: str, kind: type[ctypes.Structure]) -> list[str]:
    """Return C++ assertions for a structure and its members."""
    bare = name.partition("<")[0]
    lines = [f'static_assert(sizeof(gs2d::{name}) == {ctypes.sizeof(kind)}, "{bare}");']
    for field, member in kind._fields_:  # type: ignore[misc]
        offset = f"__INTADDR__(&static_cast<gs2d::{name}*>(nullptr)->{field})"  # NVRTC's definition of offsetof
        lines.append(f'static_assert({offset} == {getattr(kind, field).offset}, "{bare}.{field}");')
        inner = getattr(member, "_type_", member)
        if isinstance(inner, type) and issubclass(inner, ctypes.Structure):
            lines += assertions(TEMPLATES.get(inner.__name__, inner.__name__), inner)
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
    lines = [line for kind in sorted(kinds) for line in assertions(kind, cuda_structure(kind.partition("<")[0]))]
    assert len(lines) > 3
    headers = {key: value for key, value in compile.sources().items() if key.endswith(".h")}
    # only the structures: no need to recompile the kernels
    compile.compile_text(text + "\n" + "\n".join(lines), name, "compute_75", headers=headers)
