"""Search for the configurations nearest to contacts that are out of reach.

The distance of a configuration from a target is the sum of its squared contact errors, each divided
by its tolerance. Several configurations descend to local minima of this distance, and the nearest
minimum is returned: the start and the end of the failed solve, and seeds from distinct regions of
the joint space (`nearest_seeds`). It is the best minimum found; nothing is proved.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from casadi_ik.collision.clearance import CollisionQuery
from casadi_ik.compile import RUNNING
from casadi_ik.compile.graphs import StepGraph, recipe
from casadi_ik.compile.layout import Field, Layout
from casadi_ik.compile.loop import LoopKernel
from casadi_ik.files.arrays import Array, Rows
from casadi_ik.kinematics.box_qp import normal_equations, solve_box_qp
from casadi_ik.kinematics.contact_curvature import residual_curvature
from casadi_ik.kinematics.contact_fit import contact_jacobian, contact_residual
from casadi_ik.kinematics.contacts import ContactRows, Kinds, kinds_suffix
from casadi_ik.kinematics.forward import motor_scales
from casadi_ik.kinematics.smooth import with_cse
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.nearest_seeds import SEED_SETTINGS, SeedSettings, SeedTable
from casadi_ik.solve.row_selection import first_per_owner, smallest_per_owner
from casadi_ik.solve.status import Status
from casadi_ik.solve.subproblems import LocalRefinement, SubproblemSolver, residual_tolerances


@dataclass(frozen=True)
class NearestSettings:
    """Settings of the search for the nearest configurations. Source: ``studies/best_effort.py``.

    Attributes:
        seeds: Settings of the seeds.
        race_steps: Number of steps that all starts make.
        finalists: Number of starts that continue to the minimum, and additional ones per motor.
        tie: Relative difference of two distances below which the configuration nearer to the start
            is chosen.
    """

    seeds: SeedSettings = SEED_SETTINGS
    race_steps: int = 12
    finalists: tuple[int, int] = (12, 1)
    tie: float = 1e-6


NEAREST_SETTINGS = NearestSettings()

UNLIMITED_STEP = 1e3
"""Step of a descent that the limits of the motors alone bound."""

IN_COLLISION = 1e12
"""Factor of the distance of a configuration in collision, larger than any ratio of distances."""


@dataclass(frozen=True)
class DescentParameters:
    """Parameters of the descent to a local minimum. Source: ``studies/best_effort.py``.

    Attributes:
        damping: First damping of the normal matrix.
        damping_floor: Smallest damping.
        damping_ceiling: Damping at which a rejected step ends the descent.
        good_gain: Ratio of actual and predicted decrease above which the damping decreases most.
        poor_gain: Ratio below which the damping increases after an accepted step.
        good_factor: Factor of the damping after a step with a good gain.
        fair_factor: Factor of the damping after a step between the two ratios.
        poor_factor: Factor of the damping after an accepted step with a poor gain.
        rejected_factor: Factor of the damping after a rejected step.
        slow: Ratio of distances after and before a step above which steps use the exact second
            derivatives: Gauss-Newton steps converge slowly where errors remain.
        settled: Relative decrease of the distance below which a descent has ended.
        local_step: Longest step of a descent that stays near its start [rad, or part of a slider's
            range]: long steps would lead to other minima.
        passes: Number of corrections of the active set in a step.
        max_iterations: Maximum number of steps.
    """

    damping: float = 1.0
    damping_floor: float = 1e-12
    damping_ceiling: float = 1e6
    good_gain: float = 0.75
    poor_gain: float = 0.25
    good_factor: float = 0.2
    fair_factor: float = 0.7
    poor_factor: float = 3.0
    rejected_factor: float = 8.0
    slow: float = 0.5
    settled: float = 1e-11
    local_step: float = 0.1
    passes: int = 2
    max_iterations: int = 200


DESCENT = DescentParameters()


@dataclass(frozen=True)
class DescentStep:
    """Step of the bounded descent of the distance between a robot and its contacts.

    Attributes:
        robot: Description of the robot.
        kinds: Kind of contact of each finger.
    """

    robot: RobotDescription
    kinds: Kinds

    @cached_property
    def contacts(self) -> ContactRows:
        """Rows of the contacts."""
        return ContactRows(self.kinds)

    @cached_property
    def state(self) -> Layout:
        """Layout of the state."""
        return Layout(
            (
                Field("q", (len(self.robot.actuators),), unit="rad or m"),
                Field("damping", doc="damping of the next step"),
                Field("is_exact", doc="1: the next step uses exact second derivatives"),
                Field("distance", doc="half the squared residual after the last step"),
            )
        )

    @cached_property
    def parameters(self) -> Layout:
        """Layout of the parameters."""
        n = len(self.robot.actuators)
        bounds = (Field(name, (n,), unit="rad or m") for name in ("lower", "upper"))
        max_step = Field("max_step", doc="longest step [rad, or part of a slider's range]")
        return Layout((*self.contacts.fields, *bounds, max_step))

    @cached_property
    def graph(self) -> StepGraph:
        """``(state, parameters) -> (state', record, status)``."""
        name = ca.Function.fix_name(f"{self.robot.name}_descent{kinds_suffix(self.kinds)}")
        record = Layout.record(Field("distance", doc="half the squared residual after the step"))
        key = recipe(name, self.robot, self.kinds)
        return StepGraph(
            name, lambda: self._build(name), self.state, self.parameters, record, recipe=key
        )

    def _build(self, name: str) -> ca.Function:
        state, parameters = self.state.symbols("state"), self.parameters.symbols("parameters")
        s, p = self.state.unpack(state), self.parameters.unpack(parameters)
        q = ca.SX.sym("q", len(self.robot.actuators))
        residual = contact_residual(self.robot, self.contacts, q, p)
        distance = ca.sumsqr(residual) / 2
        # Structural zeros between motors of different fingers shorten the elimination.
        jacobian = contact_jacobian(self.robot, self.contacts, q, p)
        gauss_newton, gradient = normal_equations(jacobian, residual)
        hessian = gauss_newton + residual_curvature(self.robot, self.contacts, q, p, residual)
        inputs = [q, parameters]
        value = ca.Function("distance", inputs, [distance])
        model = ca.Function("model", inputs, with_cse(distance, gradient, gauss_newton, hessian))
        distance_before, slope, approximate, exact = model(s["q"], parameters)
        matrix = ca.if_else(s["is_exact"] > 0.5, exact, approximate)
        longest = p["max_step"] * motor_scales(self.robot)
        low = ca.fmax(p["lower"] - s["q"], -longest)
        high = ca.fmin(p["upper"] - s["q"], longest)
        step = solve_box_qp(matrix, s["damping"], slope, low, high, DESCENT.passes)
        trial = s["q"] + ca.fmin(ca.fmax(step, -longest), longest)
        trial = ca.fmin(ca.fmax(trial, p["lower"]), p["upper"])
        distance_after = value(trial, parameters)
        is_accepted = distance_after < distance_before
        change = trial - s["q"]
        symmetric = matrix + ca.triu(matrix, False).T
        predicted_decrease = -ca.dot(change, slope + symmetric @ change / 2)
        decrease = distance_before - distance_after
        is_slow = distance_after > DESCENT.slow * distance_before
        factor = DESCENT.poor_factor
        for gain, gain_factor in (
            (DESCENT.poor_gain, DESCENT.fair_factor),
            (DESCENT.good_gain, DESCENT.good_factor),
        ):
            factor = ca.if_else(decrease > gain * predicted_decrease, gain_factor, factor)
        factor = ca.if_else(is_accepted, factor, DESCENT.rejected_factor)
        new_state = {
            "q": ca.if_else(is_accepted, trial, s["q"]),
            "damping": ca.fmax(s["damping"] * factor, DESCENT.damping_floor),
            "is_exact": ca.if_else(is_accepted, is_slow, s["is_exact"]),
            "distance": ca.if_else(is_accepted, distance_after, distance_before),
        }
        has_settled = ca.logic_and(is_accepted, decrease <= DESCENT.settled * distance_before)
        is_stuck = ca.logic_and(ca.logic_not(is_accepted), s["damping"] > DESCENT.damping_ceiling)
        status = ca.if_else(
            ca.logic_or(has_settled, is_stuck), float(Status.STALLED), float(RUNNING)
        )
        outputs = [
            ca.densify(self.state.pack(new_state)),
            ca.densify(ca.if_else(is_accepted, distance_after, distance_before)),
            status,
        ]
        return ca.Function(name, [state, parameters], outputs)


class NearestSearch:
    """Search for the nearest configurations of one robot."""

    def __init__(
        self,
        trials: SubproblemSolver,
        kinds: Kinds,
        compiled: bool = True,
        settings: NearestSettings = NEAREST_SETTINGS,
    ) -> None:
        """Store the runs of the loop; the table is built at the first search."""
        self._trials, self._settings = trials, settings
        self._step = DescentStep(trials.robot.description, kinds)
        self._seeds = SeedTable(trials.robot, settings.seeds)
        self._compiled = compiled

    def with_settings(self, settings: NearestSettings) -> NearestSearch:
        """Return a search with other settings."""
        return NearestSearch(self._trials, self._step.kinds, self._compiled, settings)

    @cached_property
    def _kernel(self) -> LoopKernel:
        return LoopKernel(self._step.graph, self._compiled)

    def find(
        self,
        targets: TargetBatch,
        last_q: Array,
        query: CollisionQuery | None = None,
    ) -> Array:
        """Return the nearest configurations found (k, n) [rad or m].

        Args:
            targets: k targets of the kinds of contacts of this search; their starts decide between
                equally near configurations.
            last_q: (k, n) configurations at which the solves ended; NaN: none [rad or m].
            query: Collision query of the targets; None: collisions are not checked. If none of a
                target's minima is free of collisions, the nearest one is returned.
        """
        all_rows, q0 = np.arange(len(targets)), targets.starts(self._trials.robot.description)
        last_q = np.where(np.isfinite(last_q), last_q, q0)
        bounds = targets.bounds(self._trials.robot.description)
        seed_owner, seeds = self._seeds.find(targets, _weights(targets), *bounds)
        owner = np.concatenate([all_rows, all_rows, seed_owner])
        start = np.concatenate([q0, last_q, seeds])
        parameters = self._parameters(targets, UNLIMITED_STEP)
        states = self._run(self._states(parameters[owner], start), parameters[owner], is_race=True)
        count, count_per_motor = self._settings.finalists
        count += count_per_motor * len(self._trials.robot.actuators)
        finalists = smallest_per_owner(owner, self._distance(states), count)
        owner = owner[finalists]
        states = self._run(states[finalists], parameters[owner])
        q, distance = self._q(states), self._distance(states)
        if query is not None:
            is_free = query.rows(owner).check(q).free
            distance = np.where(is_free, distance, IN_COLLISION * (1 + distance))
        return self._nearest(q0, owner, q, distance)

    def descend(self, targets: TargetBatch, is_local: bool = True) -> Array:
        """Return the local minima (k, n) to which the starts of k targets descend.

        Args:
            targets: k targets of the kinds of contacts of this search.
            is_local: True for short steps, which end at a minimum near the start.
        """
        q = targets.starts(self._trials.robot.description)
        max_step = DESCENT.local_step if is_local else UNLIMITED_STEP
        parameters = self._parameters(targets, max_step)
        return self._q(self._run(self._states(parameters, q), parameters))

    def _parameters(self, targets: TargetBatch, max_step: float) -> Array:
        """Return the parameters (k, np) of the descent."""
        contacts = self._step.contacts
        values = {f"{name}s": np.nan_to_num(targets.vectors(f"{name}s")) for name in contacts.data}
        lower, upper = targets.bounds(self._trials.robot.description)
        bounds = {"weights": _weights(targets), "lower": lower, "upper": upper}
        return self._step.parameters.pack_rows(
            {**values, **bounds, "max_step": max_step}, len(targets)
        )

    def _states(self, parameters: Array, q: Array) -> Array:
        """Return the first states (m, ns) of descents."""
        layout = self._step.parameters
        lower, upper = (parameters[:, layout.slice(name)] for name in ("lower", "upper"))
        start = {"q": np.clip(q, lower, upper), "damping": DESCENT.damping}
        return self._step.state.pack_rows(start | {"is_exact": 0.0, "distance": 0.0}, len(q))

    def _run(self, states: Array, parameters: Array, is_race: bool = False) -> Array:
        """Return the states (m, ns) at the end of descents, or of their first steps."""
        count = self._settings.race_steps if is_race else DESCENT.max_iterations
        return self._kernel.run(states, parameters, count).states

    def _q(self, states: Array) -> Array:
        return states[:, self._step.state.slice("q")]

    def _distance(self, states: Array) -> Array:
        return states[:, self._step.state.slice("distance")].ravel()

    def distances(self, targets: TargetBatch, owner: Rows, q: Array) -> Array:
        """Return (m,) sums of squared contact errors, each divided by its tolerance."""
        misses = LocalRefinement(self._trials, targets).misses(owner, q)
        tolerances = residual_tolerances(targets)[owner]
        ratios = np.divide(misses, tolerances, where=tolerances > 0, out=np.zeros_like(misses))
        return (ratios**2).sum(axis=(1, 2))

    def _nearest(self, q0: Array, owner: Rows, q: Array, distance: Array) -> Array:
        """Return the nearest configuration of each target; the travel from q0 decides ties."""
        robot, minimum = self._trials.robot, np.full(len(q0), np.inf)
        np.minimum.at(minimum, owner, distance)
        is_tied = distance <= minimum[owner] * (1 + self._settings.tie)
        ranges = np.maximum(robot.upper - robot.lower, 1e-9)
        travel = (np.abs(q - q0[owner]) / ranges).max(axis=1)
        order = np.lexsort((np.where(is_tied, travel, np.inf), owner))
        return q[first_per_owner(owner, order, 1)]


def _weights(targets: TargetBatch) -> Array:
    """Return (k, f, 2) weights of points and normals: inverse tolerances, the largest is 1."""
    tolerances = residual_tolerances(targets)
    inverse = np.divide(1.0, tolerances, where=tolerances > 0, out=np.zeros_like(tolerances))
    return inverse / inverse.max(axis=(1, 2), keepdims=True)
