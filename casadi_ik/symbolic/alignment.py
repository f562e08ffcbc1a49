"""The rotation that best turns one set of vectors into another (Davenport's q-method)."""

from __future__ import annotations

import casadi as ca

from casadi_ik.symbolic.smooth import Expr
from casadi_ik.symbolic.so3 import quaternion_to_matrix

SEVERAL = 0.55
"""Squared length of the powers' matrix, of trace one, below which its dominant eigenvalue counts as
another's as well: 1 if it is one vector's alone, 1/2 if it is that of two. So it is of two fingers
that face each other, nearly enough; not of three in shipped hands."""

SQUARINGS = 7
"""Repeated squarings of the 4 x 4 matrix: a power iteration of 128 steps."""


def align(correlation: Expr, free: Expr | None = None) -> Expr:
    """Rotation R (3, 3) that maximises trace(R B') for B = sum of weighted outer products b a'.

    The best R takes the vectors a to the vectors b in the least-squares sense. The dominant
    eigenvector of Davenport's matrix is its quaternion; it is found by squaring, so that two
    vectors (B of rank two or one) are as good as many.

    Args:
        correlation: B (3, 3), any scale; zero if `free` is given only.
        free: Unit quaternion (4, 1), scalar first. Where several R are as good (one vector turns
            about itself), the one nearest to it; None: any of them.
    """
    B = correlation / ca.fmax(ca.norm_fro(correlation), 1e-300)
    trace = B[0, 0] + B[1, 1] + B[2, 2]
    z = ca.vertcat(B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1])
    K = ca.vertcat(ca.horzcat(trace, z.T), ca.horzcat(z, B + B.T - trace * ca.DM.eye(3)))
    # Eigenvalues lie in [-sqrt(3), sqrt(3)]: shifted, the dominant one is the largest.
    M = K + 2 * ca.DM.eye(4)
    for _ in range(SQUARINGS):
        M = M @ M
        M = M / (M[0, 0] + M[1, 1] + M[2, 2] + M[3, 3])
    column = M[:, 0]
    for j in range(1, 4):
        better = ca.sumsqr(M[:, j]) > ca.sumsqr(column)
        column = ca.if_else(better, M[:, j], column)
    if free is not None:
        # M is the projection onto the best quaternions, by how many dimensions they have.
        column = ca.if_else(ca.sumsqr(M) < SEVERAL, M @ free, column)
    return quaternion_to_matrix(column / ca.fmax(ca.norm_2(column), 1e-300))
