"""Why a path is lost: followed again by motors that may be faster."""

from __future__ import annotations

from typing import Any

import numpy as np
from runner import markdown_table

import casadi_ik as ik
from casadi_ik.arrays import Array
from moving_study.one_path import PERIOD, SHARE, STEPS
from moving_study.paths import smooth_path

FASTER = ((1.0, 10.0), (3.0, 10.0))
"""Times the velocity and the acceleration limits."""

TEXT = """The paths that are not wholly within tolerance, followed again with the same code by
motors that may be faster. A robot has more motors than a grasp needs, so it follows in another
posture than the one that made the path, and there the motors may need more than the path's own did.
*Largest difference:* of a motor of the arm from the path's own posture, when it is lost.
"""


def again(solver: ik.Solver, number: int) -> dict[str, Any]:
    """A lost path with other limits: the shares of cycles within tolerance.

    Args:
        solver: On the robot.
        number: Of the path.
    """
    robot = solver.robot
    path = smooth_path(robot, number, STEPS, PERIOD, SHARE)
    points, normals = robot.contacts(path)
    usual = solver.follow(path[0], PERIOD)
    met = _met(robot, usual, points, normals)
    shares, first = [], int(np.argmin(met[0])) if not met[0].all() else -1
    for velocity, acceleration in FASTER:
        more = solver.follow(
            path[0],
            PERIOD,
            velocity=velocity * usual.velocity,
            acceleration=acceleration * usual.acceleration,
        )
        shares.append(float(_met(robot, more, points, normals)[0].mean()))
    arm = list(robot.description.arm_actuators)
    off = float(np.abs(met[1][first] - path[first])[arm].max()) if first >= 0 else 0.0
    return {
        "number": number,
        "met": float(met[0].mean()),
        "first": first,
        "off": off,
        "faster": shares,
    }


def _met(
    robot: ik.ArmHand, follower: ik.Follower, points: Array, normals: Array
) -> tuple[Array, Array]:
    """(k,) whether each cycle is within tolerance, and (k, n) where the motors were."""
    q = np.array([follower(*target) for target in zip(points, normals, strict=True)])
    position, angle = robot.errors(q, points, normals)
    return ((position <= 5e-3) & (angle <= np.radians(3))).all(axis=1), q


def lost_table(
    found: dict[str, list[dict[str, Any]]], rows: dict[str, list[dict[str, Any]]]
) -> str:
    """The table of the paths that are lost.

    Args:
        found: What `again` gave, by robot.
        rows: The figures of all paths, by robot.
    """
    singular = {(r, row["number"]): row["singular"] for r, some in rows.items() for row in some}
    table = [
        [
            robot,
            str(one["number"]),
            f"{1e3 * PERIOD * one['first']:.0f}" if one["first"] >= 0 else "-",
            f"{100 * one['met']:.1f}",
            f"{np.degrees(one['off']):.0f}",
            "yes" if singular[robot, one["number"]] else "no",
            *(f"{100 * share:.1f}" for share in one["faster"]),
        ]
        for robot, some in found.items()
        for one in some
    ]
    heads = ["robot", "path", "lost at [ms]", "within tolerance %", "largest difference [deg]"]
    heads += ["near a singular arm", "accelerations x10 %", "velocities x3 too %"]
    return markdown_table(heads, table)
