"""Interval evaluation of CasADi functions, as CasADi functions.

`interval_function` replaces every operation by the operations that bound its result for all
arguments within intervals. Sums, products, quotients and roots are rounded outward, so that the
bounds hold for exact arithmetic too. The result is an ordinary Function, which is compiled in lanes
like any other.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from casadi_ik.kinematics.smooth import Expr, with_cse

RELATIVE_ROUNDING = 4e-16
"""Relative width of the outward rounding, more than one unit in the last place."""

SMALLEST = 1e-300
"""Absolute width of the outward rounding, which covers underflow."""

ELEMENTARY_ERROR = 2e-15
"""Largest error of a sine or cosine of an angle of at most a turn: two units in the last place of
compile/runtime/elementary.c, and the rounding of its argument."""

NO_BOUND = 1e300
"""Bound of a result that is not bounded, since a divisor may be zero."""


class Bounds(NamedTuple):
    """Bounds of a value.

    Attributes:
        lower: Lower bound.
        upper: Upper bound.
        floor: Number that the lower bound never falls below; -inf if none is known.
    """

    lower: Expr
    upper: Expr
    floor: float = -np.inf


def interval_function(function: ca.Function) -> ca.Function:
    """Return the function of interval bounds of a function.

    Args:
        function: An SX function, whose calls of other functions are evaluated in line.

    Returns:
        (lower bounds of each input..., upper bounds of each input...) -> (lower bounds of each
        output..., upper bounds of each output...). A result that is not bounded, because a divisor
        may be zero, is +-1e300.

    Raises:
        NotImplementedError: An operation has no interval form.
    """
    shapes = [function.size_in(i) for i in range(function.n_in())]
    names = [function.name_in(i) for i in range(function.n_in())]
    lower = [ca.SX.sym(f"lower_{n}", *shape) for n, shape in zip(names, shapes, strict=True)]
    upper = [ca.SX.sym(f"upper_{n}", *shape) for n, shape in zip(names, shapes, strict=True)]
    evaluation = _Evaluation()
    results = evaluation.run(function, [*map(_bounds_of_elements, lower, upper)])
    if any(element is UNKNOWN for elements in results for element in elements):
        raise NotImplementedError(
            f"function {function.name()!r}: an operation has no interval form"
        )
    outputs: list[Expr] = []
    for side, replacement in ((0, -NO_BOUND), (1, NO_BOUND)):
        for i, elements in enumerate(results):
            values = [
                ca.if_else(evaluation.is_bounded, element[side], replacement)
                for element in elements
            ]
            outputs.append(ca.reshape(ca.vertcat(*values), *function.size_out(i)))
    name = f"{function.name()}_interval"
    return ca.Function(name, [*lower, *upper], with_cse(*outputs))


def _bounds_of_elements(lower: Expr, upper: Expr) -> list[Bounds]:
    return [
        Bounds(low, high)
        for low, high in zip(ca.vertsplit(ca.vec(lower)), ca.vertsplit(ca.vec(upper)), strict=True)
    ]


class _Evaluation:
    """Interval evaluation of a function's instructions.

    Attributes:
        is_bounded: Condition that no divisor contains zero.
    """

    def __init__(self) -> None:
        self.is_bounded: Expr = ca.SX(1)

    def run(self, function: ca.Function, inputs: list[list[Bounds]]) -> list[list[Bounds]]:
        """Return the bounds of the elements of all outputs (dense, column by column)."""
        outputs = [
            [Bounds(ca.SX(0), ca.SX(0), 0.0)] * function.numel_out(i)
            for i in range(function.n_out())
        ]
        targets = [function.sparsity_out(i).find() for i in range(function.n_out())]
        sources = [function.sparsity_in(i).find() for i in range(function.n_in())]
        work: dict[int, Bounds] = {}
        elements: Any = None
        for k in range(function.n_instructions()):
            code, slots = function.instruction_id(k), function.instruction_output(k)
            if code == ca.OP_CONST:
                work[slots[0]] = _constant(function.instruction_constant(k))
                continue
            arguments = function.instruction_input(k)
            if code == ca.OP_INPUT:
                index, element = arguments
                work[slots[0]] = inputs[index][sources[index][element]]
            elif code == ca.OP_OUTPUT:
                index, element = slots
                outputs[index][targets[index][element]] = work[arguments[0]]
            elif code == ca.OP_CALL:
                elements = function.instructions_sx() if elements is None else elements
                values = [work[i] for i in arguments]
                for slot, value in zip(
                    slots, self._call(elements[k].which_function(), values), strict=True
                ):
                    if slot >= 0:
                        work[slot] = value
            else:
                work[slots[0]] = self._apply(code, [work[i] for i in arguments])
        return outputs

    def _call(self, function: ca.Function, values: list[Bounds]) -> list[Bounds]:
        inputs, first = [], 0
        for i in range(function.n_in()):
            elements = [_constant(0.0)] * function.numel_in(i)
            for element in function.sparsity_in(i).find():
                elements[element] = values[first]
                first += 1
            inputs.append(elements)
        outputs = self.run(function, inputs)
        return [
            outputs[i][element]
            for i in range(function.n_out())
            for element in function.sparsity_out(i).find()
        ]

    def _apply(self, code: int, values: list[Bounds]) -> Bounds:
        """Return the bounds of an operation's result."""
        a = values[0]
        b = values[1] if len(values) > 1 else a
        if code in (ca.OP_DIV, ca.OP_INV) and all(value is not UNKNOWN for value in values):
            dividend, divisor = (a, b) if code == ca.OP_DIV else (_constant(1.0), a)
            return _product(dividend, self._inverse(divisor))
        operation = OPERATIONS.get(code)
        if operation is None or any(value is UNKNOWN for value in values):
            # The operation has no interval form, but other results of the call are used.
            return UNKNOWN
        return operation(a, b)

    def _inverse(self, x: Bounds) -> Bounds:
        """Return the bounds of 1 / x; an interval that contains zero has none."""
        if x.floor > 0:
            return _outward(1 / x.upper, 1 / x.lower, 0.0)
        has_inverse = ca.logic_or(x.lower > 0, x.upper < 0)
        self.is_bounded = ca.logic_and(self.is_bounded, has_inverse)
        low, high = (ca.if_else(has_inverse, end, 1.0) for end in (x.lower, x.upper))
        return _outward(1 / high, 1 / low)


