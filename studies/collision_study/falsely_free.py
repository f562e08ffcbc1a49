"""Whether anything is called free that coal calls penetrating: random configurations in parts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

import casadi_ik as ik
from casadi_ik.problem.clearance import SceneCheck, Surroundings
from collision_study.oracles import CoalOracle
from collision_study.search import MICROMETRE, surroundings

SIZE = 50_000
"""Configurations of a part."""

OTHERS = 50
"""Of so many configurations one that is not free is checked by coal as well: it takes 1.4 ms."""

SCENE = {
    "table": {"kind": "box", "size": [1.6, 1.6, 0.04], "xyz": [0.0, 0.0, -0.1]},
    "post": {"kind": "cylinder", "radius": 0.06, "length": 0.6, "xyz": [0.45, 0.25, 0.3]},
}

ROBOT = "panda+allegro_right"


@dataclass(frozen=True)
class Part:
    """Some random configurations.

    Attributes:
        number: Of the part.
        seed: Of the study.
        size: How many.
    """

    number: int
    seed: int
    size: int


@cache
def the_check() -> tuple[ik.ArmHand, Surroundings, CoalOracle]:
    """The robot, what it is checked against, and the same by coal; made once in a process."""
    robot = ik.load_robot(ROBOT)
    points, normals = (each[0] for each in robot.contacts(robot.home[None]))
    names = zip(robot.fingers, points, normals, strict=True)
    grasp = ik.Grasp({name: ik.Contact(point, normal) for name, point, normal in names})
    around = surroundings(SceneCheck(robot, ik.Scene(SCENE)), robot, grasp)
    return robot, around, CoalOracle(robot, around)


def solve_part(part: Part) -> dict[str, int]:
    """How many are free, and how many of them are not for coal; of some others the other way."""
    robot, around, coal = the_check()
    q = robot.random(np.random.default_rng([part.seed, part.number]), part.size)
    free = around.free(q)
    others = q[~free][: part.size // OTHERS]
    return {
        "checked": len(q),
        "free": int(free.sum()),
        "falsely_free": int(coal.penetrating(q[free], MICROMETRE).sum()),
        "others": len(others),
        "falsely_touching": int((~coal.penetrating(others, MICROMETRE)).sum()),
    }
