"""The study of bodies runs, goes on where it was, and counts all targets of its parts."""

from __future__ import annotations

import numpy as np
import one_body

import casadi_ik as ik


def test_random_search_finds_exactly_the_solutions():
    robot = ik.load_robot("mobile_kuka_lwr_barrett")
    among, plain = ik.Solver(robot, scene=ik.Scene()), ik.Solver(robot)
    free = one_body.untouched(among, 1, 0)
    points, normals = robot.contacts(free)
    assert one_body.random_search(among, plain, points[0], normals[0], 0)
    assert not one_body.random_search(among, plain, points[0] + [0, 0, 9.0], normals[0], 0)


def test_perturbed_targets_keep_tolerances():
    robot, tolerance = ik.load_robot("g1+dex3"), ik.Tolerance()
    points, normals = robot.contacts(robot.home)
    moved_points, turned_normals = one_body.around(points, normals, 500, np.random.default_rng(0))
    off = np.linalg.norm(moved_points - points, axis=2)
    angle = np.arccos(np.clip((turned_normals * normals).sum(axis=2), -1, 1))
    for errors, tolerance_value in ((off, tolerance.position), (angle, tolerance.angle)):
        assert 0.99 * tolerance_value < errors.max() <= tolerance_value * (1 + 1e-9)