UNKNOWN: Any = None
"""Bounds of a result that has no interval form."""


def _constant(value: float) -> Bounds:
    return Bounds(ca.SX(value), ca.SX(value), float(value))


def _outward(lower: Expr, upper: Expr, floor: float = -np.inf) -> Bounds:
    """Return bounds that are rounded outward, but not below the floor."""
    lower = lower - (RELATIVE_ROUNDING * ca.fabs(lower) + SMALLEST)
    upper = upper + (RELATIVE_ROUNDING * ca.fabs(upper) + SMALLEST)
    return Bounds(lower if floor == -np.inf else ca.fmax(lower, floor), upper, floor)


def _add(a: Bounds, b: Bounds) -> Bounds:
    floor = 0.0 if a.floor >= 0 and b.floor >= 0 else -np.inf
    return _outward(a.lower + b.lower, a.upper + b.upper, floor)


def _negative(a: Bounds, _: Bounds) -> Bounds:
    return Bounds(-a.upper, -a.lower)


def _product(a: Bounds, b: Bounds) -> Bounds:
    if a.floor >= 0 and b.floor >= 0:
        return _outward(a.lower * b.lower, a.upper * b.upper, 0.0)
    for x, y in ((a, b), (b, a)):
        if x.lower.is_constant() and x.upper.is_constant() and float(x.lower) == float(x.upper):
            factor = float(x.lower)
            low, high = (y.lower, y.upper) if factor >= 0 else (y.upper, y.lower)
            if abs(factor) == 1.0:
                return Bounds(factor * low, factor * high)
            return _outward(factor * low, factor * high)
        if x.floor >= 0:
            return _outward(
                ca.fmin(x.lower * y.lower, x.upper * y.lower),
                ca.fmax(x.lower * y.upper, x.upper * y.upper),
            )
    products = [x * y for x in (a.lower, a.upper) for y in (b.lower, b.upper)]
    return _outward(
        ca.fmin(ca.fmin(*products[:2]), ca.fmin(*products[2:])),
        ca.fmax(ca.fmax(*products[:2]), ca.fmax(*products[2:])),
    )


