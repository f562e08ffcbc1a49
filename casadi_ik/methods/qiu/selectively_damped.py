"""Selectively damped least squares (Buss & Kim 2005): every singular direction has its own damping.

A direction is damped by how far the joints would have to move to reach its share of the error,
compared with how far their motion carries the tip: far-reaching directions pass undamped, those
that ask much of the joints and give little are held back.
"""

from __future__ import annotations

import casadi as ca

from casadi_ik.symbolic.measures import svd
from casadi_ik.symbolic.smooth import Expr, safe_norm

NEGLIGIBLE = 1e-9
"""Singular values below this part of the largest count as zero, their directions as unreachable."""


def selectively_damped(jacobian: Expr, error: Expr, gamma_max: Expr) -> Expr:
    """One SDLS step for one end effector.

    With J = sum sigma_i u_i v_i', alpha_i = u_i' e, N_i = |u_i| = 1 and
    M_i = sum_j |v_ji| |J_j| / sigma_i:  gamma_i = min(1, N_i / M_i) gamma_max and
    phi_i = clamp(alpha_i v_i / sigma_i, gamma_i); the step is clamp(sum phi_i, gamma_max). `clamp`
    shortens a vector so that no entry is larger in magnitude.

    Args:
        jacobian: (m, n) of one end effector's position or orientation.
        error: (m, 1), already shortened to the longest error that is to be followed.
        gamma_max: Largest change of any joint in one step [rad or m].

    Returns:
        (n, 1) joint step; the pseudo-inverse step wherever nothing needs damping.
    """
    n = jacobian.shape[1]
    U, s, V = svd(jacobian)
    reach = ca.vertcat(*(safe_norm(jacobian[:, j]) for j in range(n)))
    total = ca.SX.zeros(n, 1)
    largest = ca.fmax(ca.mmax(s), 1e-300)
    for i in range(s.shape[0]):
        v = V[:, i]
        counts = s[i] > NEGLIGIBLE * largest
        inverse = 1 / ca.if_else(counts, s[i], 1.0)
        effort = inverse * ca.dot(ca.fabs(v), reach)
        gamma = gamma_max * ca.fmin(1.0, 1 / ca.fmax(effort, 1e-300))
        phi = shorten(inverse * ca.dot(U[:, i], error) * v, gamma)
        total = total + ca.if_else(counts, phi, 0.0)
    return shorten(total, gamma_max)


def shorten(step: Expr, largest: Expr) -> Expr:
    """A vector scaled down so that no entry exceeds `largest` in magnitude."""
    return step * ca.fmin(1.0, largest / ca.fmax(ca.mmax(ca.fabs(step)), 1e-300))
