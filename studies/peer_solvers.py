"""Adapters of other solvers to contacts of fingertips; each does one step at a time."""

from __future__ import annotations

import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from peer_robots import Joints, peer_urdf
from samplers import Array

import casadi_ik as ik

LENGTH = 0.1
"""Position errors are divided by this [m], so that they weigh like those of the normals."""


class Peer(Protocol):
    """Interface of other solvers: one iteration on motor positions (n,)."""

    def aim(self, points: Array, normals: Array) -> None:
        """Take a target: (f, 3) points [m] and normals."""
        ...

    def contacts(self, q: Array) -> tuple[Array, Array]:
        """Go to a configuration; points and normals there, by the peer's own kinematics."""
        ...

    def step(self, q: Array) -> Array:
        """Return the change of q that the peer makes."""
        ...


class PinContacts:
    """Contacts and their Jacobian by pinocchio, in our motors."""

    def __init__(self, robot: ik.ArmHand) -> None:
        """Load the robot and look the contact frames up."""
        self.pin: Any = import_module("pinocchio")
        self.joints = Joints(robot)
        self.model = model = self.pin.buildModelFromXML(peer_urdf(robot, self.joints))
        self.frames = [model.getFrameId(f"{name}_contact") for name in robot.fingers]
        place = self.joints.order([n for n in model.names if n != "universe"])
        self.rows = np.array([model.joints[int(i) + 1].idx_q for i in place])
        self.axes = normal_axes(robot, self.at(model.createData(), robot.home)[1])

    def theta(self, q: Array) -> Array:
        """Joints in pinocchio's order."""
        theta = np.empty(self.model.nq)
        theta[self.rows] = self.joints.C @ q
        return theta

    def at(self, data: Any, q: Array) -> tuple[Array, Array]:
        """Points and rotations of the contact frames; `data` then holds the Jacobians."""
        self.pin.computeJointJacobians(self.model, data, self.theta(q))
        self.pin.updateFramePlacements(self.model, data)
        placed = [data.oMf[frame] for frame in self.frames]
        return np.array([m.translation for m in placed]), np.array([m.rotation for m in placed])

    def rows_of(self, data: Any, normals: Array) -> Array:
        """See `derivative`; joints in pinocchio's order."""
        world = self.pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        parts = [self.pin.getFrameJacobian(self.model, data, i, world) for i in self.frames]
        return derivative(parts, normals)


class Scipy:
    """`scipy.optimize.least_squares` (trf, analytic Jacobian): a whole descent is one step."""

    def __init__(self, robot: ik.ArmHand, evaluations: int, tight: bool) -> None:
        """Set it up.

        Args:
            robot: The robot.
            evaluations: Budget of a descent.
            tight: Whether to go on to the last digits.
        """
        self._least_squares: Any = import_module("scipy.optimize").least_squares
        self._robot = robot
        self._evaluations, self._tolerance = evaluations, 1e-15 if tight else 1e-6
        self._pin = PinContacts(robot)
        self._data = self._pin.model.createData()

    def aim(self, points: Array, normals: Array) -> None:
        """See `Peer`."""
        self._target = points, normals

    def contacts(self, q: Array) -> tuple[Array, Array]:
        """See `Peer`."""
        points, rotations = self._pin.at(self._data, q)
        return points, np.einsum("fij,fj->fi", rotations, self._pin.axes)

    def step(self, q: Array) -> Array:
        """See `Peer`."""
        margin = 1e-12  # the start has to be inside
        result = self._least_squares(
            self._residual,
            np.clip(q, self._robot.lower + margin, self._robot.upper - margin),
            self._jacobian,
            bounds=(self._robot.lower, self._robot.upper),
            max_nfev=self._evaluations,
            ftol=self._tolerance,
            xtol=self._tolerance,
            gtol=self._tolerance,
        )
        return result.x - q

    def _residual(self, q: Array) -> Array:
        return residual(*self.contacts(q), *self._target)

    def _jacobian(self, q: Array) -> Array:
        _, normals = self.contacts(q)
        return self._pin.rows_of(self._data, normals)[:, self._pin.rows] @ self._pin.joints.C


def normal_axes(robot: ik.ArmHand, rotations: Array) -> Array:
    """(f, 3) the normals in the contact frames, from the rotations of these at home."""
    _, normals = robot.contacts(robot.home)
    return np.einsum("fji,fj->fi", rotations, normals)


def residual(points: Array, normals: Array, targets: Array, facing: Array) -> Array:
    """(6 f,) errors of the points / LENGTH, then of the normals."""
    return np.concatenate([((points - targets) / LENGTH).ravel(), (normals - facing).ravel()])


