"""Place a pinched object with an arm without a closed form: near home, upright, in a region.

A nonlinear programme in the arm's joints from random starts around home; the measure that is
minimised: ``|q - home|^2 / n + 5 |object - wished place|^2``.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.forward import actuated
from casadi_ik.model.description import RobotDescription
from grasp_synthesis.fingertip_pinch import TipPinch
from grasp_synthesis.programme import OPTIONS

LIMIT_MARGIN = np.deg2rad(10.0)
STARTS = 12


@dataclass(frozen=True)
class Scene:
    """Desired pose of a held object.

    Attributes:
        low: (3,) corner of where the object's middle may be [m], base frame.
        high: (3,) the opposite corner.
        up: Object axis that points up; None for what has no upright (balls).
        above: Height [m], base frame, that the hand's root and the joints beyond the elbow keep.
    """

    low: Array
    high: Array
    up: tuple[float, float, float] | None
    above: float


def hold(
    robot: RobotDescription, root: str, pinch: TipPinch, scene: Scene, rng: np.random.Generator
) -> Array | None:
    """Return the (n,) configuration that holds the object; None if none was found.

    Args:
        robot: The arm-hand.
        root: The hand's root link.
        pinch: Hand and object; they stay as they are to each other.
        scene: Where and how.
        rng: Source of the wished place and the starts.
    """
    columns = list(robot.arm_actuators)
    arm, q = ca.SX.sym("arm", len(columns)), ca.SX(ca.DM(pinch.q))
    for i, column in enumerate(columns):
        q[column] = arm[i]
    links = actuated(robot, q).kinematics.links
    item = links[root].compose(pinch.object_in_hand)
    wished = rng.uniform(scene.low, scene.high)
    equal = ca.SX(0, 1)
    rows = [item.origin - scene.low, scene.high - item.origin]
    if scene.up is not None:
        up = item.rotation @ ca.DM(np.array(scene.up))
        equal = up[:2]
        rows.append(up[2])
    moving = [joint.child for joint in robot.chain(root) if joint.type != "fixed"]
    rows += [links[name].origin[2] - scene.above for name in (*moving[4:], root)]
    home = robot.home[columns]
    cost = ca.sumsqr(arm - home) / len(columns) + 5 * ca.sumsqr(item.origin - wished)
    constraints = ca.vertcat(equal, *rows)
    solver = ca.nlpsol("hold", "ipopt", {"x": arm, "f": cost, "g": constraints}, OPTIONS)
    lower, upper = robot.lower[columns] + LIMIT_MARGIN, robot.upper[columns] - LIMIT_MARGIN
    slack = constraints.numel() - equal.numel()
    best, measure = None, np.inf
    for _ in range(STARTS):
        result = solver(
            x0=np.clip(home + 0.5 * rng.standard_normal(len(columns)), lower, upper),
            lbx=lower,
            ubx=upper,
            lbg=0,
            ubg=np.concatenate([np.zeros(equal.numel()), np.full(slack, np.inf)]),
        )
        if solver.stats()["success"] and float(result["f"]) < measure:
            measure, best = float(result["f"]), pinch.q.copy()
            best[columns] = np.array(result["x"])[:, 0]
    return best
