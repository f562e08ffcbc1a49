"""From a surface to grasps that arm and hand can make: how many, how fast, and why there are none.

Every object stands, lies and stands on end on the table, half a metre before the arm; every grasp
that is found is given to `Solver.solve` in the scene once more, and some are checked by other means
(trimesh's distances, linear programs of SciPy). What is done is kept: a run that is stopped goes on
where it was::

    python studies/touch.py --minutes 40
    python studies/touch.py --robots panda+allegro_right --objects cup mug --limit 200
    python studies/touch.py --objects tennis_ball ycb/*.obj more/*.stl

The committed report has meshes of other packages, in metres: the google_16k scans of
elpis-lab/ycb_dataset, bottle, bread, can, lemon and milk of robosuite, and the first 25 of
pybullet_data/random_urdfs, scaled by 0.015 as these files say.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from runner.figures import RESULTS
from runner.parts import add_part_options, complete_parts
from runner.report import (
    Metric,
    command,
    markdown_table,
    median_metric,
    program,
    publish,
    rate_metric,
)
from runner.study import robot_of, standing
from scipy.optimize import linprog

import casadi_ik as ik

ROBOTS = (
    "panda+allegro_right",
    "ur5e+shadow",
    "panda+leap",
    "kuka_lwr_barrett",
    "panda+unitree_dex3",
    "panda+panda_hand",
    "ur10e+robotiq_2f85",
)
POSES = ((0, 0.0), (1, 0.7), (2, 2.1))
"""An object's axis that is up (z, y or x), and its yaw on the table [rad]."""

CHECKED = 5
"""Number of grasps of an object at a pose that independent code checks."""

MU, PATCH, EDGES = 0.5, 0.005, 16
"""Friction, radius of a soft contact [m], edges of its cone."""

INTRODUCTION = """
{objects} objects on the table, each at three poses (upright, on its side, on its end; yaws of 0, 40
and 120 deg), 0.5 m before the arm's base and 0.1 m aside: {names}. Asked for are {limit} distinct,
force-closed grasps (friction 0.5) of as many fingertips as the hand has, three at most. *None*:
objects at poses at which nothing is found. *First*: time until one grasp is found, the object's
scene being made. *A second*: grasps by the time of all that were found. *Confirmed*:
`Solver.solve` in the scene, from the posture found, solves the grasp. *Off*: the largest distance
of a pad from the triangles, by trimesh, of {checked} grasps each. *Closed*: those of them whose
linear program, with normals of these triangles and soft contacts, says so. Times are processor
times of one thread of this machine, other programs beside it.
"""


DISCUSSION = """
*Rate*: a third to a half of the time is spent on sampling hands, the remainder on refining grasps
and on the arm. The Barrett hand has seven motors and little freedom once three fingertips touch:
three of four such hands do not reach the surface, and a fifth of the others are distinct and
force-closed. On the irregular shapes of random_urdfs it yields a tenth of the grasps that it
yields on other objects. The capsules of LEAP exceed its fingers by 14 to 19 mm, so that they
seldom fit next to each other. Flat and small round objects leave little space for a third finger.
*None*: objects that are wider than the opening of the hand, too small for three fingers, or that
can only be grasped from a side where palm or fingers would be in the object or the table.
*Closed*: on round objects the normals of the nearest triangle and of the nearest sample differ by
some degrees, which decides marginal cases.
"""


@dataclass(frozen=True)
class Cell:
    """A robot, an object and a pose of it.

    Attributes:
        robot: Its name.
        object: Name, or path of a mesh.
        pose: Number of the pose.
        limit: How many grasps are asked for.
        seed: Of all random numbers.
    """

    robot: str
    object: str
    pose: int
    limit: int
    seed: int
    size: int = 1

    @property
    def path(self) -> Path:
        """Path of its results."""
        settings = f"{self.pose}-{self.limit}-{self.seed}.json"
        return Path(self.robot) / Path(self.object).stem / settings


@cache
def solver_of(robot: str) -> ik.Solver:
    """Return a solver for the robot with a table."""
    return ik.Solver(robot_of(robot), scene=ik.load_scene("table"))


@cache
def surface_of(name: str, seed: int) -> ik.Surface:
    """Return the surface of an object."""
    return ik.load_surface(name, seed=seed)


def placed(surface: ik.Surface, number: int) -> np.ndarray:
    """(4, 4) of an object at one of the poses."""
    axis, yaw = POSES[number]
    return standing(surface, yaw, axis)


