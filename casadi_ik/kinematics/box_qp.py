"""One damped Gauss-Newton step for a least-squares problem with simple bounds.

The step solves ``min |r + J s|^2 + damping |s|^2`` subject to bounds, a small quadratic program in
a box. A few passes correct the active set (primal-dual active set method, Hintermueller, Ito &
Kunisch 2002): a coordinate that leaves the box is fixed at the violated bound, and a fixed
coordinate whose multiplier has the wrong sign is released. Every pass costs one small
factorisation.

Structural zeros cost nothing. Fingers are coupled only by the palm and by motors that drive several
fingers; with a suitable elimination order (`elimination`) code size and time are linear in the
number of fingers, whereas those of dense matrices are cubic in the number of motors.
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
    """A pivot of the elimination.

    Attributes:
        index: Index of the unknown.
        neighbours: Indices of the remaining unknowns that are coupled with it at this point.
        sign: Sign of its diagonal entry, which no elimination changes (Vanderbei 1995).
    """

    index: int
    neighbours: tuple[int, ...]
    sign: float = 1.0

    @property
    def operations(self) -> int:
        """Approximate number of operations."""
        return (len(self.neighbours) + 2) ** 2


class LinearSystem:
    """A symmetric linear system during elimination; the entries are scalar expressions.

    Attributes:
        entries: Entries of the upper triangle by row and column.
        right: Right-hand side; for an eliminated unknown the part of its solution that does not
            depend on other unknowns.
        inverses: Inverses of the pivots by index.
    """

    def __init__(
        self, entries: dict[tuple[int, int], Expr], right: list[Expr], inverses: dict[int, Expr]
    ) -> None:
        """Store copies, which the elimination changes."""
        self.entries, self.right, self.inverses = dict(entries), list(right), dict(inverses)

    @classmethod
    def from_matrix(cls, matrix: Expr, slope: Expr) -> LinearSystem:
        """Return the system ``matrix x = -slope`` with a symmetric matrix."""
        sparsity = matrix.sparsity()
        entries_of_matrix = zip(sparsity.row(), sparsity.get_col(), matrix.nonzeros(), strict=True)
        entries = {(i, j): value for i, j, value in entries_of_matrix if i <= j}
        return cls(entries, [-slope[i] for i in range(slope.numel())], {})

    @property
    def coefficients(self) -> Expr:
        """Column of the entries, right-hand sides and inverses."""
        return ca.vertcat(*self.entries.values(), *self.right, *self.inverses.values())

    @classmethod
    def symbolic_copy(cls, system: LinearSystem) -> LinearSystem:
        """Return a system of symbols with the structure of another."""
        entries = {index: ca.SX.sym("entry") for index in system.entries}
        inverses = {i: ca.SX.sym("inverse") for i in system.inverses}
        return cls(entries, [ca.SX.sym("right") for _ in system.right], inverses)

    def copy(self) -> LinearSystem:
        """Return a copy."""
        return LinearSystem(self.entries, self.right, self.inverses)

    def eliminate(self, pivot: Pivot, free: Expr | None = None, value: Expr | None = None) -> None:
        """Eliminate an unknown from the equations of the others.

        Args:
            pivot: Pivot of the unknown.
            free: 1 if the unknown is free, 0 if it is fixed; None if it is never fixed.
            value: Value of a fixed unknown, 0 if it is free.
        """
        i, entries = pivot.index, self.entries
        inverse = pivot.sign / ca.fmax(pivot.sign * entries[i, i], PIVOT_FLOOR)
        solution = self.right[i]
        if free is None:
            solution = inverse * solution
        else:
            inverse = free * inverse
            solution = inverse * solution + value
        self.inverses[i], self.right[i] = inverse, solution
        for position, j in enumerate(pivot.neighbours):
            coupling = entries[_key(i, j)]
            factor = coupling * inverse
            self.right[j] = self.right[j] - coupling * solution
            for k in pivot.neighbours[position:]:
                update = factor * entries[_key(i, k)]
                # Elimination creates an entry (fill-in) where none existed.
                entries[j, k] = entries[j, k] - update if (j, k) in entries else -update

    def value(self, pivot: Pivot, x: dict[int, Expr]) -> Expr:
        """Return an eliminated unknown from its neighbours."""
        i = pivot.index
        coupled = sum((self.entries[_key(i, j)] * x[j] for j in pivot.neighbours), ca.SX(0))
        return self.right[i] - self.inverses[i] * coupled


@dataclass(frozen=True)
class Elimination:
    """Elimination order of a system that is solved with different fixed unknowns.

    Attributes:
        free: Number of leading unknowns that are never fixed.
        shared_pivots: Pivots that are eliminated once for all passes: all unknowns that are never
            fixed, or none.
        pass_pivots: Pivots that every pass eliminates.
        free_pivots: Pivots of the unknowns that are never fixed, if the others are known.
    """

    free: int
    shared_pivots: tuple[Pivot, ...]
    pass_pivots: tuple[Pivot, ...]
    free_pivots: tuple[Pivot, ...]

    def reduce(self, matrix: Expr, slope: Expr) -> LinearSystem:
        """Return the system after elimination of the shared pivots.

        Args:
            matrix: (n, n) symmetric positive definite, with the sparsity of this order; only its
                upper triangle is read.
            slope: (n, 1) gradient at the origin.
        """
        system = LinearSystem.from_matrix(matrix, slope)
        for pivot in self.shared_pivots:
            system.eliminate(pivot)
        return system

    def solve_pass(self, reduced: LinearSystem, is_fixed: Expr, values: Expr) -> dict[int, Expr]:
        """Return the unknowns of the pass pivots, by index.

        Args:
            reduced: System after `reduce`.
            is_fixed: (n - free, 1) 1 for a fixed unknown.
            values: (n - free, 1) values of fixed unknowns, zero for free ones.
        """
        system = reduced.copy()
        for pivot in self.pass_pivots:
            position = pivot.index - self.free
            if position < 0:
                system.eliminate(pivot)
            else:
                system.eliminate(pivot, 1 - is_fixed[position], values[position])
        x: dict[int, Expr] = {}
        for pivot in reversed(self.pass_pivots):
            x[pivot.index] = system.value(pivot, x)
        return x

    def bound_multipliers(self, reduced: LinearSystem, x: dict[int, Expr]) -> list[Expr]:
        """Return the residuals of the equations of the bounded unknowns, n - free scalars."""
        multipliers = []
        for i in range(self.free, len(reduced.right)):
            terms = (reduced.entries[_key(i, j)] * x[j] for j in x if _key(i, j) in reduced.entries)
            multipliers.append(sum(terms, -reduced.right[i]))
        return multipliers

    def initial_multipliers(self, reduced: LinearSystem) -> list[Expr]:
        """Return the `bound_multipliers` with all bounded unknowns at 0."""
        if self.shared_pivots:
            return self.bound_multipliers(reduced, {})
        at_origin = {i: ca.SX(0) for i in range(self.free, len(reduced.right))}
        solution = self.back_substitute(reduced, at_origin)
        return self.bound_multipliers(
            reduced, at_origin | {i: solution[i] for i in range(self.free)}
        )

    def back_substitute(self, reduced: LinearSystem, x: dict[int, Expr]) -> Expr:
        """Return all unknowns (n, 1) from the bounded unknowns."""
        system, solution = reduced, dict(x)
        if not self.shared_pivots:
            system = reduced.copy()
            for i in range(self.free):
                terms = (
                    system.entries[i, j] * x[j]
                    for j in range(self.free, len(reduced.right))
                    if (i, j) in system.entries
                )
                system.right[i] = system.right[i] - sum(terms, ca.SX(0))
            for pivot in self.free_pivots:
                system.eliminate(pivot)
        for pivot in reversed(self.shared_pivots or self.free_pivots):
            solution[pivot.index] = system.value(pivot, solution)
        return ca.vertcat(*(solution[i] for i in range(len(reduced.right))))


def elimination(sparsity: ca.Sparsity, free: int, times: int, duals: int = 0) -> Elimination:
    """Return the elimination order with the fewest operations.

    Args:
        sparsity: Sparsity of the matrix.
        free: Number of leading unknowns that are never fixed.
        times: Number of solves with different fixed unknowns.
        duals: Number of leading unknowns with a negative diagonal.
    """
    free_pivots = _pivots(_couplings(sparsity, free), range(free), duals)
    candidates = []
    for shared in (range(free), range(0)):
        couplings = _couplings(sparsity, sparsity.size1())
        shared_pivots = _pivots(couplings, shared, duals)
        pass_pivots = _pivots(couplings, [i for i in couplings if i not in shared], duals)
        cost = _operations(shared_pivots or free_pivots) + times * _operations(pass_pivots)
        candidates.append((cost, Elimination(free, shared_pivots, pass_pivots, free_pivots)))
    return min(candidates, key=lambda candidate: candidate[0])[1]


def _operations(pivots: Sequence[Pivot]) -> int:
    return sum(pivot.operations for pivot in pivots)


def _couplings(sparsity: ca.Sparsity, count: int) -> dict[int, set[int]]:
    """Return the neighbours of each of the first `count` unknowns."""
    neighbours: dict[int, set[int]] = {i: set() for i in range(count)}
    for i, j in zip(sparsity.row(), sparsity.get_col(), strict=True):
        if i != j and max(i, j) < count:
            neighbours[i].add(j)
            neighbours[j].add(i)
    return neighbours


def _pivots(
    couplings: dict[int, set[int]], unknowns: Sequence[int], duals: int
) -> tuple[Pivot, ...]:
    """Remove unknowns from `couplings` in minimum-degree order; return their pivots."""
    pivots, remaining = [], set(unknowns)
    while remaining:
        index = min(remaining, key=lambda i: (len(couplings[i]), i))
        remaining.remove(index)
        neighbours = couplings.pop(index)
        for i in neighbours:
            couplings[i] |= neighbours
            couplings[i] -= {index, i}
        pivots.append(Pivot(index, tuple(sorted(neighbours)), -1.0 if index < duals else 1.0))
    return tuple(pivots)


def _key(i: int, j: int) -> tuple[int, int]:
    return (i, j) if i <= j else (j, i)


@dataclass(frozen=True, eq=False)
class BoxBounds:
    """Bounds of the last k coordinates of a problem.

    Attributes:
        value: (k, 1) current values.
        lower: (k, 1) lower bounds.
        upper: (k, 1) upper bounds.
        first: Number of unbounded coordinates before them.
    """

    value: Expr
    lower: Expr
    upper: Expr
    first: int


@dataclass(frozen=True, eq=False)
class DampedStep:
    """A damped least-squares step.

    Attributes:
        step: (n, 1) step s.
        predicted_decrease: Decrease of ``|r + J s|^2`` relative to s = 0.
    """

    step: Expr
    predicted_decrease: Expr


def damped_step(
    jacobian: Expr,
    residual: Expr,
    damping: Expr,
    bounded: BoxBounds,
    passes: int,
    full: tuple[Expr, Expr] | None = None,
) -> DampedStep:
    """Return the Levenberg-Marquardt step within the bounds.

    Args:
        jacobian: (m, n), structurally sparse if possible.
        residual: (m, 1).
        damping: Scalar added to the diagonal of J'J.
        bounded: Bounds of the last coordinates.
        passes: Number of corrections of the active set, at least one.
        full: Dense rows (k, n) and their residual (k, 1). They enter as separate unknowns, so
            that J'J remains sparse.

    Returns:
        The step; value + step is within the bounds up to rounding.
    """
    normal, gradient = normal_equations(jacobian, residual)
    low, high = bounded.lower - bounded.value, bounded.upper - bounded.value
    step = solve_box_qp(normal, damping, gradient, low, high, passes, full)
    predicted_decrease = _predicted_decrease(jacobian, residual, step)
    return DampedStep(
        step,
        predicted_decrease
        if full is None
        else predicted_decrease + _predicted_decrease(*full, step),
    )


def _predicted_decrease(jacobian: Expr, residual: Expr, step: Expr) -> Expr:
    change = jacobian @ step
    return -ca.dot(change, 2 * residual + change)


def normal_equations(jacobian: Expr, residual: Expr) -> tuple[Expr, Expr]:
    """Return the upper triangle of J'J (n, n) and J'r (n, 1) for J (m, n) and r (m, 1)."""
    return _normal_equations_function(_pattern(jacobian))(jacobian, residual)


def solve_box_qp(
    matrix: Expr,
    damping: Expr,
    slope: Expr,
    low: Expr,
    high: Expr,
    passes: int,
    full: tuple[Expr, Expr] | None = None,
) -> Expr:
    """Return the minimiser of x' M x / 2 + slope' x with the last coordinates in a box.

    Args:
        matrix: (n, n) symmetric M without damping; only its upper triangle is read.
        damping: Scalar added to the diagonal, such that M is positive definite.
        slope: (n, 1) gradient at the origin.
        low: (k, 1) lower bounds, <= 0.
        high: (k, 1) upper bounds, >= 0.
        passes: Number of corrections of the active set, at least one.
        full: A (m, n) and b (m, 1) of an additional term |A x + b|^2 / 2. Its residual y becomes
            an unknown: ``M x + A' y = -slope, A x - y = -b``.
    """
    upper, duals = ca.triu(matrix), 0
    if full is not None:
        duals = full[1].numel()
        lower_rows = ca.horzcat(ca.SX(matrix.shape[0], duals), upper)
        upper = ca.vertcat(ca.horzcat(-ca.SX.eye(duals), full[0]), lower_rows)
        slope = ca.vertcat(full[1], slope)
    solution = _box_qp_function(_pattern(upper), low.numel(), passes, duals)(
        upper, damping, slope, low, high
    )
    return solution[duals:]


Pattern: TypeAlias = tuple[tuple[int, int], tuple[int, ...], tuple[int, ...]]
"""Shape, rows and columns of the structural nonzeros, the key of cached functions."""


def _pattern(matrix: Expr) -> Pattern:
    sparsity = matrix.sparsity()
    return matrix.shape, tuple(sparsity.row()), tuple(sparsity.get_col())


def _sparse_symbol(name: str, pattern: Pattern) -> Expr:
    (rows, columns), *indices = pattern
    return ca.SX.sym(name, ca.Sparsity.triplet(rows, columns, *indices))


@cache
def _normal_equations_function(pattern: Pattern) -> ca.Function:
    """Return the graph of `normal_equations`, a sum over blocks that share functions."""
    jacobian = _sparse_symbol("jacobian", pattern)
    residual = ca.SX.sym("residual", jacobian.shape[0])
    normal, gradient = ca.SX(*(jacobian.shape[1:] * 2)), ca.SX.zeros(jacobian.shape[1])
    blocks = _blocks(jacobian.sparsity())
    for block in blocks:
        rows, columns = list(block.rows), list(block.columns)
        block_jacobian, right = jacobian[rows, columns], residual[rows]
        block_width = max(
            len(candidate.columns) for candidate in blocks if len(candidate.rows) == len(rows)
        )
        same_size = [
            candidate for candidate in blocks if candidate.is_worth(len(rows), block_width)
        ]
        if block in same_size and len(same_size) > 1:
            padded = ca.horzcat(block_jacobian, ca.SX(len(rows), block_width - len(columns)))
            block_normal, block_gradient = _block_normal_equations(len(rows), block_width)(
                ca.densify(padded), right
            )
        else:
            block_normal, block_gradient = (
                ca.triu(ca.sparsify(block_jacobian.T @ block_jacobian)),
                block_jacobian.T @ right,
            )
        selection = ca.DM(len(columns), jacobian.shape[1])
        for i, column in enumerate(columns):
            selection[i, column] = 1
            gradient[column] += block_gradient[i]
        normal += selection.T @ block_normal[: len(columns), : len(columns)] @ selection
    return call_function("squares", [jacobian, residual], [normal, gradient])


@dataclass(frozen=True)
class _RowBlock:
    """Rows of a matrix with nested column patterns."""

    rows: tuple[int, ...]
    columns: tuple[int, ...]

    def is_worth(self, rows: int, columns: int) -> bool:
        """Return whether padding the block to a size costs less than a separate function."""
        return len(self.rows) == rows > 2 and columns <= 1.3 * len(self.columns)


def _blocks(sparsity: ca.Sparsity) -> list[_RowBlock]:
    """Group rows with nested column patterns."""
    columns_of_row: dict[int, set[int]] = {row: set() for row in range(sparsity.size1())}
    for row, column in zip(sparsity.row(), sparsity.get_col(), strict=True):
        columns_of_row[row].add(column)
    blocks: list[tuple[list[int], set[int]]] = []
    for row, columns in columns_of_row.items():
        for i, (rows, block_columns) in enumerate(blocks):
            if block_columns <= columns or columns <= block_columns:
                blocks[i] = [*rows, row], block_columns | columns
                break
        else:
            blocks.append(([row], columns))
    return [_RowBlock(tuple(rows), tuple(sorted(columns))) for rows, columns in blocks]


@cache
def _block_normal_equations(rows: int, columns: int) -> ca.Function:
    block, right = ca.SX.sym("block", rows, columns), ca.SX.sym("right", rows)
    return call_function(
        "block_squares", [block, right], [ca.triu(block.T @ block), block.T @ right]
    )


@cache
def _box_qp_function(pattern: Pattern, count: int, passes: int, duals: int) -> ca.Function:
    """Return the graph of `solve_box_qp`: `count` bounded unknowns, `duals` leading residuals."""
    matrix = _sparse_symbol("matrix", pattern)
    slope, damping = ca.SX.sym("slope", matrix.shape[0]), ca.SX.sym("damping")
    primal = ca.DM([float(i >= duals) for i in range(slope.numel())])
    damped = matrix + damping * ca.sparsify(ca.diag(primal))
    low, high = ca.SX.sym("low", count), ca.SX.sym("high", count)
    first = slope.numel() - count
    order = elimination((damped + damped.T).sparsity(), first, passes, duals)
    reduced = order.reduce(damped, slope)
    # All passes call one function; its inputs are only the coefficients that it depends on.
    symbolic = LinearSystem.symbolic_copy(reduced)
    is_fixed, values = ca.SX.sym("held", count), ca.SX.sym("values", count)
    unknown = dict(sorted(order.solve_pass(symbolic, is_fixed, values).items()))
    unknowns = ca.vertcat(ca.SX(0, 1), *unknown.values())
    needed = {symbol.element_hash() for symbol in ca.symvar(unknowns)}
    needed_indices = [
        i for i, symbol in enumerate(symbolic.coefficients.nz) if symbol.element_hash() in needed
    ]
    solve_pass = call_function(
        "solved", [symbolic.coefficients[needed_indices], is_fixed, values], [unknowns]
    )
    coefficients = reduced.coefficients[needed_indices]
    multipliers = ca.vertcat(*order.initial_multipliers(reduced))
    at_low = ca.logic_and(low >= 0, multipliers > 0)
    at_high = ca.logic_and(high <= 0, multipliers < 0)
    bounded = range(first, slope.numel())
    bounded_values = low
    for i in range(passes):
        is_fixed = ca.logic_or(at_low, at_high)
        x = solve_pass(coefficients, is_fixed, is_fixed * ca.if_else(at_low, low, high))
        x = dict(zip(unknown, ca.vertsplit(x), strict=True))
        bounded_values = ca.vertcat(*(x[i] for i in bounded))
        if i == passes - 1:
            break
        multipliers = ca.vertcat(*order.bound_multipliers(reduced, x))
        at_low = ca.if_else(is_fixed, ca.logic_and(at_low, multipliers > 0), bounded_values < low)
        at_high = ca.if_else(
            is_fixed, ca.logic_and(at_high, multipliers < 0), bounded_values > high
        )
    bounded_values = ca.fmin(ca.fmax(bounded_values, low), high)
    solution = order.back_substitute(
        reduced, dict(zip(bounded, ca.vertsplit(bounded_values), strict=True))
    )
    return call_function("in_box", [matrix, damping, slope, low, high], [solution])


def clip(value: Expr, bounded: BoxBounds) -> Expr:
    """Return a value clipped to the bounds."""
    return ca.fmin(ca.fmax(value, bounded.lower), bounded.upper)
