"""The WebAssembly module without a scene, in node; the page's test has one with a scene."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess

import pytest

import casadi_ik as ik
from casadi_ik.exporting.project import wasm_project, write_folder

pytestmark = pytest.mark.skipif(
    shutil.which("node") is None or importlib.util.find_spec("ziglang") is None,
    reason="needs node and the package ziglang",
)

WRAPPER = """
import { Solver, Status, home, motors, fingers } from "./arm.js";
const solver = await Solver.load(), found = [];
const { points, normals } = solver.contacts(home);
found.push(solver.solve(points, normals).status === Status.SOLVED);
solver.setRange(0, home[0], home[0]);
found.push(solver.solve(points, normals, home).q[0] === home[0]);
solver.setTolerance(-1, -1);
found.push(solver.solve(points, normals).status !== Status.SOLVED);
for (const wrong of [() => solver.solve([1], normals), () => solver.setRange(99, 0, 0)]) {
  try { wrong(); found.push(false); } catch (error) { found.push(error instanceof RangeError); }
}
found.push("setSolid" in solver || "COLLISION" in Status);
console.log(JSON.stringify({ found, motors, fingers }));
"""


def test_a_hand_without_a_scene(tmp_path):
    robot = ik.load_robot("ar10")
    module = tmp_path / "module"
    write_folder(module, wasm_project(robot, "arm"))
    done = subprocess.run(["node", "test.mjs"], cwd=module, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    said = json.loads(done.stdout)
    assert (said["targets"], said["wrong"], said["refused"]) == (1000, 0, True)

    (module / "use.mjs").write_text(WRAPPER)
    done = subprocess.run(["node", "use.mjs"], cwd=module, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["found"] == [True, True, True, True, True, False]
    assert tuple(said["motors"]) == tuple(robot.actuators)
    assert tuple(said["fingers"]) == tuple(robot.fingers)
    assert "setSolid" not in (module / "arm.d.ts").read_text()
