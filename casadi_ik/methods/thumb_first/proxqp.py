"""Small quadratic programs by ProxQP (Bambade et al. 2022) as a node of a graph.

CasADi's own interface to ProxQP cannot be asked for the nearest solution where equations and
bounds contradict each other, so proxsuite is called directly. The node has no C code.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np
from proxsuite import proxqp as backend

ITERATIONS = 30
"""Of its outer loop: contradictions in a narrow box converge slowly, and the step is only tried."""

ACCURACY = 1e-9
"""Residuals at which a program counts as solved."""


class ProxqpNode(ca.Callback):
    """``(H, g, A, b, lower, upper) -> x``, the minimiser of x'Hx/2 + g'x with Ax = b in a box."""

    def __init__(self, n: int, m: int) -> None:
        """Make the node for n unknowns and m equations."""
        ca.Callback.__init__(self)
        self._shapes = [(n, n), (n, 1), (m, n), (m, 1), (n, 1), (n, 1)]
        self.construct(f"proxqp_{n}_{m}", {})

    def get_n_in(self) -> int:
        """Number of inputs."""
        return len(self._shapes)

    def get_n_out(self) -> int:
        """Number of outputs."""
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Shape of an input, dense."""
        return ca.Sparsity.dense(*self._shapes[i])

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Shape of the output, dense."""
        del i
        return ca.Sparsity.dense(*self._shapes[1])

    def eval(self, arg: Any) -> list[Any]:
        """Solve one program; with contradicting equations the nearest that can be solved."""
        H, g, A, b, lower, upper = (np.array(x) for x in arg)
        program = backend.dense.QP(len(g), len(b), 0, True)
        program.settings.eps_abs = ACCURACY
        program.settings.primal_infeasibility_solving = True
        program.settings.max_iter = ITERATIONS
        nothing = None
        vectors = (lower.ravel(), upper.ravel())
        program.init(H, g.ravel(), A, b.ravel(), nothing, nothing, nothing, *vectors)
        program.solve()
        return [ca.DM(program.results.x.tolist())]


@cache
def proxqp(n: int, m: int) -> ProxqpNode:
    """The node for n unknowns and m equations; kept, since a graph does not keep it alive."""
    return ProxqpNode(n, m)
