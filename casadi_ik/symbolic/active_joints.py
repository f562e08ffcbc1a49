"""Which joints of a closed chain to command: mobility and active joints from its numbers.

A chain with k coordinates and the constraint C qdot = 0 of eq. (6) of Qiu & Kermani 2021 moves in
k - rank(C) ways. Any choice of that many active coordinates commands it as long as the columns of
the passive ones, H_p, are regular; which choice is good depends on the configuration. QR with
column pivoting (Businger & Golub 1965) takes as passive the columns that are farthest from one
another.
"""

from __future__ import annotations

import numpy as np

from casadi_ik.arrays import Array

DEPENDENT = 1e-9
"""A column counts as dependent if less than this part of the largest is left of it."""


def pivoted(constraint: Array) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Active and passive coordinates at one configuration.

    Args:
        constraint: C (r, k); rows should be scaled so that lengths and angles compare.

    Returns:
        Positions of the active columns, as many as the mobility, and of the passive ones, as many
        as the rank; both in rising order.
    """
    left = np.array(constraint, dtype=float)
    k = left.shape[1]
    floor = DEPENDENT * np.linalg.norm(left, axis=0).max(initial=0.0)
    passive: list[int] = []
    for _ in range(min(left.shape)):
        lengths = np.linalg.norm(left, axis=0)
        best = int(lengths.argmax())
        if lengths[best] <= floor:
            break
        passive.append(best)
        direction = left[:, best] / lengths[best]
        left -= np.outer(direction, direction @ left)
        left[:, best] = 0.0
    active = tuple(i for i in range(k) if i not in passive)
    return active, tuple(sorted(passive))


def mobility(constraint: Array) -> int:
    """In how many ways a chain moves at one configuration: its coordinates less the rank of C."""
    return len(pivoted(constraint)[0])
