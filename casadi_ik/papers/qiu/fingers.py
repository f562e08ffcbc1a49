"""Inverse kinematics of the fingers besides the thumb (Qiu & Kermani 2021, eqs. 4 and 5).

Equation (4): the desired normal determines the spread and the sum of the flexions. Equation (5):
for this spread and sum, the flexions minimise the distance of the contact point to its target,
within limits. Two solvers of eq. (5) give the same result: Ipopt on the constrained minimisation of
the paper, and a closed form, because the contact moves on a circle if the sum is constant.

The paper leaves two points open. Fingers that share a spread motor use the mean of their demands,
weighted by the squared length of the demanded normal's component across the spread axis (the error
of the normal per unit error of the spread). A demand outside the limits is replaced by the nearest
attainable normal. A normal permits two spreads that differ by half a turn; the chosen one has the
pad on the side that it faces in the middle of its flexion range (for the Barrett hand: flexion sums
up to 140 of 188 deg).

These equations hold for fingers that spread about one axis and flex in a plane, which are
recognised from their kinematics. Such a finger has, starting at the palm, at most one spread joint
and then two parallel flexion joints with axes perpendicular to the spread axis, and its pad normal
lies in the flexion plane. Its normal depends only on the spread and the sum of the flexions.
Angles and vectors are in the *finger frame*, which is fixed in the palm: z along the spread axis, y
along the flexion axis at zero spread, origin on the spread axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from casadi_ik.errors import UnsupportedError
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.contacts import Target
from casadi_ik.kinematics.forward import forward, number
from casadi_ik.kinematics.smooth import Expr
from casadi_ik.model.description import RobotDescription
from casadi_ik.model.joints import Joint

ALIGNED = 1e-9
"""Largest deviation of an inner product of unit vectors that counts as aligned."""


@dataclass(frozen=True, eq=False)
class PlanarFinger:
    """Constants of a planar finger.

    Attributes:
        name: Name of the finger.
        spread_motor: Index in q of the spread actuator; None without spread.
        ratio: Spread joint angle per unit of its actuator.
        offset: Spread joint angle at actuator position 0 [rad].
        spread_limits: (2,) limits of the spread joint [rad]; zeros without spread.
        flexion: Indices in q of the two flexion actuators, proximal first.
        flexion_limits: (2, 2) lower and upper limit of each flexion joint [rad].
        frame: (4, 4) pose of the finger frame in the palm frame.
        normal_angle: Angle a_0 of the pad normal from z towards x at zero flexion [rad].
        proximal: (3,) point on the first flexion axis in the finger frame [m].
        middle: (3,) vector from this point to the second flexion axis at zero flexion [m].
        tip: (3,) vector from the second flexion axis to the contact at zero flexion [m].
        facing: +1 if the pad faces +x of the finger frame in its flexion range, else -1.
    """

    name: str
    spread_motor: int | None
    ratio: float
    offset: float
    spread_limits: Array
    flexion: tuple[int, int]
    flexion_limits: Array
    frame: Array
    normal_angle: float
    proximal: Array
    middle: Array
    tip: Array
    facing: float


def planar_finger(robot: RobotDescription, name: str) -> PlanarFinger:
    """Recognise a planar finger.

    Args:
        robot: Description of the robot.
        name: Name of the finger.

    Raises:
        UnsupportedError: The finger is not planar; the message states the difference.
    """
    joints = {joint.name: joint for joint in robot.movable}
    chain = [joints[joint] for joint in robot.finger(name).joints]
    context = f"robot {robot.name!r}: finger {name!r} is not a planar finger"
    if len(chain) not in (2, 3) or any(joint.type != "revolute" for joint in chain):
        raise UnsupportedError(
            f"{context}: it has joints {[joint.name for joint in chain]}; expected an optional "
            "spread joint and two flexion joints, all revolute"
        )
    flexion = chain[-2:]
    for joint in flexion:
        if joint.coupling is not None:
            raise UnsupportedError(
                f"{context}: {joint.name} follows {joint.coupling.of!r}; expected a separate motor"
            )
    origins, axes, contact, normal = _reference(robot, name, chain)
    y = axes[-2]
    spread_joint = chain[0] if len(chain) == 3 else None
    z = axes[0] if spread_joint else _perpendicular_direction(normal, y)
    if abs(y @ axes[-1] - 1) > ALIGNED or abs(y @ z) > ALIGNED or abs(y @ normal) > ALIGNED:
        raise UnsupportedError(f"{context}: its flexion axes are not parallel or not in plane")
    x = np.cross(y, z)
    to_finger = np.stack([x, y, z])
    frame = np.eye(4)
    frame[:3, :3] = to_finger.T
    frame[:3, 3] = origins[0] if spread_joint else origins[-2]
    a_0 = float(np.arctan2(normal @ x, normal @ z))
    limits = np.array([[joint.lower, joint.upper] for joint in flexion])
    index, ratio, offset = _spread_actuator(robot, spread_joint, context)
    return PlanarFinger(
        name=name,
        spread_motor=index,
        ratio=ratio,
        offset=offset,
        spread_limits=np.array(
            [spread_joint.lower, spread_joint.upper] if spread_joint else [0.0, 0.0]
        ),
        flexion=(
            robot.actuator_index(flexion[0].name),
            robot.actuator_index(flexion[1].name),
        ),
        flexion_limits=limits,
        frame=frame,
        normal_angle=a_0,
        proximal=to_finger @ (origins[-2] - frame[:3, 3]),
        middle=to_finger @ (origins[-1] - origins[-2]),
        tip=to_finger @ (contact - origins[-1]),
        facing=1.0 if np.sin(a_0 + limits.sum() / 2) >= 0 else -1.0,
    )


def _spread_actuator(
    robot: RobotDescription, joint: Joint | None, context: str
) -> tuple[int | None, float, float]:
    """Return the index of the actuator of a spread joint, and ratio and offset of the joint."""
    if joint is None:
        return None, 1.0, 0.0
    if joint.coupling is None:
        return robot.actuator_index(joint.name), 1.0, 0.0
    coupling = joint.coupling
    if coupling.slope is None or coupling.of not in robot.actuator_names:
        raise UnsupportedError(f"{context}: {joint.name} does not follow a motor linearly")
    return robot.actuator_index(coupling.of), *coupling.slope


def _reference(
    robot: RobotDescription, name: str, chain: list[Joint]
) -> tuple[list[Array], list[Array], Array, Array]:
    """Return origins and axes of the chain, contact and normal at theta = 0, in the palm frame."""
    kinematics = forward(robot, ca.SX.zeros(len(robot.movable), 1))
    palm = kinematics.palm
    point, normal = kinematics.contact(name)
    points = [kinematics.links[joint.child].origin for joint in chain] + [point]
    directions = [kinematics.axes[joint.name] for joint in chain] + [normal]
    p_palm = [number(palm.inverse_apply(point)) for point in points]
    d_palm = [number(palm.rotation.T @ direction) for direction in directions]
    return p_palm[:-1], d_palm[:-1], p_palm[-1], d_palm[-1]


def _perpendicular_direction(normal: Array, y: Array) -> Array:
    """Return a direction perpendicular to the flexion axis, for a finger without spread."""
    z = normal - (normal @ y) * y
    return z / np.linalg.norm(z)


CURRENT_SPREAD_WEIGHT = 1e-12
"""Weight of the current spread, which decides only if no normal determines the spread."""

IPOPT_OPTIONS = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "print_time": False,
    "ipopt.tol": 1e-12,
    "ipopt.compl_inf_tol": 1e-12,
    "ipopt.constr_viol_tol": 1e-12,
    "ipopt.dual_inf_tol": 1e-10,
    "ipopt.mu_init": 1e-6,
    "ipopt.mu_target": 0.0,
    "ipopt.bound_relax_factor": 1e-12,
    "ipopt.honor_original_bounds": "yes",
    "ipopt.max_iter": 200,
    "error_on_fail": False,
}


@dataclass(frozen=True, eq=False)
class Demand:
    """Result of eq. (4) for one finger: the target of eq. (5).

    Attributes:
        finger: Constants of the finger.
        spread_angle: Spread joint angle [rad], scalar.
        flexion_sum: Sum of the flexions [rad], scalar, attainable within limits.
        reach: (2, 1) desired position of the second flexion axis relative to the first in the
            flexion plane: components along z and x of the finger frame [m].
        first_limits: (2, 1) limits of the first flexion that keep the second within its limits.
    """

    finger: PlanarFinger
    spread_angle: Expr
    flexion_sum: Expr
    reach: Expr
    first_limits: Expr


def demands(
    robot: RobotDescription,
    fingers: Sequence[PlanarFinger],
    q: Expr,
    goals: dict[str, Target],
) -> list[Demand]:
    """Return the results of eq. (4) for every finger.

    Args:
        robot: Description of the robot.
        fingers: Fingers to close.
        q: (n, 1) current actuator positions.
        goals: Targets in the palm frame.
    """
    local = [_in_finger_frame(finger, goals[finger.name]) for finger in fingers]
    spreads = _spreads(robot, fingers, q, local)
    return [
        _demand(finger, goal, angle)
        for finger, goal, angle in zip(fingers, local, spreads, strict=True)
    ]


def closed_form(demand: Demand) -> tuple[Expr, Expr]:
    """Return the two flexions [rad] that solve eq. (5) in closed form.

    The second axis moves on a circle about the first. The point of the circle nearest to `reach` is
    in its direction, and the distance increases with the angle from there, so that the solution
    within limits is the clamped angle.
    """
    z, x = float(demand.finger.middle[2]), float(demand.finger.middle[0])
    angle = ca.atan2(
        z * demand.reach[1] - x * demand.reach[0], z * demand.reach[0] + x * demand.reach[1]
    )
    lower, upper = demand.first_limits[0], demand.first_limits[1]
    middle = (lower + upper) / 2
    first = clamp(middle + wrap(angle - middle), lower, upper)
    return first, demand.flexion_sum - first


class IpoptFinger:
    """Solver of eq. (5) for one finger by Ipopt with exact Hessian and lengths in millimetres.

    The opposite side of the circle is a second local minimum if it is within the limits. Ipopt
    therefore starts from the best one of the ends and the middle of the range.
    """

    def __init__(self, finger: PlanarFinger) -> None:
        """Build the program in the two flexions, with sum and reach of a `Demand` as parameters."""
        x = ca.SX.sym("flexion", 2)
        p = ca.SX.sym("p", 3)
        flexion_sum, reach = p[0], p[1:]
        program = {
            "x": x,
            "p": p,
            "f": _squared_distance(finger, x[0], reach),
            "g": x[0] + x[1] - flexion_sum,
        }
        name = ca.Function.fix_name(f"finger_{finger.name}")
        self._solver = ca.nlpsol(name, "ipopt", program, IPOPT_OPTIONS)
        self._limits = finger.flexion_limits

    def __call__(self, demand: Demand) -> tuple[Expr, Expr]:
        """Return the two flexions [rad] for a demand of MX or DM."""
        solution = self._solver(
            x0=_best_start(demand),
            p=ca.vertcat(demand.flexion_sum, demand.reach),
            lbx=self._limits[:, 0],
            ubx=self._limits[:, 1],
            lbg=0,
            ubg=0,
        )
        return solution["x"][0], solution["x"][1]


def _squared_distance(finger: PlanarFinger, first: Expr, reach: Expr) -> Expr:
    """Return the objective of eq. (5) [mm^2] as a function of the first flexion [rad]."""
    z, x = float(finger.middle[2]), float(finger.middle[0])
    c, s = ca.cos(first), ca.sin(first)
    position = ca.vertcat(c * z - s * x, s * z + c * x)
    return ca.sumsqr((position - reach) * 1e3)


def _best_start(demand: Demand) -> Expr:
    """Return the best flexions (2, 1) for the ends and the middle of the first one's range."""
    lower, upper = demand.first_limits[0], demand.first_limits[1]
    best, min_distance = lower, _squared_distance(demand.finger, lower, demand.reach)
    for first in ((lower + upper) / 2, upper):
        distance = _squared_distance(demand.finger, first, demand.reach)
        best = ca.if_else(distance < min_distance, first, best)
        min_distance = ca.fmin(distance, min_distance)
    return ca.vertcat(best, demand.flexion_sum - best)


