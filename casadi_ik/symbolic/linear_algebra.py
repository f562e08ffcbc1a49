"""Small dense linear solves as straight-line graphs.

Each solver is built once per size as an SX function and inlined where it is called, so it works
on SX, MX and DM alike. There is no data-dependent branch, hence no pivoting: symmetric positive
definite systems need none, general systems use Householder reflections instead. Singular input
never yields NaN: pivots are kept above `PIVOT_FLOOR` in absolute value. That is a guard, no
regularisation; damp what may become singular.

Damping `lam` carries the unit of a singular value of J: a direction of singular value s is scaled
by s^2 / (s^2 + lam^2).
"""

from __future__ import annotations

from functools import cache

import casadi as ca

from casadi_ik.symbolic.smooth import Expr

PIVOT_FLOOR = 1e-30
"""Smallest pivot [unit of the matrix]; far below any meaningful value, far above underflow."""


def solve_spd(A: Expr, b: Expr) -> Expr:
    """Solve A x = b for a symmetric positive definite A, by LDL' without pivoting.

    Args:
        A: (n, n); only the lower triangle is read.
        b: (n, k).

    Returns:
        x (n, k).
    """
    return _solve_spd_function(*b.shape)(A, b)


def det_spd(A: Expr) -> Expr:
    """Determinant of a symmetric positive semidefinite A (n, n): the product of LDL' pivots.

    Rounding may leave it slightly negative where it should be 0. 81 instructions for n = 6,
    where CasADi's expansion by minors takes 2000.
    """
    return _det_spd_function(A.shape[0])(A)


def solve(A: Expr, b: Expr) -> Expr:
    """Solve A x = b for a general square A, by Householder QR.

    Backward stable without row exchanges: 867 instructions for n = 6, k = 4. Gaussian elimination
    with exchanges written as selections takes 1244; `ca.solve` takes 861, but its Gram-Schmidt
    loses half the digits near a singularity.

    Args:
        A: (n, n).
        b: (n, k).

    Returns:
        x (n, k); finite, but meaningless, if A is singular.
    """
    return _solve_function(*b.shape)(A, b)


def damped_pinv_times(J: Expr, e: Expr, lam: Expr) -> Expr:
    """Damped least squares J' (J J' + lam^2 I)^-1 e (Wampler 1986).

    Solved on the smaller side of J; both forms are equal.

    Args:
        J: (m, n).
        e: (m, k).
        lam: scalar damping [unit of a singular value of J].

    Returns:
        x (n, k), the minimiser of |J x - e|^2 + lam^2 |x|^2.
    """
    m, n = J.shape
    if m <= n:
        return ca.mtimes(J.T, solve_spd(_add_to_diagonal(ca.mtimes(J, J.T), lam * lam), e))
    return solve_spd(_add_to_diagonal(ca.mtimes(J.T, J), lam * lam), ca.mtimes(J.T, e))


def weighted_damped_pinv_times(J: Expr, e: Expr, lam: Expr, weights: Expr) -> Expr:
    """Weighted damped least squares (Chan & Dubey 1995).

    W^-1 J' (J W^-1 J' + lam^2 I)^-1 e with W = diag(weights): a heavy coordinate moves little.

    Args:
        J: (m, n).
        e: (m, k).
        lam: scalar damping [unit of a singular value of J W^-1/2].
        weights: (n, 1), positive.

    Returns:
        x (n, k), the minimiser of |J x - e|^2 + lam^2 x' W x.
    """
    m, n = J.shape
    if m <= n:
        Jw = J * ca.repmat((1 / weights).T, m, 1)
        return ca.mtimes(Jw.T, solve_spd(_add_to_diagonal(ca.mtimes(Jw, J.T), lam * lam), e))
    return solve_spd(_add_to_diagonal(ca.mtimes(J.T, J), lam * lam * weights), ca.mtimes(J.T, e))


def pinv_times(J: Expr, e: Expr, eps: float = 1e-6) -> Expr:
    """Pseudoinverse of J times e, regularised: `damped_pinv_times` with a tiny damping.

    Args:
        J: (m, n).
        e: (m, k).
        eps: damping [unit of a singular value of J]. The relative error in a direction of
            singular value s is eps^2 / s^2; below 1e-7 |J| rounding takes over.

    Returns:
        x (n, k).
    """
    return damped_pinv_times(J, e, eps)


