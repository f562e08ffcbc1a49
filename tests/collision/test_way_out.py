"""Remedies where every answer collides, and margins of single pairs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from collision_queries import query_of_grasps

import casadi_ik as ik
from casadi_ik.collision.distances import gaps


def test_suggested_remedies_work(robot) -> None:
    """With a ball over the cup, the stated displacement of the cup gives a free answer."""
    cup = ik.load_grasp("cup")
    ball = {"kind": "sphere", "radius": 0.16, "xyz": (cup.object_pose[:3, 3] + [0.1, 0, 0.2])}
    solver = ik.Solver(robot, scene=ik.Scene({"ball": ball}))
    solution = solver.solve(cup)
    assert solution.status is ik.Status.COLLISION
    remedies = solution.collision.way_out
    assert 0 < np.linalg.norm(remedies.translation) <= remedies.max_translation
    pose = cup.object_pose.copy()
    pose[:3, 3] += remedies.translation
    assert solver.solve(cup.in_object_frame().at(pose)).success
    lines = "\n".join(solution.collision.lines)
    assert f"moved by {1e3 * np.linalg.norm(remedies.translation):.0f} mm" in lines
    for name in remedies.dispensable:
        fewer = {key: c for key, c in cup.contacts.items() if key != name}
        assert solver.solve(dataclasses.replace(cup, contacts=fewer)).success
        assert name in lines
    assert solver.solve(cup, diagnose=False).collision.way_out is None


def test_an_object_is_not_moved_into_the_table() -> None:
    scene = ik.Scene(
        {
            "table": {"kind": "box", "size": [1, 1, 0.1], "xyz": [0, 0, -0.05]},
            "wall": {"kind": "half-space", "xyz": [0, 0.2, 0], "rpy": [np.pi / 2, 0, 0]},
            "cup": {"kind": "cylinder", "radius": 0.04, "length": 0.1, "xyz": [0, 0, 0.05]},
            "pole": {"kind": "capsule", "radius": 0.01, "length": 0.2, "xyz": [0.1, 0, 0.1]},
        }
    )
    other_items = [item for name, item in scene.items.items() if name != "cup"]
    shifts = np.array([[0, 0, 0.02], [0, 0, -0.02], [0, 0.17, 0.02], [0.06, 0, 0.05]])
    poses = np.repeat(scene.items["cup"].pose[None], 5, axis=0)
    poses[:4, :3, 3] += shifts
    poses[4, :3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # it lies on the air, 40 mm thick below
    distances = gaps(scene.items["cup"], other_items, poses)
    np.testing.assert_allclose(distances, [0.02, -0.02, -0.01, -0.01, 0.01], atol=2e-3)


def test_margins_of_single_pairs(robot) -> None:
    """The margin of a pair overrides other margins; the clearance is unchanged."""
    post = {"kind": "box", "size": [0.1, 0.1, 0.4], "xyz": [0.5, 0.5, 0.2], "margin": 0.03}
    smaller_margins = [{"links": ["lwr_link_6", "post"], "margin": 0.002}]
    clearances = []
    for margins, expected_margin in (((), 0.03), (smaller_margins, 0.002)):
        scene = ik.Scene({"post": post}, margin=0.01, margins=margins)
        solver = ik.Solver(robot, scene=scene, compiled=False)
        around = query_of_grasps(solver, [ik.load_grasp("cup")])
        of_pair = np.array([set(names) == {"lwr_link_6", "post"} for names in around.table.names])
        verdict = around.with_table(around.table.select(of_pair)).check(robot.home[None])
        clearances.append(float(verdict.distance[0]))
        assert verdict.surplus[0] == pytest.approx(verdict.distance[0] - expected_margin)
    assert clearances[0] == pytest.approx(clearances[1])


@pytest.mark.parametrize(
    ("margin", "message"),
    [
        (
            {"links": ["moon", "a"], "margin": 0.1},
            r"margins\[0\].links: 'moon' is unknown; expected one of: a",
        ),
        ({"links": ["a", "lwr_link_6"], "margin": -1}, r"margins\[0\].margin: found -1, expected"),
        ({"links": ["a", "a"], "margin": float("nan")}, r"margins\[0\].margin: found nan"),
    ],
)
def test_bad_margins_are_named(robot, margin, message) -> None:
    box = {"kind": "box", "size": [1, 1, 1], "xyz": [3, 0, 0]}
    with pytest.raises(ik.errors.DescriptionError, match=message):
        ik.Solver(robot, scene=ik.Scene({"a": box}, margins=[margin]), compiled=False)