def planar_fingers(robot: RobotDescription) -> list[PlanarFinger]:
    """Return the fingers that the step closes: all fingers except the thumb.

    Raises:
        UnsupportedError: A finger is not planar; the message states the difference.
    """
    return [planar_finger(robot, name) for name in robot.finger_names if name != robot.thumb]


def finger_step_function(robot: RobotDescription, solver: str) -> ca.Function:
    """Return the finger step as a Function that step graphs call.

    Args:
        robot: Description of a robot whose fingers except the thumb are planar.
        solver: "ipopt" or "closed-form".

    Returns:
        ``(q (n, 1), points (3, k), normals (3, k)) -> q' (n, 1)`` with the targets of the fingers
        except the thumb, in order, in the palm frame.

    Raises:
        UnsupportedError: A finger is not planar.
    """
    fingers = planar_fingers(robot)
    kind: Any = ca.MX if solver == "ipopt" else ca.SX
    q = kind.sym("q", len(robot.actuators))
    points = kind.sym("points", 3, len(fingers))
    normals = kind.sym("normals", 3, len(fingers))
    goals = {finger.name: Target(points[:, i], normals[:, i]) for i, finger in enumerate(fingers)}
    entries = [q[i] for i in range(q.numel())]
    for demand in demands(robot, fingers, q, goals):
        finger = demand.finger
        if solver == "ipopt":
            first, second = IpoptFinger(finger)(demand)
        else:
            first, second = closed_form(demand)
        entries[finger.flexion[0]], entries[finger.flexion[1]] = first, second
        if finger.spread_motor is not None:
            entries[finger.spread_motor] = (demand.spread_angle - finger.offset) / finger.ratio
    return ca.Function(
        "finger_step",
        [q, points, normals],
        [ca.vertcat(*entries)],
        ["q", "points", "normals"],
        ["q_next"],
    )