def derivative(jacobians: list[Array], normals: Array) -> Array:
    """(6 f, joints) derivative of `residual`, from the Jacobian (6, joints) of every contact."""
    normal_rates = [-cross(n) @ J[3:] for n, J in zip(normals, jacobians, strict=True)]
    return np.concatenate([J[:3] / LENGTH for J in jacobians] + normal_rates)


def cross(v: Array) -> Array:
    """(3, 3) the matrix of the cross product with v."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def by_daqp(problem: Any, lower: Array, upper: Array, motors: NDArray[np.intp]) -> Array:
    """Return the bounded change of the motors by DAQP; zero if it fails."""
    problem.lb, problem.ub = lower, upper
    change = import_module("qpsolvers").solve_problem(problem, solver="daqp").x
    return np.zeros(len(motors)) if change is None else change[motors]


MIN_DAMPING = 1e-9
"""Smallest weight of placo's regularization: its program has to be strictly convex."""


class Pink:
    """Pink: all contacts as one task of our own, DAQP with the limits as bounds."""

    def __init__(self, robot: ik.ArmHand, damping: float) -> None:
        """Set it up; `damping` is the task's Levenberg-Marquardt damping."""
        self._pink: Any = import_module("pink")
        tasks: Any = import_module("pink.tasks")
        self._pin = contacts = PinContacts(robot)
        model = contacts.model
        names = contacts.joints.names
        self._motors = contacts.rows[contacts.joints.leader]
        start = contacts.theta(robot.home)
        self._configuration = self._pink.Configuration(model, model.createData(), start)
        self._lower, self._upper = model.lowerPositionLimit, model.upperPositionLimit
        peer = self

        class Contacts(tasks.Task):
            def compute_error(self, configuration: Any) -> Array:
                del configuration
                return residual(*peer._current, *peer._target)

            def compute_jacobian(self, configuration: Any) -> Array:
                return contacts.rows_of(configuration.data, peer._current[1])

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
        self._current = (
            np.array([m.translation for m in placed]),
            np.array([m.rotation @ a for m, a in zip(placed, self._pin.axes, strict=True)]),
        )
        return self._current

    def step(self, q: Array) -> Array:
        """See `Peer`."""
        del q
        problem = self._pink.build_ik(
            self._configuration, self._tasks, 1.0, 1e-8, limits=[], constraints=self._coupled
        )
        theta = self._configuration.q
        return by_daqp(problem, self._lower - theta, self._upper - theta, self._motors)


class Mink:
    """mink: all contacts as one stacked task, DAQP with the limits as bounds."""

    def __init__(self, robot: ik.ArmHand, damping: float) -> None:
        """Set it up; `damping` is the task's Levenberg-Marquardt damping."""
        mink: Any = import_module("mink")
        mujoco: Any = import_module("mujoco")
        self._mink, self._mujoco = mink, mujoco
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
                return residual(*peer._current, *peer._target)

            def compute_jacobian(self, configuration: Any) -> Array:
                return peer._derivative(configuration.data)

        rows = 6 * len(self._bodies)
        self._tasks = [Contacts(cost=np.ones(rows), lm_damping=damping)]
        self._coupled = [mink.EqualityConstraintTask(model, 1.0)] if joints.pairs else []

    def limits(self) -> list[Any]:
        """Return the limits of the program besides the bounds of motors."""
        return []

    def _spec(self, robot: ik.ArmHand) -> Any:
        """Return the specification of the robot."""
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
        self._current = data.xpos[self._bodies], np.einsum("fij,fj->fi", rotations, self._axes)
        return self._current

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
        motors = self._rows[self._joints.leader]
        return by_daqp(problem, self._limits[0] - theta, self._limits[1] - theta, motors)

    def _derivative(self, data: Any) -> Array:
        parts = []
        for body in self._bodies:
            J = np.zeros((6, self._model.nv))
            self._mujoco.mj_jacBody(self._model, data, J[:3], J[3:], body)
            parts.append(J)
        return derivative(parts, self._current[1])


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
        self._current = placed[:, :3, 3], np.einsum("fij,fj->fi", placed[:, :3, :3], self._axes)
        return self._current

    def step(self, q: Array) -> Array:
        """See `Peer`."""
        error = residual(*self._current, *self._target)
        weight = max(self._damping * float(error @ error), MIN_DAMPING)
        self._regular.configure("regularization", "soft", weight)
        try:
            change = self._solver.solve(False)
        except RuntimeError:  # its quadratic program has no solution
            return np.zeros_like(q)
        return change[self._moves][self._joints.leader]
