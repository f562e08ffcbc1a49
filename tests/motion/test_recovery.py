"""A follower that is stuck after an excursion of its target recovers."""

from __future__ import annotations

import numpy as np
import pytest
from collision_queries import query_at
from excursions import excursion

import casadi_ik as ik

PERIOD = 0.01


def free_starts(robot, count):
    """Return postures (count, n) without self-collision."""
    careful, rng = ik.Solver(robot, scene=ik.Scene()), np.random.default_rng(7)
    starts = robot.home + 0.5 * (robot.random(rng, 100) - robot.home)
    return starts[clearances(careful, starts).free][:count]


def clearances(solver, q):
    return query_at(solver, q[:1]).check(q)


@pytest.mark.parametrize("kind", ["out", "turn"])
@pytest.mark.parametrize(
    ("name", "has_scene"),
    [
        ("kuka_lwr_barrett", False),
        *(
            pytest.param(name, has_scene, marks=pytest.mark.slow)
            for name, has_scene in (
                ("kuka_lwr_barrett", True),
                ("panda+allegro_right", True),
                ("ur5e+shadow", True),
                ("g1+dex3", True),
                ("g1+dex3", False),
            )
        ),
    ],
)
def test_returning_target_is_followed_again(name, has_scene, kind):
    robot = ik.load_robot(name)
    solver = ik.Solver(robot, scene=ik.Scene() if has_scene else None)
    for start in free_starts(robot, 10):
        follower = solver.follow(start, PERIOD)
        path = [start, start]
        path += [follower(*target) for target in excursion(robot, start, kind, PERIOD)]
        q = np.array(path)
        assert follower.state.status is ik.motion.FollowStatus.FOLLOWING
        assert not has_scene or clearances(solver, q).free.all()
        steps = np.diff(q, axis=0)
        assert (np.abs(steps) <= follower.velocity * PERIOD * (1 + 1e-9)).all()
        changes = np.diff(steps, axis=0)
        assert (np.abs(changes) <= follower.acceleration * PERIOD**2 * (1 + 1e-9) + 1e-12).all()
        assert (q >= robot.lower).all()
        assert (q <= robot.upper).all()