def clamp(value: Expr, lower: Expr, upper: Expr) -> Expr:
    """Return a value clipped to [lower, upper]."""
    return ca.fmin(ca.fmax(value, lower), upper)


def wrap(angle: Expr) -> Expr:
    """Return an angle wrapped to [-pi, pi] [rad]."""
    return ca.atan2(ca.sin(angle), ca.cos(angle))


def _in_finger_frame(finger: PlanarFinger, goal: Target) -> Target:
    """Return a target of the palm frame in the finger frame."""
    rotation = ca.DM(finger.frame[:3, :3].T)
    origin = ca.DM(finger.frame[:3, 3])
    return Target(rotation @ (goal.point - origin), rotation @ goal.normal)


def _spreads(
    robot: RobotDescription,
    fingers: Sequence[PlanarFinger],
    q: Expr,
    local: Sequence[Target],
) -> list[Expr]:
    """Return the spread angle of every finger; fingers on one motor share one angle."""
    angles: dict[int, Expr] = {}
    for motor in {finger.spread_motor for finger in fingers if finger.spread_motor is not None}:
        weighted_sum, sum_of_weights = CURRENT_SPREAD_WEIGHT * q[motor], CURRENT_SPREAD_WEIGHT
        lower, upper = _spread_range(robot, fingers, motor)
        for finger, goal in zip(fingers, local, strict=True):
            if finger.spread_motor == motor:
                middle = float(finger.spread_limits.mean())
                azimuth = ca.atan2(finger.facing * goal.normal[1], finger.facing * goal.normal[0])
                angle = middle + wrap(azimuth - middle)
                weight = goal.normal[0] ** 2 + goal.normal[1] ** 2
                weighted_sum += weight * (angle - finger.offset) / finger.ratio
                sum_of_weights += weight
        angles[motor] = clamp(weighted_sum / sum_of_weights, lower, upper)
    return [
        0.0
        if finger.spread_motor is None
        else finger.ratio * angles[finger.spread_motor] + finger.offset
        for finger in fingers
    ]


