"""Singular values of a small Jacobian as a graph, and the measures built on them.

One-sided Jacobi rotations (Hestenes 1958) make the columns of the narrower of J and J'
orthogonal: no square of J is formed, so small singular values keep an absolute error of rounding
times the largest. The number of sweeps is fixed, chosen by measurement (`SWEEPS`), and rank
deficiency is harmless. A Householder QR first makes J square, which saves a third of the
instructions for a (3, 9) Jacobian. Not meant to be differentiated.
"""

from __future__ import annotations

from functools import cache

import casadi as ca

from casadi_ik.symbolic.linear_algebra import det_spd, reflect, reflector
from casadi_ik.symbolic.smooth import Expr, safe_sqrt

SWEEPS = {1: 0, 2: 1, 3: 4, 4: 5, 5: 5, 6: 5}
"""Default sweeps by the smaller dimension of J."""

TINY = 1e-300


def svd(J: Expr, sweeps: int | None = None) -> tuple[Expr, Expr, Expr]:
    """Thin singular value decomposition J = U diag(s) V'.

    Args:
        J: (m, n); k = min(m, n).
        sweeps: Jacobi sweeps; None takes `SWEEPS[k]`, or 7 for k > 6.

    Returns:
        U (m, k), s (k, 1), V (n, k), with s descending. The factor on the narrow side of J (U
        if square) is orthogonal always, the other one up to columns of singular values below
        1e-100, which may be zero.
    """
    wide = J.shape[0] <= J.shape[1]
    A = J.T if wide else J
    k = A.shape[1]
    W, s, V = _svd_function(*A.shape, SWEEPS.get(k, 7) if sweeps is None else sweeps)(A)
    return (V, s, W) if wide else (W, s, V)


def singular_values(J: Expr, sweeps: int | None = None) -> Expr:
    """Singular values (k, 1) of J (m, n), k = min(m, n), descending; see `svd`."""
    return svd(J, sweeps)[1]


def condition_number(s: Expr, cap: float = 1e12) -> Expr:
    """Largest over smallest of the singular values s (k, 1), at most `cap`, never NaN."""
    ratio = ca.mmin(s) / (ca.mmax(s) + TINY)
    return 1 / ca.fmax(ratio, 1 / cap)


def manipulability(J: Expr) -> Expr:
    """Yoshikawa's measure sqrt(det(J J')) of J (m, n), or sqrt(det(J' J)) if m > n.

    Differentiable; at a singularity 0 (1e-150) with derivative 0. Its square is resolved to
    rounding only, so where the singular values are at hand, their product is more accurate.
    """
    m, n = J.shape
    G = ca.mtimes(J, J.T) if m <= n else ca.mtimes(J.T, J)
    return safe_sqrt(det_spd(G))


@cache
def _sweep_function(k: int) -> ca.Function:
    """One sweep over all pairs of columns of A (k, k), the same rotations applied to V (k, k)."""
    A, V = ca.SX.sym("A", k, k), ca.SX.sym("V", k, k)
    a, v = ca.horzsplit(A), ca.horzsplit(V)
    for i in range(k - 1):
        for j in range(i + 1, k):
            cosine, sine = _rotation(a[i], a[j])
            a[i], a[j] = cosine * a[i] + sine * a[j], cosine * a[j] - sine * a[i]
            v[i], v[j] = cosine * v[i] + sine * v[j], cosine * v[j] - sine * v[i]
    return ca.Function(f"jacobi_sweep_{k}", [A, V], [ca.horzcat(*a), ca.horzcat(*v)])


def _rotation(x: Expr, y: Expr) -> tuple[Expr, Expr]:
    """Cosine and sine of the rotation that makes x, y orthogonal and the first the longer one."""
    difference = ca.dot(x, x) - ca.dot(y, y)
    twice = 2 * ca.dot(x, y)
    root = ca.sqrt(difference * difference + twice * twice)
    tangent = twice / (ca.fabs(difference) + root + TINY)
    cosine = 1 / ca.sqrt(1 + tangent * tangent)
    sine = cosine * tangent
    ordered = difference >= 0
    return ca.if_else(ordered, cosine, sine), ca.if_else(ordered, sine, cosine)


@cache
def _svd_function(n: int, k: int, sweeps: int) -> ca.Function:
    """SVD of a tall A (n, k): QR first where it is not square, then Jacobi on the triangle."""
    A = ca.SX.sym("A", n, k)
    columns, reflections = ca.horzsplit(A), []
    if n > k:
        for j in range(k):
            v, w, pivot = reflector(columns[j], j)
            columns[j] = ca.vertcat(columns[j][:j], pivot, ca.SX.zeros(k - j - 1, 1))
            columns[j + 1 :] = [reflect(v, w, y) for y in columns[j + 1 :]]
            reflections.append((v, w))
    W, V = ca.horzcat(*[x[:k] for x in columns]), ca.SX(ca.densify(ca.DM.eye(k)))
    for _ in range(sweeps):
        W, V = _sweep_function(k)(W, V)
    s = [ca.sqrt(ca.dot(w, w)) for w in ca.horzsplit(W)]
    U = [w / ca.fmax(norm, TINY) for w, norm in zip(ca.horzsplit(W), s, strict=True)]
    U = [ca.vertcat(u, ca.SX.zeros(n - k, 1)) for u in U]
    for v, w in reversed(reflections):
        U = [reflect(v, w, u) for u in U]
    return ca.Function(f"svd_{n}_{k}_{sweeps}", [A], [ca.horzcat(*U), ca.vertcat(*s), V])
