"""All arms for a palm pose: its branches, and how far each of them may be varied."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from casadi_ik.answers.solution import ArmBranch
from casadi_ik.arms.family import SIGNS, ArmFamily, ClosedForm
from casadi_ik.arms.search import PARAMETERS
from casadi_ik.arrays import Array
from casadi_ik.kernels import FunctionKernel
from casadi_ik.symbolic.kinematics import Pose

TURN = 2 * np.pi


@dataclass(frozen=True)
class StretchParameters:
    """How the allowed stretches of a redundancy are found, and the best arm in one.

    Attributes:
        positions: Looked at along the bounds, where breakpoints are not known.
        iterative_positions: Of an iterative family: each costs a search for all roots.
        thirds: That the neighbourhood of a position is cut down by, to find a short stretch within.
        halvings: Of a step between two positions, to find the end of a stretch.
        samples: Looked at along a stretch for its best arm, and again around the best of them.
        zooms: How often; each time the steps shrink to a sixteenth.
    """

    positions: int = 361
    iterative_positions: int = 37
    thirds: int = 12
    halvings: int = 45
    samples: int = 33
    zooms: int = 2


STRETCHES = StretchParameters()


class ArmBranches:
    """Enumerates the arms of a family with one number of redundancy or none."""

    def __init__(self, family: ArmFamily, compiled: bool = True) -> None:
        """Compile the functions of the arm or load them from the cache."""
        self.family = family
        self._at = FunctionKernel(family.arms(), compiled)
        edges = _breakpoints(family)
        self._edges = None if edges is None else FunctionKernel(edges, compiled)

    def find(self, palm: Array, lower: Array, upper: Array) -> list[ArmBranch]:
        """Every stretch of every branch, its ends as exact as the margins are.

        The margin (the least distance of a joint from its bounds) is looked at all along the
        redundancy: between two breakpoints all are allowed or none. Where they are not known,
        closer wherever it is largest: a stretch between two positions is found by its peak. Of a
        joint that turns more than once the middle turn is taken. Stretches of an iterative family
        end at positions that were looked at.

        Args:
            palm: (4, 4) pose of the palm, base frame.
            lower: (n,) bounds [rad].
            upper: (n,).
        """

        def margins(values: Array) -> Array:
            return self._margins(palm, values, lower, upper)

        if not self.family.redundancy:
            allowed = margins(np.zeros(1))[0] >= PARAMETERS.allowed
            return [self._branch(int(row), None) for row in np.flatnonzero(allowed)]
        positions = self._positions(palm, lower, upper)
        refined = self._edges is None and not self.family.is_iterative
        if refined:
            peaks = _peaks(positions, margins)
            positions = np.unique(np.concatenate([positions, peaks]))
        allowed = margins(positions) >= PARAMETERS.allowed
        # With a row of none on either side every stretch has a beginning and an end.
        padded = np.pad(allowed, ((1, 1), (0, 0)))
        rows, first = np.nonzero((padded[1:-1] & ~padded[:-2]).T)
        last = np.nonzero((padded[1:-1] & ~padded[2:]).T)[1]
        starts, stops = positions[first], positions[last]
        if refined:
            outer = np.concatenate(
                [np.maximum(first - 1, 0), np.minimum(last + 1, len(positions) - 1)]
            )
            ends = np.concatenate([starts, stops])
            starts, stops = np.split(_ends(ends, positions[outer], np.tile(rows, 2), margins), 2)
        stretches = zip(rows.tolist(), starts.tolist(), stops.tolist(), strict=True)
        return [self._branch(row, ends) for row, *ends in self._joined(list(stretches))]

    def arms(self, palm: Array, branch: ArmBranch, values: Array) -> Array:
        """Configurations (k, n) [rad] of a branch at values (k,) of the redundancy."""
        signs = tuple(getattr(branch, part) for part in self.family.parts)
        arms, _ = self._at(palm[:3, :3], palm[:3, 3], values)
        return arms[:, SIGNS.index(signs) * self.family.roots + branch.root]

    def best(
        self,
        palm: Array,
        branch: ArmBranch,
        bounds: tuple[Array, Array],
        score: Callable[[Array], Array],
    ) -> tuple[Array, float | None]:
        """The arm of a branch with the highest score, and its redundancy.

        Args:
            palm: (4, 4).
            branch: With its stretch.
            bounds: (n,) and (n,), those that it was found with.
            score: Of configurations (k, n) -> (k,).
        """
        if branch.swivel is None:
            return self.arms(palm, branch, np.zeros(1))[0], None
        first, last = branch.swivel
        values, zooms = np.linspace(first, last, STRETCHES.samples), STRETCHES.zooms
        if self.family.is_iterative:
            values, zooms = self._positions(palm, *bounds), 0
            values = values[(values >= first) & (values <= last)]
        for _ in range(zooms):
            i = int(np.argmax(score(self.arms(palm, branch, values))))
            step = values[1] - values[0]
            ends = max(first, values[i] - step), min(last, values[i] + step)
            values = np.linspace(*ends, STRETCHES.samples)
        arms = self.arms(palm, branch, values)
        i = int(np.argmax(score(arms)))
        return arms[i], float(values[i])

    def _positions(self, palm: Array, lower: Array, upper: Array) -> Array:
        """Values of the redundancy that are looked at, sorted."""
        low, high = (float(end) for end in self.family.redundancy[0].bounds(lower, upper))
        if self._edges is not None:
            sides = np.array([1.0, -1.0])
            (edges,) = self._edges(palm[:3, :3], palm[:3, 3], sides, lower, upper)
            edges = np.unique(np.append(np.mod(edges.ravel() - low, TURN) + low, [low, high]))
            return np.unique(np.concatenate([edges, (edges[1:] + edges[:-1]) / 2]))
        if self.family.is_iterative:
            # Away from the ends: the swept joint is within its limits, the others tell apart.
            count = STRETCHES.iterative_positions
            return low + (high - low) * (np.arange(count) + 0.5) / count
        return np.linspace(low, high, STRETCHES.positions)

    def _margins(self, palm: Array, values: Array, lower: Array, upper: Array) -> Array:
        """(k, rows) of every branch; the slack where it is out of reach."""
        arms, slack = self._at(palm[:3, :3], palm[:3, 3], values)
        margin = np.minimum(arms - lower, upper - arms).min(axis=2)
        slack = slack.reshape(margin.shape)
        return np.where(slack < 0, np.minimum(margin, slack), margin)

    def _joined(self, stretches: list[tuple[int, float, float]]) -> list[tuple[int, float, float]]:
        """Those of an angle that goes all around are joined where the turn ends."""
        if self.family.redundancy[0].joint is not None:
            return stretches
        joined = []
        for row in sorted({row for row, *_ in stretches}):
            own = [stretch for stretch in stretches if stretch[0] == row]
            if len(own) > 1 and own[0][1] <= -np.pi and own[-1][2] >= np.pi:
                own = [*own[1:-1], (row, own[-1][1], own[0][2] + TURN)]
            joined += own
        return joined

    def _branch(self, row: int, stretch: tuple[float, float] | list[float] | None) -> ArmBranch:
        number, root = divmod(row, self.family.roots)
        signs = dict(zip(self.family.parts, SIGNS[number], strict=True))
        ends = None if stretch is None else (stretch[0], stretch[1])
        return ArmBranch(**signs, swivel=ends, root=root)


def _breakpoints(family: ArmFamily) -> ca.Function | None:
    """(rotation, origin, sign of the bend, lower, upper) -> where joints may stand at bounds."""
    if not isinstance(family, ClosedForm):
        return None
    n, sign = len(family.screws), ca.SX.sym("sign")
    rotation, origin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("origin", 3)
    lower, upper = ca.SX.sym("lower", n), ca.SX.sym("upper", n)
    found = family.breakpoints(Pose(rotation, origin), (sign,), lower, upper)
    if found is None:
        return None
    return ca.Function("breakpoints", [rotation, origin, sign, lower, upper], [found])


def _peaks(grid: Array, margins: Callable[[Array], Array]) -> Array:
    """Where the margin of a branch is largest between positions that are all outside."""
    margin = margins(grid)
    padded = np.pad(margin, ((1, 1), (0, 0)), constant_values=-np.inf)
    top = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:])
    at, rows = np.nonzero(top & (margin < PARAMETERS.allowed))
    step, each = grid[1] - grid[0], np.arange(len(at))
    first, last = np.maximum(grid[at] - step, grid[0]), np.minimum(grid[at] + step, grid[-1])
    for _ in range(STRETCHES.thirds if len(at) else 0):
        near, far = first + (last - first) / 3, last - (last - first) / 3
        rising = margins(near)[each, rows] < margins(far)[each, rows]
        first, last = np.where(rising, near, first), np.where(rising, last, far)
    return (first + last) / 2


def _ends(
    inner: Array, outer: Array, rows: NDArray[np.intp], margins: Callable[[Array], Array]
) -> Array:
    """Where branches cease to be allowed from an allowed value to one that is not."""
    each = np.arange(len(inner))
    for _ in range(STRETCHES.halvings if len(inner) else 0):
        middle = (inner + outer) / 2
        allowed = margins(middle)[each, rows] >= PARAMETERS.allowed
        inner, outer = np.where(allowed, middle, inner), np.where(allowed, outer, middle)
    return inner
