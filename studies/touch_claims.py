"""Check what `grasps_of` claims of its grasps, by means that share nothing with the package.

Fifteen meshes stand on a table before eight arm-hands. Every grasp is checked against the mesh:
distances and normals by trimesh, force closure by a linear program of SciPy, fingertips and links
by the robot's public forward kinematics. A run that is stopped continues where it was::

    python studies/touch_claims.py --minutes 40
    python studies/touch_claims.py --robots panda+allegro_right --meshes torus bowl --limit 20
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
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
    program,
    publish,
    rate_metric,
)
from runner.study import standing
from touch import MU, closure_margin, solver_of

import casadi_ik as ik

ROBOTS = (
    "panda+allegro_right",
    "ur5e+shadow",
    "panda+leap",
    "kuka_lwr_barrett",
    "panda+unitree_dex3",
    "ur10e+robotiq_3f",
    "panda+panda_hand",
    "ur10e+robotiq_2f85",
)

EDGES, FIRST_EDGE = 12, 0.3
"""Edges of the polyhedral friction cone, and angle of the first in steps between edges."""

MAX_DISTANCE = 1.2e-3
"""Largest distance of a stated contact from the mesh [m]."""

MAX_LEAN = {False: np.deg2rad(15.0), True: np.deg2rad(40.0)}
"""Largest angle between pad normal and inward surface normal [rad]; by whether a pad is a ball."""

MAX_DEPTH = 1e-4
"""Largest depth of a link that must not touch the object [m]; distances are exact to 0.1 um."""

EQUAL_NORMALS = 1e-9
"""Triangles are equally near if their distances differ by less than this [m]."""

INTRODUCTION = """
{meshes} meshes on a table before {robots} arm-hands; asked for are {limit} distinct grasps each, of
three fingertips at most, with friction 0.5. Every grasp is checked by means that share nothing with
`grasps_of`: distances and normals by trimesh, force closure by SciPy's `linprog` with soft contacts
(twelve edges a cone), fingertips and links by the robot's public forward kinematics. Where several
triangles are equally near to a contact, the one with the largest violation counts.

