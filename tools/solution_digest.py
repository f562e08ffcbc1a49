"""Digests of solutions, to compare installations bit by bit.

    python tools/solution_digest.py ROBOT...

prints a line per robot: its name, the SHA-256 of the solutions of seeded targets, and how many are
solved. The environment variable CASADI_IK_COMPILE is set to "wait", so that compiled code solves.
A robot without compiled code is an error.
"""

from __future__ import annotations

import hashlib
import os
import sys
import warnings

os.environ.setdefault("CASADI_IK_COMPILE", "wait")

import numpy as np

import casadi_ik as ik

TARGETS = 500


def digest(name: str) -> str:
    """Return the line of a robot."""
    robot = ik.load_robot(name)
    points, normals = robot.contacts(robot.random(np.random.default_rng(0), TARGETS))
    solutions = ik.Solver(robot).solve_batch(points, normals)
    content = hashlib.sha256(solutions.q.tobytes()).hexdigest()
    return f"{name} {content} {int(solutions.success.sum())}"


if __name__ == "__main__":
    # Without compiled code the package warns.
    warnings.simplefilter("error", RuntimeWarning)
    for robot_name in sys.argv[1:]:
        print(digest(robot_name), flush=True)
