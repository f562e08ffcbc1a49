"""Guards that keep values and first derivatives finite where a formula reads 0/0; shared pieces.

A formula in `s = theta^2` that is analytic at zero is written twice, as its closed form and as
its Taylor series. Where the series is taken the closed form is evaluated at the fixed point
where the two meet, so neither it nor its derivative is ever NaN.
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
        s: scalar, the square of an angle [rad^2] or of a sine or chord.
        closed: the formula; never called below `below`.
        series: Taylor coefficients in powers of `s`, constant first.
        below: the series is used for `s < below`.

    Returns:
        Scalar.
    """
    polynomial = series[-1]
    for coefficient in reversed(series[:-1]):
        polynomial = coefficient + s * polynomial
    return ca.if_else(s < below, polynomial, closed(ca.fmax(s, below)))


def safe_sqrt(s: Expr, floor: float = 1e-300) -> Expr:
    """Square root with `s` kept above a floor: no NaN, and derivative 0 below the floor.

    Args:
        s: scalar.
        floor: smallest value of s [unit of s].

    Returns:
        Scalar, at least sqrt(floor).
    """
    return ca.sqrt(ca.fmax(s, floor))


def safe_norm(x: Expr) -> Expr:
    """Euclidean norm of a vector (n, 1); at the zero vector 1e-150 with derivative 0, not NaN."""
    return safe_sqrt(ca.dot(x, x))


def shared(*outputs: Expr) -> list[Any]:
    """The same expressions, every equal piece computed once; to be given to a Function.

    CasADi does not merge equal pieces of an SX graph by itself.
    """
    merged: Any = ca.cse(list(outputs))
    return merged


def part(name: str, inputs: Sequence[Expr], outputs: Sequence[Expr]) -> ca.Function:
    """A Function that graphs call where others are written out: code stands once for all calls.

    Args:
        name: Identifier.
        inputs: Symbols.
        outputs: Expressions of them; every equal piece is computed once.
    """
    return ca.Function(name, list(inputs), shared(*outputs), {"never_inline": True})


def part_of(
    name: str, inputs: Sequence[Expr], given: Sequence[Expr], outputs: Sequence[Expr]
) -> Callable[..., Any]:
    """A `part` that is called several times in one graph.

    Args:
        name: Identifier.
        inputs: Symbols for what differs from call to call.
        given: Symbols of the graph itself; what depends on them alone is computed once for all.
        outputs: Expressions of both.

    Returns:
        The function of the inputs, for use in that graph.
    """
    varying: Any
    varying, symbols, known = ca.extract_parametric(shared(*outputs), list(given))
    called = part(name, [*inputs, *given, ca.vertcat(*symbols)], varying)
    return lambda *values: called(*values, *given, ca.vertcat(*known))
