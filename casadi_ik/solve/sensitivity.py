"""Derivatives of solutions by their targets, from the implicit function theorem.

With the contact residual r(q, t), a solution q follows its target t such that the remaining
residual stays constant, r(q + dq, t + dt) = r(q, t), in the least-squares sense if the rows
conflict:

    dq = -(dr/dq)^+ dr/dt dt

over the motors that can move. A motor at a limit does not move. Motions that the
contacts leave free are zero: the pseudo-inverse returns the smallest motion (scaled by
`motor_scales`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.compile import FunctionGraph, FunctionKernel
from casadi_ik.compile.graphs import recipe
from casadi_ik.files.arrays import Array
from casadi_ik.files.reprs import RecordReprMixin
from casadi_ik.kinematics.contact_fit import contact_residual
from casadi_ik.kinematics.contacts import ContactRows, Kinds, kinds_suffix
from casadi_ik.kinematics.forward import motor_scales
from casadi_ik.kinematics.linear_algebra import solve_spd
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.targets import TargetBatch

LIMIT_DISTANCE = 1e-9
"""Distance below which a motor counts as being at its limit [rad or m]."""

PSEUDO_INVERSE_DAMPING, PSEUDO_INVERSE_PASSES = 1e-7, 5
"""Damping of the squared singular values, and number of refinements that remove its effect.

The remaining effect is 1e-5 of a singular value of 1e-3. Singular values below 3e-4 count as free
motions. With a damping of 1e-8, rounding errors of free motions appear in other motions (3e-7)."""


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivity(RecordReprMixin):
    """Derivatives of configurations, or of a scalar function of them, by the contacts.

    Attributes:
        points: (..., f, 3) derivatives by contact points [1/m]; 0 where free.
        normals: (..., f, 3) derivatives by normals, which are normalised to length 1; 0 where free.
    """

    points: Array
    normals: Array


class SensitivityKernel:
    """Compiled derivatives of a robot's solutions, for one combination of contact kinds."""

    def __init__(self, robot: RobotDescription, kinds: Kinds, compiled: bool = True) -> None:
        """Define the inputs; the function is compiled when first needed."""
        self._robot, self._contacts = robot, ContactRows(kinds)
        n, f = len(robot.actuators), len(kinds)
        self._inputs = {"q": (n, 1), "free": (n, 1), "gradient": (n, 1)}
        self._inputs |= {field.name: (f, field.size // f) for field in self._contacts.fields}
        size = sum(rows * columns for rows, columns in self._inputs.values())
        self._name = name = ca.Function.fix_name(f"{robot.name}_sensitivity{kinds_suffix(kinds)}")
        self._shapes, graph_recipe = {"inputs": (size, 1)}, recipe(name, robot, kinds)
        self._outputs, self._recipe, self._compiled = ((6 * f, 1),), graph_recipe, compiled

    @cached_property
    def _kernel(self) -> FunctionKernel:
        graph = FunctionGraph(self._name, self._graph, self._shapes, self._outputs, self._recipe)
        return FunctionKernel(graph, self._compiled, in_lanes=True)

    def __call__(self, targets: TargetBatch, q: Array, gradients: Array) -> Sensitivity:
        """Return derivatives of ``gradients @ q`` for solutions q (k, n), gradients (k, n)."""
        if not len(q):
            empty = np.zeros((0, len(self._robot.fingers), 3))
            return Sensitivity(empty, empty)
        low, high = targets.bounds(self._robot, np.inf)
        values: dict[str, Any] = {"q": q, "gradient": gradients}
        values["free"] = (q - low >= LIMIT_DISTANCE) & (high - q >= LIMIT_DISTANCE)
        is_constrained = [~np.isnan(array[..., 0]) for array in (targets.points, targets.normals)]
        values["weights"] = np.stack(is_constrained, axis=2)
        for name in self._inputs.keys() - values.keys():
            values[name] = np.nan_to_num(targets.vectors(name))
        columns = [values[name].reshape(len(q), -1) for name in self._inputs]
        (rates,) = self._kernel(np.concatenate(columns, axis=1, dtype=float))
        points, normals = np.split(rates.reshape(len(q), -1, 3), 2, axis=1)
        return Sensitivity(points, normals)

    def _graph(self) -> ca.Function:
        """Return the graph from the stacked inputs to the derivatives by points and normals."""
        inputs, offset, robot = dict[str, ca.SX](), 0, self._robot
        ((_, shape),) = self._shapes.items()
        column = ca.SX.sym("inputs", *shape)
        for name, (rows, columns) in self._inputs.items():
            values = column[offset : offset + rows * columns]
            inputs[name], offset = ca.reshape(values, columns, rows).T, offset + rows * columns
        residual = contact_residual(robot, self._contacts, inputs["q"], inputs)
        scales = inputs["free"] * motor_scales(robot)
        rates = ca.jacobian(residual, inputs["q"]) @ ca.diag(scales)
        normal_matrix = ca.densify(
            rates.T @ rates + PSEUDO_INVERSE_DAMPING * ca.DM.eye(len(robot.actuators))
        )
        step = solve_spd(normal_matrix, scales * inputs["gradient"])
        total = step
        for _ in range(PSEUDO_INVERSE_PASSES - 1):
            step = PSEUDO_INVERSE_DAMPING * solve_spd(normal_matrix, step)
            total = total + step
        by_points, by_normals = (
            -ca.jtimes(residual, inputs[name], rates @ total, True)
            for name in ("points", "normals")
        )
        component_along_normal = ca.sum2(by_normals * inputs["normals"])
        by_normals = by_normals - ca.repmat(component_along_normal, 1, 3) * inputs["normals"]
        result = ca.vertcat(ca.vec(by_points.T), ca.vec(by_normals.T))
        return ca.Function(self._name, [column], [ca.densify(ca.cse(result))])
