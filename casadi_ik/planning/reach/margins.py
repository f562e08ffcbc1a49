"""Margins of a palm pose: graphs that are >= 0 if and only if the arm reaches it.

A branch of a closed-form arm exists if its reach margin is >= 0, and is usable if every joint is
within its limits, which is an inequality of the direction of the joint. The margin of a branch is
the smallest of these numbers. The margin of a palm pose at a value of the redundancy parameter is
the largest margin of its branches.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from casadi_ik.compile import FunctionKernel
from casadi_ik.compile.graphs import FunctionGraph, recipe
from casadi_ik.files.arrays import Array
from casadi_ik.kinematics.arms.family import ArmFamily, ClosedForm
from casadi_ik.kinematics.arms.screws import Screws, arm_screws, clipped_directions
from casadi_ik.kinematics.arms.search import Farthest
from casadi_ik.kinematics.forward import Pose
from casadi_ik.kinematics.intervals import interval_function
from casadi_ik.kinematics.smooth import Expr, with_cse
from casadi_ik.model.description import RobotDescription
from casadi_ik.solve.proofs.premises import LIMIT_MARGIN

MARGIN_SHAPES = {"rotation": (3, 3), "origin": (3, 1), "redundancy": (1, 1), "base": (4, 1)}
"""Shapes of the inputs of a margin; the base is x, y, z [m] and yaw [rad]."""


DISTANCE_ROUNDING = 1e-9
"""Distance from the workspace that may be due to rounding [m]."""


def pose_in_base(rotation: Expr, origin: Expr, base: Expr) -> Pose:
    """Return a pose in the frame of a base at x, y, z [m] and yaw [rad]."""
    cosine, sine = ca.cos(base[3]), ca.sin(base[3])
    upright = ca.SX(3, 3)
    upright[0, 0], upright[0, 1] = cosine, sine
    upright[1, 0], upright[1, 1] = -sine, cosine
    upright[2, 2] = 1
    return Pose(upright @ rotation, upright @ (origin - base[:3]))


def margin_function(
    family: ClosedForm,
    name: str,
    limits: tuple[Array, Array],
    has_base: bool = False,
    has_distance: bool = False,
) -> ca.Function:
    """Return the function of the margin of a palm pose within joint limits (n,) [rad].

    Args:
        family: Family of the arm.
        name: Name of the function.
        limits: Lower and upper limits (n,) of the joints [rad].
        has_base: Whether the pose of the base is another input.
        has_distance: Whether the margin is negative where the family bounds the distance from the
            workspace, at every value of the redundancy parameter, which intervals exploit.

    Returns:
        (rotation (3, 3), origin (3, 1) [m], redundancy [rad]) -> margin. With `has_base` there is
        another input (4, 1), the pose of the arm's base.
    """
    symbols = {key: ca.SX.sym(key, *shape) for key, shape in MARGIN_SHAPES.items()}
    palm = Pose(symbols["rotation"], symbols["origin"])
    if has_base:
        palm = pose_in_base(palm.rotation, palm.origin, symbols["base"])
    else:
        del symbols["base"]
    with clipped_directions():
        bends = family.bends(palm, symbols["redundancy"])
    margin = ca.mmax(ca.vertcat(*(bend.limit_margin(*limits) for bend in bends)))
    if has_distance:
        distance = family.distance_out_of_reach(palm, *map(ca.DM, limits))
        if distance is not None:
            margin = ca.fmin(margin, DISTANCE_ROUNDING - ca.fabs(distance))
    outputs = with_cse(margin)
    return ca.Function(name, list(symbols.values()), outputs, list(symbols), ["margin"])


class MarginKernels:
    """Kernels of the margin of one arm: on numbers and on intervals, and its best configuration.

    Attributes:
        value: Margin of a palm pose, see `margin_function`.
        bounds: Bounds of the margin for limits that are widened by `LIMIT_MARGIN`.
        best_arm: (redundancy, rotation, origin, lower, upper, near) -> the arm farthest from its
            limits [rad], and its limit margin [rad].
    """

    def __init__(
        self,
        robot: RobotDescription,
        family: ClosedForm,
        limits: tuple[Array, Array],
        compiled: bool = True,
        has_base: bool = False,
    ) -> None:
        """Build the kernels.

        Args:
            robot: Description of the robot.
            family: Family of its arm.
            limits: Lower and upper limits (n,) of the arm [rad].
            compiled: Whether the kernels are compiled.
            has_base: Whether the margins have the pose of the base as another input.
        """
        shapes = dict(MARGIN_SHAPES) if has_base else dict(list(MARGIN_SHAPES.items())[:3])
        name = ca.Function.fix_name(f"{robot.name}_{'base' if has_base else 'reach'}_margin")
        hashed = recipe(name, robot, limits)
        wide = limits[0] - LIMIT_MARGIN, limits[1] + LIMIT_MARGIN

        def bounds() -> ca.Function:
            return interval_function(margin_function(family, name, wide, has_base, True))

        interval_shapes = {
            f"{side}_{k}": s for side in ("lower", "upper") for k, s in shapes.items()
        }
        self.value = FunctionKernel(
            FunctionGraph(
                name,
                lambda: margin_function(family, name, limits, has_base),
                shapes,
                ((1, 1),),
                hashed,
            ),
            compiled,
            in_lanes=True,
        )
        interval_name = f"{name}_interval"
        self.bounds = FunctionKernel(
            FunctionGraph(interval_name, bounds, interval_shapes, ((1, 1), (1, 1)), hashed),
            compiled,
            in_lanes=True,
        )
        n = len(family.screws)
        arm_name = ca.Function.fix_name(f"{robot.name}_reach_arm")
        best_shapes = {"redundancy": (1, 1), "rotation": (3, 3), "origin": (3, 1)}
        best_shapes |= {"lower": (n, 1), "upper": (n, 1), "near": (n, 1)}
        self.best_arm = FunctionKernel(
            FunctionGraph(
                arm_name,
                lambda: family.best(arm_name, Farthest()),
                best_shapes,
                ((n, 1), (1, 1)),
                recipe(arm_name, robot),
            ),
            compiled,
            in_lanes=True,
        )


def model_deviation(robot: RobotDescription, family: ArmFamily) -> float:
    """Return a bound of the deviation of the palm of the family's arm from the real one.

    Returns:
        Bound of the distance [m] and of the rotation [rad] at every configuration.
    """
    real, nominal = arm_screws(robot), family.screws
    if nominal.reverse:
        nominal = nominal.reversed()
    tilt = np.linalg.norm(real.axes - nominal.axes, axis=1)
    offsets = np.cross(nominal.points - real.points, real.axes)
    miss = np.linalg.norm(offsets, axis=1)
    end = np.linalg.norm(real.rotation - nominal.rotation) + np.linalg.norm(
        real.origin - nominal.origin
    )
    # A rotation about a tilted axis differs by at most twice the tilt times the lever.
    lever = 1.0 + _length(real)
    return float(2 * (tilt.sum() * lever + miss.sum()) + end * lever)


def _length(screws: Screws) -> float:
    """Return the length of the polyline through the joints and the palm [m]."""
    points = np.vstack([screws.points, screws.origin])
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
