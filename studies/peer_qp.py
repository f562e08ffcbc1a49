"""Pink, mink and placo: a quadratic program in every step."""

from __future__ import annotations

import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from peer_model import Joints, peer_urdf
from peer_steps import LENGTH, PinContacts, cross, normal_axes, residual

import casadi_ik as ik
from casadi_ik.arrays import Array

LEAST = 1e-9
"""Smallest weight of placo's regularization: its program has to be strictly convex."""


class Pink:
    """Pink: all contacts as one task of our own, DAQP with the limits as bounds."""

    def __init__(self, robot: ik.ArmHand, damping: float) -> None:
        """Set it up; `damping` is the task's Levenberg-Marquardt damping."""
        self._pink: Any = import_module("pink")
        self._qp: Any = import_module("qpsolvers")
        tasks: Any = import_module("pink.tasks")
        self._pin = contacts = PinContacts(robot)
        model = contacts.model
        names = contacts.joints.names
        start = contacts.theta(robot.home)
        self._configuration = self._pink.Configuration(model, model.createData(), start)
        self._lower, self._upper = model.lowerPositionLimit, model.upperPositionLimit
        peer = self

        class Contacts(tasks.Task):
            def compute_error(self, configuration: Any) -> Array:
                del configuration
                return residual(*peer._now, *peer._target)

            def compute_jacobian(self, configuration: Any) -> Array:
                return contacts.rows_of(configuration.data, peer._now[1])

            def __repr__(self) -> str:
                return "Contacts()"

        self._tasks = [Contacts(lm_damping=damping)]
        self._coupled = [
            tasks.JointCouplingTask([names[a], names[b]], [r, -1.0], 1.0, self._configuration)
            for a, b, r in contacts.joints.pairs
        ]

    def aim(self, points: Array, normals: Array) -> None:
        """See `Peer`."""
        self._target = points, normals

    def contacts(self, q: Array) -> tuple[Array, Array]:
        """See `Peer`."""
        self._configuration.update(self._pin.theta(q))
        placed = [self._configuration.data.oMf[frame] for frame in self._pin.frames]
        self._now = (
            np.array([m.translation for m in placed]),
            np.array([m.rotation @ a for m, a in zip(placed, self._pin.axes, strict=True)]),
        )
        return self._now

    def step(self, q: Array) -> Array:
        """See `Peer`."""
        del q
        problem = self._pink.build_ik(
            self._configuration, self._tasks, 1.0, 1e-8, limits=[], constraints=self._coupled
        )
        theta = self._configuration.q
        problem.lb, problem.ub = self._lower - theta, self._upper - theta
        change = self._qp.solve_problem(problem, solver="daqp").x
        return np.zeros(len(self._pin.joints.leader)) if change is None else self._ours(change)

    def _ours(self, change: Array) -> Array:
        return change[self._pin.rows][self._pin.joints.leader]


class Mink:
    """mink: all contacts as one stacked task, DAQP with the limits as bounds."""

    def __init__(self, robot: ik.ArmHand, damping: float) -> None:
        """Set it up; `damping` is the task's Levenberg-Marquardt damping."""
        mink: Any = import_module("mink")
        mujoco: Any = import_module("mujoco")
        self._mink, self._mujoco = mink, mujoco
        self._qp: Any = import_module("qpsolvers")
        joints = self._joints = Joints(robot)
        self._model = model = self._spec(robot).compile()
        order = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, n) for n in joints.names]
        self._rows = np.array([model.jnt_qposadr[i] for i in order])
        self._bodies = [
            mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, f"{name}_contact")
            for name in robot.fingers
        ]
        self._configuration = mink.Configuration(model)
        self._limits = model.jnt_range[:, 0], model.jnt_range[:, 1]
        self._axes = np.zeros((len(self._bodies), 3))
        self.contacts(robot.home)
        rotations = self._configuration.data.xmat[self._bodies].reshape(-1, 3, 3)
        self._axes = normal_axes(robot, rotations)
        peer = self

        class Contacts(mink.Task):
            def compute_error(self, configuration: Any) -> Array:
                del configuration
                return residual(*peer._now, *peer._target)

            def compute_jacobian(self, configuration: Any) -> Array:
                return peer._derivative(configuration.data)

        rows = 6 * len(self._bodies)
        self._tasks = [Contacts(cost=np.ones(rows), lm_damping=damping)]
        self._coupled = [mink.EqualityConstraintTask(model, 1.0)] if joints.pairs else []

    def limits(self) -> list[Any]:
        """What the program keeps beside the bounds of motors."""
        return []

    def _spec(self, robot: ik.ArmHand) -> Any:
        """The robot, before it is compiled."""
        compiler = (
            '<mujoco><compiler fusestatic="false" boundmass="0.01" boundinertia="0.001"/></mujoco>'
        )
        urdf = peer_urdf(robot, self._joints).replace("<link", f"{compiler}<link", 1)
        spec = self._mujoco.MjSpec.from_string(urdf)
        for a, b, ratio in self._joints.pairs:
            shared = spec.add_equality(
                type=self._mujoco.mjtEq.mjEQ_JOINT,
                name1=self._joints.names[b],
                name2=self._joints.names[a],
            )
            shared.data[:2] = 0.0, ratio  # the polynomial b = 0 + ratio a
        return spec

    def aim(self, points: Array, normals: Array) -> None:
        """See `Peer`."""
        self._target = points, normals

    def contacts(self, q: Array) -> tuple[Array, Array]:
        """See `Peer`."""
        theta = np.empty(self._model.nq)
        theta[self._rows] = self._joints.C @ q
        self._configuration.update(theta)
        data = self._configuration.data
        rotations = data.xmat[self._bodies].reshape(-1, 3, 3)
        self._now = data.xpos[self._bodies], np.einsum("fij,fj->fi", rotations, self._axes)
        return self._now

    def step(self, q: Array) -> Array:
        """See `Peer`."""
        del q
        problem = self._mink.build_ik(
            self._configuration,
            self._tasks,
            1.0,
            1e-8,
            limits=self.limits(),
            constraints=self._coupled,
        )
        theta = self._configuration.q
        problem.lb, problem.ub = self._limits[0] - theta, self._limits[1] - theta
        change = self._qp.solve_problem(problem, solver="daqp").x
        if change is None:
            return np.zeros(len(self._joints.leader))
        return change[self._rows][self._joints.leader]

    def _derivative(self, data: Any) -> Array:
        parts = []
        for body in self._bodies:
            J = np.zeros((6, self._model.nv))
            self._mujoco.mj_jacBody(self._model, data, J[:3], J[3:], body)
            parts.append(J)
        turned = [-cross(n) @ J[3:] for n, J in zip(self._now[1], parts, strict=True)]
        return np.concatenate([J[:3] / LENGTH for J in parts] + turned)