def _spread_range(
    robot: RobotDescription, fingers: Sequence[PlanarFinger], motor: int
) -> tuple[float, float]:
    """Return limits of a spread motor that keep it and all its joints within their limits."""
    lower, upper = float(robot.lower[motor]), float(robot.upper[motor])
    for finger in fingers:
        if finger.spread_motor == motor:
            limits = (finger.spread_limits - finger.offset) / finger.ratio
            lower, upper = max(lower, float(limits.min())), min(upper, float(limits.max()))
    return lower, upper


def _demand(finger: PlanarFinger, goal: Target, spread_angle: Expr) -> Demand:
    """Return the attainable flexion sum closest to the normal, and the reach for eq. (5)."""
    c, s = ca.cos(spread_angle), ca.sin(spread_angle)
    (low_1, high_1), (low_2, high_2) = finger.flexion_limits
    normal_x = c * goal.normal[0] + s * goal.normal[1]
    middle = (low_1 + low_2 + high_1 + high_2) / 2
    angle = ca.atan2(normal_x, goal.normal[2]) - finger.normal_angle
    flexion_sum = clamp(middle + wrap(angle - middle), low_1 + low_2, high_1 + high_2)
    x = c * goal.point[0] + s * goal.point[1] - finger.proximal[0]
    z = goal.point[2] - finger.proximal[2]
    c, s = ca.cos(flexion_sum), ca.sin(flexion_sum)
    tip_z, tip_x = float(finger.tip[2]), float(finger.tip[0])
    # Rotation about +y by the flexion takes z towards x.
    reach = ca.vertcat(z - (c * tip_z - s * tip_x), x - (s * tip_z + c * tip_x))
    limits = ca.vertcat(ca.fmax(low_1, flexion_sum - high_2), ca.fmin(high_1, flexion_sum - low_2))
    return Demand(finger, spread_angle, flexion_sum, reach, limits)
