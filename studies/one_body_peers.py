"""Other ways to solve a body with two hands: fingertip contacts, or wrist poses alone.

Contacts go to the solvers of `peers.py`, with all motors of the body as those of one hand. Those
that know frames only get poses of both palms, which arms alone reach with the trunk at home: an
easier question. Peers that are not installed are left out.
"""

from __future__ import annotations

import importlib.util
import tempfile
import time
from collections.abc import Callable
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from peers import SETTINGS, run_peer

import casadi_ik as ik
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.kinematics.forward import actuated

Array = NDArray[np.float64]
LEG = 90
"""Poses from one posture to the next: three seconds at 30 Hz."""

WITHIN = 5e-3, np.deg2rad(3.0)
"""Tolerance of a wrist pose [m], [rad]."""


def by_contacts(robot: ArmHand, q: Array) -> list[list[str]]:
    """Rows of a table: way, share that is solved, time of a target."""
    targets, one_hand = robot.contacts(q), ArmHand(robot.description.as_hand)
    rows = []
    for label, solver in {
        "hand first, side by side and trunk": ik.Solver(robot),
        "hand first, as one hand with all motors": ik.Solver(one_hand),
    }.items():
        solver.solve_batch(targets[0][:2], targets[1][:2])
        begun = time.process_time()
        solution = solver.solve_batch(*targets[:2])
        time_each = 1e6 * (time.process_time() - begun) / len(q)
        rows.append(
            [robot.name, label, f"{int(solution.success.sum())} of {len(q)}", f"{time_each:.0f}"]
        )
    for name in ("mink", "ipopt"):
        if name in SETTINGS and not importlib.util.find_spec(SETTINGS[name].package):
            continue
        run = run_peer(name, one_hand, targets, ik.Tolerance())
        solved, time_each = round(run.solved * len(q)), 1e6 * float(np.mean(run.times))
        label = "Ipopt" if name == "ipopt" else name
        rows.append(
            [robot.name, f"{label}, all motors", f"{solved} of {len(q)}", f"{time_each:.0f}"]
        )
    return rows


def by_wrists(robot: ArmHand, count: int, seed: int) -> list[list[str]]:
    """Return rows for poses of both palms on a path of the arms, with the trunk at home.

    As in teleoperation: from home to a random posture and on to the next, `LEG` poses each; every
    way starts from its last answer.
    """
    rng = np.random.default_rng(seed)
    arm_motors = [
        robot.actuators.index(name) for side in robot.description.sides for name in side.arm
    ]
    legs = -(-count // LEG)
    ends = np.vstack([robot.home, robot.random(rng, legs)])[:, arm_motors]
    q, part = np.tile(robot.home, (legs * LEG, 1)), (np.arange(LEG) + 1.0)[:, None] / LEG
    q[:, arm_motors] = np.concatenate([a + part * (b - a) for a, b in pairwise(ends)])
    q = q[:count]
    sides = [side.name for side in robot.description.sides]
    targets = {side: robot.palm(q, side) for side in sides}
    solvers: dict[str, Callable[[int], Array]] = {
        "hand first, palms given": _ours(robot, targets),
        "xr_teleoperate's formulation (Ipopt), arms alone": TeleoperationNlp(
            robot, arm_motors, targets
        ),
    }
    if importlib.util.find_spec("embodik"):
        solvers["embodiK, waist and arms"] = Embodik(robot, targets)
    rows = []
    for label, solve in solvers.items():
        times, errors = np.zeros(count), np.zeros((count, 2))
        for i in range(count):
            begun = time.process_time()
            answer = solve(i)
            times[i] = time.process_time() - begun
            for side in sides:
                errors[i] = np.maximum(
                    errors[i], _pose_error(robot.palm(answer, side), targets[side][i])
                )
        solved = int((errors <= np.array(WITHIN)).all(axis=1).sum())
        median_error, time_each = (
            1e3 * float(np.median(errors[:, 0])),
            1e6 * float(np.median(times)),
        )
        rows.append(
            [robot.name, label, f"{solved} of {count}", f"{median_error:.2g}", f"{time_each:.0f}"]
        )
    return rows


def _pose_error(pose: Array, second: Array) -> Array:
    turn = pose[:3, :3].T @ second[:3, :3]
    angle = np.arctan2(
        np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]),
        np.trace(turn) - 1,
    )
    return np.array([float(np.linalg.norm(pose[:3, 3] - second[:3, 3])), float(angle)])


