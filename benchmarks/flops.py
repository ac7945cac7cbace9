"""Floating-point operations of one splat at one pixel, counted by hand from ``kernels/core/blend.h``.

A fused multiply-add counts 2, any other addition, subtraction, multiplication, division or rounding 1; comparisons,
selects, minima, maxima, loads and the exponent's integer arithmetic count nothing. Operations that the compiler
shares (z = z_c / Q) count once. The distance to the pixel centre counts (2).

    intersect                              composite                 composite_vjp<Geo, Dist, no Abs>
      dx, dy                     2           1/z = Q / z_c     1       T after, w                         3
      Q, 1/Q                     5           T after, w        3       along: colours, alpha              6
      u, v                       8           q, w q            2       along: normals, depth              8
      rho of plane and filter    7           distortion        7       dL/dz: depth, median               2
      log2 alpha                 2           M1, M2            3       distortion: 1/z, q, lever          4
      exp2 (round 1, f 1, f^2 1, 13          alpha             1         along                            5
        5 fused)                             colour, normal   12         dL/dz                            6
      z = z_c / Q                1           depth             2       S, dL/d ln alpha                   7
                               ---                           ---       sums: alpha, colour, normal       13
                                38                            31       t, tu, tv, gQ                      4
                                                                       z: gz/Q, sum, gQ                   4
                                                                       X, Y, Q and their moments         15
                                                                       filter's centre                    4
                                                                                                        ---
                                                                                                         81
"""

from __future__ import annotations

INTERSECT, COMPOSITE, COMPOSITE_VJP = 38, 31, 81
FORWARD = INTERSECT + COMPOSITE  # 69
BACKWARD = INTERSECT + COMPOSITE_VJP  # 119: the forward pass's intersection is computed again


def fraction(flops_per_pair: int, pairs: int, milliseconds: float, fma_gflops: float) -> float:
    """Share of the peak multiply-add rate that the visible pairs alone account for."""
    return flops_per_pair * pairs / (1e6 * milliseconds * fma_gflops)
