"""The lines of docs/add_an_arm_family.md add a family of arms to a copy of the package."""

from __future__ import annotations

import re

from package_copy import blocks, package_copy, run_with
from robot_variants import part_of_the_arm
from toy_robots import replace

SCRIPT = """
import sys
import numpy as np
import casadi_ik as ik

robot = ik.load_robot(sys.argv[1])
solver = ik.Solver(robot, compiled=False)
q = robot.random(np.random.default_rng(3), 5)
batch = solver.solve_batch(*robot.contacts(q))
assert batch.success.all(), batch.status
assert batch.phases["arm-placement"].all()
points, normals = robot.contacts(q[0])
contacts = zip(robot.fingers, points, normals)
grasp = ik.Grasp({name: ik.Contact(point, normal) for name, point, normal in contacts})
found = solver.solve_all(grasp, limit=8, apart=0)
assert {one.branch.wrist for one in found} <= {1, -1}
assert found and all(one.branch.swivel is None for one in found)
"""


def test_a_family_is_added_in_two_files(tmp_path):
    (tmp_path / "robot").mkdir()
    package = package_copy(tmp_path)
    family, row = blocks("add_an_arm_family.md")
    (package / "kinematics" / "arms" / "gimbal.py").write_text(family)
    registry = package / "kinematics" / "arms" / "recognise.py"
    (old,) = re.findall(r"^FAMILIES: .*$", registry.read_text(), re.MULTILINE)
    replace(registry, old, row.rstrip())
    imported = "from casadi_ik.kinematics.arms.offset_wrist"
    replace(registry, imported, f"from casadi_ik.kinematics.arms.gimbal import Gimbal\n{imported}")
    run_with(package, SCRIPT, part_of_the_arm(tmp_path / "robot", slice(4, None)))
