"""Floating-point operations of one splat at one pixel, counted by hand.

There are two counts. ``EXECUTED`` counts the operations of the loops in ``kernels/core/blend.h``; its share of peak
measures how well the machine is used. ``USEFUL`` counts the operations of the formulas in docs/math.md when each pixel
is computed on its own. An optimisation that skips work lowers only the first count. Forward, 67: offsets 2, the plane
from its six coefficients 10, 1 / I 1, u and v 2, rho3d 3, the low-pass filter 4, log2 alpha 2, a polynomial of degree 5
for 2^x 13, compositing 30 as below. Backward: 119.

A fused multiply-add counts 2; any other addition, subtraction, multiplication, division or rounding counts 1.
Comparisons, selects, minima, maxima, loads and integer arithmetic of the exponent are not counted. Executed operations
with AVX-512, for a pair with a plain splat (``is_plain``, nearly all pairs; with AVX2 2^x has one more term, 2
operations):

    meet, alpha                            composite                 weigh_vjp, add_colors, add_geometry
      X, Y, I: lane + block      3           T after, w        3       T after, w                         3
      z = 1 / I                  1           q, w q            2       along: colours, alpha              6
      u, v                       2           distortion        6       along: normals, depth              8
      rho of the plane           3           M1, M2            4       dL/dz: depth, median               2
      log2 alpha                 2           alpha             1       dL/dI of it: z^2, product          2
      2^x: to the table and      3           colour, normal   12       distortion: q, along, dL/dI        9
        back, degree 2           4           depth             2       S                                  2
        product                  1                           ---       1 / (1 - alpha), dL/d ln alpha     6
                               ---                            30       sums: alpha, colour, normal       13
                                19                                     X and Y again, dx, dy              4
                                                                       t, t z, tu, tv, gI                 6
                                                                       X, Y, I and their moments         15
                                                                                                        ---
                                                                                                         76
"""

from __future__ import annotations

USEFUL = {"forward": 67, "backward": 119}
EXECUTED = {"forward": 19 + 30, "backward": 19 + 76}  # the backward pass recomputes the intersection


def fraction(flops_per_pair: int, pairs: int, milliseconds: float, fma_gflops: float) -> float:
    """Return the share of the peak multiply-add rate that the visible pairs account for."""
    return flops_per_pair * pairs / (1e6 * milliseconds * fma_gflops)
