"""Common subexpressions: CasADi does not merge equal pieces of an SX graph by itself."""

from __future__ import annotations

from typing import Any

import casadi as ca

from casadi_ik.symbolic.smooth import Expr


def shared(*outputs: Expr) -> list[Any]:
    """The same expressions, every equal piece computed once; to be given to a Function."""
    merged: Any = ca.cse(list(outputs))
    return merged