def _ours(robot: ArmHand, targets: dict[str, Array]) -> Callable[[int], Array]:
    solver = ik.Solver(robot)
    hands = [motor for side in robot.description.sides for motor in side.hand]
    posture = {motor: float(robot.home[robot.actuators.index(motor)]) for motor in hands}
    last = robot.home

    def solve(i: int) -> Array:
        nonlocal last
        palms = {side: poses[i] for side, poses in targets.items()}
        last = solver.solve(ik.Grasp(palm=palms, posture=posture), q0=last).q
        return last

    return solve


class TeleoperationNlp:
    """The program that xr_teleoperate gives to Ipopt for two arms, with its weights and options.

    Costs are 50 of squared position, 1 of squared rotation vector, 0.02 of squared joints and 0.1
    of squared change; at most 30 iterations, tolerance 1e-6 (robot_arm_ik.py of unitreerobotics).
    The first guess is the last answer.
    """

    def __init__(self, robot: ArmHand, arm_motors: list[int], targets: dict[str, Array]) -> None:
        self.robot, self.moved_motors, self.targets = robot, arm_motors, targets
        x, last = ca.SX.sym("x", len(arm_motors)), ca.SX.sym("last", len(arm_motors))
        self.last = robot.home[arm_motors]
        q = ca.SX(robot.home)
        q[arm_motors] = x
        links, pose_parameters = actuated(robot.description, q).kinematics.links, []
        cost = 0.02 * ca.sumsqr(x) + 0.1 * ca.sumsqr(x - last)
        for side in robot.description.sides:
            pose = ca.SX.sym(side.name, 3, 4)
            palm = links[side.palm_link].compose(side.palm_placement)
            pose_parameters.append(ca.vec(pose))
            turn = palm.rotation @ pose[:, :3].T
            axis = ca.vertcat(
                turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
            )
            length = ca.sqrt(ca.sumsqr(axis) + 1e-12)
            angle = ca.atan2(length, ca.trace(turn) - 1)
            cost += 50 * ca.sumsqr(palm.origin - pose[:, 3]) + ca.sumsqr(axis / length * angle)
        nlp = {"x": x, "p": ca.vertcat(*pose_parameters, last), "f": cost}
        options = {"max_iter": 30, "tol": 1e-6, "print_level": 0, "sb": "yes"}
        self.solver = ca.nlpsol("nlp", "ipopt", nlp, {"print_time": False, "ipopt": options})

    def __call__(self, i: int) -> Array:
        """Return the configuration nearest to the poses of a row."""
        poses = [self.targets[side.name][i][:3] for side in self.robot.description.sides]
        robot, parameters = (
            self.robot,
            np.concatenate([*(pose.ravel("F") for pose in poses), self.last]),
        )
        solution = self.solver(
            x0=self.last,
            p=parameters,
            lbx=robot.lower[self.moved_motors],
            ubx=robot.upper[self.moved_motors],
        )
        q = robot.home.copy()
        q[self.moved_motors] = self.last = np.array(solution["x"]).ravel()
        return q


class Embodik:
    """embodiK's stepping solver on both wrist frames, from its last answer."""

    STEPS = 20

    def __init__(self, robot: ArmHand, targets: dict[str, Array]) -> None:
        embodik: Any = import_module("embodik")
        self.robot, self.targets = robot, targets
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "body.urdf"
            path.write_text(robot.urdf())
            self.model = embodik.RobotModel(str(path), False)
        self.names = list(self.model.get_joint_names())
        self.solver = embodik.KinematicsSolver(self.model)
        self.sides = robot.description.sides
        for side in self.sides:
            self.solver.add_frame_task(side.name, side.palm_link)
        self.target, self.options = embodik.TaskTarget, embodik.PositionStepOptions()
        self.options.max_steps = self.STEPS
        self.solver.enable_position_limits(True)
        home = robot.joints(robot.home)
        self.last = np.array([float(home[name]) for name in self.names])

    def __call__(self, i: int) -> Array:
        """Return the configuration nearest to the poses of a row."""
        targets = []
        for side in self.sides:
            pose = self.targets[side.name][i] @ np.linalg.inv(side.palm_placement)
            target = self.target()
            # A step closes the whole error.
            target.position_gain = target.orientation_gain = 1 / self.solver.dt
            target.task_name, target.target_pose = side.name, np.asfortranarray(pose)
            targets.append(target)
        solution = self.solver.solve_position_step(self.last, targets, self.options).q_solution
        self.last = solution = np.array(solution)
        q, place = self.robot.home.copy(), {name: j for j, name in enumerate(self.names)}
        for index, motor in enumerate(self.robot.actuators):
            if motor in place:
                q[index] = solution[place[motor]]
        return q
