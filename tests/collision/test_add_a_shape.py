"""The lines of docs/add_a_shape.md add a kind of solid to a copy of the package."""

from __future__ import annotations

from pathlib import Path

import pytest
from capsule_arm import write_robot
from package_copy import blocks, package_copy, run_with
from toy_robots import replace

SCRIPT = """
import sys
import numpy as np
import casadi_ik as ik

robot = ik.load_robot(sys.argv[1])
wall = {"kind": "slab", "thickness": 0.02, "xyz": [0.35, 0, 0], "rpy": [0, np.pi / 2, 0]}
box = {"kind": "box", "size": [9.0, 9.0, 0.02], "xyz": [0.35, 0, 0], "rpy": [0, np.pi / 2, 0]}
q = robot.random(np.random.default_rng(0), 200)
points, normals = robot.contacts(robot.home)
contacts = {name: ik.Contact(p, n) for name, p, n in zip(robot.fingers, points, normals)}
found = []
for solid in (wall, box):
    for compiled in (True, False):
        solver = ik.Solver(robot, scene=ik.Scene({"wall": solid}), compiled=compiled)
        found.append(solver.check(q, ik.Grasp(contacts)).distance)
for other in found[1:]:
    np.testing.assert_allclose(found[0], other, atol=3e-7)
assert (found[0] < 0).any() and (found[0] > 0).any()
try:
    ik.Scene({"wall": {**wall, "thickness": -1}})
except ik.errors.DescriptionError as error:
    assert "solids.wall.thickness: found -1" in str(error), error
"""


@pytest.mark.slow
def test_a_kind_is_added_in_three_files(tmp_path: Path) -> None:
    package = package_copy(tmp_path)
    name, row, make, entry = blocks("add_a_shape.md")
    distance, call = blocks("add_a_shape.md", "c")
    solids = package / "collision" / "solids.py"
    replace(solids, "    CLOUD = 5\n", f"    CLOUD = 5\n{name}")
    replace(solids, '}\n"""Properties of all kinds', f'{row}}}\n"""Properties of all kinds')
    replace(solids, "def half_space()", f"{make}\n\ndef half_space()")
    driver = package / "compile" / "runtime" / "clearance.c"
    original = "static LANES_TARGET along distance_along("
    replace(driver, original, f"{distance}\n{original}")
    first = "  if (shape->kind == BOX)"
    replace(driver, first, f"{call}{first}")
    scene = package / "collision" / "scene_file.py"
    replace(
        scene,
        "SolidEntry = (\n    BoxEntry",
        f"{entry}\n\nSolidEntry = (\n    SlabEntry | BoxEntry",
    )
    replace(scene, "    half_space,\n", "    half_space,\n    slab,\n")
    run_with(package, SCRIPT, write_robot(tmp_path))
