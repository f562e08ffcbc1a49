"""Seeds of the search for nearest configurations."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik.model.targets import TargetBatch
from casadi_ik.solve.nearest_seeds import SeedTable


@pytest.mark.parametrize("name", ["kuka_lwr_barrett", "g1+dex3"])
def test_seeds_differ_and_come_nearer_than_random_configurations(name):
    robot = ik.load_robot(name)
    q = robot.random(np.random.default_rng(0), 4)
    points, normals = robot.contacts(q)
    targets = TargetBatch(points, normals, ik.Tolerance(), enforce_limits=True)
    weights = np.ones((4, len(robot.fingers), 2))
    owner, seeds = SeedTable(robot).find(targets, weights, robot.lower, robot.upper)
    random = robot.random(np.random.default_rng(1), len(seeds))
    for target in range(4):
        rows = owner == target
        assert len(np.unique(seeds[rows], axis=0)) == rows.sum() >= 32
        distances = [
            np.linalg.norm(robot.contacts(samples[rows])[0] - points[target], axis=2).mean(axis=1)
            for samples in (seeds, random)
        ]
        assert np.median(distances[0]) < 0.7 * np.median(distances[1])