def solve(cell: Cell) -> dict[str, Any]:
    """Find grasps and check them."""
    solver, surface = solver_of(cell.robot), surface_of(cell.object, cell.seed)
    pose = placed(surface, cell.pose)
    settings = {"pose": pose, "mu": MU, "seed": cell.seed}
    try:
        solver.grasps_of(
            surface, limit=1, among=1, **settings
        )  # the object's scene, the hand's table
    except ik.errors.DescriptionError as error:
        return {"count": 0, "reason": f"refused: {error}"}
    first = solver.grasps_of(surface, limit=1, among=1, **settings)
    results = solver.grasps_of(surface, limit=cell.limit, among=cell.limit, **settings)
    if not len(results):
        return {"count": 0, "reason": results.reason, "time": results.time}
    confirmed = [bool(solver.solve(result.grasp, q0=result.q).success) for result in results]
    checked_grasps = results[:: max(1, len(results) // CHECKED)][:CHECKED]
    checks = [checked(solver.robot, surface, pose, result) for result in checked_grasps]
    return {
        "count": len(results),
        "time": results.time,
        "first": first.time,
        "counts": dict(results.counts),
        "load": results[0].load,
        "confirmed": sum(confirmed),
        "off": [off for off, _ in checks],
        "closed": [closed for _, closed in checks],
    }


@cache
def _mesh(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Corners (t, 3, 3) of an object's triangles [m] and their unit normals (t, 3)."""
    vertices, triangles = surface_of(name, 0).object.mesh(resolution=96)
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    return corners[length > 0], normals[length > 0] / length[length > 0, None]


def checked(
    robot: ik.ArmHand, surface: ik.Surface, pose: np.ndarray, grasp: Any
) -> tuple[float, bool]:
    """Largest distance of a pad from the triangles [m], and whether the contacts close."""
    corners, normals = _mesh(surface.name)
    frames, back = robot.contact_frames(grasp.q), np.linalg.inv(pose)
    middles, radii = [], []
    for name in grasp.grasp.contacts:
        frame = back @ frames[robot.fingers.index(name)]
        radii.append(robot.description.finger(name).radius)
        middles.append(frame[:3, 3] - radii[-1] * frame[:3, 0])
    nearest: Any = import_module("trimesh.triangles").closest_point
    points, inward = np.zeros((2, len(middles), 3))
    for i, middle in enumerate(middles):
        feet = nearest(corners, np.broadcast_to(middle, (len(corners), 3)))
        triangle = np.linalg.norm(feet - middle, axis=1).argmin()
        points[i], inward[i] = feet[triangle], -normals[triangle]
    off = float(np.abs(np.linalg.norm(points - middles, axis=1) - radii).max())
    return off, closes(points - surface.middle, inward, surface.size / 2)


def closes(points: np.ndarray, inward: np.ndarray, length: float) -> bool:
    """Return whether soft contacts resist any small wrench, see `closure_margin`."""
    return closure_margin(points, inward, length) > 1e-9


def closure_margin(
    points: np.ndarray, inward: np.ndarray, length: float, edges: int = EDGES, turn: float = 0.0
) -> float:
    """Return the largest least share of all cone edges in balance; above 0 for force closure.

    Args:
        points: (c, 3) contacts from the reference point [m].
        inward: (c, 3) unit normals into the object.
        length: Length by which torques are divided [m].
        edges: Edges of the polyhedral friction cone.
        turn: Angle of the first edge, in steps between edges.
    """
    columns = []
    for point, normal in zip(points, inward, strict=True):
        across = np.linalg.svd(normal[None])[2][1:]
        for angle in 2 * np.pi * (np.arange(edges) + turn) / edges:
            force = normal + MU * (np.cos(angle) * across[0] + np.sin(angle) * across[1])
            columns.append([*force, *np.cross(point, force) / length])
        for spin in (1, -1):
            torque = np.cross(point, normal) + spin * 2 / 3 * MU * PATCH * normal
            columns.append([*normal, *torque / length])
    wrenches = np.array(columns).T
    g = wrenches.shape[1]
    if np.linalg.matrix_rank(wrenches, tol=1e-6) < 6:
        return 0.0
    balance = np.zeros((7, g + 1))
    balance[:6, :g], balance[6, :g] = wrenches, 1.0
    lower = np.concatenate([-np.eye(g), np.ones((g, 1))], axis=1)
    cost = np.append(np.zeros(g), -1.0)
    bounds = [(0, None)] * g + [(None, None)]
    program = linprog(cost, lower, np.zeros(g), balance, [0.0] * 6 + [1.0], bounds)
    return float(-program.fun) if program.status == 0 else 0.0


def cells(options: argparse.Namespace) -> list[Cell]:
    """Return all cells, alternating between robots."""
    settings = options.limit, options.seed
    return [
        Cell(robot, name, (pose + i) % len(POSES), *settings)
        for pose in range(len(POSES))
        for i, name in enumerate(options.objects)
        for robot in options.robots
    ]


def row_of(robot: str, results: list[dict[str, Any]], metrics: list[Metric]) -> list[str]:
    """Return the row of a robot."""
    name, good = f"touch/{robot}", [result for result in results if result["count"]]
    complete_times = [result["time"] for result in good if result["count"] >= 100]
    off = [1e3 * value for result in good for value in result["off"]]
    closed = [value for result in good for value in result["closed"]]
    count = sum(result["count"] for result in good)
    success_rate = rate_metric(f"{name}/found", len(good), len(results))
    early = median_metric(f"{name}/first", [1e3 * result["first"] for result in good], "ms")
    hundred = median_metric(f"{name}/hundred", complete_times, "s", "lower")
    rates = [result["count"] / result["time"] for result in good]
    rate = median_metric(f"{name}/rate", rates, "1/s", "higher")
    load = median_metric(f"{name}/load", [result["load"] for result in good], "N/N", "higher")
    sure = rate_metric(f"{name}/confirmed", sum(result["confirmed"] for result in good), count)
    firm = rate_metric(f"{name}/closed", sum(closed), len(closed))
    largest = max(off, default=float("nan"))
    distance_metric = Metric(f"{name}/off", largest, "mm", "lower", largest, largest, len(off))
    metrics += [success_rate, early, hundred, rate, load, sure, firm, distance_metric]
    cells = [robot, str(len(results)), str(len(results) - len(good)), str(count)]
    cells += [
        f"{early.value:.0f}",
        f"{hundred.value:.2f} ({len(complete_times)})",
        f"{rate.value:.0f}",
    ]
    cells += [f"{load.value:.2f}", f"{sum(result['confirmed'] for result in good)} of {count}"]
    return [*cells, f"{largest:.2f}", f"{sum(closed)} of {len(closed)}"]


def causes(results: list[tuple[Cell, dict[str, Any]]]) -> Iterator[list[str]]:
    """Robot, cause, how often and of what, where nothing was found."""
    causes, of = Counter[tuple[str, str]](), dict[tuple[str, str], set[str]]()
    for cell, result in results:
        if not result["count"]:
            key = cell.robot, result["reason"].rpartition("no candidate passed: ")[2]
            causes[key] += 1
            of.setdefault(key, set()).add(Path(cell.object).stem)
    for (robot, cause), number in sorted(causes.items()):
        yield [robot, cause, str(number), ", ".join(sorted(of[robot, cause]))]


def main(arguments: list[str] | None = None) -> None:
    """Find grasps and write the report."""
    parser = argparse.ArgumentParser(description="Grasps of surfaces.")
    parser.add_argument("--robots", nargs="+", default=ROBOTS)
    parser.add_argument("--objects", nargs="+", default=ik.shipped_names("objects"))
    parser.add_argument("--limit", type=int, default=100, help="grasps of an object at a pose")
    add_part_options(parser, "touch", RESULTS / "touch")
    options = parser.parse_args(arguments)
    results = complete_parts(solve, cells(options), options, "objects at poses")
    done = results.done
    metrics, rows = list[Metric](), []
    for robot in options.robots:
        robot_results = [result for cell, result in done if cell.robot == robot]
        if robot_results:
            rows.append(row_of(robot, robot_results, metrics))
    heads = ["robot", "objects at poses", "none", "grasps", "first [ms], median"]
    heads += ["100 of them [s], median (of)", "a second, median", "best load, median [N/N]"]
    heads += ["confirmed", "off, most [mm]", "closed"]
    names = ", ".join(Path(name).stem for name in options.objects)
    texts = {"objects": len(options.objects), "names": names, "limit": options.limit}
    poses, failed = (sum(int(row[i]) for row in rows) for i in (1, 2))
    result = f"Grasps are found for {poses - failed:,} of {poses:,} object poses."
    parts = [INTRODUCTION.format(checked=CHECKED, **texts), markdown_table(heads, rows)]
    parts += results.note
    reasons = list(causes(done))
    if reasons:
        table = markdown_table(
            ["robot", "stage that no candidate passed", "times", "objects"], reasons
        )
        parts += ["## None found", table]
    parts += ["## Discussion", DISCUSSION] if metrics else []
    run_by, code = command(__file__, arguments), {"touch": results.codes}
    publish("Grasps from meshes", result, parts, options.out, run_by, code, metrics)


if __name__ == "__main__":
    program(main)
