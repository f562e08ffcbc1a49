"""How often a method solves the shipped grasps with the arm anywhere: a small study.

For every shipped grasp the hand keeps its posture and the arm is drawn uniformly within its
limits; forward kinematics gives targets that are reachable by construction (Qiu & Kermani 2021,
section III). Every target is solved from the robot's home, once::

    python studies/random_arms.py                          # 100 arm configurations per grasp
    python studies/random_arms.py --count 1000 --seed 7 --method enhanced-dls
"""

from __future__ import annotations

import argparse

import numpy as np
from rich.console import Console
from rich.table import Table

import casadi_ik as ik


def random_arm_targets(
    robot: ik.ArmHand, names: tuple[str, ...], count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Targets of the grasps' hand postures with random arms.

    Args:
        robot: The robot.
        names: Shipped grasps.
        count: Arm configurations per grasp.
        rng: Source of the arm configurations.

    Returns:
        points [m] and normals, (len(names) * count, f, 3), grasp by grasp.
    """
    q = robot.random(rng, len(names) * count)
    for i, name in enumerate(names):
        for actuator, value in ik.load_grasp(name).posture.items():
            q[i * count : (i + 1) * count, robot.actuators.index(actuator)] = value
    return robot.contacts(q)


def main(arguments: list[str] | None = None) -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description="Success on random arm configurations.")
    parser.add_argument("--count", type=int, default=100, help="arm configurations per grasp")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--method", default="enhanced-dls", choices=ik.METHODS)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args(arguments)
    robot = ik.load_robot("kuka_lwr_barrett")
    names = ik.shipped_grasps(robot.name)
    rng = np.random.default_rng(options.seed)
    points, normals = random_arm_targets(robot, names, options.count, rng)
    results = {}
    for limits in ("ignore", "enforce"):
        finger_step = "closed-form" if options.method.startswith("enhanced") else None
        solver = ik.Solver(robot, options.method, limits=limits, finger_step=finger_step)
        results[limits] = solver.solve_batch(points, normals, jobs=options.jobs)
    table = Table(title=f"{options.method}, {options.count} arm configurations per grasp")
    for heading in ("grasp", "solved %", "iterations", "solved % within limits", "iterations "):
        table.add_column(heading, justify="left" if heading == "grasp" else "right")
    groups = [
        (name, slice(i * options.count, (i + 1) * options.count)) for i, name in enumerate(names)
    ]
    for name, rows in [*groups, ("all", slice(None))]:
        cells = []
        for batch in results.values():
            solved = batch.success[rows]
            mean = batch.iterations[rows][solved].mean() if solved.any() else float("nan")
            cells += [f"{100 * solved.mean():.1f}", f"{mean:.0f}"]
        table.add_row(name, *cells, end_section=name == names[-1])
    Console().print(table)


if __name__ == "__main__":
    main()
