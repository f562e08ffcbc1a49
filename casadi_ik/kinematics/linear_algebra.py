"""Small dense linear algebra as straight-line graphs: solves, pseudoinverses, singular values.

Each solver is built once per size as an SX function and inlined at each call, so it works on SX, MX
and DM. There are no data-dependent branches and therefore no pivoting: symmetric positive definite
systems need none, general systems use Householder reflections. Singular input never yields NaN,
because the absolute values of pivots are at least `PIVOT_FLOOR`. This bound does not regularise:
use damping for systems that can become singular.

Damping `lam` has the unit of a singular value of J: a direction of singular value s is scaled by
s^2 / (s^2 + lam^2).

`svd`: one-sided Jacobi rotations (Hestenes 1958) make the columns of the narrower of J and J'
orthogonal. No square of J is formed, so the absolute error of small singular values is the rounding
error of the largest. The number of sweeps is fixed (`SWEEPS`, chosen by measurement), and rank
deficiency is harmless. A Householder QR makes J square beforehand, which saves a third of the
instructions for a (3, 9) Jacobian.

`extreme_singular_values` takes a tenth of the instructions of `svd`: the Gram matrix of the
narrower side is brought to tridiagonal form (Householder), and Laguerre's iteration on its
characteristic polynomial converges monotonically from outside to the first and the last root. The
Gram matrix loses digits: values below about 1e-7 of the largest singular value are not resolved.

Do not differentiate `svd` and `extreme_singular_values`.
"""

from __future__ import annotations

from functools import cache

import casadi as ca

from casadi_ik.kinematics.smooth import Expr, safe_sqrt

PIVOT_FLOOR = 1e-30
"""Smallest pivot, far below any meaningful value and far above underflow [unit of the matrix]."""


def solve_spd(A: Expr, b: Expr) -> Expr:
    """Solve A x = b for a symmetric positive definite A by LDL' without pivoting.

    Args:
        A: (n, n) matrix; only the lower triangle is read.
        b: (n, k) right-hand sides.

    Returns:
        x (n, k).
    """
    return _solve_spd_function(*b.shape)(A, b)


def det_spd(A: Expr) -> Expr:
    """Return the determinant of a symmetric positive semidefinite A (n, n) from its LDL' pivots.

    Rounding can make a zero determinant slightly negative. It takes 81 instructions for n = 6, and
    CasADi's expansion by minors takes 2000.
    """
    return _det_spd_function(A.shape[0])(A)


def solve(A: Expr, b: Expr) -> Expr:
    """Solve A x = b for a general square A by Householder QR.

    The method is backward stable without row exchanges and takes 867 instructions for n = 6, k = 4.
    Gaussian elimination with exchanges as selections takes 1244; `ca.solve` takes 861, but its
    Gram-Schmidt loses half the digits near a singularity.

    Args:
        A: (n, n) matrix.
        b: (n, k) right-hand sides.

    Returns:
        x (n, k); finite but meaningless if A is singular.
    """
    return _solve_function(*b.shape)(A, b)


def damped_pinv_times(J: Expr, e: Expr, lam: Expr) -> Expr:
    """Return the damped least-squares solution J' (J J' + lam^2 I)^-1 e (Wampler 1986).

    The smaller of the two equivalent systems is solved.

    Args:
        J: (m, n) Jacobian.
        e: (m, k) errors.
        lam: Scalar damping [unit of a singular value of J].

    Returns:
        x (n, k), the minimiser of |J x - e|^2 + lam^2 |x|^2.
    """
    m, n = J.shape
    if m <= n:
        return ca.mtimes(J.T, solve_spd(_add_to_diagonal(ca.mtimes(J, J.T), lam * lam), e))
    return solve_spd(_add_to_diagonal(ca.mtimes(J.T, J), lam * lam), ca.mtimes(J.T, e))


def weighted_damped_pinv_times(J: Expr, e: Expr, lam: Expr, weights: Expr) -> Expr:
    """Return the weighted damped least-squares solution (Chan & Dubey 1995).

    W^-1 J' (J W^-1 J' + lam^2 I)^-1 e with W = diag(weights): a coordinate of large weight moves
    little.

    Args:
        J: (m, n) Jacobian.
        e: (m, k) errors.
        lam: Scalar damping [unit of a singular value of J W^-1/2].
        weights: (n, 1) positive weights.

    Returns:
        x (n, k), the minimiser of |J x - e|^2 + lam^2 x' W x.
    """
    m, n = J.shape
    if m <= n:
        Jw = J * ca.repmat((1 / weights).T, m, 1)
        return ca.mtimes(Jw.T, solve_spd(_add_to_diagonal(ca.mtimes(Jw, J.T), lam * lam), e))
    return solve_spd(_add_to_diagonal(ca.mtimes(J.T, J), lam * lam * weights), ca.mtimes(J.T, e))


