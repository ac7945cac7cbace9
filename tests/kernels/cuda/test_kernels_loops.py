"""Machine code of the CUDA kernels: registers, shared memory and inner loops match the committed values."""

from __future__ import annotations

import json
from typing import Any

import pytest
from benchmarks import cuda_loops

LISTING = """
	.section	.text.outer,"ax",@progbits
.L_x_0:
        /*0000*/                   MOV R1, c[0x0][0x28] ;
.L_x_1:
        /*0010*/                   LDS.128 R4, [R2] ;
        /*0020*/                   FFMA R8, R4, R5, R6 ;
        /*0030*/              @!P0 FADD.FTZ R8, R8, R4 ;
        /*0040*/                   MUFU.RCP R9, R8 ;
        /*0050*/              @P1  BRA `(.L_x_1) ;
        /*0060*/              @P2  BRA `(.L_x_0) ;
        /*0070*/                   EXIT ;
.L_x_9:
        /*0080*/                   BRA `(.L_x_9);
	.section	.text.straight,"ax",@progbits
        /*0000*/                   EXIT ;
"""


def test_only_innermost_loops_count_and_the_trap_at_the_end_does_not() -> None:
    loops = cuda_loops.innermost_loops(LISTING)
    assert [len(loop) for loop in loops["outer"]] == [5]  # 0010 to 0050; the loop from 0000 contains it
    assert loops["straight"] == []
    assert cuda_loops.mix(loops["outer"][0]) == {"total": 5, "shared": 1, "arithmetic": 2, "special": 1, "branch": 1}


def test_a_figure_may_leave_its_tolerance_in_neither_direction() -> None:
    def kernel(registers: int, total: int) -> dict[str, dict[str, Any]]:
        return {"f": {"registers": registers, "shared_bytes": 0, "spilled_bytes": 0, "loop": {"total": total}}}

    for registers, total, lines in ((72, 300, 0), (75, 300, 1), (69, 300, 1), (72, 309, 0), (72, 310, 1), (70, 290, 1)):
        assert len(cuda_loops.differences(kernel(registers, total), kernel(72, 300))) == lines, (registers, total)
    assert "only one side has: f" in cuda_loops.differences(kernel(1, 1), {})[0]


@pytest.fixture(scope="module")
def measured() -> dict[str, dict[str, Any]]:
    try:
        cuda_loops.compiler_version()
        return cuda_loops.count()
    except cuda_loops.Unavailable as reason:
        pytest.skip(str(reason))


@pytest.mark.slow
def test_loops_registers_and_shared_memory_are_as_committed(measured: dict[str, dict[str, Any]]) -> None:
    committed = json.loads(cuda_loops.COMMITTED.read_text())
    if committed["compiler"] != cuda_loops.compiler_version():
        pytest.skip(f"the committed counts are of {committed['compiler']}, this is {cuda_loops.compiler_version()}")
    over = cuda_loops.differences(measured, committed["kernels"])
    assert not over, f"{over}; if it is meant: python -m benchmarks.cuda_loops --update"


@pytest.mark.slow
def test_the_blend_kernels_leave_room_for_the_warps_that_hide_their_latencies(
    measured: dict[str, dict[str, Any]],
) -> None:
    """sm_90 has 65536 registers and 228 KB of shared memory, of which each block loses 1 KB to the system.

    128 threads of 72 registers give 7 blocks (28 warps), of 64 registers 8 blocks (32 warps). The
    distortion loss, rarely used, has 7 and 5 blocks.
    """
    least = {
        "blend_forward": 8,
        "blend_forward_distortion": 7,
        "blend_vjp": 7,
        "blend_vjp_distortion": 5,
        "blend_vjp_transmittance": 5,
        "splat_errors": 8,
    }
    for kernel, figures in measured.items():
        wanted = [blocks for name, blocks in least.items() if kernel.startswith(name)]
        if not wanted:
            continue
        registers = -(-figures["registers"] // 8) * 8
        blocks = min(65536 // (128 * registers), (228 << 10) // (figures["shared_bytes"] + 1024))
        assert blocks >= wanted[-1], (kernel, figures)
        assert "local" not in figures["loop"], kernel
        assert figures["spilled_bytes"] == 0, kernel
