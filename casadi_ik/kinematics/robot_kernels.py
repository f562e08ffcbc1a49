"""Numeric kinematics of a robot, compiled at the first use."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import casadi as ca
import numpy as np

from casadi_ik.compile.function_kernel import FunctionKernel
from casadi_ik.compile.graphs import FunctionGraph, Shape, recipe
from casadi_ik.kinematics.couplings import joint_positions, toggle_margins
from casadi_ik.kinematics.forward import Pose, actuated
from casadi_ik.model.description import CONTINUOUS_LIMIT, RobotDescription


class RobotKernels:
    """Kernels of q (n,) [rad or m]; results in the base frame, in m and rad."""

    def __init__(self, robot: RobotDescription) -> None:
        """Store the description; kernels are built at the first use."""
        self._robot = robot

    @cached_property
    def joints(self) -> FunctionKernel:
        """Positions of all movable joints."""

        def build(q: ca.SX) -> list[ca.SX]:
            return [joint_positions(self._robot, q)]

        return self._kernel("joints", build, {}, [(len(self._robot.joint_names), 1)])

    @cached_property
    def toggle_margins(self) -> tuple[tuple[str, ...], FunctionKernel]:
        """Names of the joints with mechanisms, and the kernel of their toggle margins."""
        q = ca.SX.sym("q", len(self._robot.actuators))
        margins = toggle_margins(self._robot, q)
        values = ca.densify(ca.vertcat(ca.SX(0, 1), *margins.values()))
        name = ca.Function.fix_name(f"{self._robot.name}_toggle_margins")
        return tuple(margins), FunctionKernel(ca.Function(name, [q], [values]))

    @cached_property
    def contacts(self) -> FunctionKernel:
        """Contact points and normals, (f, 3) each."""

        def build(q: ca.SX) -> list[ca.SX]:
            kinematics = actuated(self._robot, q).kinematics
            pairs = [kinematics.contact(name) for name in self._robot.finger_names]
            points = ca.horzcat(*(point for point, _ in pairs)).T
            normals = ca.horzcat(*(normal for _, normal in pairs)).T
            return [points, normals]

        f = len(self._robot.finger_names)
        return self._kernel("contacts", build, {}, [(f, 3), (f, 3)])

    @cached_property
    def contact_frames(self) -> FunctionKernel:
        """Contact frames (4, 4), stacked: axes normal, tangent, normal x tangent."""

        def build(q: ca.SX) -> list[ca.SX]:
            kinematics = actuated(self._robot, q).kinematics
            frames = []
            for name in self._robot.finger_names:
                point, normal = kinematics.contact(name)
                tangent = kinematics.tangent(name)
                axes = ca.horzcat(normal, tangent, ca.cross(normal, tangent))
                frames.append(_matrix(Pose(axes, point)))
            return [ca.vertcat(*frames)]

        return self._kernel("contact_frames", build, {}, [(4 * len(self._robot.finger_names), 4)])

    @cached_property
    def deviations(self) -> FunctionKernel:
        """Distances and angles (f,) from points and normals (f, 3), and `limit_excess`.

        The verdict uses this kernel, which shares no code with the residuals of the methods.
        """

        def build(q: ca.SX, points: ca.SX, normals: ca.SX) -> list[ca.SX]:
            kinematics = actuated(self._robot, q).kinematics
            positions, angles = [], []
            for i, name in enumerate(self._robot.finger_names):
                point, normal = kinematics.contact(name)
                positions.append(ca.norm_2(point - points[i, :].T))
                # Kahan's formula is exact at zero and at a half turn, where the arc cosine loses
                # half the digits.
                difference, total = normal - normals[i, :].T, normal + normals[i, :].T
                angles.append(2 * ca.atan2(ca.norm_2(difference), ca.norm_2(total)))
            return [ca.vertcat(*positions), ca.vertcat(*angles), self._excess(q)]

        f = len(self._robot.finger_names)
        targets = {"points": (f, 3), "normals": (f, 3)}
        return self._kernel("deviations", build, targets, [(f, 1), (f, 1), (1, 1)])

    @cached_property
    def limit_excess(self) -> FunctionKernel:
        """Largest violation of the limits of an actuator or joint; negative within all limits."""
        return self._kernel("beyond_limits", lambda q: [self._excess(q)], {}, [(1, 1)])

    def _excess(self, q: ca.SX) -> ca.SX:
        description = self._robot
        positions = ca.vertcat(q, joint_positions(description, q))
        # The limits of the file; bounds that were derived from them are not checked.
        strokes = description.actuator_limits
        names = np.array(description.actuator_names)[description.continuous]
        motors, joints = (
            np.isin(all_names, names)
            for all_names in (description.actuator_names, description.joint_names)
        )
        is_continuous = np.concatenate([motors, joints])
        lower = np.concatenate([strokes[0], description.joint_lower])
        upper = np.concatenate([strokes[1], description.joint_upper])
        lower, upper = (
            ca.DM(np.where(is_continuous, sign * CONTINUOUS_LIMIT, limits))
            for sign, limits in ((-1, lower), (1, upper))
        )
        return ca.mmax(ca.fmax(lower - positions, positions - upper))

    @cached_property
    def palm(self) -> FunctionKernel:
        """Pose (4, 4) of the palm."""

        def build(q: ca.SX) -> list[ca.SX]:
            return [_matrix(actuated(self._robot, q).kinematics.palm)]

        return self._kernel("palm", build, {}, [(4, 4)])

    @cached_property
    def links(self) -> FunctionKernel:
        """Poses of all links, stacked."""

        def build(q: ca.SX) -> list[ca.SX]:
            links = actuated(self._robot, q).kinematics.links
            return [ca.vertcat(*(_matrix(links[name]) for name in self._robot.links))]

        return self._kernel("links", build, {}, [(4 * len(self._robot.links), 4)])

    def _kernel(
        self,
        name: str,
        build: Callable[..., list[ca.SX]],
        extra_inputs: Mapping[str, Shape],
        outputs: Sequence[Shape],
    ) -> FunctionKernel:
        """Return the kernel of a function of q and further inputs."""
        # Names of functions permit fewer characters than names of robots.
        function_name = ca.Function.fix_name(f"{self._robot.name}_{name}")
        inputs = {"q": (len(self._robot.actuators), 1), **extra_inputs}

        def function() -> ca.Function:
            symbols = [ca.SX.sym(key, *shape) for key, shape in inputs.items()]
            results = [ca.densify(output) for output in build(*symbols)]
            return ca.Function(
                function_name,
                symbols,
                results,
                list(inputs),
                [f"out_{i}" for i in range(len(results))],
            )

        key = recipe(function_name, self._recipe)
        graph = FunctionGraph(function_name, function, inputs, tuple(outputs), key)
        return FunctionKernel(graph)

    @cached_property
    def _recipe(self) -> str:
        return recipe(self._robot)


def _matrix(pose: Pose) -> ca.SX:
    bottom = ca.SX(ca.DM([[0.0, 0.0, 0.0, 1.0]]))
    return ca.vertcat(ca.horzcat(pose.rotation, pose.origin), bottom)