def _square(a: Bounds, _: Bounds) -> Bounds:
    if a.floor >= 0:
        return _outward(a.lower * a.lower, a.upper * a.upper, 0.0)
    smallest = ca.fmax(ca.fmax(a.lower, -a.upper), 0.0)
    largest = ca.fmax(-a.lower, a.upper)
    return _outward(smallest * smallest, largest * largest, 0.0)


def _absolute(a: Bounds, _: Bounds) -> Bounds:
    smallest = ca.fmax(ca.fmax(a.lower, -a.upper), 0.0)
    return Bounds(smallest, ca.fmax(-a.lower, a.upper), 0.0)


def _root(a: Bounds, _: Bounds) -> Bounds:
    low, high = (ca.sqrt(ca.fmax(end, 0.0)) for end in (a.lower, a.upper))
    return _outward(low, high, 0.99 * np.sqrt(a.floor) if a.floor > 0 else 0.0)


def _cosine(a: Bounds, _: Bounds) -> Bounds:
    largest = _largest_cosine(a.lower, a.upper)
    smallest = -_largest_cosine(a.lower - np.pi, a.upper - np.pi)
    return Bounds(
        ca.fmax(smallest - ELEMENTARY_ERROR, -1.0), ca.fmin(largest + ELEMENTARY_ERROR, 1.0)
    )


def _largest_cosine(lower: Expr, upper: Expr) -> Expr:
    """Return the largest cosine of angles in an interval [rad], with a margin against rounding."""
    margin = 1e-9
    last_full_turn = ca.floor((upper + margin) / (2 * np.pi)) * (2 * np.pi)
    contains_zero = last_full_turn >= lower - margin
    return ca.if_else(contains_zero, 1.0, ca.fmax(ca.cos(lower), ca.cos(upper)))


def _select(condition: Bounds, value: Bounds) -> Bounds:
    """Return the bounds of `value` where the condition holds, zero elsewhere."""
    floor = value.floor if value.floor >= 0 else -np.inf
    certain, possible = condition.lower > 0, condition.upper > 0
    low = ca.if_else(certain, value.lower, ca.fmin(value.lower, 0.0))
    high = ca.if_else(certain, value.upper, ca.fmax(value.upper, 0.0))
    low, high = (ca.if_else(possible, end, 0.0) for end in (low, high))
    return Bounds(low, high, min(floor, 0.0))


def _minimum(a: Bounds, b: Bounds) -> Bounds:
    return Bounds(ca.fmin(a.lower, b.lower), ca.fmin(a.upper, b.upper), min(a.floor, b.floor))


def _maximum(a: Bounds, b: Bounds) -> Bounds:
    return Bounds(ca.fmax(a.lower, b.lower), ca.fmax(a.upper, b.upper), max(a.floor, b.floor))


def _shifted(a: Bounds, shift: float) -> Bounds:
    return _outward(a.lower + shift, a.upper + shift)


OPERATIONS = {
    ca.OP_ASSIGN: lambda a, _: a,
    ca.OP_ADD: _add,
    ca.OP_SUB: lambda a, b: _add(a, _negative(b, b)),
    ca.OP_NEG: _negative,
    ca.OP_MUL: _product,
    ca.OP_SQ: _square,
    ca.OP_TWICE: lambda a, _: Bounds(2 * a.lower, 2 * a.upper, 2 * a.floor),
    ca.OP_FABS: _absolute,
    ca.OP_SQRT: _root,
    ca.OP_COS: _cosine,
    ca.OP_SIN: lambda a, _: _cosine(_shifted(a, -np.pi / 2), a),
    ca.OP_FMIN: _minimum,
    ca.OP_FMAX: _maximum,
    ca.OP_IF_ELSE_ZERO: _select,
    ca.OP_LT: lambda a, b: Bounds(a.upper < b.lower, a.lower < b.upper, 0.0),
    ca.OP_LE: lambda a, b: Bounds(a.upper <= b.lower, a.lower <= b.upper, 0.0),
    ca.OP_NOT: lambda a, _: Bounds(ca.logic_not(a.upper), ca.logic_not(a.lower), 0.0),
    ca.OP_AND: lambda a, b: Bounds(
        ca.logic_and(a.lower, b.lower), ca.logic_and(a.upper, b.upper), 0.0
    ),
    ca.OP_OR: lambda a, b: Bounds(
        ca.logic_or(a.lower, b.lower), ca.logic_or(a.upper, b.upper), 0.0
    ),
}
"""Bounds of operations by CasADi's operation code; unary operations ignore the second argument."""
