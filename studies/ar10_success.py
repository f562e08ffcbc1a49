"""How often `hand-first` solves what the AR10 can reach, alone and on Baxter's right arm.

Targets are the contacts of configurations within limits, so all of them are reachable: contacts of
thumb, index and middle finger (or other fingers), the others free. One solve each from home::

    python studies/ar10_success.py                            # 1,000 targets per set
    python studies/ar10_success.py --count 10000 --out studies/results/ar10_success
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import casadi_ik as ik
from casadi_ik.arrays import Array

# (robot, rng, count) -> (count, n) configurations within limits.
Configurations = Callable[[ik.ArmHand, np.random.Generator, int], Array]
FINGERS = ("thumb", "index", "middle")
TOLERANCES = (5e-3, np.deg2rad(3)), (1e-6, 1e-6)
"""Of a contact's place [m] and direction [rad], if not asked otherwise."""
NEAR = 0.01
"""Near a limit: within this part of the range."""


def any_configuration(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Every actuator uniform within its limits."""
    return robot.random(rng, count)


def near_limits(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """Every actuator by itself: a third near its lower limit, a third near its upper one."""
    q = robot.random(rng, count)
    near = rng.uniform(0, NEAR, q.shape) * (robot.upper - robot.lower)
    where = rng.integers(0, 3, q.shape)
    return np.where(where == 0, robot.lower + near, np.where(where == 1, robot.upper - near, q))


def pinches(robot: ik.ArmHand, rng: np.random.Generator, count: int) -> Array:
    """The hands of the shipped pinches, one after the other, on random arms."""
    q = robot.random(rng, count)
    names = ik.shipped_grasps("baxter_ar10")
    for i, name in enumerate(names):
        for actuator, value in ik.load_grasp(name).posture.items():
            q[i :: len(names), robot.actuators.index(actuator)] = value
    return q


SETS: dict[str, tuple[Configurations, Sequence[str]]] = {
    "anywhere": (any_configuration, FINGERS),
    "near limits": (near_limits, FINGERS),
    "shipped pinches": (pinches, FINGERS),
    "anywhere, thumb and index": (any_configuration, FINGERS[:2]),
    "anywhere, thumb alone": (any_configuration, FINGERS[:1]),
    "anywhere, all five fingers": (any_configuration, (*FINGERS, "ring", "little")),
}


def contacts(robot: ik.ArmHand, q: Array, fingers: Sequence[str]) -> tuple[Array, Array]:
    """Targets (k, f, 3): contacts of some fingers [m], NaN for the others."""
    points, normals = robot.contacts(q)
    free = [finger not in fingers for finger in robot.fingers]
    points[:, free], normals[:, free] = np.nan, np.nan
    return points, normals


def tolerance_name(position: float, angle: float) -> str:
    """A tolerance [m, rad] in the units in which it is a plain number."""
    if position < 1e-4:
        return f"{position:.2g} m, {angle:.2g} rad".replace("e-0", "e-")
    return f"{1e3 * position:g} mm, {np.rad2deg(angle):.4g} deg"


def main(arguments: list[str] | None = None) -> None:
    """Solve, print the table and, if asked, write it."""
    parser = argparse.ArgumentParser(description="Success of hand-first on the AR10.")
    parser.add_argument("--count", type=int, default=1000, help="targets per set")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--tolerance",
        type=float,
        nargs=2,
        action="append",
        metavar=("METRES", "RADIANS"),
        help="of a contact's place and direction; may be given several times",
    )
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, help="folder of report.md")
    options = parser.parse_args(arguments)
    table = Table(
        *("robot", "tolerance", "targets", "n", "missed", "solved %", "iterations", "most"),
        "starts, most",
    )
    misses: list[str] = []
    for name in ("baxter_ar10", "ar10"):
        robot = ik.load_robot(name)
        for position, angle in options.tolerance or TOLERANCES:
            label = tolerance_name(position, angle)
            solver = ik.Solver(robot, "hand-first", ik.Tolerance(position, angle))
            for index, (key, (made, fingers)) in enumerate(SETS.items()):
                if made is pinches and not robot.description.arm_actuators:
                    continue  # without an arm they are six targets only
                rng = np.random.default_rng([options.seed, index])
                targets = contacts(robot, made(robot, rng, options.count), fingers)
                batch = solver.solve_batch(*targets, jobs=options.jobs)
                rows = np.flatnonzero(~batch.success)
                misses += [f"{name}, {label}, {key}: {row}" for row in rows]
                table.add_row(
                    *(name, label, key, f"{len(batch):,}", str(len(rows))),
                    f"{100 * batch.success.mean():.2f}",
                    f"{batch.iterations.mean():.1f}",
                    *(str(batch.iterations.max()), str(batch.restarts.max() + 1)),
                )
    Console(width=120).print(table)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "report.md").write_text(report(table, misses, options.seed))


def report(table: Table, misses: list[str], seed: int) -> str:
    """The table and the misses as Markdown."""
    columns = [list(column.cells) for column in table.columns]
    lines = ["# Success of hand-first on the AR10", "", *_INTRODUCTION.strip().split("\n"), ""]
    lines += [f"Seed {seed}.", ""]
    lines.append("| " + " | ".join(str(column.header) for column in table.columns) + " |")
    lines.append("|" + "---|" * len(columns))
    lines += ["| " + " | ".join(map(str, row)) + " |" for row in zip(*columns, strict=True)]
    lines += ["", "Missed targets, by their number in the set:", ""]
    lines += [f"- {miss}" for miss in misses] or ["- none"]
    return "\n".join(lines) + "\n"


_INTRODUCTION = """
All targets are contacts of configurations within limits, hence reachable; one solve each from home.
*Solved:* every contact within the tolerance, every actuator and joint within its limits, recomputed
from the answer by forward kinematics. *Anywhere:* every actuator uniform within its limits. *Near
limits:* every actuator by itself within 1 % of its range of the lower limit, of the upper one, or
anywhere, a third each. *Shipped pinches:* the hand posture of a shipped grasp on a uniformly random
arm. Contacts of thumb, index and middle finger, unless said otherwise; the other fingers are free.
*Starts:* hand postures tried until the contacts were met.
"""


if __name__ == "__main__":
    main()
