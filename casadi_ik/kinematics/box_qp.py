"""One damped Gauss-Newton step for a least-squares problem with simple bounds.

The step solves ``min |r + J s|^2 + damping |s|^2`` with the bounded coordinates kept between their
bounds: a small quadratic problem in a box, whose active set is corrected in a few passes
(primal-dual active set method, Hintermueller, Ito & Kunisch 2002). A coordinate that leaves its box
is held at the bound it passed, one that is held against its will is let go. Every pass costs one
small factorisation.

What is structurally zero costs nothing: fingers share no more than the palm and what drives several
of them, so in the right order (`elimination`) code and time grow with the number of fingers, where
those of dense matrices grow with the cube of the number of motors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TypeAlias

import casadi as ca

from casadi_ik.kinematics.linear_algebra import PIVOT_FLOOR
from casadi_ik.kinematics.smooth import Expr, call_function


@dataclass(frozen=True)
class Pivot:
    """An unknown and those that its elimination concerns.

    Attributes:
        place: Number of the unknown.
        others: Numbers of the unknowns it is coupled with by then, those eliminated before aside.
        sign: Of its diagonal entry, which no elimination changes (Vanderbei 1995).
    """

    place: int
    others: tuple[int, ...]
    sign: float = 1.0

    @property
    def operations(self) -> int:
        """About how many operations it takes."""
        return (len(self.others) + 2) ** 2


class System:
    """Equations on the way of their elimination; the entries are scalar expressions.

    Attributes:
        entries: Of the matrix, by row and column, the smaller number first.
        right: Right-hand side; of an unknown that is eliminated its value but for the others' part.
        inverses: Of the pivots.
    """

    def __init__(
        self, entries: dict[tuple[int, int], Expr], right: list[Expr], inverses: dict[int, Expr]
    ) -> None:
        """Copy what changes on the way."""
        self.entries, self.right, self.inverses = dict(entries), list(right), dict(inverses)

    @classmethod
    def of(cls, matrix: Expr, slope: Expr) -> System:
        """``matrix x = -slope``, symmetric."""
        sparsity = matrix.sparsity()
        places = zip(sparsity.row(), sparsity.get_col(), matrix.nonzeros(), strict=True)
        entries = {(i, j): value for i, j, value in places if i <= j}
        return cls(entries, [-slope[i] for i in range(slope.numel())], {})

    @property
    def numbers(self) -> Expr:
        """All of it, in one column."""
        return ca.vertcat(*self.entries.values(), *self.right, *self.inverses.values())

    @classmethod
    def of_symbols(cls, other: System) -> System:
        """One like another, made of symbols."""
        entries = {place: ca.SX.sym("entry") for place in other.entries}
        inverses = {i: ca.SX.sym("inverse") for i in other.inverses}
        return cls(entries, [ca.SX.sym("right") for _ in other.right], inverses)

    def copy(self) -> System:
        """The same, to go on with."""
        return System(self.entries, self.right, self.inverses)

    def eliminate(self, pivot: Pivot, free: Expr | None = None, value: Expr | None = None) -> None:
        """Take an unknown out of the equations of the others.

        Args:
            pivot: The unknown.
            free: 1 if it is not held, 0 if it is; None if it never is.
            value: Where it is held, 0 if it is not.
        """
        i, entries = pivot.place, self.entries
        inverse = pivot.sign / ca.fmax(pivot.sign * entries[i, i], PIVOT_FLOOR)
        own = self.right[i]
        if free is None:
            own = inverse * own
        else:
            inverse = free * inverse
            own = inverse * own + value
        self.inverses[i], self.right[i] = inverse, own
        for place, j in enumerate(pivot.others):
            coupling = entries[_key(i, j)]
            factor = coupling * inverse
            self.right[j] = self.right[j] - coupling * own
            for k in pivot.others[place:]:
                taken = factor * entries[_key(i, k)]
                # Where none was before an entry comes into being.
                entries[j, k] = entries[j, k] - taken if (j, k) in entries else -taken

    def value(self, pivot: Pivot, x: dict[int, Expr]) -> Expr:
        """An eliminated unknown, from those that it was coupled with."""
        i = pivot.place
        behind = sum((self.entries[_key(i, j)] * x[j] for j in pivot.others), ca.SX(0))
        return self.right[i] - self.inverses[i] * behind


@dataclass(frozen=True)
class Elimination:
    """In which order a system is solved.

    Attributes:
        free: Unknowns before this number are never held.
        once: Pivots that come first, whatever is held: all that are never held, or none.
        each: Those that follow, each time.
        after: The pivots of all that are never held, if the others are known.
    """

    free: int
    once: tuple[Pivot, ...]
    each: tuple[Pivot, ...]
    after: tuple[Pivot, ...]

    def begun(self, matrix: Expr, slope: Expr) -> System:
        """Eliminate what comes first.

        Args:
            matrix: (n, n) symmetric positive definite, with the sparsity the order was made for;
                only its upper triangle is read.
            slope: (n, 1).
        """
        system = System.of(matrix, slope)
        for pivot in self.once:
            system.eliminate(pivot)
        return system

    def solved(self, begun: System, held: Expr, values: Expr) -> dict[int, Expr]:
        """The unknowns that do not come first, by number.

        Args:
            begun: The system.
            held: (n - free, 1) whether an unknown is held.
            values: (n - free, 1) where; zero for those that are not.
        """
        system = begun.copy()
        for pivot in self.each:
            place = pivot.place - self.free
            if place < 0:
                system.eliminate(pivot)
            else:
                system.eliminate(pivot, 1 - held[place], values[place])
        x: dict[int, Expr] = {}
        for pivot in reversed(self.each):
            x[pivot.place] = system.value(pivot, x)
        return x

    def forces(self, begun: System, x: dict[int, Expr]) -> list[Expr]:
        """By how much the equations of what may be held are not met, (n - free) numbers."""
        found = []
        for i in range(self.free, len(begun.right)):
            parts = (begun.entries[_key(i, j)] * x[j] for j in x if _key(i, j) in begun.entries)
            found.append(sum(parts, -begun.right[i]))
        return found

    def resting(self, begun: System) -> list[Expr]:
        """The `forces` where all that may be held is 0, and what is never held follows."""
        if self.once:
            return self.forces(begun, {})
        still = {i: ca.SX(0) for i in range(self.free, len(begun.right))}
        whole = self.completed(begun, still)
        return self.forces(begun, still | {i: whole[i] for i in range(self.free)})

    def completed(self, begun: System, x: dict[int, Expr]) -> Expr:
        """All unknowns (n, 1), where what may be held is given."""
        system, known = begun, dict(x)
        if not self.once:
            system = begun.copy()
            for i in range(self.free):
                parts = (
                    system.entries[i, j] * x[j]
                    for j in range(self.free, len(begun.right))
                    if (i, j) in system.entries
                )
                system.right[i] = system.right[i] - sum(parts, ca.SX(0))
            for pivot in self.after:
                system.eliminate(pivot)
        for pivot in reversed(self.once or self.after):
            known[pivot.place] = system.value(pivot, known)
        return ca.vertcat(*(known[i] for i in range(len(begun.right))))


def elimination(sparsity: ca.Sparsity, free: int, times: int, duals: int = 0) -> Elimination:
    """The order that takes fewest operations.

    Args:
        sparsity: Of the matrix.
        free: Unknowns before this number are never held.
        times: How often it is solved with other unknowns held.
        duals: Unknowns before this number have a negative diagonal.
    """
    after = _pivots(_couplings(sparsity, free), range(free), duals)
    ways = []
    for first in (range(free), range(0)):
        couplings = _couplings(sparsity, sparsity.size1())
        once = _pivots(couplings, first, duals)
        each = _pivots(couplings, [i for i in couplings if i not in first], duals)
        cost = _operations(once or after) + times * _operations(each)
        ways.append((cost, Elimination(free, once, each, after)))
    return min(ways, key=lambda way: way[0])[1]


def _operations(pivots: Sequence[Pivot]) -> int:
    return sum(pivot.operations for pivot in pivots)


def _couplings(sparsity: ca.Sparsity, count: int) -> dict[int, set[int]]:
    """With which others each of the first unknowns is coupled."""
    found: dict[int, set[int]] = {i: set() for i in range(count)}
    for i, j in zip(sparsity.row(), sparsity.get_col(), strict=True):
        if i != j and max(i, j) < count:
            found[i].add(j)
            found[j].add(i)
    return found


def _pivots(couplings: dict[int, set[int]], places: Sequence[int], duals: int) -> tuple[Pivot, ...]:
    """Some unknowns, always the least coupled one next (minimum degree); they are taken out."""
    found, left = [], set(places)
    while left:
        place = min(left, key=lambda i: (len(couplings[i]), i))
        left.remove(place)
        others = couplings.pop(place)
        for i in others:
            couplings[i] |= others
            couplings[i] -= {place, i}
        found.append(Pivot(place, tuple(sorted(others)), -1.0 if place < duals else 1.0))
    return tuple(found)


def _key(i: int, j: int) -> tuple[int, int]:
    return (i, j) if i <= j else (j, i)


@dataclass(frozen=True, eq=False)
class Bounded:
    """Bounds of the last coordinates of a problem.

    Attributes:
        value: (k, 1) where the coordinates are.
        lower: (k, 1).
        upper: (k, 1).
        first: How many coordinates without bounds come before them.
    """

    value: Expr
    lower: Expr
    upper: Expr
    first: int


@dataclass(frozen=True, eq=False)
class DampedStep:
    """A step and what the linear model promises of it.

    Attributes:
        step: (n, 1).
        promised: By how much ``|r + J s|^2`` falls.
    """

    step: Expr
    promised: Expr


def damped_step(
    jacobian: Expr,
    residual: Expr,
    damping: Expr,
    bounded: Bounded,
    passes: int,
    full: tuple[Expr, Expr] | None = None,
) -> DampedStep:
    """Levenberg-Marquardt step within the bounds.

    Args:
        jacobian: (m, n), structurally sparse if possible.
        residual: (m, 1).
        damping: Scalar added to the diagonal of J'J.
        bounded: The bounded coordinates, the last ones.
        passes: Corrections of the active set, at least one.
        full: Rows (k, n) that concern all coordinates, and their residual (k, 1). As multipliers
            of their own they leave J'J as sparse as it is.

    Returns:
        The step; value + step is within the bounds, to rounding.
    """
    normal, gradient = squares(jacobian, residual)
    low, high = bounded.lower - bounded.value, bounded.upper - bounded.value
    step = in_box(normal, damping, gradient, low, high, passes, full)
    promised = _promise(jacobian, residual, step)
    return DampedStep(step, promised if full is None else promised + _promise(*full, step))


def _promise(jacobian: Expr, residual: Expr, step: Expr) -> Expr:
    change = jacobian @ step
    return -ca.dot(change, 2 * residual + change)


def squares(jacobian: Expr, residual: Expr) -> tuple[Expr, Expr]:
    """Upper triangle (n, n) of J'J, and J'r (n, 1), of J (m, n) and r (m, 1)."""
    return _squares(_pattern(jacobian))(jacobian, residual)


def in_box(
    matrix: Expr,
    damping: Expr,
    slope: Expr,
    low: Expr,
    high: Expr,
    passes: int,
    full: tuple[Expr, Expr] | None = None,
) -> Expr:
    """Minimiser of x' M x / 2 + slope' x, the last coordinates in a box that holds the origin.

    Args:
        matrix: (n, n) M but for the damping, symmetric; only its upper triangle is read.
        damping: Scalar added to the diagonal, so that M is positive definite.
        slope: (n, 1).
        low: (k, 1) lower ends of the box, <= 0.
        high: (k, 1) upper ends, >= 0.
        passes: Corrections of the active set, at least one.
        full: A (m, n) and b (m, 1) of |A x + b|^2 / 2, which is added. Its residual y is unknown
            as well, ``M x + A' y = -slope, A x - y = -b``.
    """
    upper, duals = ca.triu(matrix), 0
    if full is not None:
        duals = full[1].numel()
        below = ca.horzcat(ca.SX(matrix.shape[0], duals), upper)
        upper = ca.vertcat(ca.horzcat(-ca.SX.eye(duals), full[0]), below)
        slope = ca.vertcat(full[1], slope)
    found = _in_box(_pattern(upper), low.numel(), passes, duals)(upper, damping, slope, low, high)
    return found[duals:]


Pattern: TypeAlias = tuple[tuple[int, int], tuple[int, ...], tuple[int, ...]]
"""Size, rows and columns of what is structurally not zero: what functions are kept by."""


def _pattern(matrix: Expr) -> Pattern:
    sparsity = matrix.sparsity()
    return matrix.shape, tuple(sparsity.row()), tuple(sparsity.get_col())


def _sparse(name: str, pattern: Pattern) -> Expr:
    (rows, columns), *places = pattern
    return ca.SX.sym(name, ca.Sparsity.triplet(rows, columns, *places))


@cache
def _squares(pattern: Pattern) -> ca.Function:
    """See `squares`: the sum of those of blocks, as many as possible calls of one function."""
    jacobian = _sparse("jacobian", pattern)
    residual = ca.SX.sym("residual", jacobian.shape[0])
    normal, gradient = ca.SX(*(jacobian.shape[1:] * 2)), ca.SX.zeros(jacobian.shape[1])
    blocks = _blocks(jacobian.sparsity())
    for block in blocks:
        rows, columns = list(block.rows), list(block.columns)
        part_of, right = jacobian[rows, columns], residual[rows]
        width = max(len(other.columns) for other in blocks if len(other.rows) == len(rows))
        alike = [other for other in blocks if other.is_worth(len(rows), width)]
        if block in alike and len(alike) > 1:
            padded = ca.horzcat(part_of, ca.SX(len(rows), width - len(columns)))
            normal_of, gradient_of = _block_squares(len(rows), width)(ca.densify(padded), right)
        else:
            normal_of, gradient_of = ca.triu(ca.sparsify(part_of.T @ part_of)), part_of.T @ right
        chosen = ca.DM(len(columns), jacobian.shape[1])
        for i, column in enumerate(columns):
            chosen[i, column] = 1
            gradient[column] += gradient_of[i]
        normal += chosen.T @ normal_of[: len(columns), : len(columns)] @ chosen
    return call_function("squares", [jacobian, residual], [normal, gradient])


@dataclass(frozen=True)
class _Block:
    """Rows of a matrix, each nonzero in some of the columns that the next is nonzero in."""

    rows: tuple[int, ...]
    columns: tuple[int, ...]

    def is_worth(self, rows: int, columns: int) -> bool:
        """Whether it may be taken for one of a size: that a function serves several is worth it."""
        return len(self.rows) == rows > 2 and columns <= 1.3 * len(self.columns)


def _blocks(sparsity: ca.Sparsity) -> list[_Block]:
    """The rows by what is nonzero in them."""
    numbers: dict[int, set[int]] = {row: set() for row in range(sparsity.size1())}
    for row, column in zip(sparsity.row(), sparsity.get_col(), strict=True):
        numbers[row].add(column)
    found: list[tuple[list[int], set[int]]] = []
    for row, columns in numbers.items():
        for i, (rows, others) in enumerate(found):
            if others <= columns or columns <= others:
                found[i] = [*rows, row], others | columns
                break
        else:
            found.append(([row], columns))
    return [_Block(tuple(rows), tuple(sorted(columns))) for rows, columns in found]


@cache
def _block_squares(rows: int, columns: int) -> ca.Function:
    block, right = ca.SX.sym("block", rows, columns), ca.SX.sym("right", rows)
    return call_function(
        "block_squares", [block, right], [ca.triu(block.T @ block), block.T @ right]
    )


@cache
def _in_box(pattern: Pattern, count: int, passes: int, duals: int) -> ca.Function:
    """See `in_box`; `count` are bounded, the first unknowns are multipliers."""
    matrix = _sparse("matrix", pattern)
    slope, damping = ca.SX.sym("slope", matrix.shape[0]), ca.SX.sym("damping")
    primal = ca.DM([float(i >= duals) for i in range(slope.numel())])
    damped = matrix + damping * ca.sparsify(ca.diag(primal))
    low, high = ca.SX.sym("low", count), ca.SX.sym("high", count)
    first = slope.numel() - count
    order = elimination((damped + damped.T).sparsity(), first, passes, duals)
    begun = order.begun(damped, slope)
    # All passes are calls of one function, of those numbers of the system that it needs.
    known = System.of_symbols(begun)
    held, values = ca.SX.sym("held", count), ca.SX.sym("values", count)
    unknown = dict(sorted(order.solved(known, held, values).items()))
    unknowns = ca.vertcat(ca.SX(0, 1), *unknown.values())
    needed = {symbol.element_hash() for symbol in ca.symvar(unknowns)}
    places = [i for i, each in enumerate(known.numbers.nz) if each.element_hash() in needed]
    solved = call_function("solved", [known.numbers[places], held, values], [unknowns])
    numbers = begun.numbers[places]
    force = ca.vertcat(*order.resting(begun))
    at_low = ca.logic_and(low >= 0, force > 0)
    at_high = ca.logic_and(high <= 0, force < 0)
    bounded = range(first, slope.numel())
    inside = low
    for number in range(passes):
        held = ca.logic_or(at_low, at_high)
        x = solved(numbers, held, held * ca.if_else(at_low, low, high))
        x = dict(zip(unknown, ca.vertsplit(x), strict=True))
        inside = ca.vertcat(*(x[i] for i in bounded))
        if number == passes - 1:
            break
        force = ca.vertcat(*order.forces(begun, x))
        at_low = ca.if_else(held, ca.logic_and(at_low, force > 0), inside < low)
        at_high = ca.if_else(held, ca.logic_and(at_high, force < 0), inside > high)
    inside = ca.fmin(ca.fmax(inside, low), high)
    whole = order.completed(begun, dict(zip(bounded, ca.vertsplit(inside), strict=True)))
    return call_function("in_box", [matrix, damping, slope, low, high], [whole])


def clip(value: Expr, bounded: Bounded) -> Expr:
    """Value moved into the bounds."""
    return ca.fmin(ca.fmax(value, bounded.lower), bounded.upper)