- *not closed*: the contacts do not resist every small force and torque, although `load` is above 0.
- *outside the cone*: a force of `forces` is outside the friction cone at its contact.
- *leaning*: a pad normal and the inward surface normal differ by more than 15 deg (balls: 40 deg).
- *off*: a stated contact is more than 1.2 mm from the mesh.
- *deep*: the capsule of a link that must not touch the object is inside it.
"""


def _revolved(*profile: tuple[float, float]) -> Any:
    """Return the body that a profile of (radius, height) [m] sweeps about z."""
    return import_module("trimesh.creation").revolve(np.array(profile), sections=40)


def _extruded(*outline: tuple[float, float], height: float) -> Any:
    """Return the prism over an outline of (x, y) [m] that is star-shaped about its first corner."""
    trimesh: Any = import_module("trimesh")
    flat, n = np.array(outline), len(outline)
    low, high = (np.column_stack([flat, np.full(n, z)]) for z in (-height / 2, height / 2))
    fan = np.array([[0, i, i + 1] for i in range(1, n - 1)])
    sides = [
        row
        for i in range(n)
        for row in ([i, (i + 1) % n, (i + 1) % n + n], [i, (i + 1) % n + n, i + n])
    ]
    faces = np.concatenate([fan[:, ::-1], fan + n, sides])
    return trimesh.Trimesh(np.concatenate([low, high]), faces)


def _bumpy() -> Any:
    """Return a ball with waves of 2 mm."""
    ball: Any = import_module("trimesh.creation").icosphere(4, 0.035)
    direction = ball.vertices / 0.035
    waves = 0.002 * np.sin(9 * direction[:, 0]) * np.sin(7 * direction[:, 1] + 1)
    ball.vertices += waves[:, None] * direction
    return ball


def _mug() -> Any:
    """Return a cup with half a torus as its handle, two pieces."""
    trimesh: Any = import_module("trimesh")
    cup = _revolved((0, 0), (0.038, 0), (0.04, 0.09), (0.036, 0.09), (0.034, 0.006), (0, 0.006))
    handle = trimesh.creation.torus(0.025, 0.006)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    handle.apply_translation([0.046, 0, 0.045])
    return trimesh.util.concatenate([cup, handle])


def _scaled(shape: Any, *factors: float) -> Any:
    shape.apply_scale(factors)
    return shape


def _creation(name: str, *arguments: Any, **options: Any) -> Any:
    return getattr(import_module("trimesh.creation"), name)(*arguments, **options)


MESHES: dict[str, Callable[[], Any]] = {
    "box": lambda: _creation("box", (0.05, 0.07, 0.12)),
    "can": lambda: _creation("cylinder", 0.033, 0.1, sections=128),
    "coarse_can": lambda: _creation("cylinder", 0.036, 0.1, sections=16),
    "capsule": lambda: _creation("capsule", 0.09, 0.028),
    "ball": lambda: _creation("icosphere", 4, 0.034),
    "coarse_ball": lambda: _creation("icosphere", 2, 0.036),
    "cone": lambda: _revolved((0, 0), (0.045, 0), (0.018, 0.12), (0, 0.12)),
    "torus": lambda: _creation("torus", 0.045, 0.017),
    "ellipsoid": lambda: _scaled(_creation("icosphere", 4, 1.0), 0.03, 0.04, 0.06),
    "hexagon": lambda: _creation("cylinder", 0.035, 0.1, sections=6),
    "angle_bar": lambda: _extruded(
        (0.015, 0.015), (0, 0.08), (0, 0), (0.08, 0), (0.08, 0.015), height=0.06
    ),
    "bottle": lambda: _revolved(
        (0, 0), (0.033, 0), (0.035, 0.08), (0.03, 0.1), (0.014, 0.13), (0.013, 0.16), (0, 0.16)
    ),
    "bowl": lambda: _revolved(
        (0, 0), (0.035, 0), (0.06, 0.03), (0.065, 0.06), (0.06, 0.06), (0.053, 0.03), (0, 0.008)
    ),
    "bumpy_ball": _bumpy,
    "mug": _mug,
}


@dataclass(frozen=True)
class Cell:
    """A robot before a mesh.

    Attributes:
        robot: Name of the robot.
        mesh: Name of the mesh.
        limit: Number of grasps asked for.
        seed: Seed of all random numbers.
        size: Weight of the cell for the progress bar.
    """

    robot: str
    mesh: str
    limit: int
    seed: int
    size: int = 1

    @property
    def path(self) -> Path:
        """File of the results, relative to the folder of parts."""
        return Path(self.robot) / f"{self.mesh}-{self.limit}-{self.seed}.json"


@cache
def surface_of(mesh: str) -> tuple[ik.Surface, Any]:
    """Return the surface of a mesh and the mesh, read from a file of triangles alone."""
    path = Path(_folder().name) / f"{mesh}.stl"
    MESHES[mesh]().export(path)
    return ik.load_surface(path), import_module("trimesh").load_mesh(path)


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    """Return a folder for meshes that exists as long as the process."""
    return tempfile.TemporaryDirectory()


def solve(cell: Cell) -> dict[str, Any]:
    """Find grasps of a mesh and check them."""
    surface, mesh = surface_of(cell.mesh)
    solver, pose = solver_of(cell.robot), standing(surface, 0.7)
    grasps = solver.grasps_of(
        surface, pose, mu=MU, limit=cell.limit, among=cell.limit, seed=cell.seed
    )
    checks = [check(solver.robot, mesh, pose, grasp) for grasp in grasps]
    return {"count": len(grasps), "counts": dict(grasps.counts), "violations": checks}


@dataclass(frozen=True)
class Feet:
    """Points of a mesh that are nearest to given points.

    Attributes:
        point: (k, 3) nearest points [m].
        distance: (k,) distances [m].
        normals: By point the outward normals of all triangles that are equally near.
    """

    point: np.ndarray
    distance: np.ndarray
    normals: list[np.ndarray]


def feet(mesh: Any, points: np.ndarray) -> Feet:
    """Return the nearest points of a mesh, by trimesh and over all triangles."""
    triangles = mesh.triangles[mesh.area_faces > 0]
    normals = mesh.face_normals[mesh.area_faces > 0]
    closest: Any = import_module("trimesh.triangles").closest_point
    nearest, distances, normals_of_contact = [], [], []
    for point in points:
        nearest_points = closest(triangles, np.broadcast_to(point, (len(triangles), 3)))
        distance = np.linalg.norm(nearest_points - point, axis=1)
        ties = np.flatnonzero(distance <= distance.min() + EQUAL_NORMALS)
        nearest.append(nearest_points[ties[0]])
        distances.append(distance[ties[0]])
        normals_of_contact.append(normals[ties])
    return Feet(np.array(nearest), np.array(distances), normals_of_contact)


def check(robot: ik.ArmHand, mesh: Any, pose: np.ndarray, grasp: Any) -> dict[str, Any]:
    """Compare the claims of a grasp with the mesh.

    Args:
        robot: The robot.
        mesh: A trimesh object, in the object's frame [m].
        pose: (4, 4) pose of the object in the base frame.
        grasp: The grasp.

    Returns:
        Whether each claim is violated, and by how much.
    """
    points, normals = robot.contacts(grasp.q)
    names = list(grasp.grasp.contacts)
    rows = [robot.fingers.index(name) for name in names]
    radii = np.array([robot.description.finger(name).radius for name in names])
    back = np.linalg.inv(pose)
    local = (points - radii_of(robot)[:, None] * normals)[rows] @ back[:3, :3].T + back[:3, 3]
    pads = normals[rows] @ back[:3, :3].T
    stated = np.array([grasp.grasp.contacts[name].point for name in names])
    stated = stated @ back[:3, :3].T + back[:3, 3]
    forces = np.array([grasp.forces[name] for name in names]) @ back[:3, :3].T
    pad_feet, stated_feet = feet(mesh, local), feet(mesh, stated)
    distance = max(
        float(stated_feet.distance.max()), float(np.abs(pad_feet.distance - radii).max())
    )
    lean = cone = -np.inf
    for i, normals_of_contact in enumerate(stated_feet.normals):
        inward = -np.concatenate([normals_of_contact, pad_feet.normals[i]])
        leans = np.arccos(np.clip(inward @ pads[i], -1, 1)) - MAX_LEAN[bool(radii[i])]
        pressed = inward @ forces[i]
        sliding = np.linalg.norm(forces[i] - pressed[:, None] * inward, axis=1)
        lean, cone = max(lean, leans.max()), max(cone, (sliding - MU * pressed).max())
    inward = -np.array([normals_of_contact[0] for normals_of_contact in stated_feet.normals])
    center, length = mesh.bounds.mean(axis=0), float(mesh.extents.max()) / 2
    margin = closure_margin(stated_feet.point - center, inward, length, EDGES, FIRST_EDGE)
    depth = link_depth(robot, mesh, back, grasp)
    return {
        "not closed": bool(grasp.load > 0 and margin <= 1e-9),
        "outside the cone": bool(cone > 1e-6),
        "leaning": bool(lean > 1e-6),
        "off": bool(distance > MAX_DISTANCE),
        "deep": bool(depth > MAX_DEPTH),
        "worst": {
            "margin": margin,
            "cone": float(cone),
            "lean": float(lean),
            "distance": distance,
            "depth": depth,
        },
    }


CLAIMS = ("not closed", "outside the cone", "leaning", "off", "deep")


def radii_of(robot: ik.ArmHand) -> np.ndarray:
    """Return the radii (f,) of the fingertip pads [m], 0 for planes."""
    return np.array([robot.description.finger(name).radius for name in robot.fingers])


def link_depth(robot: ik.ArmHand, mesh: Any, back: np.ndarray, grasp: Any) -> float:
    """Return how deep a link that must not touch the object is in it [m], 0 if none is.

    The axes of the links' capsules are sampled; links fixed to the pad of a finger that touches may
    be in the object.
    """
    joints = {joint.child: joint for joint in robot.description.joints}

    def body(link: str) -> str:
        while link in joints and joints[link].type == "fixed":
            link = joints[link].parent
        return link

    touching = {body(robot.description.finger(name).link) for name in grasp.grasp.contacts}
    poses, axes, radii = robot.links(grasp.q), [], []
    for capsule in robot.description.shapes.capsules:
        if capsule.covers >= 0 or body(capsule.link) in touching:
            continue
        count = 2 + int(2 * np.linalg.norm(capsule.half_axis) / 4e-3)
        axis_points = capsule.center + np.linspace(-1, 1, count)[:, None] * capsule.half_axis
        pose = back @ poses[capsule.link]
        axes.append(axis_points @ pose[:3, :3].T + pose[:3, 3])
        radii.append(np.full(count, capsule.radius))
    points, radius = np.concatenate(axes), np.concatenate(radii)
    low, high = mesh.bounds
    outside = np.linalg.norm(points - np.clip(points, low, high), axis=1)
    is_near = outside < radius
    if not is_near.any():
        return 0.0
    return float(max(0.0, (radius[is_near] - signed_distances(mesh, points[is_near])).max()))


def signed_distances(mesh: Any, points: np.ndarray) -> np.ndarray:
    """Return the distances (k,) of points (k, 3) from the surface of a mesh [m], negative inside.

    The winding number decides the sign. The normal of the nearest triangle does not, because at an
    edge several triangles are equally near and their normals disagree.
    """
    is_inside = winding_numbers(mesh, points) > 0.5
    return np.where(is_inside, -1.0, 1.0) * feet(mesh, points).distance


def winding_numbers(mesh: Any, points: np.ndarray) -> np.ndarray:
    """Return how often a closed mesh encloses each of the points (k, 3), about 0 outside it.

    The signed solid angles of all triangles are summed (van Oosterom and Strackee 1983).
    """
    winding = np.zeros(len(points))
    for i, point in enumerate(points):
        a, b, c = np.moveaxis(mesh.triangles - point, 1, 0)
        la, lb, lc = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
        volume = (a * np.cross(b, c)).sum(axis=1)
        products = (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
        winding[i] = np.arctan2(volume, la * lb * lc + products).sum() / (2 * np.pi)
    return winding


def cells(options: argparse.Namespace) -> list[Cell]:
    """Return all cells, so that the first ones are of every robot."""
    return [
        Cell(robot, mesh, options.limit, options.seed)
        for mesh in options.meshes
        for robot in options.robots
    ]


def row_of(robot: str, results: list[dict[str, Any]], metrics: list[Metric]) -> list[str]:
    """Return a robot's row of the table and append its metrics."""
    checks = [check for result in results for check in result["violations"]]
    row = [robot, str(len(results)), str(len(checks))]
    for claim in CLAIMS:
        violations = sum(check[claim] for check in checks)
        row.append(str(violations))
        name = f"touch_claims/{robot}/{claim.replace(' ', '_')}"
        metrics.append(rate_metric(name, len(checks) - violations, len(checks)))
    worst = max((check["worst"]["distance"] for check in checks), default=float("nan"))
    return [*row, f"{1e3 * worst:.2f}"]