def project_to_null_space(J: Expr, x: Expr, eps: float = 1e-6) -> Expr:
    """Project x onto the null space of J: x - J^+ J x, regularised as in `pinv_times`.

    The part of x at a singular value s is left with eps^2 / (s^2 + eps^2) of its length.

    Args:
        J: (m, n).
        x: (n, k).
        eps: damping [unit of a singular value of J].

    Returns:
        (n, k).
    """
    return x - pinv_times(J, ca.mtimes(J, x), eps)


def _add_to_diagonal(A: Expr, value: Expr) -> Expr:
    """A + diag(value) for a scalar or (n, 1) value."""
    n = A.shape[0]
    return ca.densify(A + ca.diag(value * ca.DM.ones(n, 1)))


@cache
def _solve_spd_function(n: int, k: int) -> ca.Function:
    A, B = ca.SX.sym("A", n, n), ca.SX.sym("B", n, k)
    L, _, inverses = _ldl(A)
    X = [B[i, :] for i in range(n)]
    for j in range(n):
        for i in range(j):
            X[j] = X[j] - L[j][i] * X[i]
    for j in reversed(range(n)):
        X[j] = X[j] * inverses[j]
        for i in range(j + 1, n):
            X[j] = X[j] - L[i][j] * X[i]
    return ca.Function(f"solve_spd_{n}_{k}", [A, B], [ca.densify(ca.vertcat(*X))])


@cache
def _det_spd_function(n: int) -> ca.Function:
    A = ca.SX.sym("A", n, n)
    det = ca.SX(1)
    for pivot in _ldl(A)[1]:
        det = det * pivot
    return ca.Function(f"det_spd_{n}", [A], [det])


def _ldl(A: Expr) -> tuple[list[list[Expr]], list[Expr], list[Expr]]:
    """Rows of the strict lower factor L the pivots of A = L D L' and their inverses."""
    L: list[list[Expr]] = []
    pivots, inverses = [], []
    for j in range(A.shape[0]):
        row, pivot = [], A[j, j]
        for i in range(j):
            # Row j of L D first, then of L: one division per pivot in all.
            row.append(A[j, i] - sum((row[p] * L[i][p] for p in range(i)), ca.SX(0)))
        for i in range(j):
            scaled = row[i] * inverses[i]
            pivot = pivot - scaled * row[i]
            row[i] = scaled
        L.append(row)
        pivots.append(pivot)
        inverses.append(1 / ca.fmax(pivot, PIVOT_FLOOR))
    return L, pivots, inverses


@cache
def _solve_function(n: int, k: int) -> ca.Function:
    A, B = ca.SX.sym("A", n, n), ca.SX.sym("B", n, k)
    columns = ca.horzsplit(ca.horzcat(A, B))
    pivots = []
    for j in range(n - 1):
        v, w, pivot = reflector(columns[j], j)
        pivots.append(pivot)
        columns[j + 1 :] = [reflect(v, w, y) for y in columns[j + 1 :]]
    pivots.append(columns[n - 1][n - 1])
    rhs = ca.horzcat(*columns[n:])
    X = [rhs[i, :] for i in range(n)]
    for j in reversed(range(n)):
        pivot = pivots[j]
        magnitude = ca.fmax(ca.fabs(pivot), PIVOT_FLOOR)
        for i in range(j + 1, n):
            X[j] = X[j] - columns[i][j] * X[i]
        X[j] = X[j] * (ca.if_else(pivot < 0, -1.0, 1.0) / magnitude)
    return ca.Function(f"solve_{n}_{k}", [A, B], [ca.densify(ca.vertcat(*X))])


def reflector(x: Expr, row: int) -> tuple[Expr, Expr, Expr]:
    """Householder reflection I - v w' that clears a vector below a row.

    Args:
        x: (n, 1).
        row: entries above this row stay as they are.

    Returns:
        v (n - row, 1), w (n - row, 1), both acting on the rows from `row` on, and the value
        left in `row`. A reflection for x = 0 as well.
    """
    x = ca.vertcat(x[row] + 1e-150, x[row + 1 :])
    norm = ca.sqrt(ca.dot(x, x))
    signed = ca.if_else(x[0] < 0, -norm, norm)
    v = ca.vertcat(x[0] + signed, x[1:])
    return v, v / (signed * v[0]), -signed


def reflect(v: Expr, w: Expr, y: Expr) -> Expr:
    """Apply a reflection I - v w' to the last rows of a vector y (n, 1)."""
    row = y.shape[0] - v.shape[0]
    return ca.vertcat(y[:row], y[row:] - ca.dot(w, y[row:]) * v)
