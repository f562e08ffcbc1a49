"""Expressions that stay finite where a formula reads 0/0, and functions called from graphs.

A formula in `s = theta^2` that is analytic at zero is evaluated as its closed form or as its Taylor
series. Below the switching point the closed form is evaluated at the switching point, so that
neither its value nor its derivative is ever NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import casadi as ca

Expr: TypeAlias = Any
"""A CasADi matrix: SX, MX or DM (CasADi's stubs cannot express "the same type in and out")."""


def even_function(
    s: Expr, closed: Callable[[Expr], Expr], series: Sequence[float], below: float
) -> Expr:
    """Return `closed(s)`, or its Taylor polynomial where `s` is small.

    Args:
        s: Scalar square of an angle [rad^2], a sine or a chord.
        closed: Closed form; never evaluated below `below`.
        series: Taylor coefficients in powers of `s`, from the constant upwards.
        below: Switching point; the series is used for `s < below`.

    Returns:
        Scalar.
    """
    polynomial = series[-1]
    for coefficient in reversed(series[:-1]):
        polynomial = coefficient + s * polynomial
    return ca.if_else(s < below, polynomial, closed(ca.fmax(s, below)))


def safe_sqrt(s: Expr, floor: float = 1e-300) -> Expr:
    """Return the square root of `max(s, floor)`, whose derivative is 0 below the floor.

    Args:
        s: Scalar.
        floor: Smallest argument of the root [unit of s].

    Returns:
        Scalar, at least sqrt(floor).
    """
    return ca.sqrt(ca.fmax(s, floor))


def safe_norm(x: Expr) -> Expr:
    """Return the Euclidean norm of a vector (n, 1); 1e-150 with derivative 0 at the zero vector."""
    return safe_sqrt(ca.dot(x, x))


def with_cse(*outputs: Expr) -> list[Any]:
    """Return expressions after common subexpression elimination.

    CasADi does not merge equal subexpressions of an SX graph by default.
    """
    merged: Any = ca.cse(list(outputs))
    return merged


def call_function(name: str, inputs: Sequence[Expr], outputs: Sequence[Expr]) -> ca.Function:
    """Return a Function that is called instead of inlined, so that its code exists once.

    Args:
        name: Identifier of the function in the generated code.
        inputs: Symbols of the arguments.
        outputs: Expressions of the inputs.
    """
    return ca.Function(name, list(inputs), with_cse(*outputs), {"never_inline": True})


def hoisted_call_function(
    name: str, inputs: Sequence[Expr], outer: Sequence[Expr], outputs: Sequence[Expr]
) -> Callable[..., Any]:
    """Return a `call_function` whose call-invariant subexpressions are computed once per graph.

    Args:
        name: Identifier of the function in the generated code.
        inputs: Symbols of the arguments, which differ between calls.
        outer: Symbols of the calling graph; subexpressions that depend on them alone are computed
            outside the function.
        outputs: Expressions of `inputs` and `outer`.

    Returns:
        Callable of the inputs, for use in the calling graph.
    """
    varying: Any
    varying, symbols, invariant = ca.extract_parametric(with_cse(*outputs), list(outer))
    function = call_function(name, [*inputs, *outer, ca.vertcat(*symbols)], varying)
    return lambda *values: function(*values, *outer, ca.vertcat(*invariant))
