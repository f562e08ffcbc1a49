"""What it takes to choose among many grasps of one object, with and without a scene."""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from runner import markdown_table

import casadi_ik as ik
from casadi_ik.arrays import Array

CANDIDATES = 500
RUNS = 5
"""Of each the median is taken."""

PLACE = (0.5, 0.1, 0.3)
"""Of the object [m]."""

SCENE = """\
name: table and bottle
description: The table, and a bottle beside the object.
margin: 0 mm
solids:
  table: {kind: box, size: [2 m, 2 m, 40 mm], xyz: [0, 0, -20 mm]}
  bottle: {kind: box, size: [80 mm, 80 mm, 300 mm], xyz: [450 mm, -150 mm, 150 mm]}
"""

TEXT = f"""{CANDIDATES} grasps in the frame of an object at {PLACE} m, hands at random about it:
random postures, whichever way the hand comes from, as contacts or as palms with the posture. The
ten preferred (`prefer="q0"`) are asked for, free of collision where there is a scene: the table on
which the robot stands, and a bottle beside the object. Processor's time of one thread, median of
{RUNS}; *plain:* over what `solve_batch` takes for as many random reachable targets in the same run.
"""


def chosen(robot: ik.ArmHand) -> list[dict[str, Any]]:
    """Figures of palms and contacts, without a scene and with one."""
    contacts, palms = candidates(robot)
    pose = np.eye(4)
    pose[:3, 3] = PLACE
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scene.yaml"
        path.write_text(SCENE)
        scene = ik.load_scene(path)
    solvers = {"no": ik.Solver(robot), "yes": ik.Solver(robot, scene=scene)}
    points, normals = robot.contacts(robot.random(np.random.default_rng(1), CANDIDATES))
    plain = _median(lambda: solvers["no"].solve_batch(points, normals))
    rows = []
    for given, grasps in (("palms", palms), ("contacts", contacts)):
        for around, solver in solvers.items():
            ranking = solver.choose(grasps, pose, robot.home)
            spent = _median(lambda s=solver, g=grasps: s.choose(g, pose, robot.home))
            rows.append(
                {
                    "given": given,
                    "scene": around,
                    "answered": ranking.answered,
                    "seconds": spent,
                    "plain": plain,
                }
            )
    return rows


def _median(run: Any) -> float:
    run()
    found = []
    for _ in range(RUNS):
        begin = time.thread_time()
        run()
        found.append(time.thread_time() - begin)
    return float(np.median(found))


def candidates(robot: ik.ArmHand) -> tuple[list[ik.Grasp], list[ik.Grasp]]:
    """The same grasps as contacts and as palms, in the frame of an object amid the fingertips."""
    rng = np.random.default_rng(0)
    q = robot.random(rng, CANDIDATES)
    turns = np.linalg.qr(rng.normal(size=(CANDIDATES, 3, 3)))[0]
    turns[:, :, 0] *= np.linalg.det(turns)[:, None]
    palm = robot.palm(q)
    points, normals = robot.contacts(q)
    # Seen from the palm, then turned about the middle of the fingertips.
    points = (points - palm[:, None, :3, 3]) @ palm[:, :3, :3]
    normals = normals @ palm[:, :3, :3]
    middle = points.mean(axis=1)
    palms = np.tile(np.eye(4), (CANDIDATES, 1, 1))
    palms[:, :3, :3], palms[:, :3, 3] = turns, -_turned(turns, middle[:, None])[:, 0]
    points, normals = _turned(turns, points - middle[:, None]), _turned(turns, normals)
    motors = robot.description.finger_motors
    hands = q[:, [robot.actuators.index(name) for name in motors]]
    return (
        [
            ik.Grasp({n: ik.Contact(*c) for n, *c in zip(robot.fingers, *one, strict=True)})
            for one in zip(points, normals, strict=True)
        ],
        [
            ik.Grasp(palm=one, posture=dict(zip(motors, hand.tolist(), strict=True)))
            for one, hand in zip(palms, hands, strict=True)
        ],
    )


def _turned(turns: Array, vectors: Array) -> Array:
    """(k, f, 3) vectors turned by (k, 3, 3)."""
    return vectors @ np.swapaxes(turns, 1, 2)


def choice_table(found: dict[str, list[dict[str, Any]]]) -> str:
    """The table of all robots."""
    rows = [
        [
            robot,
            one["given"],
            one["scene"],
            str(one["answered"]),
            f"{1e3 * one['seconds']:.0f}",
            f"{one['seconds'] / one['plain']:.1f}",
        ]
        for robot, some in found.items()
        for one in some
    ]
    heads = ["robot", "given", "scene", "have an answer", f"{CANDIDATES} grasps [ms CPU]"]
    return markdown_table([*heads, "over plain"], rows)