class Placo:
    """placo: a position and an axis-align task per contact, limits and coupling hard."""

    def __init__(self, robot: ik.ArmHand, damping: float) -> None:
        """Set it up; `damping` times the squared error is the weight of the regularization task."""
        placo: Any = import_module("placo")
        self._joints = Joints(robot)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "robot.urdf"
            file.write_text(peer_urdf(robot, self._joints), encoding="utf-8")
            self._robot = placo.RobotWrapper(str(file), placo.Flags.ignore_collisions)
        self._solver = placo.KinematicsSolver(self._robot)
        self._solver.mask_fbase(True)
        self._solver.enable_joint_limits(True)
        self._damping, self._regular = damping, self._solver.add_regularization_task(damping)
        names = self._joints.names
        for a, b, ratio in self._joints.pairs:
            gear = self._solver.add_gear_task()
            gear.set_gear(names[b], names[a], ratio)
            gear.configure("gear", "hard", 1.0)
        self._offsets = np.array([self._robot.get_joint_offset(name) for name in names])
        self._moves = np.array([self._robot.get_joint_v_offset(name) for name in names])
        self._frames = [f"{name}_contact" for name in robot.fingers]
        rotations = self._placed(robot.home)[:, :3, :3]
        self._axes = normal_axes(robot, rotations)
        zero = np.zeros(3)
        self._points = [self._solver.add_position_task(frame, zero) for frame in self._frames]
        self._normals = [
            self._solver.add_axisalign_task(frame, axis, np.array([0.0, 0.0, 1.0]))
            for frame, axis in zip(self._frames, self._axes, strict=True)
        ]
        for i, (point, normal) in enumerate(zip(self._points, self._normals, strict=True)):
            point.configure(f"point {i}", "soft", 1 / LENGTH**2)
            normal.configure(f"normal {i}", "soft", 1.0)

    def _placed(self, q: Array) -> Array:
        state = self._robot.state.q
        state[self._offsets] = self._joints.C @ q
        self._robot.state.q = state
        self._robot.update_kinematics()
        return np.array([self._robot.get_T_world_frame(frame) for frame in self._frames])

    def aim(self, points: Array, normals: Array) -> None:
        """See `Peer`."""
        self._target = points, normals
        for i, (point, normal) in enumerate(zip(self._points, self._normals, strict=True)):
            point.target_world = points[i]
            normal.targetAxis_world = normals[i]

    def contacts(self, q: Array) -> tuple[Array, Array]:
        """See `Peer`."""
        placed = self._placed(q)
        self._now = placed[:, :3, 3], np.einsum("fij,fj->fi", placed[:, :3, :3], self._axes)
        return self._now

    def step(self, q: Array) -> Array:
        """See `Peer`."""
        error = residual(*self._now, *self._target)
        weight = max(self._damping * float(error @ error), LEAST)
        self._regular.configure("regularization", "soft", weight)
        try:
            change = self._solver.solve(False)
        except RuntimeError:  # its quadratic program has no solution
            return np.zeros_like(q)
        return change[self._moves][self._joints.leader]
