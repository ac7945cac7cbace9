"""A fake GPU for torch: tensors on "cuda" whose bytes are in host memory.

As on a GPU, host and device tensors cannot be mixed, NumPy cannot read device tensors, and "cuda" is not "cuda:0".
Kernels run in the emulator. ``install`` changes torch for the rest of the process, so use a separate process. Streams,
device memory and timing are not modelled.
"""

from __future__ import annotations

import ctypes
from collections import Counter
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map_only

from emulate import Emulator

GPU = torch.device("cuda:0")
CROSSES = {"aten::copy_", "aten::_to_copy"}  # operations that accept tensors of both devices

# Device information that torch needs where it is built without CUDA.
GUARD = """
#include <c10/core/impl/DeviceGuardImplInterface.h>
static c10::impl::DeviceGuardImplRegistrar registrar(
    c10::DeviceType::CUDA, new c10::impl::NoOpDeviceGuardImpl<c10::DeviceType::CUDA>());
"""


class GpuTensor(Tensor):
    """A tensor on the device; ``inner`` holds its values."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> GpuTensor:
        layout = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype}
        made: GpuTensor = Tensor._make_wrapper_subclass(cls, inner.shape, **layout, device=GPU)
        made.inner = inner
        return made

    def __repr__(self) -> str:  # type: ignore[override]
        return f"GpuTensor({self.inner})"

    def data_ptr(self) -> int:
        return self.inner.data_ptr()

    def tolist(self) -> Any:
        return self.inner.tolist()

    def numpy(self, *_: Any, **__: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy: use Tensor.cpu() first")

    __array__ = numpy

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(func, args, kwargs or {})


def run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Run one operation on the inner values and return its result on the device that a GPU would use."""
    tensors = [t for t in tree_flatten((args, kwargs))[0] if isinstance(t, Tensor)]
    there = any(isinstance(t, GpuTensor) for t in tensors)
    here = [t for t in tensors if not isinstance(t, GpuTensor) and t.dim() > 0]
    name, device = func._schema.name, kwargs.get("device")
    if there and here and name not in CROSSES:
        raise RuntimeError(f"{name}: tensors of the host and of the device are mixed")
    if device is not None:
        there, kwargs = torch.device(device).type == "cuda", {**kwargs, "device": torch.device("cpu")}
    if kwargs.get("pin_memory"):
        kwargs = {**kwargs, "pin_memory": False}
    inner_args, inner_kwargs = tree_map_only(GpuTensor, lambda t: t.inner, (args, kwargs))
    result = func(*inner_args, **inner_kwargs)
    if name == "aten::_local_scalar_dense":
        return result
    if func._schema.is_mutable and isinstance(args[0], Tensor) and result is inner_args[0]:
        return args[0]  # in place
    return tree_map_only(Tensor, GpuTensor, result) if there else result


class _Everywhere(TorchDispatchMode):
    """Mode that also intercepts functions creating tensors without tensor arguments."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(func, args, kwargs or {})


def backward(self: Tensor, gradient: Tensor | None = None) -> None:
    """``Tensor.backward`` without torch's engine, which needs a real device: visits the graph in topological order."""
    root: Any = self.grad_fn
    waiting: Counter[Any] = Counter()
    seen, todo = {root}, [root]
    while todo:
        for node, _ in todo.pop().next_functions:
            if node is not None:
                waiting[node] += 1
                if node not in seen:
                    seen.add(node)
                    todo.append(node)
    given: dict[Any, dict[int, Tensor]] = {root: {self.output_nr: torch.ones_like(self)}}
    todo = [root]
    with torch.no_grad():
        while todo:
            node = todo.pop()
            inputs = given.pop(node, {})
            outputs = _applied(node, inputs)
            for (after, number), gradient_of in zip(node.next_functions, outputs, strict=False):
                if after is None:
                    continue
                if gradient_of is not None:
                    gradient_of = gradient_of.sum_to_size(after._input_metadata[number].shape)  # undo broadcasting
                    sums = given.setdefault(after, {})
                    sums[number] = sums[number] + gradient_of if number in sums else gradient_of
                waiting[after] -= 1
                if waiting[after] == 0:
                    todo.append(after)


def _applied(node: Any, inputs: dict[int, Tensor]) -> tuple[Tensor | None, ...]:
    if hasattr(node, "variable"):  # a leaf
        if 0 in inputs:
            leaf = node.variable
            leaf.grad = inputs[0].clone() if leaf.grad is None else leaf.grad + inputs[0]
        return ()
    if not inputs:
        return (None,) * len(node.next_functions)
    outputs = (getattr(node, "apply", None) or node)(*(inputs.get(i) for i in range(len(node._input_metadata))))
    outputs = outputs if isinstance(outputs, tuple) else (outputs,)
    takes = getattr(node, "takes_tensors", None)  # gs2d's own functions: arguments that are not tensors have no edge
    return outputs if takes is None else tuple(g for g, is_tensor in zip(outputs, takes, strict=True) if is_tensor)


def _noting_tensors(apply: Callable[..., Any]) -> Any:
    """Wrap ``Function.apply`` to record which arguments were tensors."""

    def noting(cls: Any, *args: Any) -> Any:
        outputs = apply.__get__(None, cls)(*args)
        for output in outputs if isinstance(outputs, tuple) else (outputs,):
            if output.grad_fn is not None:
                output.grad_fn.takes_tensors = [isinstance(arg, Tensor) for arg in args]
        return outputs

    return classmethod(noting)


class _Event:
    """An event of a device that has always finished."""

    def __init__(self, **_: Any) -> None: ...

    def record(self, stream: Any = None) -> None: ...

    def synchronize(self) -> None: ...


def install(guard: str, emulator: Emulator) -> Counter[str]:
    """Install the fake GPU in this process; return the launches by kernel, updated as they happen."""
    from gs2d.kernels.cuda import launch
    from gs2d.render.backends import BACKENDS
    from gs2d.render.cuda_backend import CudaBackend

    launched: Counter[str] = Counter()

    def run_kernel(name: str, blocks: int, threads: int, arguments: ctypes.Structure) -> None:
        launched[name] += 1
        emulator.launch(name, blocks, threads, arguments)

    def run_all(works: Any) -> None:
        for work in works:
            run_kernel(work.name, work.blocks, work.threads, work.arguments)

    def launcher_for(device: torch.device) -> Any:
        assert device.type == "cuda", device
        return SimpleNamespace(launch=run_kernel, run=run_all)

    ctypes.CDLL(guard)
    nothing: Callable[..., Any] = lambda *_, **__: None  # noqa: E731
    for name in ("_lazy_init", "synchronize", "reset_peak_memory_stats", "current_stream", "empty_cache"):
        setattr(torch.cuda, name, nothing)
    torch.cuda.Event = _Event  # type: ignore[assignment, misc]
    torch.cuda.current_device = lambda: 0  # type: ignore[method-assign]
    torch.cuda.max_memory_allocated = lambda *_: 1 << 20
    Tensor.backward = backward  # type: ignore[assignment, method-assign]
    Tensor.pin_memory = lambda self: self.clone()  # type: ignore[assignment, method-assign]
    torch.autograd.Function.apply = _noting_tensors(vars(torch.autograd.Function)["apply"])
    launch.launcher_for = launcher_for
    BACKENDS._objects["cuda"] = lambda: CudaBackend()  # skips GPU detection
    torch._C._set_only_lift_cpu_tensors(True)  # the mode also intercepts torch.tensor(..., device="cuda")
    _Everywhere().__enter__()
    return launched