def pinv_times(J: Expr, e: Expr, eps: float = 1e-6) -> Expr:
    """Return the regularised pseudoinverse of J times e: `damped_pinv_times` with small damping.

    Args:
        J: (m, n) Jacobian.
        e: (m, k) errors.
        eps: Damping [unit of a singular value of J]. The relative error in a direction of singular
            value s is eps^2 / s^2; rounding errors dominate below 1e-7 |J|.

    Returns:
        x (n, k).
    """
    return damped_pinv_times(J, e, eps)


def project_to_null_space(J: Expr, x: Expr, eps: float = 1e-6) -> Expr:
    """Project x onto the null space of J: x - J^+ J x, regularised as in `pinv_times`.

    The component of x at a singular value s is scaled by eps^2 / (s^2 + eps^2).

    Args:
        J: (m, n) Jacobian.
        x: (n, k) vectors.
        eps: Damping [unit of a singular value of J].

    Returns:
        (n, k).
    """
    return x - pinv_times(J, ca.mtimes(J, x), eps)


def _add_to_diagonal(A: Expr, value: Expr) -> Expr:
    """Return A + diag(value) for a scalar or (n, 1) value."""
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
    """Return rows of the strict lower factor L, pivots of A = L D L', and their inverses."""
    L: list[list[Expr]] = []
    pivots, inverses = [], []
    for j in range(A.shape[0]):
        row, pivot = [], A[j, j]
        for i in range(j):
            # Row j of L D before row j of L, so that each pivot needs only one division.
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
    """Return the Householder reflection I - v w' that zeroes a vector below a row.

    The result is a reflection even for x = 0.

    Args:
        x: (n, 1) vector.
        row: Index of the first row that the reflection changes.

    Returns:
        v (n - row, 1) and w (n - row, 1), which act on the rows from `row` on, and the new value of
        `row`.
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


SWEEPS = {1: 0, 2: 1, 3: 4, 4: 5, 5: 5, 6: 5}
"""Default number of sweeps by the smaller dimension of J."""

SMALLEST_DIVISOR = 1e-300
"""Lower bound of divisors."""


def svd(J: Expr, sweeps: int | None = None) -> tuple[Expr, Expr, Expr]:
    """Return the thin singular value decomposition J = U diag(s) V'.

    Args:
        J: (m, n) matrix; k = min(m, n).
        sweeps: Number of Jacobi sweeps; None: `SWEEPS[k]`, or 7 for k > 6.

    Returns:
        U (m, k), s (k, 1) in descending order, V (n, k). The factor on the narrow side of J (U if
        J is square) is always orthogonal. Columns of the second factor whose singular values are
        below 1e-100 may be zero.
    """
    wide = J.shape[0] <= J.shape[1]
    A = J.T if wide else J
    k = A.shape[1]
    W, s, V = _svd_function(*A.shape, SWEEPS.get(k, 7) if sweeps is None else sweeps)(A)
    return (V, s, W) if wide else (W, s, V)


def singular_values(J: Expr, sweeps: int | None = None) -> Expr:
    """Return the singular values (k, 1) of J (m, n) in descending order; see `svd`."""
    return svd(J, sweeps)[1]


def condition_number(s: Expr, cap: float = 1e12) -> Expr:
    """Return the ratio of largest to smallest singular value s (k, 1), at most `cap`, never NaN."""
    ratio = ca.mmin(s) / (ca.mmax(s) + SMALLEST_DIVISOR)
    return 1 / ca.fmax(ratio, 1 / cap)


def manipulability(J: Expr) -> Expr:
    """Return Yoshikawa's measure sqrt(det(J J')) of J (m, n), or sqrt(det(J' J)) if m > n.

    It is differentiable, and 0 (1e-150) with derivative 0 at a singularity. It is computed from its
    square, so the product of the singular values is more accurate.
    """
    m, n = J.shape
    G = ca.mtimes(J, J.T) if m <= n else ca.mtimes(J.T, J)
    return safe_sqrt(det_spd(G))


@cache
def _sweep_function(k: int) -> ca.Function:
    """Return A and V (k, k) after one sweep of rotations of all pairs of columns of A."""
    A, V = ca.SX.sym("A", k, k), ca.SX.sym("V", k, k)
    a, v = ca.horzsplit(A), ca.horzsplit(V)
    for i in range(k - 1):
        for j in range(i + 1, k):
            cosine, sine = _rotation(a[i], a[j])
            a[i], a[j] = cosine * a[i] + sine * a[j], cosine * a[j] - sine * a[i]
            v[i], v[j] = cosine * v[i] + sine * v[j], cosine * v[j] - sine * v[i]
    return ca.Function(f"jacobi_sweep_{k}", [A, V], [ca.horzcat(*a), ca.horzcat(*v)])


def _rotation(x: Expr, y: Expr) -> tuple[Expr, Expr]:
    """Return cosine and sine of the rotation that makes x, y orthogonal, the longer first."""
    difference = ca.dot(x, x) - ca.dot(y, y)
    twice = 2 * ca.dot(x, y)
    root = ca.sqrt(difference * difference + twice * twice)
    tangent = twice / (ca.fabs(difference) + root + SMALLEST_DIVISOR)
    cosine = 1 / ca.sqrt(1 + tangent * tangent)
    sine = cosine * tangent
    ordered = difference >= 0
    return ca.if_else(ordered, cosine, sine), ca.if_else(ordered, sine, cosine)


@cache
def _svd_function(n: int, k: int, sweeps: int) -> ca.Function:
    """Return the SVD of a tall A (n, k): QR unless A is square, then Jacobi rotations."""
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
    U = [w / ca.fmax(norm, SMALLEST_DIVISOR) for w, norm in zip(ca.horzsplit(W), s, strict=True)]
    U = [ca.vertcat(u, ca.SX.zeros(n - k, 1)) for u in U]
    for v, w in reversed(reflections):
        U = [reflect(v, w, u) for u in U]
    return ca.Function(f"svd_{n}_{k}_{sweeps}", [A], [ca.horzcat(*U), ca.vertcat(*s), V])


ITERATIONS = {2: 1, 3: 4, 4: 4}
"""Number of Laguerre iterations by the smaller dimension; 5 for larger ones. Two roots are exact
after one iteration. On 400 random matrices of up to 6 rows, some singular, the smallest value is
exact to 1e-8 of the largest, and the largest has a relative error of 2e-5."""


def extreme_singular_values(J: Expr) -> tuple[Expr, Expr]:
    """Return the smallest and largest of the min(m, n) singular values of J (m, n).

    Do not differentiate the result.
    """
    narrow = J.T if J.shape[0] <= J.shape[1] else J
    gram = ca.densify(narrow.T @ narrow)
    n = gram.shape[0]
    scale = ca.trace(gram) + SMALLEST_DIVISOR
    unit = 1 / scale
    diagonal, squares = _tridiagonal([[gram[i, j] * unit for j in range(n)] for i in range(n)])
    # All roots lie between 0 and the trace, which is 1.
    smallest = _laguerre(diagonal, squares, ca.SX(0.0), 1.0) if n > 1 else diagonal[0]
    largest = _laguerre(diagonal, squares, ca.SX(1.0), -1.0) if n > 1 else diagonal[0]
    return ca.sqrt(ca.fmax(smallest, 0.0) * scale), ca.sqrt(ca.fmax(largest, 0.0) * scale)


def _tridiagonal(A: list[list[Expr]]) -> tuple[list[Expr], list[Expr]]:
    """Return diagonal and squares of the subdiagonal of a symmetric matrix in tridiagonal form."""
    n = len(A)
    diagonal, squares = [], []
    for k in range(n - 2):
        rows = range(k + 1, n)
        tail = sum((A[i][k] * A[i][k] for i in rows[1:]), ca.SX(0.0))
        square = A[k + 1][k] * A[k + 1][k] + tail
        norm = ca.sqrt(square)
        head = A[k + 1][k] + ca.if_else(A[k + 1][k] < 0, -norm, norm)
        v = {k + 1: head} | {i: A[i][k] for i in rows[1:]}
        factor = 2 / (head * head + tail + SMALLEST_DIVISOR)
        p = {
            i: factor * sum((A[max(i, j)][min(i, j)] * v[j] for j in rows), ca.SX(0.0))
            for i in rows
        }
        projection = 0.5 * factor * sum((p[i] * v[i] for i in rows), ca.SX(0.0))
        w = {i: p[i] - projection * v[i] for i in rows}
        for i in rows:
            for j in range(k + 1, i + 1):
                A[i][j] = A[i][j] - v[i] * w[j] - w[i] * v[j]
        diagonal.append(A[k][k])
        squares.append(square)
    diagonal += [A[i][i] for i in range(max(n - 2, 0), n)]
    squares += [A[n - 1][n - 2] * A[n - 1][n - 2]] if n > 1 else []
    return diagonal, squares


def _laguerre(diagonal: list[Expr], squares: list[Expr], x: Expr, direction: float) -> Expr:
    """Return the root of the characteristic polynomial nearest to x in a direction (>= 2 rows)."""
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
        x = x + direction * n * ca.fabs(p) / (ca.fabs(q) + root + SMALLEST_DIVISOR)
    return x
