"""The launches of a rendering and its gradients: kernel, number of blocks, arguments.

``cuda_passes`` creates them for torch tensors and runs them at once. ``cuda_step`` creates them once for persistent
memory and runs them in each iteration, one by one or as a graph. View and room for pairs may be written later.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Mapping
from typing import TypeAlias

from torch import Tensor

from gs2d.kernels.cuda.kernel_arguments import THREADS, cuda_structure, work_of
from gs2d.kernels.cuda.launch import Work

ORDER_THREADS = 512  # order.cu
MOST_PIECES = 1024  # about the number of blocks that a large GPU runs at once
SHORTEST_PIECE = 128  # entries: 4 chunks, whose blending takes several times as long as adding up the pieces
PIECE_ROW, PIECE_STATE = 6, 15 * 256  # pixels.h: integers and floats of a piece
OF_EMISSION = ("width", "height", "tiles_x", "tiles_y", "near")

Pointers: TypeAlias = Mapping[str, Tensor | ctypes.Structure | int | None]


def blocks_of(count: int) -> int:
    """Return the number of blocks for ``count`` threads."""
    return -(-count // THREADS)


def takes_view(work: Work) -> bool:
    """Whether a launch takes a view or parts of one."""
    return hasattr(work.arguments, "view") or isinstance(work.arguments, cuda_structure("EmitArguments"))


def set_view(works: Iterable[Work], view: ctypes.Structure) -> None:
    """Write a view into launches that take one."""
    for work in works:
        if hasattr(work.arguments, "view"):
            work.arguments.view = view
        else:
            for name in OF_EMISSION:
                setattr(work.arguments, name, getattr(view, name))


def project(
    splats: Mapping[str, Tensor], projected: Mapping[str, Tensor], *, errors: bool = False, exact: bool = True
) -> Work:
    """Project splats to records and footprints: of blending, or with ``errors`` of rho <= error_cutoff^2."""
    count = len(splats["means"])
    options = {"count": count, "sh_rest": splats["shN"].shape[1], "errors": int(errors), "exact": int(exact)}
    return work_of("project_splats", blocks_of(count), splats, projected, options)


def piece_words(room: int) -> int:
    """Return the memory of the pieces of long lists, in words of 32 bits, for lists of ``room`` pairs in total."""
    return min(MOST_PIECES, room // SHORTEST_PIECE) * (PIECE_STATE + PIECE_ROW) + 1


def piece_buffers(memory: Tensor, words: int) -> ctypes.Structure:
    """Return the structure of the pieces: their states, then their table, in ``words`` as from :func:`piece_words`."""
    capacity, start = words // (PIECE_STATE + PIECE_ROW), memory.data_ptr()
    return cuda_structure("Pieces")(capacity, start + memory.element_size() * PIECE_STATE * capacity, start)


def order_tiles(tiles: int, pointers: Pointers, pieces: ctypes.Structure) -> Work:
    """Order tiles by their number of pairs, largest first, and cut long lists into pieces if there is room for them."""
    limits = {"tiles": tiles, "shortest": SHORTEST_PIECE, "most": MOST_PIECES}
    table = {"capacity": pieces.capacity, "pieces": pieces.table}
    return work_of("order_tiles", 1, pointers, limits, table, threads=ORDER_THREADS)


def blend(tiles: int, lists: Pointers, images: Pointers, pieces: ctypes.Structure, *, distortion: bool) -> list[Work]:
    """Blend the images from the lists of all tiles; first compute the transmittance of pieces of long lists."""
    name, capacity = f"blend_forward{'_distortion' if distortion else ''}", int(pieces.capacity)
    works = [work_of(name, capacity + tiles, lists, images, pieces=pieces)]
    if capacity > 0:
        works.insert(0, work_of("pieces_forward", capacity, lists, pieces=pieces))
    return works


def blend_gradients(
    tiles: int,
    lists: Pointers,
    images: Pointers,
    upstream: Pointers,
    sums: Pointers,
    pieces: ctypes.Structure,
    *,
    absolute: bool = False,
    features: ctypes.Structure | None = None,
) -> Work:
    """Compute the gradients of the blending, summed for each splat.

    ``lists``, ``images`` and ``pieces`` are those of the forward pass; there are no pieces with further channels
    (``features``). ``upstream`` are the gradients of the images by name; absent or None: no gradient. ``sums`` are
    "gradients", "extras", "slots" and "learns"; without "gradients", only colour gradients are computed. ``absolute``:
    whether to gather the absolute densification signal.
    """
    blocks = tiles + int(pieces.capacity)
    if sums.get("gradients") is None:
        colors = {"g_color": upstream["color"], "gradients": sums["extras"]}
        colors |= {name: sums.get(name) for name in ("learns", "slots")}
        return work_of("blend_vjp_learning", blocks, lists, colors, pieces=pieces)
    present = {name: tensor for name, tensor in upstream.items() if tensor is not None}
    distortion, further = "distortion" in present, "depth_transmittance" in present
    if features is not None:
        kind = "features_vjp" + "_distortion" * distortion
    elif further:
        kind = "blend_vjp_" + "distortion_" * distortion + "transmittance"
    elif distortion:
        kind = "blend_vjp_distortion"
    else:
        geometry = not present.keys().isdisjoint(("normal", "depth_mean", "depth_median"))
        kind = f"blend_vjp_{'geometry' if geometry else 'color'}"
    inputs: dict[str, object] = {name: image for name, image in images.items() if name != "depth_median"}
    inputs |= {"pieces": pieces} | ({} if features is None else {"features": features})
    gradients = {f"g_{name}": tensor for name, tensor in present.items()}
    return work_of(f"{kind}{'_abs' if absolute else ''}", blocks, lists, inputs, gradients, sums)


def splat_gradients(
    splats: Mapping[str, Tensor], sums: Pointers, gradients: Mapping[str, Tensor | None], *, clears: bool = False
) -> Work:
    """Compute the gradients of the parameters from the sums of :func:`blend_gradients`.

    ``sums`` are "tile_counts", "learns", "gradients" and "extras"; without "gradients", only colour gradients are
    computed. ``gradients`` are the output tensors by attribute, "probe" and "intrinsics"; absent or None: not computed.
    ``clears``: whether to reset the sums to zero.
    """
    count = len(splats["means"])
    scalars = {"count": count, "sh_rest": splats["shN"].shape[1], "clears": int(clears)}
    outputs = {f"g_{name}": tensor for name, tensor in gradients.items() if tensor is not None}
    if sums.get("gradients") is None:
        colors = {name: splats[name] for name in ("means", "sh0", "shN")} | outputs
        shared = {"tile_counts": sums["tile_counts"], "learns": sums.get("learns"), "gradients": sums["extras"]}
        return work_of("project_colors_vjp", blocks_of(count), scalars, colors, shared)
    probe = gradients.get("probe")
    scalars["probe_columns"] = 0 if probe is None else int(probe.shape[1])
    return work_of("project_splats_vjp", blocks_of(count), scalars, splats, sums, outputs)