def main(arguments: list[str] | None = None) -> None:
    """Find grasps, check them and write the report."""
    parser = argparse.ArgumentParser(description="Claims of grasps of surfaces.")
    parser.add_argument("--robots", nargs="+", default=ROBOTS)
    parser.add_argument("--meshes", nargs="+", default=list(MESHES), choices=list(MESHES))
    parser.add_argument("--limit", type=int, default=40, help="grasps per mesh and robot")
    add_part_options(parser, "touch_claims", RESULTS / "touch_claims")
    options = parser.parse_args(arguments)
    results = complete_parts(solve, cells(options), options, "meshes before robots")
    done = results.done
    metrics, rows = list[Metric](), []
    for robot in options.robots:
        robot_results = [result for cell, result in done if cell.robot == robot]
        if robot_results:
            rows.append(row_of(robot, robot_results, metrics))
    heads = ["robot", "meshes", "grasps", *CLAIMS, "farthest contact [mm]"]
    sizes = {"meshes": len(options.meshes), "robots": len(options.robots)}
    checks = [check for _, result in done for check in result["violations"]]
    faulty = sum(any(check[claim] for claim in CLAIMS) for check in checks)
    result = f"{faulty or 'None'} of {len(checks):,} grasps violates a checked property."
    introduction = INTRODUCTION.format(limit=options.limit, **sizes)
    parts = [introduction, markdown_table(heads, rows), *results.note]
    run_by, code = command(__file__, arguments), {"touch_claims": results.codes}
    heading = "Checked properties of grasps from meshes"
    publish(heading, result, parts, options.out, run_by, code, metrics)


if __name__ == "__main__":
    program(main)
